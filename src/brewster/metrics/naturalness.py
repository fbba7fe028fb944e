"""NIQE: the distance between the local statistics of an image and those of undistorted photographs, without ground
truth.

A. Mittal, R. Soundararajan, A. C. Bovik, "Making a 'Completely Blind' Image Quality Analyzer", IEEE Signal Process.
Lett. 20(3), 2013. The multivariate Gaussian of undistorted photographs was published by the authors; the file
niqe_pristine.npz has its mean (36,) and covariance (36, 36). Luma is 0.299 R + 0.587 G + 0.114 B of the 8-bit values,
rounded, as in the package pyiqa. The NTIRE challenges report the values of pyiqa."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from brewster.metrics.windows import Image, check_images

if TYPE_CHECKING:
    from jaxtyping import Float64

BLOCK_SIDE: Final = 96
"""Features are computed in blocks of 96x96 pixels, and of 48x48 pixels at half the resolution."""

_PRISTINE_FILE: Final = Path(__file__).with_name("niqe_pristine.npz")
_LUMA: Final = (0.299, 0.587, 0.114)
_RADIUS: Final = 3
_SIGMA: Final = 7 / 6
_WINDOW: Final = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA) ** 2)
_TAPS: Final = _WINDOW / _WINDOW.sum()
_ROUNDING_ERROR: Final = 1e-10
_NEIGHBOURS: Final = ((0, 1), (1, 0), (1, 1), (1, -1))
"""The shifts of equation 6 of the paper: horizontal, vertical and both diagonals."""

_HALVING_TAPS: Final = np.array([-3, -9, 29, 111, 111, 29, -9, -3]) / 256
"""Cubic convolution (a = -0.5), stretched by two: the antialiased halving of MATLAB's imresize."""

Blocks = NDArray[np.float64]


def niqe(image: Image) -> float:
    """Returns the NIQE of an image, uint8 sRGB (H, W, 3) (equation 10 of the paper).

    The image is cropped to whole blocks of 96x96 pixels, from the upper left corner. The NIQE is a distance between two
    Gaussians, at least 0; lower is better. Undistorted photographs have values of 2 to 5. Raises ValueError if the image
    is not uint8 (H, W, 3), or fewer than two blocks have features."""
    check_images(image)
    luma = np.rint(image @ np.array(_LUMA))
    rows, columns = (side // BLOCK_SIDE for side in luma.shape)
    features = np.empty((0, 0))
    if rows * columns > 1:
        luma = luma[: rows * BLOCK_SIDE, : columns * BLOCK_SIDE]
        halved = _filtered(luma, _HALVING_TAPS, 2, "symmetric")
        scales = [_features(level, rows, columns) for level in (luma, halved)]
        features = np.concatenate(scales, axis=1)
        features = features[np.isfinite(features).all(axis=1)]
    if len(features) < 2:
        raise ValueError(f"NIQE needs two blocks of {BLOCK_SIDE}x{BLOCK_SIDE} pixels that are not uniform")
    mean, covariance = _pristine()
    difference = mean - features.mean(axis=0)
    pooled = (covariance + np.cov(features, rowvar=False)) / 2
    return float(np.sqrt(difference @ np.linalg.pinv(pooled) @ difference))


@functools.cache
def _pristine() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    with np.load(_PRISTINE_FILE) as file:
        return file["mean"], file["covariance"]


def _features(luma: Float64[NDArray[np.float64], "h w"], rows: int, columns: int) -> NDArray[np.float64]:
    """Returns the 18 features of each block at one scale, (blocks, 18)."""
    normalised = _normalised(luma)
    height, width = (side // count for side, count in zip(luma.shape, (rows, columns), strict=True))
    blocks = normalised.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(-1, height, width)
    shape, left, right = _fit_asymmetric_gaussian(blocks)
    features = [shape, (left + right) / 2]
    for shift in _NEIGHBOURS:
        shape, left, right = _fit_asymmetric_gaussian(blocks * np.roll(blocks, shift, axis=(1, 2)))
        mean = (right - left) * np.array([math.exp(math.lgamma(2 / a) - math.lgamma(1 / a)) for a in shape])
        features += [shape, mean, left, right]
    return np.stack(features, axis=1)


def _normalised(luma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns (luma - local mean) / (local standard deviation + 1), equation 1 of the paper."""
    mean, mean_square = (_filtered(values, _TAPS, 1, "edge") for values in (luma, luma * luma))
    deviation = np.sqrt(np.abs(mean_square - mean * mean))
    normalised: NDArray[np.float64] = (luma - mean) / (deviation + 1)
    # In flat areas, such as clipped skies, the result consists of rounding errors. They are set to 0, so that their random
    # signs do not change the features. Other implementations keep them, which changes the distance by up to about 0.01.
    return np.where(np.abs(normalised) < _ROUNDING_ERROR, 0, normalised)


def _filtered(
    values: NDArray[np.float64],
    taps: NDArray[np.float64],
    step: int,
    beyond_border: Literal["edge", "symmetric"],
) -> NDArray[np.float64]:
    """Filters rows and columns, and keeps every `step`-th value. Values are repeated beyond the border, as in np.pad."""
    for axis in (0, 1):
        padding = [(_RADIUS, _RADIUS) if i == axis else (0, 0) for i in range(2)]
        along_axis = np.moveaxis(np.pad(values, padding, beyond_border), axis, 0)
        count = (len(along_axis) - len(taps)) // step + 1
        total = sum(tap * along_axis[i : i + step * (count - 1) + 1 : step] for i, tap in enumerate(taps))
        values = np.moveaxis(np.asarray(total), 0, axis)
    return values


def _fit_asymmetric_gaussian(
    blocks: Blocks,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fits an asymmetric generalised Gaussian to each block (N. Lasmar et al., ICIP 2009). Returns the shape, and the
    scales of the left and the right half, (blocks,) each. The scales are NaN for a block without negative or without
    positive values."""
    flat = blocks.reshape(len(blocks), -1)
    squares = flat * flat
    with np.errstate(invalid="ignore", divide="ignore"):
        left, right = (
            np.sqrt((squares * side).sum(axis=1) / side.sum(axis=1)) for side in (flat < 0, flat > 0)
        )
        ratio = left / right
        moments = np.abs(flat).mean(axis=1) ** 2 / squares.mean(axis=1)
        target = moments * (ratio**3 + 1) * (ratio + 1) / (ratio**2 + 1) ** 2
    shapes, expected, scales = _shape_table()
    nearest = np.abs(expected - target[:, None]).argmin(axis=1)
    scale = np.where(np.isfinite(target), scales[nearest], np.nan)
    return shapes[nearest], left * scale, right * scale


@functools.cache
def _shape_table() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns shapes a in 0.2..10, with Gamma(2/a)^2 / (Gamma(1/a) Gamma(3/a)) and sqrt(Gamma(1/a) / Gamma(3/a)) of each."""
    shapes = np.arange(0.2, 10.001, 0.001)
    logs = np.array([[math.lgamma(i / a) for i in (1, 2, 3)] for a in shapes]).T
    return shapes, np.exp(2 * logs[1] - logs[0] - logs[2]), np.exp((logs[0] - logs[2]) / 2)
