"""PSNR, SSIM and the linear-light error of 8-bit sRGB images, as papers on reflection removal
define them.

SSIM (Z. Wang et al., IEEE Trans. Image Proc. 13, 2004; K1 0.01, K2 0.03, range 255) is computed per
RGB channel, and its map is averaged over the positions where the whole window is inside the image.
There are two windows:

    uniform    7x7, sample covariance, as ERRNet, RAGNet and their successors report it. Equal to
               scikit-image's structural_similarity(a, b, channel_axis=2)
    gaussian   11x11, sigma 1.5, population covariance, as in the paper of Wang et al. Equal to the
               same call with gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
               data_range=255
"""

from collections.abc import Callable, Sequence
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from brewster.metrics import windows
from brewster.metrics.windows import Image, Region
from brewster.photo.srgb import to_linear

Window = Literal["uniform", "gaussian"]
PairCounts = NDArray[np.int64]

_LUMINANCE_CONSTANT: Final = (0.01 * 255) ** 2
_CONTRAST_CONSTANT: Final = (0.03 * 255) ** 2
_LINEAR: Final = to_linear(np.arange(256, dtype=np.float32) / 255)
_SQUARED_ERRORS: Final = np.square(np.subtract.outer(np.arange(256.0), np.arange(256.0))).ravel()
_LINEAR_SQUARED_ERRORS: Final = np.square(
    np.subtract.outer(_LINEAR, _LINEAR), dtype=np.float64
).ravel()
"""The squared error of each pair of 8-bit values, (65536,), with the index of `count_pairs`."""
_STRIP_ROWS: Final = 32


def psnr(prediction: Image, truth: Image, *, region: Region | None = None) -> float:
    """Returns the peak signal-to-noise ratio in dB, 10 log10(255^2 / MSE); infinity for equal
    images. Higher is better.

    The mean squared error is over the three channels of all scored pixels.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        region: the pixels to score, bool (H, W); None is all of them.

    Raises:
        ValueError: the images are not uint8 (H, W, 3) or differ in shape, or the region is empty or
            of another shape.
    """
    return psnr_of_counts(count_pairs(prediction, truth, region=region))


def psnr_of_counts(counts: PairCounts) -> float:
    """The PSNR in dB, from the counts of `count_pairs`; infinity for equal images."""
    mse = float(_SQUARED_ERRORS @ counts / counts.sum())
    return float(10 * np.log10(255**2 / mse)) if mse else float("inf")


def count_pairs(prediction: Image, truth: Image, *, region: Region | None = None) -> PairCounts:
    """Counts the pairs of 8-bit values at the same position: the joint histogram of two images,
    over all channels. Every mean over all pixels, or over those in `region`, of a function of two
    values follows from it, and it is faster than the function of each pixel. The counts are int64
    (65536,). The index is 256 times the value of the prediction, plus that of the ground truth.
    Raises ValueError as `psnr`.
    """
    windows.check_images(prediction, truth)
    if region is not None:
        windows.check_region(region, prediction.shape[:2])
        inside = np.flatnonzero(region)
        prediction, truth = (image.reshape(-1, 3)[inside] for image in (prediction, truth))
    pairs = prediction.astype(np.intp)
    pairs *= 256
    pairs += truth
    return np.bincount(pairs.ravel(), minlength=256 * 256)


def psnr_of_channels(prediction: Image, truth: Image, *, limit_db: float = np.inf) -> float:
    """Returns the mean of the PSNR of red, green and blue, as the code of ERRNet (util/index.py)
    and XReflection computes it.

    The value is never below that of `psnr`, which uses one mean squared error over all channels. It
    is in dB. Higher is better.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        limit_db: the PSNR of a channel that is equal in both images, in dB.

    Raises:
        ValueError: as `psnr`.
    """
    windows.check_images(prediction, truth)
    difference = prediction.astype(np.int32) - truth
    mse = (difference * difference).mean(axis=(0, 1))
    with np.errstate(divide="ignore"):
        return float(np.minimum(10 * np.log10(255**2 / mse), limit_db).mean())


def linear_rmse(prediction: Image, truth: Image, *, region: Region | None = None) -> float:
    """Returns the root mean squared error in linear light, in 0..1: sqrt(mean((L(prediction) -
    L(truth))^2)).

    L is the inverse of the sRGB curve (IEC 61966-2-1). The mean is over the three channels of all
    scored pixels. This error is proportional to the light that is wrong; errors of encoded values
    are not. Lower is better.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        region: the pixels to score, bool (H, W); None is all of them.

    Raises:
        ValueError: as `psnr`.
    """
    return linear_rmse_of_counts(count_pairs(prediction, truth, region=region))


def linear_rmse_of_counts(counts: PairCounts) -> float:
    """The error of `linear_rmse`, from the counts of `count_pairs`."""
    return float((_LINEAR_SQUARED_ERRORS @ counts / counts.sum()) ** 0.5)


