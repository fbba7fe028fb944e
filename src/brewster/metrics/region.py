"""The reflection region: the pixels of a photo that the glass has visibly changed."""

from __future__ import annotations

from typing import Final

import numpy as np

from brewster.metrics.windows import BOX_SIDE, Image, Region, box_sums, check_images

DEFAULT_THRESHOLD: Final = 0.08
"""A fraction of the 8-bit range, chosen by eye on 20 real pairs, where it marks 0.1 to 87 % of the pixels (median: a
third). 0.04 marks most of an image, half of it because of haze or tint. 0.15 often marks only highlights."""


def reflection_region(photo: Image, truth: Image, *, threshold: float = DEFAULT_THRESHOLD) -> Region:
    """The pixels where a photo differs from the ground truth without reflection by more than a threshold.

    The difference is |photo - truth| / 255 in the channel where it is largest, averaged over 7x7 pixels. Edge
    pixels are repeated beyond the border of the image.

    Returns:
        A bool mask (H, W).

    Raises:
        ValueError: the images are not uint8 (H, W, 3) or differ in shape, or the threshold is not in 0..1.
    """
    check_images(photo, truth)
    if not 0 <= threshold <= 1:
        raise ValueError(f"the threshold must be in 0..1, not {threshold}")
    red, green, blue = np.moveaxis(np.abs(photo.astype(np.int16) - truth), 2, 0)
    largest = np.maximum(np.maximum(red, green), blue)  # much faster than max(axis=2)
    sums = box_sums(np.pad(largest, BOX_SIDE // 2, mode="edge"))  # at most 49 * 255: int16 holds them exactly
    region: Region = sums > threshold * 255 * BOX_SIDE**2
    return region
