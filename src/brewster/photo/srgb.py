"""The sRGB transfer function (IEC 61966-2-1) for numpy arrays and torch tensors.

Float images are linear light unless their name ends in `_encoded`; uint8 and uint16 images have
stored values. Values above 1 follow the power segment and values below 0 the linear segment, so
that the function stays invertible.
"""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = TypeVar("Array", bound=Any)

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)


def to_linear(encoded: Array) -> Array:
    """Converts sRGB-encoded values of any shape to linear light; 1.0 maps to 1.0."""
    dark = encoded <= 0.04045
    # `safe` is 1 on the linear segment, so that the power gives no NaN and no infinite gradient.
    safe = encoded * ~dark + dark
    linear: Array = encoded / 12.92 * dark + ((safe + 0.055) / 1.055) ** 2.4 * ~dark
    return linear


def to_encoded(linear: Array) -> Array:
    """Converts linear light of any shape to sRGB-encoded values; 1.0 maps to 1.0."""
    dark = linear <= 0.0031308
    safe = linear * ~dark + dark
    encoded: Array = linear * 12.92 * dark + (1.055 * safe ** (1 / 2.4) - 0.055) * ~dark
    return encoded


def to_8bit(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Converts linear light of any shape, clipped to 0..1, to sRGB values of 8 bits."""
    values: NDArray[np.uint8] = np.rint(255 * to_encoded(np.clip(linear, 0, 1))).astype(np.uint8)
    return values
