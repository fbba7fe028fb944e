"""The translation of the second layer of a burst, from the spectra of the frames. No estimate of a
layer is needed.

After the frames are aligned with the first layer, the spectrum of frame k is F_k = T + R exp(-i w
d_k). The differences to the reference frame do not contain T. For given translations d_k, R has a
closed least-squares solution; the part of the differences that it leaves unexplained is the cost of
d_k.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.threads import POOL

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Spectra = NDArray[np.complex64]

_MIN_ENERGY: Final = 1e-12
"""Added to energies, which are 0 where all frames are equal."""
_REFINEMENT_STEPS: Final = 60
_RATE: Final = 0.1
"""The step of the refinement, in pixels."""


@final
@dataclass(frozen=True)
class SearchRange:
    """The translations that are looked for, and the structures that show them."""

    width_px: int
    """The width of the frames of which the spectra are made."""
    shortest: float
    longest: float
    """The translations at the end of the path, as shares of the width."""
    sizes: int
    """The number of lengths between them, along each axis."""
    starts: int
    """The number of paths of the grid that are refined."""
    frequencies: tuple[float, float]
    """The smallest and the largest frequency, in periods per pixel."""
    large: float
    """The largest frequency of large structures, whose change is proportional to the motion."""
    has_line: bool
    """Whether the frames may also be equally far apart on a line, in the given order."""


LARGE_MOTIONS: Final = SearchRange(
    width_px=250,
    shortest=0.0004,
    longest=0.1,
    sizes=14,
    starts=3,
    frequencies=(0.01, 0.25),
    large=0.05,
    has_line=True,
)
"""Of a camera that is moved: 100 px of 1,000."""
SMALL_MOTIONS: Final = SearchRange(
    width_px=500,
    shortest=0.0005,
    longest=0.01,
    sizes=5,
    starts=2,
    frequencies=(0.008, 0.15),
    large=0.1,
    has_line=False,
)
"""Of a hand: .5 to 10 px of 1,000 from the reference frame. Codecs damp the finer structures of a
weak layer, and a hand moves along no line.
"""


@final
@dataclass(frozen=True)
class Translations:
    """A path of the second layer."""

    offsets: Doubles
    """(K, 2), from the reference frame to each frame, in pixels of the frames."""
    explained: float
    """The share of the change between the frames that a second layer with this path explains, 0..1,
    each frequency with its weight.
    """


def find_translations(
    aligned: Sequence[Floats],
    reference: int,
    on_step: Callable[[], None] = lambda: None,
    searched: SearchRange = LARGE_MOTIONS,
) -> list[Translations]:
    """Returns the translations of the second layer; the best are first.

    First the frames lie along a line with constant speed, or in a plane as their differences
    suggest, on a grid of sizes and directions. Then each frame of the best of these paths moves
    freely.

    Args:
        aligned: the frames, (h, w, 3) linear light, aligned with the first layer.
        reference: the index of the reference frame.
        on_step: called several times a second. An exception raised in it stops the work.
        searched: the translations that are looked for.
    """
    spectra, frequencies = _spectra(aligned, searched)
    energy, weights = _changes(spectra)
    if not energy.any():  # the frames are equal
        return []
    times = np.arange(len(aligned), dtype=float) - reference
    line = np.stack([times, 0 * times], 1)
    plane = _plane(spectra, frequencies, reference, searched.large)
    mirrored = plane * [1, -1]  # differences do not tell left from right
    width = searched.width_px
    lengths = np.geomspace(searched.shortest * width, searched.longest * width, searched.sizes)
    ends = np.concatenate([-lengths[::-1], [0], lengths])
    costs: list[Floats] = []
    paths = []
    for places in (line, plane, mirrored) if searched.has_line else (plane, mirrored):
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
    starts = _different(
        (path for path in grid[np.concatenate(costs).argsort()] if path.any()), searched.starts
    )
    refined = []
    for found in POOL.map(
        lambda path: _refined(spectra, frequencies, weights, reference, path), starts
    ):
        refined.append(found)
        on_step()
    scale = aligned[0].shape[1] / width
    total = float(weights @ energy)
    return [
        Translations(offsets=scale * path, explained=explained / total)
        for path, explained in _different_of(refined, searched.starts)
    ]


def explained_share(
    aligned: Sequence[Floats], reference: int, offsets: Doubles, searched: SearchRange
) -> float:
    """Returns the share of the change between the frames that a second layer with this path
    explains, 0..1, each frequency with its weight.

    Args:
        aligned: see `find_translations`; or the same part of each.
        reference: the index of the reference frame.
        offsets: (K, 2), see `Translations`.
        searched: the structures that count.
    """
    spectra, frequencies = _spectra(aligned, searched)
    energy, weights = _changes(spectra)
    scale = searched.width_px / aligned[0].shape[1]
    explained, _ = _explained(spectra, reference, _turns(scale * offsets, frequencies))
    return float(weights @ explained) / max(float(weights @ energy), _MIN_ENERGY)


def remaining_change(
    before: Sequence[Floats], after: Sequence[Floats], searched: SearchRange
) -> float:
    """Returns the energy of the change between frames relative to that of the same frames before a
    part of it was removed, each frequency with its weight.

    Args:
        before: (h, w, 3) linear light.
        after: the same frames.
        searched: the structures that count.
    """
    energy, weights = _changes(_spectra(before, searched)[0])
    remaining, _ = _changes(_spectra(after, searched)[0])
    return float(weights @ remaining) / max(float(weights @ energy), _MIN_ENERGY)


def _changes(spectra: Spectra) -> tuple[Floats, Floats]:
    """Returns the energy (n,) of the change between the frames, and the weights of the frequencies,
    which whiten it.
    """
    energy: Floats = np.square(np.abs(spectra - spectra.mean(0))).sum(0)
    weights: Floats = (energy + np.median(energy) + _MIN_ENERGY) ** -0.75
    return energy, weights


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


def _different_of(
    refined: Iterable[tuple[Doubles, float]], count: int
) -> list[tuple[Doubles, float]]:
    """Returns the paths that explain most and are not neighbours, with what they explain."""
    best = sorted(refined, key=lambda found: -found[1])
    chosen = _different((path for path, _ in best), count)
    return [found for found in best if any(found[0] is path for path in chosen)]


def _refined(
    spectra: Spectra, frequencies: Floats, weights: Floats, reference: int, path: Doubles
) -> tuple[Doubles, float]:
    """Returns the translations after steps of Adam, in which each frame but the reference frame
    moves freely, and the weighted energy that they explain.

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
    return offsets - offsets[reference], float(weights @ explained)


