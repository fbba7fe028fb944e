"""Exposure and white balance of photos of one scene in changing light, and their noise.

The edges of T are in all photos, with the gain of each photo; those of R change from photo to
photo. The gains are therefore the most frequent ratio of edges: the mode of their directions in K
dimensions, where K is the number of photos.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

CLIPPED: Final = 0.93
"""Brighter light may be clipped in a reduced photo."""
DARK: Final = np.float32(0.003)
"""Added to light before its square root, to which noise is about proportional."""
_EXPOSURE_STOPS: Final = 0.8
"""Photos whose mean light differs by more have details that are clipped in some of them only."""
_SAFE: Final = 0.7
"""Darker pixels of a reduced photo hardly contain clipped details. Others have edges that are too
weak: by them, the gain of a photo of two stops more was 8 % too small.
"""
_STRONG: Final = 0.8
"""The quantile of the strength above which edges count."""
_EDGES: Final = 12_000
"""The number of edges that are compared."""
_STARTS: Final = 120
"""The number of edges whose direction is tried first."""
_MIN_RATIO: Final = 0.15
"""An edge whose weakest photo has less of the strongest one is not that of T."""
_MIN_EXIF_RATIO: Final = 0.6
"""The same, of edges divided by the exposures of EXIF."""
_MAX_RATIO: Final = 2.0
"""Gains relative to the exposures of EXIF that differ more are not those of T."""
_WIDTHS: Final = (0.12, 0.08, 0.06, 0.05)
_CHANNEL_WIDTHS: Final = (0.06, 0.04)
"""The relative error at which an edge has a weight of exp(-1/2), from step to step."""
_MIN_EDGES: Final = 30
LAPLACIAN_NOISE: Final = 0.6745 * 20**0.5
"""The median of the absolute Laplacian of white noise with a standard deviation of 1."""


def half_size(frames: Floats) -> Floats:
    """Returns frames (K, h, w, 3) at half the size."""
    height, width = frames.shape[1:3]
    size = max(2, width // 2), max(2, height // 2)
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def gradients(image: Floats) -> Floats:
    """Returns the differences to the next pixel to the right and below, (2, ..., h, w, 3)."""
    right, below = np.zeros((2, *image.shape), np.float32)
    np.subtract(image[..., :, 1:, :], image[..., :, :-1, :], out=right[..., :, :-1, :])
    np.subtract(image[..., 1:, :, :], image[..., :-1, :, :], out=below[..., :-1, :, :])
    return np.stack([right, below])


def fit_gains(frames: Floats, reference: int, exposures: Doubles | None = None) -> Doubles:
    """Returns the gain of each photo and channel relative to the reference, (K, 3).

    Args:
        frames: (K, h, w, 3) aligned linear light.
        reference: the index of the reference frame.
        exposures: those of EXIF, (K,), of any unit; None: unknown. A polariser and the tones of the
            camera change the light of T, too: they only refute gains that are far from them, which
            are those of strong edges of R.
    """
    small = half_size(frames)
    of_light: Doubles = small.mean((1, 2), dtype=np.float64) + 1e-6
    of_light /= of_light[reference]
    fitted = _fitted(small, of_light, reference, None)
    gains = of_light if fitted is None else fitted
    if exposures is None:
        return gains
    ratios = gains.mean(1) / exposures
    if ratios.max() < _MAX_RATIO * ratios.min():
        return gains
    agreeing = _fitted(small, of_light, reference, exposures)
    return gains if agreeing is None else agreeing


def _fitted(
    small: Floats, of_light: Doubles, reference: int, exposures: Doubles | None
) -> Doubles | None:
    """Returns the gains by edges that agree with the exposures, or None if they are too few.

    Args:
        small: (K, h, w, 3) reduced photos.
        of_light: (K, 3): the gains by the mean light, as a start.
        reference: the index of the reference frame.
        exposures: see `fit_gains`; None: all edges count.
    """
    gains = of_light.copy()
    are_safe = _are_safe(small, gains)
    edges, are_valid = _edges((small / gains[:, None, None]).astype(np.float32))
    are_valid &= are_safe
    columns = edges[:, are_valid].T
    if exposures is not None:
        ratios = columns / (exposures / gains.mean(1))
        columns = columns[_are_shared(ratios, _MIN_EXIF_RATIO)]
    lengths = np.linalg.norm(columns, axis=1)
    is_strong = lengths > np.quantile(lengths, _STRONG) if len(lengths) else lengths > 0
    columns, lengths = _sampled(columns[is_strong], lengths[is_strong])
    directions: Floats = (columns / np.maximum(lengths, 1e-9)[:, None]).astype(np.float32)
    directions *= np.where(directions.sum(1, keepdims=True) < 0, -1, 1)
    weights = np.minimum(lengths, np.quantile(lengths, 0.95)) if len(lengths) else lengths
    is_shared = _are_shared(directions, _MIN_RATIO)
    if is_shared.sum() < _MIN_EDGES:
        return None
    mode = _mode(directions, weights, np.flatnonzero(is_shared))
    gains *= (mode / mode[reference])[:, None]
    for width in _CHANNEL_WIDTHS:
        edges, are_valid = _edges((small / gains[:, None, None]).astype(np.float32))
        are_valid &= are_safe
        for channel in range(3):
            gains[:, channel] *= _channel_factor(edges[:, are_valid[:, channel], channel], width)
    factors: Doubles = gains / gains[reference]
    return factors


def noise_level(frames: Floats) -> float:
    """Returns the standard deviation of the noise of the square root of light: what the details of
    the frames (K, h, w, 3) do not share.
    """
    details = np.stack([cv2.Laplacian(np.sqrt(frame + DARK), -1) for frame in frames])
    deviations = np.abs(details - np.median(details, axis=0))
    # The median of few frames takes a part of their noise
    share = np.sqrt(1 - 1 / len(frames))
    return float(np.median(deviations) / (LAPLACIAN_NOISE * share)) + 1e-4


def _edges(small: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Returns the edges of frames in units of noise, (K, n, 3), and which are not clipped."""
    scale = np.sqrt(small.mean(0) + DARK)
    edges = (gradients(small) / scale).transpose(1, 0, 2, 3, 4).reshape(len(small), -1, 3)
    are_valid = np.tile((small.max(0) < CLIPPED).reshape(-1, 3), (2, 1))
    return edges, are_valid


