"""Finds predictions that are mirrored or shifted against their photo, which ruins all scores of a
good method.

The comparison is with the photo, not with the ground truth: refraction can shift the ground truth
by some pixels.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from brewster.metrics import Image

MAX_SIDE_PX: Final = 256
"""Larger images are reduced by a whole factor before the comparison."""

MIN_SHIFT_PX: Final = 2.0
"""Smaller shifts at the reduced size are not reported."""

_FLIPS: Final = {
    "mirrored left to right": np.s_[:, ::-1],
    "mirrored top to bottom": np.s_[::-1, :],
    "rotated by 180 degrees": np.s_[::-1, ::-1],
}
_MIN_FLIP_GAIN: Final = 0.1
"""A flip must raise the correlation with the photo by this much, because some photos are nearly
symmetric.
"""
_MIN_FLIP_CORRELATION: Final = 0.5

_MIN_PEAK_RATIO: Final = 2.0
"""The peak of the phase correlation must exceed its value at zero shift by this factor."""

_MIN_PEAK: Final = 0.1
_MIN_PEAK_DEVIATIONS: Final = 8.0
"""The peak of the phase correlation of two images that differ only by a shift is near 1. That of
unrelated images with n pixels is a few times 1 / sqrt(n).
"""

_Plane = NDArray[np.float64]


def find_misregistration(prediction: Image, photo: Image) -> str:
    """Compares a prediction with its photo, both uint8 (H, W, 3) of one size: flips are found by
    the correlation of the pixels, shifts by phase correlation (Kuglin and Hines 1975). Returns how
    it is flipped or shifted; "" if it is not, or if this cannot be decided.
    """
    factor = max(1, -(-max(photo.shape) // MAX_SIDE_PX))
    one, other = (_reduced(image, factor) for image in (prediction, photo))
    if min(one.shape) < 8 or not one.any() or not other.any():
        return ""
    direct = _correlation(one, other)
    flips = {name: _correlation(one[flip], other) for name, flip in _FLIPS.items()}
    best = max(flips, key=flips.__getitem__)
    if flips[best] > max(direct + _MIN_FLIP_GAIN, _MIN_FLIP_CORRELATION):
        return best
    rows, columns = _phase_shift(one, other)
    if np.hypot(rows, columns) < MIN_SHIFT_PX:
        return ""
    vertical = f"{abs(rows) * factor} px {'down' if rows > 0 else 'up'}" if rows else ""
    horizontal = (
        f"{abs(columns) * factor} px to the {'right' if columns > 0 else 'left'}" if columns else ""
    )
    return f"shifted by about {' and '.join(filter(None, (vertical, horizontal)))}"


def _reduced(image: Image, factor: int) -> _Plane:
    """The sum of the channels, reduced by `factor`, with mean 0, (h, w)."""
    rows, columns = (side // factor * factor for side in image.shape[:2])
    inside = image[:rows, :columns].astype(np.uint16)
    sums = inside[..., 0] + inside[..., 1] + inside[..., 2]  # much faster than sum(axis=2)
    plane = (
        sums.reshape(rows // factor, factor, columns // factor, factor).sum(axis=1).mean(axis=2)
        / factor
    )
    centred: _Plane = plane - plane.mean() if plane.size else plane
    return centred


def _correlation(one: _Plane, other: _Plane) -> float:
    return float((one * other).sum() / np.sqrt((one * one).sum() * (other * other).sum()))


def _phase_shift(one: _Plane, other: _Plane) -> tuple[int, int]:
    """The shift (rows, columns) of `one` against `other`; (0, 0) if the correlation has no clear
    peak elsewhere.
    """
    # The window hides the borders, which do not wrap around.
    window = np.outer(np.hanning(one.shape[0]), np.hanning(one.shape[1]))
    product = np.fft.rfft2(one * window) * np.conj(np.fft.rfft2(other * window))
    correlation = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-12), one.shape)
    at_zero = correlation[:2, :2].max()
    row, column = np.unravel_index(correlation.argmax(), correlation.shape)
    noise = _MIN_PEAK_DEVIATIONS / np.sqrt(correlation.size)
    if correlation[row, column] < max(_MIN_PEAK, noise, _MIN_PEAK_RATIO * at_zero):
        return 0, 0
    height, width = one.shape
    return int((row + height // 2) % height - height // 2), int(
        (column + width // 2) % width - width // 2
    )
