"""How close two pictures are, by this field's own definitions, on 8-bit sRGB values.

PSNR over all pixels and channels. SSIM (Wang et al. 2004) as ERRNet, RAGNet and their successors report it:
a uniform 7x7 window, per RGB channel, sample covariance, K1 0.01, K2 0.03, range 255, the three-pixel border
left out; equal to scikit-image's `structural_similarity(a, b, channel_axis=2)` for 8-bit pictures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import UInt8

    Picture = UInt8[NDArray[np.uint8], "h w c"]
else:
    Picture = NDArray

_WINDOW: Final = 7
_LUMINANCE_CONSTANT: Final = (0.01 * 255) ** 2
_CONTRAST_CONSTANT: Final = (0.03 * 255) ** 2


def psnr(picture: Picture, truth: Picture) -> float:
    """Peak signal-to-noise ratio in dB, higher is better; infinite for equal pictures.

    Raises:
        ValueError: the pictures differ in shape.
    """
    _check_shapes(picture, truth)
    error = np.mean((picture.astype(np.float64) - truth) ** 2)
    return float(10 * np.log10(255**2 / error)) if error else float("inf")


def ssim(picture: Picture, truth: Picture) -> float:
    """Structural similarity, at most 1, higher is better; pictures of at least 7x7 pixels.

    Raises:
        ValueError: the pictures differ in shape, or are smaller than the window.
    """
    _check_shapes(picture, truth)
    if min(picture.shape[:2]) < _WINDOW:
        raise ValueError(f"SSIM needs at least {_WINDOW}x{_WINDOW} pixels, not {picture.shape[:2]}")
    x, y = picture.astype(np.float64), truth.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    sample = _WINDOW**2 / (_WINDOW**2 - 1)
    variance_x = sample * (_window_mean(x * x) - mean_x**2)
    variance_y = sample * (_window_mean(y * y) - mean_y**2)
    covariance = sample * (_window_mean(x * y) - mean_x * mean_y)
    luminance = (2 * mean_x * mean_y + _LUMINANCE_CONSTANT) / (mean_x**2 + mean_y**2 + _LUMINANCE_CONSTANT)
    structure = (2 * covariance + _CONTRAST_CONSTANT) / (variance_x + variance_y + _CONTRAST_CONSTANT)
    return float(np.mean(luminance * structure))


def _check_shapes(picture: Picture, truth: Picture) -> None:
    if picture.shape != truth.shape:
        raise ValueError(f"the pictures differ in shape: {picture.shape} and {truth.shape}")


def _window_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of all whole 7x7 windows, (h - 6, w - 6, c)."""
    for axis in (0, 1):
        count = values.shape[axis] - _WINDOW + 1
        values = sum(np.take(values, range(i, i + count), axis=axis) for i in range(_WINDOW))  # type: ignore[assignment]
    return values / _WINDOW**2
