"""Degrade a picture for catch trials with a strong blur, which preserves large shapes, and with noise."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_BLUR_RADIUS: Final = 0.02
"""The radius of the box blur, as a fraction of the longer side."""
_NOISE_STD: Final = 28.0
"""Standard deviation of the noise in 8-bit code values."""


def degrade(picture: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """Blur an sRGB picture (H, W, 3) twice with a box filter and add grey noise; deterministic for a seed."""
    radius = max(2, round(_BLUR_RADIUS * max(picture.shape[:2])))
    blurred = picture.astype(np.float32)
    for axis in (0, 1, 0, 1):
        blurred = _box_blur(blurred, radius, axis)
    noise = np.random.default_rng(seed).normal(0, _NOISE_STD, (*picture.shape[:2], 1))
    return np.rint(blurred + noise).clip(0, 255).astype(np.uint8)


def _box_blur(values: NDArray[np.float32], radius: int, axis: int) -> NDArray[np.float32]:
    """Moving mean over 2 radius + 1 values along an axis; edge values are repeated beyond the border."""
    padding = [(0, 0)] * values.ndim
    padding[axis] = (radius + 1, radius)
    sums = np.cumsum(np.pad(values, padding, mode="edge"), axis=axis, dtype=np.float64)
    length = values.shape[axis]
    ends = np.take(sums, np.arange(2 * radius + 1, 2 * radius + 1 + length), axis=axis)
    starts = np.take(sums, np.arange(length), axis=axis)
    return ((ends - starts) / (2 * radius + 1)).astype(np.float32)
