"""The translation of the second layer of a burst, from the spectra of the frames. No estimate of a
layer is needed.

After the frames are aligned with the first layer, the spectrum of frame k is F_k = T + R exp(-i w
d_k). The differences to the reference frame do not contain T. For given translations d_k, R has a
closed least-squares solution; the part of the differences that it leaves unexplained is the cost of
d_k.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.burst.threads import POOL

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Spectra = NDArray[np.complex64]

_WIDTH_PX: Final = 250
_MAX_TRANSLATION: Final = 0.1
"""The largest translation at the end of the path, as a share of the width."""
_GRID: Final = 14
_STARTS: Final = 3
_LARGE: Final = 0.05
"""The largest frequency of large structures, in periods per pixel."""
_REFINEMENT_STEPS: Final = 60
_RATE: Final = 0.1
"""The step of the refinement, in pixels."""


def find_translations(
    aligned: Sequence[Floats], reference: int, on_step: Callable[[], None] = lambda: None
) -> list[NDArray[np.float64]]:
    """Returns the translations (K, 2) in pixels of the second layer, from the reference frame to
    each frame; the best are first.

    First the frames lie along a line with constant speed, or in a plane as their differences
    suggest, on a grid of sizes and directions. Then each frame of the best of these paths moves
    freely.

    Args:
        aligned: the frames, (h, w, 3) linear light, aligned with the first layer.
        reference: the index of the reference frame.
        on_step: called several times a second. An exception raised in it stops the work.
    """
    spectra, frequencies = _spectra(aligned)
    energy = np.square(np.abs(spectra - spectra.mean(0))).sum(0)
    if not energy.any():  # the frames are equal
        return []
    weights = (energy + np.median(energy) + 1e-12) ** -0.75  # whitens the changes
    times = np.arange(len(aligned), dtype=float) - reference
    line = np.stack([times, 0 * times], 1)
    plane = _plane(spectra, frequencies, reference)
    mirrored = plane * [1, -1]  # differences do not tell left from right
    lengths = np.geomspace(0.1, _MAX_TRANSLATION * _WIDTH_PX, _GRID)
    ends = np.concatenate([-lengths[::-1], [0], lengths])
    costs: list[Floats] = []
    paths = []
    for places in (line, plane, mirrored):
        along = places / (np.linalg.norm(places, axis=1).max() + 1e-9)
        across = along[:, ::-1] * [-1, 1]
        along_turns, across_turns = (
            _turns(ends[:, None, None] * axis, frequencies) for axis in (along, across)
        )

        def costs_of_row(turn: Spectra, across_turns: Spectra = across_turns) -> Floats:
            costs: Floats = -_explained(spectra, reference, turn * across_turns)[0] @ weights
            return costs

        for row in POOL.map(costs_of_row, along_turns):
            costs.append(row)
            on_step()
        paths.append(ends[:, None, None, None] * along + ends[:, None, None] * across)
    grid = np.concatenate(paths).reshape(-1, len(aligned), 2)
    chosen = _different(
        (path for path in grid[np.concatenate(costs).argsort()] if path.any()), _STARTS
    )
    refined = []
    for found in POOL.map(
        lambda path: _refined(spectra, frequencies, weights, reference, path), chosen
    ):
        refined.append(found)
        on_step()
    best = _different((path for path, _ in sorted(refined, key=lambda found: found[1])), _STARTS)
    return [path * (aligned[0].shape[1] / _WIDTH_PX) for path in best]


def _different(paths: Iterable[Doubles], count: int) -> list[Doubles]:
    """Returns the first paths (K, 2) that are not neighbours of earlier ones."""
    chosen: list[Doubles] = []
    for path in paths:
        norms = [(np.linalg.norm(path - other), np.linalg.norm(other)) for other in chosen]
        if all(distance > 0.3 * length + 0.5 for distance, length in norms):
            chosen.append(path)
        if len(chosen) == count:
            break
    return chosen


def _refined(
    spectra: Spectra, frequencies: Floats, weights: Floats, reference: int, path: Doubles
) -> tuple[Doubles, float]:
    """Returns the translations after steps of Adam, in which each frame but the reference frame
    moves freely, and their cost.

    Args:
        spectra: (K, n), from `_spectra`.
        frequencies: (n, 2), angular, in radians per pixel.
        weights: (n,), those of the frequencies in the cost.
        reference: the index of the reference frame.
        path: (K, 2), the translations at the start, in pixels.
    """
    offsets = path.copy()
    first = np.zeros_like(path)
    second = np.zeros_like(path)
    for step in range(1, _REFINEMENT_STEPS + 1):
        turns = _turns(offsets, frequencies)
        explained, slopes = _explained(spectra, reference, turns, with_slopes=True)
        gradient = -np.stack([slopes @ (weights * axis) for axis in frequencies.T], 1)
        first += 0.1 * (gradient - first)
        second += 0.001 * (gradient**2 - second)
        offsets -= _RATE * first / (1 - 0.9**step) / (np.sqrt(second / (1 - 0.999**step)) + 1e-8)
    return offsets - offsets[reference], -float(weights @ explained)


def _spectra(aligned: Sequence[Floats]) -> tuple[Spectra, Floats]:
    """Returns the spectra (K, n) and their angular frequencies (n, 2)."""
    height = round(_WIDTH_PX * aligned[0].shape[0] / aligned[0].shape[1])
    grey = np.stack(
        [
            cv2.resize(frame.mean(-1), (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            for frame in aligned
        ]
    )
    window = np.outer(np.hanning(height), np.hanning(_WIDTH_PX))
    spectra = np.fft.fft2((grey - grey.mean((1, 2), keepdims=True)) * window)
    y, x = np.meshgrid(np.fft.fftfreq(height), np.fft.fftfreq(_WIDTH_PX), indexing="ij")
    radius = np.hypot(x, y)
    kept = (radius > 2.5 / _WIDTH_PX) & (radius < 0.25) & (x >= 0)
    frequencies = 2 * np.pi * np.stack([x[kept], y[kept]], -1)
    return spectra[:, kept].astype(np.complex64), frequencies.astype(np.float32)


def _plane(spectra: Spectra, frequencies: Floats, reference: int) -> Doubles:
    """Returns the places of the frames relative to the reference frame, (K, 2) in any unit, rotated
    or mirrored at will.

    Classical multidimensional scaling: of large structures, the change from frame to frame is
    proportional to the motion.

    Args:
        spectra: (K, n), from `_spectra`.
        frequencies: (n, 2), angular, in radians per pixel.
        reference: the index of the reference frame.
    """
    large = spectra[:, np.linalg.norm(frequencies, axis=1) < 2 * np.pi * _LARGE].astype(complex)
    centred = large - large.mean(0)
    values, vectors = np.linalg.eigh((centred @ centred.conj().T).real)
    places = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0))
    relative: Doubles = places - places[reference]
    return relative


def _turns(offsets: Doubles, frequencies: Floats) -> Spectra:
    """Returns the phase factors (..., n) of translations (..., 2)."""
    turns: Spectra = np.exp(np.complex64(-1j) * (offsets.astype(np.float32) @ frequencies.T))
    return turns


def _explained(
    spectra: Spectra, reference: int, turns: Spectra, *, with_slopes: bool = False
) -> tuple[Floats, Floats]:
    """Returns the energy of the change that the best R explains, (..., n), and its derivatives by
    the phases, (K, n).

    Args:
        spectra: (K, n), from `_spectra`.
        reference: the index of the reference frame.
        turns: (..., K, n), from `_turns`.
        with_slopes: whether the derivatives are computed. Otherwise they are 0.
    """
    others = np.arange(len(spectra)) != reference
    # The noise of the reference frame is in all differences: subtracting a share of their mean
    # makes it independent
    share = np.float32(1 - 1 / np.sqrt(len(spectra)))
    changes = spectra[others] - spectra[reference]
    changes = changes - share * changes.mean(0)
    moved = turns[..., others, :] - turns[..., reference, None, :]
    moved = moved - share * moved.mean(-2, keepdims=True)
    product = (moved.conj() * changes).sum(-2)
    energy = np.square(np.abs(moved)).sum(-2) + np.float32(1e-3)
    explained = np.square(np.abs(product)) / energy
    slopes = np.zeros(spectra.shape, np.float32)
    if with_slopes:
        forces = (product.conj() * changes - explained * moved) / energy
        forces = forces - share * forces.mean(0)
        slopes[others] = -2 * (turns[others].conj() * forces).imag
    return explained, slopes
