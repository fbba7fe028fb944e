"""Resizes the frames of a burst."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


def resized(image: Floats, long_side_px: int) -> Floats:
    """Returns an image, resized so that its long side has this length. Smaller images are
    enlarged.
    """
    height, width = image.shape[:2]
    scale = long_side_px / max(height, width)
    size = max(8, round(width * scale)), max(8, round(height * scale))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small: Floats = cv2.resize(image, size, interpolation=interpolation)
    return small