def ssim(
    prediction: Image, truth: Image, *, window: Window = "uniform", region: Region | None = None
) -> float:
    """Returns the mean structural similarity (Wang et al. 2004), with one of the two windows of
    this module.

    The SSIM map is averaged over all scored pixels. The map has no values within 3 pixels of the
    image's border, or 5 pixels with the Gaussian window. The mean is 1 for equal images. Higher is
    better.

    Args:
        prediction: the predicted layer, uint8 sRGB (H, W, 3).
        truth: its ground truth, of the same shape.
        window: "uniform" (7x7) or "gaussian" (11x11).
        region: the pixels to score, bool (H, W); None is all of them.

    Raises:
        ValueError: as `psnr`; or the images are smaller than the window, or the region has only
            pixels without a value.
    """
    return mean_ssim(ssim_map(prediction, truth, window=window), region=region)


def mean_ssim(values: NDArray[np.float64], *, region: Region | None = None) -> float:
    """Returns the mean of a map of `ssim_map`, over all its pixels or over those in `region`, bool
    (H, W). Raises ValueError if the region is empty, of another shape, or has only pixels without a
    value.
    """
    if region is None:
        return float(np.mean(values))
    border = (region.shape[0] - values.shape[0]) // 2
    windows.check_region(region, (values.shape[0] + 2 * border, values.shape[1] + 2 * border))
    inside = region[border : border + values.shape[0], border : border + values.shape[1]]
    if not inside.any():
        raise ValueError(
            f"all pixels of the region are within {border} pixels of the border, where SSIM has "
            "no value"
        )
    # Sum over the channels first, because indexing (H, W, 3) with a mask of pixels takes ten times
    # as long.
    sums = values[..., 0] + values[..., 1] + values[..., 2]
    return float(np.sum(sums[inside], dtype=np.float64) / (3 * np.count_nonzero(inside)))


def ssim_map(prediction: Image, truth: Image, *, window: Window = "uniform") -> NDArray[np.float64]:
    """Returns the local SSIM, (H - side + 1, W - side + 1, 3) for a window with sides of `side`
    pixels. Raises ValueError if the images are not uint8 (H, W, 3), differ in shape, or are smaller
    than the window.
    """
    windows.check_images(prediction, truth)
    side, windowed_ssim = _WINDOWS[window]
    height, width = prediction.shape[:2]
    if min(height, width) < side:
        raise ValueError(f"SSIM needs at least {side}x{side} pixels, not {height}x{width}")
    # Strips of 32 rows fit into the processor's cache.
    strips = [
        np.s_[top : top + _STRIP_ROWS + side - 1]
        for top in range(0, height - side + 1, _STRIP_ROWS)
    ]
    return np.concatenate([windowed_ssim(prediction[strip], truth[strip]) for strip in strips])


def _ssim_uniform(prediction: Image, truth: Image) -> NDArray[np.float64]:
    """Returns the SSIM map with the uniform window. int16 holds sums of 8-bit values, int32 those
    of products.
    """
    x, y = prediction.astype(np.int32), truth.astype(np.int32)
    sums = [
        windows.box_sums(image.astype(np.int16)).astype(np.int32) for image in (prediction, truth)
    ]
    sums += [windows.box_sums(x * x + y * y), windows.box_sums(x * y)]
    return _ssim_formula(sums, windows.BOX_SIDE**2, sample_covariance=True)


def _ssim_gaussian(prediction: Image, truth: Image) -> NDArray[np.float64]:
    x, y = prediction.astype(np.float64), truth.astype(np.float64)
    means = [windows.gaussian_means(values) for values in (x, y, x * x + y * y, x * y)]
    return _ssim_formula(means, 1, sample_covariance=False)


def _ssim_formula(
    window_sums: Sequence[NDArray[Any]], pixel_count: int, *, sample_covariance: bool
) -> NDArray[np.float64]:
    """Returns SSIM = (2 mx my + C1) (2 cov + C2) / ((mx^2 + my^2 + C1) (vx + vy + C2)) from window
    sums of x, y, x^2 + y^2 and x y; m is a mean, v a variance. `pixel_count` is the number of
    pixels in a sum (1 for weighted means).
    """
    # Multiplied by powers of `pixel_count`, it has one division, and integer sums stay integers
    # until then.
    mean_x, mean_y, squares, products = window_sums
    mean_product = mean_x * mean_y
    mean_squares = mean_x * mean_x + mean_y * mean_y
    luminance = _LUMINANCE_CONSTANT * pixel_count**2
    contrast = _CONTRAST_CONSTANT * pixel_count * (pixel_count - sample_covariance)
    numerator = (2 * mean_product + luminance) * (
        2 * (pixel_count * products - mean_product) + contrast
    )
    denominator = (mean_squares + luminance) * (pixel_count * squares - mean_squares + contrast)
    values: NDArray[np.float64] = numerator / denominator
    return values


_WINDOWS: Final[dict[Window, tuple[int, Callable[[Image, Image], NDArray[np.float64]]]]] = {
    "uniform": (windows.BOX_SIDE, _ssim_uniform),
    "gaussian": (2 * windows.GAUSSIAN_RADIUS + 1, _ssim_gaussian),
}
"""The side of each window in pixels, and the function that computes the map."""