def _are_safe(small: Floats, gains: Doubles) -> NDArray[np.bool_]:
    """Returns which edges of frames (K, h, w, 3) are not near clipped details, (n, 1); all of them
    if the exposures, gains (K, 3), are about equal.
    """
    brightest = cv2.dilate(small.max((0, -1)), np.ones((3, 3), np.uint8))
    limit = _SAFE if np.ptp(np.log2(gains.mean(1))) > _EXPOSURE_STOPS else np.inf
    return np.tile((brightest < limit).reshape(-1, 1), (2, 1))


def _are_shared(columns: Floats, least: float) -> NDArray[np.bool_]:
    """Returns whether edges (n, K) can be those of T: they have one sign in all photos, and the
    weakest one is more than this part of the strongest one.
    """
    columns = columns * np.sign(columns.sum(1, keepdims=True))
    shared: NDArray[np.bool_] = columns.min(1) > least * columns.max(1)
    return shared


def _sampled(columns: Floats, lengths: Floats) -> tuple[Floats, Floats]:
    step = max(1, len(columns) // _EDGES)
    return columns[::step], lengths[::step]


def _mode(directions: Floats, weights: Floats, shared: NDArray[np.intp]) -> Doubles:
    """Returns the direction (K,) that most edges have in most of the photos.

    Args:
        directions: (n, K), normalised.
        weights: (n,)
        shared: the indices of the directions that can be those of T.
    """
    strongest = shared[np.argsort(-weights[shared], kind="stable")]
    starts = directions[strongest[:: max(1, len(strongest) // _STARTS)]]
    scores = [float(weights @ _agreement(directions, start, _WIDTHS[0])[0]) for start in starts]
    mode: Doubles = starts[int(np.argmax(scores))].astype(np.float64)
    for width in np.repeat(_WIDTHS, 5):
        share, kernel, strength = _agreement(directions, mode, width)
        weighted = kernel * (weights * share)[:, None]
        total = np.maximum((weighted * strength[:, None] ** 2).sum(0), 1e-12)
        mode = (weighted * directions * strength[:, None]).sum(0) / total
    return mode


def _agreement(
    directions: Floats, mode: Doubles | Floats, width: float
) -> tuple[Doubles, Doubles, Doubles]:
    """Returns how well edges agree with a direction: the squared share of the photos (n,), the
    agreement of each photo (n, K), and the strength of the edge (n,).
    """
    scaled = directions / np.maximum(mode, 1e-3)
    strength = np.median(scaled, axis=1)
    errors = (scaled - strength[:, None]) / np.maximum(np.abs(strength), 0.05)[:, None]
    kernel = np.exp(-np.square(errors) / (2 * width**2))
    return np.square(kernel.mean(1)), kernel, strength


def _channel_factor(edges: Floats, width: float) -> Doubles:
    """Returns by how much the gains of a channel must change, (K,). `edges` is (K, n)."""
    typical = np.median(edges, axis=0)
    strength = np.abs(typical)
    if len(strength) < _MIN_EDGES:
        return np.ones(len(edges))
    is_strong = strength > np.quantile(strength, 0.75)
    edges, typical, strength = edges[:, is_strong], typical[is_strong], strength[is_strong]
    if not len(strength):
        return np.ones(len(edges))
    errors = (edges - typical) / strength
    weights = np.exp(-np.square(errors) / (2 * width**2))
    weights *= np.minimum(strength, np.quantile(strength, 0.9))
    logarithms = np.log(np.maximum(edges / typical, 0.3))
    factors: Doubles = np.exp((weights * logarithms).sum(1) / (weights.sum(1) + 1e-9))
    return factors
