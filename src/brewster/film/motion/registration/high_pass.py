"""High-pass filters: the detail of pictures, without their smooth light."""

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.photo.srgb import to_encoded

Floats = NDArray[np.float32]


def high_pass(image: Floats, sigma_px: float) -> Floats:
    """Returns an image (h, w) or (h, w, C) without what a Gaussian leaves of it.

    Args:
        image: any values.
        sigma_px: the standard deviation of the Gaussian.
    """
    detail: Floats = image - cv2.GaussianBlur(image, (0, 0), sigma_px)
    return detail


def root_high_pass(frame: Floats, sigma_px: float) -> Floats:
    """Returns the grey detail of a frame, (h, w), in roots of light, in which noise is even.

    Args:
        frame: (h, w, 3) linear light.
        sigma_px: the standard deviation of the Gaussian whose result is removed.
    """
    return high_pass(np.sqrt(np.maximum(frame.mean(-1), 0)), sigma_px)


def grey_high_pass(frame: Floats, sigma_px: float) -> Floats:
    """Returns the grey detail of a frame, (h, w), in sRGB values.

    Args:
        frame: (h, w, 3) linear light.
        sigma_px: the standard deviation of the Gaussian whose result is removed.
    """
    return high_pass(to_encoded(np.clip(frame, 0, 1)).mean(-1), sigma_px)
