"""The translation of the second layer of a burst, from the spectra of the frames. No estimate of a layer is needed.

After the frames are aligned with the first layer, the spectrum of frame k is F_k = T + R exp(-i w d_k). The differences to the
reference frame do not contain T. For given translations d_k, R has a closed least-squares solution; the part of the differences that
it leaves unexplained is the cost of d_k.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float32]

_WIDTH_PX: Final = 250
_MAX_TRANSLATION: Final = 0.1
"""The largest translation at the end of the path, as a share of the width."""
_GRID: Final = 14
_STARTS: Final = 3
_LARGE: Final = 0.05
"""The largest frequency of large structures, in periods per pixel."""
_REFINEMENT_STEPS: Final = 60


def find_translations(aligned: Sequence[Floats], reference: int) -> list[NDArray[np.float64]]:
    """Returns the translations (K, 2) in pixels of the second layer, from the reference frame to each frame; the best are first.

    First the frames lie along a line with constant speed, or in a plane as their differences suggest, on a grid of sizes and directions.
    Then each frame of the best of these paths moves freely.

    Args:
        aligned: the frames, (h, w, 3) linear light, aligned with the first layer.
        reference: the index of the reference frame.
    """
    spectra, frequencies, weights = _spectra(aligned)
    times = torch.arange(len(aligned), dtype=torch.float32) - reference
    line, plane = torch.stack([times, 0 * times], 1), _plane(spectra, frequencies, reference)
    mirrored = plane * torch.tensor([1, -1])  # differences do not tell left from right
    lengths = torch.logspace(-1, math.log10(_MAX_TRANSLATION * _WIDTH_PX), _GRID)
    ends = torch.cat([-lengths.flip(0), torch.zeros(1), lengths])
    grid = torch.cartesian_prod(ends, ends)[..., None, None]
    costs, paths = [], []
    for places in (line, plane, mirrored):
        along = places / (places.norm(dim=1).max() + 1e-9)
        across = along.flip(1) * torch.tensor([-1, 1])
        along_turns, across_turns = (
            torch.exp(-1j * ends[:, None, None] * (axis @ frequencies.T)) for axis in (along, across)
        )
        costs += [_costs(spectra, weights, reference, turn * across_turns) for turn in along_turns]
        paths.append(grid[:, 0] * along + grid[:, 1] * across)
    chosen: list[Tensor] = []
    for path in torch.cat(paths)[torch.cat(costs).argsort()]:  # the best ones that are not neighbours
        is_still = not path.any()
        if not is_still and all((path - other).norm() > 0.3 * other.norm() + 0.5 for other in chosen):
            chosen.append(path)
        if len(chosen) == _STARTS:
            break
    offsets = torch.stack(chosen).requires_grad_()
    optimiser = torch.optim.Adam([offsets], lr=0.1)
    for _ in range(_REFINEMENT_STEPS):
        optimiser.zero_grad()
        refined_costs = _costs(spectra, weights, reference, torch.exp(-1j * (offsets @ frequencies.T)))
        refined_costs.sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    found = offsets.detach() - offsets.detach()[:, reference : reference + 1]
    order = refined_costs.argsort()
    if not torch.isfinite(found).all():  # the frames are equal
        return []
    return list(found[order].double().numpy() * (aligned[0].shape[1] / _WIDTH_PX))


def _spectra(aligned: Sequence[Floats]) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the spectra (K, n), their angular frequencies (n, 2) and weights (n,) that whiten the changes."""
    height = round(_WIDTH_PX * aligned[0].shape[0] / aligned[0].shape[1])
    grey = np.stack(
        [cv2.resize(frame.mean(-1), (_WIDTH_PX, height), interpolation=cv2.INTER_AREA) for frame in aligned]
    )
    window = np.outer(np.hanning(height), np.hanning(_WIDTH_PX))
    spectra = np.fft.fft2((grey - grey.mean((1, 2), keepdims=True)) * window)
    y, x = np.meshgrid(np.fft.fftfreq(height), np.fft.fftfreq(_WIDTH_PX), indexing="ij")
    radius = np.hypot(x, y)
    kept = (radius > 2.5 / _WIDTH_PX) & (radius < 0.25) & (x >= 0)
    frequencies = 2 * np.pi * np.stack([x[kept], y[kept]], -1)
    selected = torch.from_numpy(spectra[:, kept]).to(torch.complex64)
    energy = (selected - selected.mean(0)).abs().square().sum(0)
    return selected, torch.from_numpy(frequencies).float(), (energy + energy.median()) ** -0.75


def _plane(spectra: Tensor, frequencies: Tensor, reference: int) -> Tensor:
    """Returns the places of the frames relative to the reference frame, (K, 2) in any unit, rotated or mirrored at will.

    Classical multidimensional scaling: of large structures, the change from frame to frame is proportional to the motion.
    """
    large = spectra[:, frequencies.norm(dim=1) < 2 * math.pi * _LARGE]
    centred = large - large.mean(0)
    values, vectors = torch.linalg.eigh((centred @ centred.mH).real)
    places: Tensor = vectors[:, -2:] * values[-2:].clamp(min=0).sqrt()
    return places - places[reference]


def _costs(spectra: Tensor, weights: Tensor, reference: int, phases: Tensor) -> Tensor:
    """Returns the share of the change that translations leave unexplained, (C,), from their phase factors (C, K, n)."""
    others = [k for k in range(len(spectra)) if k != reference]
    # The noise of the reference frame is in all differences: subtracting a share of their mean makes it independent
    share = 1 - 1 / np.sqrt(len(spectra))
    changes = spectra[others] - spectra[reference]
    changes = changes - share * changes.mean(0)
    turns = phases[:, others] - phases[:, reference : reference + 1]
    turns = turns - share * turns.mean(1, keepdim=True)
    explained = (turns.conj() * changes).sum(1).abs().square() / (turns.abs().square().sum(1) + 1e-3)
    total = changes.abs().square().sum(0)
    unexplained: Tensor = (weights * (total - explained)).sum(1) / (weights * total).sum()
    return unexplained
