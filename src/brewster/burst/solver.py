"""Finds both layers and their motions, from coarse to fine: many candidates on small frames, the best one on larger frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brewster.burst.joint_model import JointModel, Rates, Weights, optimise
from brewster.burst.registration import MotionCandidate

Floats = NDArray[np.float32]


@final
@dataclass(frozen=True)
class _Level:
    """A step from coarse to fine."""

    long_side_px: int
    steps: int
    spline_size: tuple[int, int]
    """Rows and columns of the splines; 2 x 2 splines are zero at the start, and their rate is 0."""
    kept: int
    """The number of candidates that are optimised at this level."""


_LEVELS: Final = (
    _Level(80, 60, (2, 2), 99),
    _Level(160, 90, (4, 6), 4),
    _Level(320, 70, (6, 8), 1),
    _Level(640, 35, (8, 12), 1),
)


@final
@dataclass(frozen=True)
class Solution:
    """Both layers of the reference frame, (h, w, 3) linear light, and the model that explains the burst."""

    transmission: Floats
    reflection: Floats
    model: JointModel
    candidate: MotionCandidate
    losses: dict[str, float]
    """The loss of each candidate at the last level that optimised it."""


def solve(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    candidates: Sequence[MotionCandidate],
    *,
    weights: Weights = Weights(),
    levels: Sequence[_Level] = _LEVELS,
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> Solution:
    """Returns the layers of the reference frame for the best of the candidates.

    Args:
        frames: (h, w, 3) linear light, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        candidates: guesses for the motions.
        weights: the weights of the loss.
        levels: the sizes of the frames.
        on_progress: called with the completed fraction.
    """
    model, names, losses = None, list(range(len(candidates))), {}
    for index, level in enumerate(levels):
        small = _packed(frames, level.long_side_px)
        small_prior = _packed([prior], level.long_side_px)[0]
        if model is None:
            motions = np.stack([[c.transmission for c in candidates], [c.reflection for c in candidates]])
            model = JointModel.start(small, torch.from_numpy(motions).float(), reference)
        else:
            best = sorted(range(len(names)), key=model.losses.__getitem__)[: level.kept]
            model, names = model.selected(best), [names[i] for i in best]
            model = model.resized(small, level.spline_size)
        rates = Rates() if index == 0 else Rates().scaled(80 / level.long_side_px)
        if min(level.spline_size) <= 2:
            rates = Rates(splines=0)
        model = optimise(model, small, small_prior, level.steps, rates=rates, weights=weights)
        losses |= {candidates[i].name: loss for i, loss in zip(names, model.losses, strict=True)}
        on_progress((index + 1) / len(levels))
    assert model
    best_candidate = int(np.argmin(model.losses))
    with torch.no_grad():
        layers = model.selected([best_candidate]).reference_layers(*small.shape[-2:])[:, 0]
    transmission, reflection = (layer.movedim(0, -1).numpy() for layer in layers)
    return Solution(transmission, reflection, model, candidates[names[best_candidate]], losses)


def resized(image: Floats, long_side_px: int) -> Floats:
    """Returns an image, resized so that its long side has this length."""
    height, width = image.shape[:2]
    scale = long_side_px / max(height, width)
    size = max(8, round(width * scale)), max(8, round(height * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)


def _packed(images: Sequence[Floats], long_side_px: int) -> Tensor:
    """Returns resized images as a tensor (K, 3, h, w)."""
    small = np.stack([resized(image, long_side_px) for image in images])
    return torch.from_numpy(np.ascontiguousarray(small.transpose(0, 3, 1, 2), dtype=np.float32))
