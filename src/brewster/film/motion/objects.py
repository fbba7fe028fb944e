"""Opaque objects between the glass and the wall, which move like a layer of their own and belong to
the transmission.

A reflection adds its light to the transmission; an object hides it. Where the second layer has most
of the light, the optimisation starts again as if it were opaque. Where the photos show the
transmission through it, it becomes transparent; where they show that the transmission is hidden,
most clearly at the edges that move over the wall, it stays opaque, and the photos are explained
better. These regions become the layer of the objects, and the reflection is a third layer, whose
motion is looked for again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import Doubles, Floats, JointModel
from brewster.film.motion.model.optimiser import Rates, Weights, optimise

OPACITY_STEPS: Final = 110
FIRST_STEPS: Final = 12
"""Of all candidates for the motion of the reflection."""
SEARCH_STEPS: Final = 40
"""Of the better ones of them."""
_FIRST_KEPT: Final = 3
FINAL_STEPS: Final = 70
"""Of the best ones."""
_KEPT: Final = 2
_MIN_AREA: Final = 0.004
"""Smaller regions are ignored, as shares of the frame."""
_DOMINANT: Final = 0.55
"""The share of the second layer in the light of a region that may be an object."""
_MAX_AREA: Final = 0.6
"""If all regions together are larger, they are the wall."""
_LIKELY_OPACITY: Final = 0.5
"""What the optimisation leaves less opaque is no object; nor is a region that the photos do not
show better if it is opaque.
"""
_CLEAR_LOSS: Final = 0.9
"""There are objects if the loss with them falls below this share of the loss without, after the
same steps. Measured on real and simulated bursts, see dev/notes/burst.md.
"""
_FIXED_OPACITY: Final = 1.5
"""Of objects: above 1, so that the next levels do not change it."""
_MIN_SUM: Final = 1e-3
"""Added to the light of both layers, so that dark places are no object."""
_SMOOTHING_PX: Final = 2
"""Of the light of the layers, before their shares are compared."""
_RING_PX: Final = 9
"""The side of the square that dilates a region: it, and what is next to it, is looked at."""


def with_objects(
    model: JointModel,
    frames: Floats,
    prior: Floats,
    motions: Sequence[Doubles],
    *,
    density: float,
    rates: Rates,
    weights: Weights,
    edges_every: int = 1,
    on_step: Callable[[], None] = lambda: None,
) -> tuple[JointModel, tuple[JointModel, float] | None]:
    """Returns the model after more steps, and a model of three layers, the wall, the objects and
    the reflection, with the data term of the same without a reflection; None if there are no
    objects.

    Args:
        model: a single candidate with two transparent layers, after its optimisation.
        frames: (K, h, w, 4) linear light.
        prior: T of the reference frame from a single photo, (h, w, 4).
        motions: candidates for the motion of the reflection, each (K, 3, 3), frame to reference.
            That of the objects is another one.
        density: see `JointModel.start`.
        rates: see `optimise`.
        weights: see `optimise`.
        edges_every: see `optimise`.
        on_step: see `optimise`.
    """
    optimised = partial(
        optimise,
        frames=frames,
        prior=prior,
        rates=rates,
        weights=weights,
        edges_every=edges_every,
        on_step=on_step,
    )
    starts = _opaque_starts(model, frames.shape[1:3])
    together = optimised(
        JointModel.stacked([model, *(start.model for start in starts)]), steps=OPACITY_STEPS
    )
    additive = together.selected([0])
    if not starts:
        return additive, None
    best = int(together.losses[1:].argmin())
    start = starts[best]
    behind = additive.exchanged() if start.is_exchanged else additive
    opaque = together.selected([best + 1])
    mask = _object_mask(behind, opaque, frames, start.regions)
    if not mask.any():
        return additive, None
    objects = opaque.with_opacity(_FIXED_OPACITY * mask, elsewhere=0)
    candidates = _with_reflections(objects, behind, _dark_layers(model, frames, motions, density))
    first = _best_of(optimised(candidates, steps=FIRST_STEPS), _FIRST_KEPT)
    searched = _best_of(optimised(first, steps=SEARCH_STEPS), _KEPT)
    if searched.losses[1:].min() > additive.losses[0]:
        return additive, None  # more steps gained at most .08 of the loss
    final = optimised(searched, steps=FINAL_STEPS)
    found = final.selected([int(final.losses[1:].argmin()) + 1])
    is_clear = found.losses[0] < _CLEAR_LOSS * additive.losses[0]
    return additive, (found, float(final.data_losses[0])) if is_clear else None


def _best_of(model: JointModel, count: int) -> JointModel:
    """Returns the first candidate, which has no reflection, and the best `count` of the others."""
    return model.selected([0, *(model.losses[1:].argsort()[:count] + 1)])


@final
@dataclass(frozen=True)
class _OpaqueStart:
    """A model in which the second layer may hide the first one."""

    model: JointModel
    regions: NDArray[np.bool_]
    """(h, w): where the second layer is opaque in the reference frame."""
    is_exchanged: bool
    """Whether the second layer was the first one before."""


def _opaque_starts(model: JointModel, size: tuple[int, int]) -> list[_OpaqueStart]:
    """Returns the starts with objects in either layer, without those that have none or only
    objects.
    """
    starts = []
    for is_exchanged in (False, True):
        each = model.exchanged() if is_exchanged else model
        opaque, regions = _dominant(each, size)
        if 0 < regions.mean() <= _MAX_AREA:
            starts.append(_OpaqueStart(model=opaque, regions=regions, is_exchanged=is_exchanged))
    return starts


def _dark_layers(
    model: JointModel, frames: Floats, motions: Sequence[Doubles], density: float
) -> JointModel:
    """Returns one candidate for each motion, whose second layer is the darkest light of the frames
    aligned with it: the start of a reflection.

    Args:
        model: a model of the same frames.
        frames: (K, h, w, 4) linear light.
        motions: (K, 3, 3) each, frame to reference.
        density: see `JointModel.start`.
    """
    pairs = np.array([[motion, motion] for motion in motions]).reshape(-1, 2, len(frames), 3, 3)
    return JointModel.start(
        frames,
        pairs,
        np.zeros(len(pairs), bool),
        model.reference,
        density,
        exposures=model.exposures,
    )


def _dominant(model: JointModel, size: tuple[int, int]) -> tuple[JointModel, NDArray[np.bool_]]:
    """Returns the model with opaque regions in its second layer, where this has most of the light
    of the reference frame, and these regions (h, w).

    Args:
        model: a single candidate with two layers.
        size: height and width of the frames, (h, w).
    """
    transmission, reflection = (
        cv2.GaussianBlur(layer.mean(-1), (0, 0), _SMOOTHING_PX)
        for layer in model.reference_layers(*size)
    )
    is_dominant = reflection > _DOMINANT * (transmission + reflection + _MIN_SUM)
    regions = np.any([np.zeros(size, bool), *_regions(is_dominant)], 0)
    return model.with_opacity(is_dominant.astype(np.float32)), regions


def _object_mask(
    transparent: JointModel, opaque: JointModel, frames: Floats, regions: NDArray[np.bool_]
) -> Floats:
    """Returns 1 in the regions, and next to them, that may be objects, and 0 elsewhere, (h, w).

    Args:
        transparent: a single candidate whose second layer adds its light.
        opaque: a single candidate whose second layer may hide the first one.
        frames: (K, h, w, 4) linear light.
        regions: (h, w), where the objects were at the start.
    """
    opacity = opaque.reference_opacity(*frames.shape[1:3])
    errors, errors_if_opaque = (
        model.collected_errors(frames, layer=1) for model in (transparent, opaque)
    )
    around = np.ones((_RING_PX, _RING_PX), np.uint8)
    inwards = np.ones((3, 3), np.uint8)
    mask = np.zeros(opacity.shape, bool)
    for region in _regions(_dilated(regions, around) & (opacity > _LIKELY_OPACITY)):
        near = _dilated(region, around)
        if errors_if_opaque[near].mean() < errors[near].mean():
            mask |= _dilated(region, inwards)
    return mask.astype(np.float32)


def _with_reflections(objects: JointModel, additive: JointModel, dark: JointModel) -> JointModel:
    """Returns N + 2 candidates with a third layer: none (black), what `additive` has outside of the
    objects, and the second layer of each candidate of `dark`.

    Args:
        objects: a single candidate, the wall and the objects.
        additive: a single candidate, the wall and the light that is added to it.
        dark: N candidates, from `_dark_layers`.
    """
    is_opaque = objects.layers[0, 1, ..., 3:] > 0
    first = objects.layers[0].copy()
    first[1] *= is_opaque
    rest = np.where(is_opaque, 0, additive.layers[0, 1])
    thirds = [np.zeros_like(rest), rest, *dark.layers[:, 1]]
    count = len(thirds)
    homographies, splines = (
        np.repeat(each[:, [0, 1, 1]], count, 0) for each in (objects.homographies, objects.splines)
    )
    homographies[2:, 2] = dark.homographies[:, 1]
    splines[2:, 2] = 0
    return replace(
        objects,
        layers=np.stack([np.stack([*first, third]) for third in thirds]),
        homographies=homographies,
        splines=splines,
        log_gains=np.repeat(objects.log_gains, count, 0),
        is_locked=np.zeros(count, bool),
    )


def _dilated(mask: NDArray[np.bool_], kernel: NDArray[np.uint8]) -> NDArray[np.bool_]:
    dilated: NDArray[np.bool_] = cv2.dilate(mask.astype(np.uint8), kernel) > 0
    return dilated


def _regions(mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Returns the connected regions of a mask, without small and thin ones."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(opened)
    return [
        labels == n
        for n in range(1, count)
        if statistics[n, cv2.CC_STAT_AREA] >= _MIN_AREA * mask.size
    ]
