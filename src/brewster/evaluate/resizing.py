"""Resizes photo and ground truth before the methods run, as a protocol demands it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brewster.evaluate.config import EvaluationConfig
from brewster.photo import Photo

_SUPPORT = 2.0
"""The half width of the cubic kernel, in pixels."""


def resize(photo: Photo, config: EvaluationConfig) -> Photo:
    """Downscales a photo to `config.short_side_px`, then to sides that are multiples of `config.size_divisor`.

    Returns:
        The resized photo, 8-bit sRGB; the photo itself if both settings leave it as it is.
    """
    return round_sides(downscale(photo, config.short_side_px), config.size_divisor)


def downscale(photo: Photo, shorter: int | None) -> Photo:
    """Downscales a photo by area means in linear light, so that its shorter side has `shorter` px.

    Returns:
        The downscaled photo, 8-bit sRGB. The photo itself if it is not larger, or if `shorter` is None.
    """
    if shorter is None or min(photo.size) <= shorter:
        return photo
    width, height = (round(side * shorter / min(photo.size)) for side in photo.size)
    small = Photo.from_array(photo.resized(width, height), encoding="linear")
    return Photo.from_array(small.srgb_8bit(), encoding="srgb")


def round_sides(photo: Photo, size_divisor: int) -> Photo:
    """Resizes a photo so that its sides are the next smaller multiples of `size_divisor` px.

    The 8-bit values are interpolated by cubic convolution (a = -0.5, antialiased), first along the rows, as Pillow's
    `Image.resize` does by default: the test code of DSRNet, RDNet and XReflection uses it.

    Returns:
        The resized photo, 8-bit sRGB. The photo itself if its sides are multiples, or shorter than `size_divisor`.
    """
    width, height = (max(side // size_divisor * size_divisor, min(side, size_divisor)) for side in photo.size)
    if (width, height) == photo.size:
        return photo
    rows = _resampled(photo.srgb_8bit(), width, axis=1)
    return Photo.from_array(_resampled(rows, height, axis=0), encoding="srgb")


def _resampled(image: NDArray[np.uint8], length: int, *, axis: int) -> NDArray[np.uint8]:
    values = np.moveaxis(image, axis, 0).astype(np.float64)
    resampled = np.tensordot(_cubic_weights(len(values), length), values, 1)
    rounded = np.floor(resampled + 0.5).clip(0, 255).astype(np.uint8)
    return np.moveaxis(rounded, 0, axis)


def _cubic_weights(old: int, new: int) -> NDArray[np.float64]:
    """The weights of the `old` pixels in each of the `new` pixels, (new, old). Each row sums to 1."""
    scale = old / new
    stretch = max(scale, 1.0)
    centres = (np.arange(new) + 0.5) * scale
    distance = np.abs(np.arange(old) + 0.5 - centres[:, None]) / stretch
    near = (1.5 * distance - 2.5) * distance**2 + 1
    far = ((-0.5 * distance + 2.5) * distance - 4) * distance + 2
    weights = np.where(distance < 1, near, np.where(distance < _SUPPORT, far, 0))
    normalised: NDArray[np.float64] = weights / weights.sum(axis=1, keepdims=True)
    return normalised
