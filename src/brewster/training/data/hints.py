"""Simulated hints: rough strokes and boxes, painted over the reflection or over parts that show
only the scene.

    hints = simulate_hints(batch, probability=0.5, seed=7, step=0)

A hint is a soft mask in 0..1. FIRM (Chen et al., AAAI 2025) found that areas help a network, and
points do not.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torch.nn import functional

from brewster.photo.srgb import to_linear
from brewster.training.data.mixtures import TrainingBatch
from brewster.training.data.sample_rng import SampleRng

if TYPE_CHECKING:
    from jaxtyping import Float

    Mask = Float[Tensor, "_ _"]

_SEED_OFFSET: Final = 77
"""Separates the random numbers of the hints from those of the samples."""
_REFLECTED: Final = 0.35
_CLEAN: Final = 0.05
"""Shares of the reflection in the light of an area: "reflection" is above the first, "scene only"
below the second.
"""
_GRID: Final = 32
"""A person judges areas, not pixels: shares are computed on a grid of this many cells per side."""


def simulate_hints(
    batch: TrainingBatch, *, probability: float, seed: int, step: int
) -> Float[Tensor, "n 2 s s"]:
    """Returns two masks for each sample: where there is reflection, and where there is only the
    scene.

    A sample has hints with this probability, else both masks are zero. They depend on (seed, step,
    slot), layers.
    """
    transmission, reflection = (
        to_linear(layer).mean(dim=1)
        for layer in (batch.transmission_encoded, batch.reflection_encoded)
    )
    shares = functional.adaptive_avg_pool2d(reflection, _GRID) / (
        functional.adaptive_avg_pool2d(transmission + reflection, _GRID) + 1e-3
    )
    size = transmission.shape[-1]
    masks = [
        _sample_hints(SampleRng(seed + _SEED_OFFSET, step, slot), share, size, probability)
        for slot, share in enumerate(shares.cpu())
    ]
    return torch.stack(masks).to(batch.photo_encoded.device)


def _sample_hints(
    rng: SampleRng, share: Mask, size: int, probability: float
) -> Float[Tensor, "2 s s"]:
    if not rng.bernoulli(probability):
        return torch.zeros(2, size, size)
    areas = [(share > _REFLECTED).float(), (share < _CLEAN).float()]
    return torch.stack(
        [
            _painted(rng, area, size) if rng.bernoulli(0.75) else torch.zeros(size, size)
            for area in areas
        ]
    )


def _painted(rng: SampleRng, area: Mask, size: int) -> Mask:
    """Returns one to four strokes or boxes that start in the area. A careful hand stays within the
    dilated area.
    """
    if not area.any():
        return torch.zeros(size, size)
    cells = area.nonzero()
    strokes = torch.zeros(size, size)
    for _ in range(1 + rng.randint(4)):
        row, column = ((cells[rng.randint(len(cells))] + rng.uniform_tensor(2)) / _GRID).tolist()
        draw = _box if rng.bernoulli(0.3) else _stroke
        strokes = torch.maximum(strokes, draw(rng, row, column, size))
    if rng.bernoulli(0.7):
        dilated = functional.max_pool2d(area[None, None], 3, 1, 1)
        strokes = strokes * functional.interpolate(dilated, (size, size), mode="bilinear")[0, 0]
    return functional.avg_pool2d(strokes[None, None], 9, 1, 4)[0, 0] * rng.uniform((0.7, 1.0))


def _box(rng: SampleRng, row: float, column: float, size: int) -> Mask:
    """Returns a box of 0.08 to 0.5 of the side around a point (fractions of the side)."""
    height, width = rng.log_uniform((0.08, 0.5)), rng.log_uniform((0.08, 0.5))
    rows, columns = _coordinates(size)
    return ((rows - row).abs() < height / 2).float() * (
        (columns - column).abs() < width / 2
    ).float()


def _stroke(rng: SampleRng, row: float, column: float, size: int) -> Mask:
    """Returns a stroke of a broad brush: a chain of two to five segments from a point (fractions of
    the side).
    """
    radius = rng.log_uniform((0.02, 0.09))
    rows, columns = _coordinates(size)
    distance = torch.full((size, size), 9.0)
    angle = rng.uniform((0, 2 * math.pi))
    for _ in range(2 + rng.randint(4)):
        angle += rng.uniform((-1.2, 1.2))
        length = rng.log_uniform((0.05, 0.25))
        down, right = length * math.sin(angle), length * math.cos(angle)
        along = (((rows - row) * down + (columns - column) * right) / length**2).clamp(0, 1)
        distance = torch.minimum(
            distance, torch.hypot(rows - row - along * down, columns - column - along * right)
        )
        row, column = row + down, column + right
    return (distance < radius).float()


def _coordinates(size: int) -> tuple[Tensor, Tensor]:
    centres = (torch.arange(size) + 0.5) / size
    return centres[:, None], centres[None]