def _spectra(aligned: Sequence[Floats], searched: SearchRange) -> tuple[Spectra, Floats]:
    """Returns the spectra (K, n) and their angular frequencies (n, 2)."""
    width = searched.width_px
    height = round(width * aligned[0].shape[0] / aligned[0].shape[1])
    grey = np.stack(
        [
            cv2.resize(frame.mean(-1), (width, height), interpolation=cv2.INTER_AREA)
            for frame in aligned
        ]
    )
    window = np.outer(np.hanning(height), np.hanning(width))
    spectra = np.fft.fft2((grey - grey.mean((1, 2), keepdims=True)) * window)
    y, x = np.meshgrid(np.fft.fftfreq(height), np.fft.fftfreq(width), indexing="ij")
    radius = np.hypot(x, y)
    smallest, largest = searched.frequencies
    kept = (radius > smallest) & (radius < largest) & (x >= 0)
    frequencies = 2 * np.pi * np.stack([x[kept], y[kept]], -1)
    return spectra[:, kept].astype(np.complex64), frequencies.astype(np.float32)


def _plane(
    spectra: Spectra, frequencies: Floats, reference: int, largest_frequency: float
) -> Doubles:
    """Returns the places of the frames relative to the reference frame, (K, 2) in any unit, rotated
    or mirrored at will.

    Classical multidimensional scaling: of large structures, the change from frame to frame is
    proportional to the motion.

    Args:
        spectra: (K, n), from `_spectra`.
        frequencies: (n, 2), angular, in radians per pixel.
        reference: the index of the reference frame.
        largest_frequency: that of large structures, in periods per pixel.
    """
    is_large = np.linalg.norm(frequencies, axis=1) < 2 * np.pi * largest_frequency
    large = spectra[:, is_large].astype(complex)
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
