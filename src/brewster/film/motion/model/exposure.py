"""Fits the exposures of the frames of a burst: that of a phone drifts by up to half a stop in 1 s.

The solver fits the gains of the frames, too, but from 1 on and in small steps: what remains of a
drift is a change that no motion of one layer explains, as if there were a second one.

`fit_gains` (light/gains.py) does the same where the light of R changes, which biases the mean light
here; it compares edges, which agree only in photos that are aligned to a fraction of a pixel.
"""

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import (
    Doubles,
    Floats,
    pixel_grid,
    to_pixels,
    transformed,
)
from brewster.film.motion.resizing import resized

_COMPARED_PX: Final = 160
"""The long side of the frames that are compared."""
_BLUR_PX: Final = 2.0
"""The standard deviation of the windows that are compared: they hardly depend on the motion."""
CLIPPED_IN_SOME: Final = 0.9
"""Brighter light may be clipped in frames with another exposure."""
_DARK: Final = 0.01
"""Darker light has lost its ratio to that of other frames."""
_MIN_PIXELS: Final = 50


def fitted_exposures(frames: Sequence[Floats], reference: int, homographies: Doubles) -> Doubles:
    """Returns the exposure of each frame relative to the reference frame, (K, 3), one for each
    channel because the white balance may change, too: the median ratio of the light of places that
    both show. It is 1 where too few are neither clipped nor dark.

    Args:
        frames: (h, w, 3) linear light.
        reference: the index of the reference frame.
        homographies: (K, 3, 3), from each frame to the reference frame, in normalised coordinates.
    """
    small = [resized(frame, _COMPARED_PX) for frame in frames]
    grid = pixel_grid(*small[0].shape[:2])
    exposures = np.ones((len(frames), 3))
    for k, frame in enumerate(small):
        if k == reference:
            continue
        x, y = to_pixels(transformed(homographies[k], grid), frame.shape)
        shown = cv2.remap(
            small[reference],
            x,
            y,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(-1, -1, -1),  # counts as dark
        )
        is_compared = _has_ratio(shown) & _has_ratio(frame)
        if is_compared.sum() >= _MIN_PIXELS:
            ratios = _blurred(frame)[is_compared] / _blurred(shown)[is_compared]
            exposures[k] = np.median(ratios, axis=0)
    return exposures


def _has_ratio(image: Floats) -> NDArray[np.bool_]:
    """Returns where the light (h, w, 3) is neither clipped, nor dark, nor outside of the frame."""
    reach = 2 * round(2 * _BLUR_PX) + 1
    brightest = cv2.dilate(image.max(-1), np.ones((reach, reach), np.uint8))
    darkest = cv2.erode(image.min(-1), np.ones((reach, reach), np.uint8))
    has_ratio: NDArray[np.bool_] = (brightest < CLIPPED_IN_SOME) & (darkest > _DARK)
    return has_ratio


def _blurred(image: Floats) -> Floats:
    blurred: Floats = cv2.GaussianBlur(image, (0, 0), _BLUR_PX)
    return blurred
