"""`Solution`: the measured layers of a burst, and how well they explain it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import cv2
import numpy as np

from brewster.film.motion.mixed_scenes import MixedScenes
from brewster.film.motion.model.joint_model import Floats, JointModel
from brewster.film.motion.side_by_side import SideBySide

_ERROR_AT_1_E: Final = 0.05
"""The error of the frames at which the confidence is 1/e."""
_MIN_UNEXPLAINED: Final = 0.02
_UNEXPLAINED_TIMES: Final = 5
"""The smallest error of the frames that neither layer explains: this, and this often the median of
the photo.
"""
MIN_COMPARED_MOTION: Final = 0.01
"""At 160 pixels, a smaller relative motion is less than two pixels."""
_ERROR_SMOOTHING: Final = 0.025
"""The standard deviation, as a share of the long side, that smooths the errors of the frames."""


@final
@dataclass(frozen=True)
class Solution:
    """Both layers of the reference frame, and how well they explain the burst."""

    measured: Floats
    """T and R by the motion, (2, h, w, 3) linear light."""
    predicted: Floats
    """T and R of the single photo, (2, h, w, 3)."""
    frame_errors: Floats
    """(h, w): the mean errors of the frames, as differences of square roots of light, at each pixel
    of T.
    """
    relative_motion: float
    """The largest motion of R relative to T between two frames, as a share of the width of a frame.
    """
    naming: float
    """How clearly T and R are told apart, at 160 pixels: about 0 if they may have each other's
    names.
    """
    edge_correlation: float
    """The correlation of the strengths of the edges of both layers, at 160 pixels: about 0 for two
    scenes, and more if a wrong motion makes the second layer a copy of the first.
    """
    one_layer_error: float
    """The mean error of the frames if both layers move together: the data term of the loss at the
    level that compared the candidates, of 160 or 320 pixels.
    """
    two_layer_error: float
    """The same for the best candidate."""
    small_motion_evidence: float = 0.0
    """The share of the change between the aligned frames that a small motion explains, 0..1; 0 if
    none was looked for. See small_motions.py.
    """
    is_small: bool = False
    """Whether the layers have this small motion."""
    side_by_side: SideBySide | None = None
    """How well two images side by side explain the frames. None if there are opaque objects, which
    lie side by side with the wall.
    """
    mixed_scenes: MixedScenes | None = None
    """How the frames would move the layers where R has more detail than T."""
    without_glass: Floats | None = None
    """Where the photo shows no glass, (h, w, 1) in 0..1; see pane.py. Of the names that the layers
    have.
    """
    model: JointModel | None = None
    """The layers on their canvases and the motions of the frames, in the order in which they were
    solved. Not exchanged by `swapped`.
    """

    @property
    def nbytes(self) -> int:
        """The memory of its arrays and of those of its model."""
        return sum(
            part.nbytes
            for part in vars(self).values()
            if isinstance(part, np.ndarray | JointModel | SideBySide)
        )

    @property
    def confidence(self) -> Floats:
        """(h, w, 1) in 0..1: how well the frames agree with their prediction at each pixel of the
        transmission; 0 where the layers are doubtful.
        """
        confidence: Floats = np.exp(-self.frame_errors / _ERROR_AT_1_E)[..., None]
        return confidence * (1 - self.doubtful)

    @property
    def is_side_by_side(self) -> bool:
        """Whether no place shows both layers, or two scenes that lie side by side became one layer.
        A small motion does not tell.
        """
        if self.relative_motion < MIN_COMPARED_MOTION:
            return False
        found = self.side_by_side, self.mixed_scenes
        return any(each is not None and each.is_likely for each in found)

    @property
    def doubtful(self) -> Floats:
        """(h, w, 1) in 0..1: where the layers are doubtful: everywhere, or where neither of them
        explains the frames.
        """
        unexplained = self.unexplained
        return np.ones_like(unexplained) if self.is_side_by_side else unexplained

    @property
    def unexplained(self) -> Floats:
        """(h, w, 1) in 0..1: where neither layer explains the frames, as at a person who walks by.
        There, the errors of the frames are much larger than elsewhere.
        """
        return unexplained_share(self.frame_errors)

    @property
    def layers(self) -> Floats:
        """T and R, (2, h, w, 3): as measured, those of the single photo where neither layer
        explains the frames, and T alone where there is no glass.
        """
        layers: Floats = self.measured + self.unexplained * (self.predicted - self.measured)
        if self.without_glass is None:
            return layers
        transmission, reflection = layers
        given_back = self.without_glass * reflection
        return np.stack([transmission + given_back, reflection - given_back])

    def swapped(self) -> Solution:
        """Returns the solution with both measured layers exchanged."""
        return replace(self, measured=self.measured[::-1], naming=-self.naming, without_glass=None)


def unexplained_share(errors: Floats) -> Floats:
    """Returns where neither layer explains a frame, (h, w, 1) in 0..1: its errors are much larger
    there than elsewhere.

    Args:
        errors: (h, w), absolute differences of square roots of light.
    """
    smooth = cv2.GaussianBlur(errors, (0, 0), _ERROR_SMOOTHING * max(errors.shape))
    limit = max(_MIN_UNEXPLAINED, _UNEXPLAINED_TIMES * float(np.median(smooth)))
    share: Floats = np.clip(2 * (smooth / limit - 1), 0, 1)[..., None]
    return share
