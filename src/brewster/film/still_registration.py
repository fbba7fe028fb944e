"""Finds the frame of a film that shows what a still shows, and where its pixels are in the still.

A phone records the film around the still. The time of the still in the film is often stated, but
phones stabilise the film and not the still, and the statement is wrong by some frames or missing.
Therefore the frame is found by its picture: by the features that it shares with the still.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.registration.features import features_of, frame_homography
from brewster.film.motion.registration.high_pass import high_pass
from brewster.film.motion.registration.homographies import Matrices, normalised
from brewster.film.motion.threads import POOL
from brewster.film.tracking import linear_light

Floats = NDArray[np.float32]
Picture = NDArray[np.uint8]

_SMALL_PX: Final = 160
"""The width of the copies in which the still is compared with all frames."""
_SMOOTH_PX: Final = 6.0
"""Larger structures of the copies are removed: exposure and local tone differ."""
_SEARCH_PX: Final = 500
"""The width at which features are compared with those of many frames."""
_SPREAD: Final = 7
"""The number of frames at equal distances in time that are compared first. The residual changes
smoothly in time, but not its likeness in small copies: on real iPhones, that was largest 13 and 32
frames from the right one.
"""
_MOST_ALIKE: Final = 2
"""The number of frames that are compared because their small copies are most like the still."""
_TRAVEL_COST: Final = 0.005
"""Added to the residual for each pixel that the view moved: of frames that fit equally well, the
nearest one is meant, whose layers moved least against each other.
"""
_LIKENESS_COST: Final = 0.5
"""Subtracted from the likeness for a motion by the whole width, for the same reason."""
_MIN_INLIERS: Final = 40
"""Fewer features that agree about a motion do not show that both pictures have one scene."""


@final
@dataclass(frozen=True)
class StillMatch:
    """The frame of a film that is nearest to a still."""

    frame: int
    """The index of the frame."""
    homography: Matrices
    """(3, 3): from the still to the frame, in normalised coordinates: -1 and 1 are the edges."""
    residual_px: float
    """The median distance of the features that follow the homography, in pixels of a picture that
    is 1,000 pixels wide.
    """
    travel_px: float
    """How far the homography moves the centre, in the same pixels."""
    features: int
    """The number of these features."""

    @property
    def cost(self) -> float:
        """The lower, the nearer is the frame to the still."""
        return self.residual_px + _TRAVEL_COST * self.travel_px


def match_still(
    still: Picture, frames: Sequence[Picture], stated: int | None = None
) -> StillMatch | None:
    """Returns the frame that shows the view of the still, or None if no frame shows its scene.

    The features of the still are compared with those of some frames, reduced: the stated one, those
    that are most like the still, and some in between. From the nearest one, the search goes on in
    time with smaller and smaller steps, and ends at full size.

    Args:
        still: (h, w, 3) sRGB, as wide as the frames.
        frames: the frames of the film in the order of time, each (h', w, 3) sRGB.
        stated: the index of the frame at the time that the metadata state, or None.
    """
    search = _Search(still, frames, _SEARCH_PX)
    likeness = still_likeness(still, frames)
    spread = np.linspace(0, len(frames) - 1, _SPREAD).round().astype(int)
    first = {*map(int, spread), *map(int, np.argsort(-likeness)[:_MOST_ALIKE])}
    if stated is not None:
        first.add(min(stated, len(frames) - 1))
    best = search.best(first)
    step = len(frames) // _SPREAD
    while best is not None and step:
        best = search.best({best.frame - step, best.frame, best.frame + step})
        step //= 2
    if best is None:
        return None
    return _Search(still, frames, still.shape[1]).best(range(best.frame - 1, best.frame + 2))


@final
class _Search:
    """Compares a still with frames at one width. Each frame is compared once."""

    def __init__(self, still: Picture, frames: Sequence[Picture], width: int) -> None:
        self._frames = frames
        self._width = min(width, still.shape[1])
        reduced = self._reduced(still)
        self._still_size = reduced.shape[:2]
        self._still_features = features_of(linear_light(reduced))
        self._found: dict[int, StillMatch | None] = {}

    def best(self, indices: Iterable[int]) -> StillMatch | None:
        """Returns the nearest of these frames, or None if none of them shows the scene."""
        wanted = sorted(k for k in set(indices) if 0 <= k < len(self._frames))
        new = [k for k in wanted if k not in self._found]
        self._found |= dict(zip(new, POOL.map(self._match, new), strict=True))
        found = (self._found[k] for k in wanted)
        return min((match for match in found if match), key=lambda m: m.cost, default=None)

    def _match(self, index: int) -> StillMatch | None:
        frame = self._reduced(self._frames[index])
        features = features_of(linear_light(frame))
        fit = frame_homography(self._still_features, features, self._still_size)
        if fit is None or len(fit.distances) < _MIN_INLIERS:
            return None
        homography = normalised(fit.matrix, self._still_size, frame.shape[:2])
        return StillMatch(
            frame=index,
            homography=homography,
            residual_px=float(np.median(fit.distances)) * 1000 / frame.shape[1],
            travel_px=500 * float(np.hypot(*homography[:2, 2])),
            features=len(fit.distances),
        )

    def _reduced(self, picture: Picture) -> Picture:
        height, width = picture.shape[:2]
        size = self._width, round(self._width * height / width)
        reduced: Picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        return reduced


def still_likeness(still: Picture, frames: Sequence[Picture]) -> NDArray[np.float64]:
    """Returns how alike each frame and the still are after a translation, (K,): the correlation of
    their details, less for a larger motion. For the arguments, see `match_still`.
    """
    template = _details(still)
    return np.array([_likeness(template, _details(frame)) for frame in frames])


def _details(picture: Picture) -> Floats:
    """Returns a small grey copy without large structures."""
    height, width = picture.shape[:2]
    size = _SMALL_PX, max(8, round(_SMALL_PX * height / width))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).mean(-1, dtype=np.float32)
    return high_pass(small, _SMOOTH_PX)


def _likeness(first: Floats, second: Floats) -> float:
    # The film may be wider than the photo; an even height: cv2.phaseCorrelate is off at odd ones
    height = min(len(first), len(second)) // 2 * 2
    first, second = (_middle_rows(image, height) for image in (first, second))
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(first * window, second * window)
    motion = np.array([[1, 0, x], [0, 1, y]], np.float32)
    moved = cv2.warpAffine(first, motion, first.shape[::-1])
    is_shared = cv2.warpAffine(np.ones_like(first), motion, first.shape[::-1]) > 0.5
    one, other = moved[is_shared], second[is_shared]
    norm = float(np.sqrt(np.square(one).sum() * np.square(other).sum()))
    travel = float(np.hypot(x, y)) / first.shape[1]
    return float((one * other).sum()) / norm - _LIKENESS_COST * travel if norm else -1.0


def _middle_rows(image: Floats, height: int) -> Floats:
    top = (len(image) - height) // 2
    return image[top : top + height]
