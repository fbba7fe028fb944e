"""How close the values of two pictures are: PSNR and SSIM, on 8-bit sRGB values and in this field's definitions.

SSIM (Z. Wang et al., IEEE Trans. Image Proc. 13, 2004; K1 0.01, K2 0.03, range 255) is taken per RGB channel, and
its map is averaged where the window lies wholly in the picture. Two windows are in use:

    uniform    7x7, sample covariance: what ERRNet, RAGNet and their successors report. scikit-image's
               structural_similarity(a, b, channel_axis=2)
    gaussian   11x11, sigma 1.5, population covariance: what its authors describe. The same with
               gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from brewster.metrics.windows import (
    BOX,
    GAUSSIAN_RADIUS,
    Picture,
    Region,
    box_sums,
    check_pictures,
    check_region,
    gaussian_means,
)

Window = Literal["uniform", "gaussian"]

_LUMINANCE_CONSTANT: Final = (0.01 * 255) ** 2
_CONTRAST_CONSTANT: Final = (0.03 * 255) ** 2
_STRIP: Final = 32
_SIDES: Final[dict[Window, int]] = {"uniform": BOX, "gaussian": 2 * GAUSSIAN_RADIUS + 1}


def psnr(picture: Picture, truth: Picture, *, region: Region | None = None) -> float:
    """Peak signal-to-noise ratio in dB, higher is better; infinite for equal pictures.

    10 log10(255^2 / MSE), the mean over all three channels of all pixels, or of those in `region`, bool (H, W).

    Raises:
        ValueError: the pictures are not uint8 (H, W, 3), differ in shape, or the region is empty or of another shape.
    """
    check_pictures(picture, truth)
    difference = picture.astype(np.int32) - truth
    if region is not None:
        check_region(region, picture.shape[:2])
        difference = difference[region]
    error = np.mean(difference * difference)
    return float(10 * np.log10(255**2 / error)) if error else float("inf")


def ssim(
    picture: Picture, truth: Picture, *, window: Window = "uniform", region: Region | None = None
) -> float:
    """Structural similarity, at most 1, higher is better; by Wang et al. 2004, the window as the module says.

    With a `region`, bool (H, W), the mean of the local values at its pixels. Those nearer to the picture's border
    than the window reaches (3 pixels, Gaussian 5) have none.

    Raises:
        ValueError: the pictures are not uint8 (H, W, 3), differ in shape, or are smaller than the window; the
            region is of another shape, or has no pixel with a value.
    """
    check_pictures(picture, truth)
    side = _SIDES[window]
    height, width = picture.shape[:2]
    if min(height, width) < side:
        raise ValueError(f"SSIM needs at least {side}x{side} pixels, not {height}x{width}")
    local = _local(picture, truth, window)
    if region is not None:
        check_region(region, (height, width))
        border = side // 2
        local = local[region[border : height - border, border : width - border]]
        if not local.size:
            raise ValueError(
                f"all of the region lies within {border} pixels of the border, where SSIM has no value"
            )
    return float(np.mean(local))


def _local(picture: Picture, truth: Picture, window: Window) -> NDArray[np.float64]:
    """The map of local values, (H - side + 1, W - side + 1, 3), in strips that stay in the processor's cache."""
    compare, high = _COMPARE[window], _STRIP + _SIDES[window] - 1
    tops = range(0, len(picture) - _SIDES[window] + 1, _STRIP)
    return np.concatenate([compare(picture[top : top + high], truth[top : top + high]) for top in tops])


def _uniform(picture: Picture, truth: Picture) -> NDArray[np.float64]:
    """Sums of 8-bit values over the window fit int32 and are exact, so only the end is floating."""
    return _compare(picture.astype(np.int32), truth.astype(np.int32), box_sums, BOX**2, sample=True)


def _gaussian(picture: Picture, truth: Picture) -> NDArray[np.float64]:
    return _compare(picture.astype(np.float64), truth.astype(np.float64), gaussian_means, 1, sample=False)


def _compare(
    x: NDArray[Any], y: NDArray[Any], total: Callable[[Any], Any], weight: int, *, sample: bool
) -> NDArray[np.float64]:
    """SSIM with both fractions multiplied through by the window's weight: one division, and sums stay integers.

    The variances of both pictures are only ever added, so x^2 + y^2 is summed at once.
    """
    mean_x, mean_y, squares, products = total(x), total(y), total(x * x + y * y), total(x * y)
    mean_product, mean_squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    luminance = _LUMINANCE_CONSTANT * weight**2
    contrast = _CONTRAST_CONSTANT * weight * (weight - sample)
    above = (2 * mean_product + luminance) * (2 * (weight * products - mean_product) + contrast)
    below = (mean_squares + luminance) * (weight * squares - mean_squares + contrast)
    ratio: NDArray[np.float64] = above / below
    return ratio


_COMPARE: Final[dict[Window, Callable[[Picture, Picture], NDArray[np.float64]]]] = {
    "uniform": _uniform,
    "gaussian": _gaussian,
}
