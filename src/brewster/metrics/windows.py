"""Checks of images and regions, sums over sliding windows, and the reflection region, for all
metrics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Bool, UInt8

    Image = UInt8[NDArray[np.uint8], "h w 3"]
    Region = Bool[NDArray[np.bool_], "h w"]
else:
    Image = Region = NDArray

_Values = TypeVar("_Values", bound=NDArray[Any])

MIN_COUNT: Final = 64
"""A score over fewer values is too noisy to report."""

BOX_SIDE: Final = 7
"""The side of the uniform window, in pixels."""

GAUSSIAN_RADIUS: Final = 5
GAUSSIAN_SIGMA: Final = 1.5
"""The Gaussian window of Wang et al. 2004: 11x11 pixels, as in scikit-image, which truncates it at
3.5 sigma.
"""

# The first half of the symmetric window, up to its centre; the sum of the whole window is 1.
_HALF_TAPS: Final = np.exp(-0.5 * (np.arange(-GAUSSIAN_RADIUS, 1) / GAUSSIAN_SIGMA) ** 2)
_GAUSSIAN: Final = _HALF_TAPS / (2 * _HALF_TAPS.sum() - _HALF_TAPS[-1])


def check_images(*images: Image) -> None:
    """Checks that all images are uint8 (H, W, 3) and of the same shape. Raises ValueError if an
    image is not uint8 (H, W, 3) or has no pixels, or the shapes differ.
    """
    for image in images:
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ValueError(f"an image must be uint8 (H, W, 3), not {image.dtype} {image.shape}")
        if image.shape != images[0].shape:
            raise ValueError(f"the images differ in shape: {images[0].shape} and {image.shape}")


def check_region(region: Region, shape: tuple[int, int]) -> None:
    """Checks that a region is a bool mask of this (height, width) with at least one pixel. Raises
    ValueError if the region is not bool (H, W), or is empty.
    """
    if region.dtype != np.bool_ or region.shape != shape:
        raise ValueError(f"the region must be bool {shape}, not {region.dtype} {region.shape}")
    if not region.any():
        raise ValueError("the region is empty; a metric needs at least one pixel")


def check_count(count: int, condition: str) -> None:
    """Raises ValueError if a score is over fewer than 64 values. `condition` describes them:
    "pixels are white".
    """
    if count < MIN_COUNT:
        raise ValueError(f"{count} {condition}; a score needs at least {MIN_COUNT}")


def box_sums(values: _Values) -> _Values:
    """Returns sums over all complete 7x7 windows, (H - 6, W - 6, ...). Integer sums that fit are
    exact.
    """
    sums_of_2 = values[:-1] + values[1:]
    sums_of_4 = sums_of_2[:-2] + sums_of_2[2:]
    columns = sums_of_4[:-3] + sums_of_2[4:-1] + values[6:]
    sums_of_2 = columns[:, :-1] + columns[:, 1:]
    sums_of_4 = sums_of_2[:, :-2] + sums_of_2[:, 2:]
    sums: _Values = sums_of_4[:, :-3] + sums_of_2[:, 4:-1] + columns[:, 6:]
    return sums


def gaussian_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns Gaussian-weighted means over all complete 11x11 windows, (H - 10, W - 10, ...)."""
    for axis in (0, 1):
        along_axis = np.moveaxis(values, axis, 0)
        count = len(along_axis) - 2 * GAUSSIAN_RADIUS
        last = 2 * GAUSSIAN_RADIUS
        mean = along_axis[GAUSSIAN_RADIUS : GAUSSIAN_RADIUS + count] * _GAUSSIAN[GAUSSIAN_RADIUS]
        for i in range(GAUSSIAN_RADIUS):
            mean += (
                along_axis[i : i + count] + along_axis[last - i : last - i + count]
            ) * _GAUSSIAN[i]
        values = np.moveaxis(mean, 0, axis)
    return values


DEFAULT_THRESHOLD: Final = 0.08
"""A fraction of the 8-bit range, chosen on 20 real pairs, in which the region contains 0.1 to 87 %
of the pixels, with a median of one third. With 0.04, it is most of an image, and half of it differs
only by haze or tint; with 0.15, it often contains only highlights.
"""


def reflection_region(
    photo: Image, truth: Image, *, threshold: float = DEFAULT_THRESHOLD
) -> Region:
    """Returns the pixels where a photo differs from its ground truth by more than a threshold.

    The difference is the maximum of |photo - truth| / 255 over the channels, averaged over 7x7
    pixels. Edge pixels are repeated beyond the border of the image. The region is a bool mask (H,
    W).

    Args:
        photo: the photo, uint8 sRGB (H, W, 3).
        truth: the ground truth of its transmission, of the same shape.
        threshold: the smallest difference in the region, as a fraction of the 8-bit range, 0..1.

    Raises:
        ValueError: the images are not uint8 (H, W, 3) or differ in shape, or the threshold is not
            in 0..1.
    """
    check_images(photo, truth)
    if not 0 <= threshold <= 1:
        raise ValueError(f"the threshold must be in 0..1, not {threshold}")
    red, green, blue = np.moveaxis(np.abs(photo.astype(np.int16) - truth), 2, 0)
    largest = np.maximum(np.maximum(red, green), blue)  # much faster than max(axis=2)
    sums = box_sums(
        np.pad(largest, BOX_SIDE // 2, mode="edge")
    )  # at most 49 * 255: int16 holds them exactly
    region: Region = sums > threshold * 255 * BOX_SIDE**2
    return region
