"""The reflection region: the pixels of a photo that the glass has visibly changed."""

from __future__ import annotations

from typing import Final

import numpy as np

from brewster.metrics.windows import BOX_SIDE, Image, Region, box_sums, check_images

DEFAULT_THRESHOLD: Final = 0.08
"""A fraction of the 8-bit range. It was chosen by visual inspection of 20 real pairs. In these pairs, the region
contains
0.1 to 87 % of the pixels, with a median of one third. With 0.04, the region is most of an image, and half of it differs
only by haze or tint. With 0.15, the region often contains only highlights."""


def reflection_region(photo: Image, truth: Image, *, threshold: float = DEFAULT_THRESHOLD) -> Region:
    """Returns the pixels where a photo differs from its ground truth by more than a threshold.

    The difference is the maximum of |photo - truth| / 255 over the channels, averaged over 7x7 pixels. Edge pixels are
    repeated beyond the border of the image. The region is a bool mask (H, W). Raises ValueError if the images are not
    uint8 (H, W, 3) or differ in shape, or the threshold is not in 0..1."""
    check_images(photo, truth)
    if not 0 <= threshold <= 1:
        raise ValueError(f"the threshold must be in 0..1, not {threshold}")
    red, green, blue = np.moveaxis(np.abs(photo.astype(np.int16) - truth), 2, 0)
    largest = np.maximum(np.maximum(red, green), blue)  # much faster than max(axis=2)
    sums = box_sums(np.pad(largest, BOX_SIDE // 2, mode="edge"))  # at most 49 * 255: int16 holds them exactly
    region: Region = sums > threshold * 255 * BOX_SIDE**2
    return region
