"""Opaque objects between the glass and the wall, which move like a layer of their own and belong to the transmission.

A reflection adds its light to the transmission; an object hides it. Where the second layer has most of the light, the
optimisation starts again as if it were opaque. Where the photos show the transmission through it, it becomes
transparent; where they show that the transmission is hidden, most clearly at the edges that move over the wall, it
stays opaque, and the photos are explained better. These regions become the layer of the objects, and the reflection is
a third layer, whose motion is looked for again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.burst.joint_model import Doubles, Floats, JointModel
from brewster.burst.optimiser import Rates, Weights, optimise

OPACITY_STEPS: Final = 120
SEARCH_STEPS: Final = 40
"""Of all candidates for the motion of the reflection."""
FINAL_STEPS: Final = 70
"""Of the best ones."""
_KEPT: Final = 2
_MIN_AREA: Final = 0.004
"""Smaller regions are ignored, as shares of the frame."""
_DOMINANT: Final = 0.55
"""The share of the second layer in the light of a region that may be an object."""
_MAX_AREA: Final = 0.6
"""If all regions together are larger, they are the wall."""
_CLEAR_AREA: Final = 0.01
_CLEAR_OPACITY: Final = 0.7
_CLEAR_ERROR: Final = 0.9
_CLEAR_EDGE_ERROR: Final = 0.8
"""There are objects if a region is larger and more opaque than this, and the errors in and around it, and at its edge,
fall below these shares. Of 40 simulated bursts with objects and shop_statue, the clearest regions have at most .85 and
.75; without objects (7 real, 50 simulated), two have less than .9 around, .86 and .87, and these have .86 and .88 at
the edge. Chosen on these bursts."""
_LIKELY_OPACITY: Final = 0.5
"""What the optimisation leaves less opaque is no object; nor is a region that the photos do not show better if it is
opaque."""
_FIXED_OPACITY: Final = 1.5
"""Of objects: above 1, so that the next levels do not change it."""
_SMOOTHING_PX: Final = 2
_RING_PX: Final = 9


def with_objects(
    model: JointModel,
    frames: Floats,
    prior: Floats,
    motions: Sequence[Doubles],
    *,
    density: float,
    rates: Rates,
    weights: Weights,
    on_step: Callable[[], None] = lambda: None,
) -> tuple[JointModel, float] | None:
    """Returns a model of three layers, the wall, the objects and the reflection, and the data term of the same without
    a reflection; None if there are no objects.

    Args:
        model: a single candidate with two transparent layers, after its optimisation.
        frames: (K, h, w, 4) linear light.
        prior: T of the reference frame from a single photo, (h, w, 4). motions: candidates for the motion of the
            reflection, each (K, 3, 3), frame to reference. That of the objects is another one. density: see
            `JointModel.start`.
        rates, weights, on_step: see `optimise`.
    """

    def optimised(model: JointModel, steps: int) -> JointModel:
        return optimise(model, frames, prior, steps, rates=rates, weights=weights, on_step=on_step)

    chosen = _opaque_objects([model, model.exchanged()], frames, lambda opaque: optimised(opaque, OPACITY_STEPS))
    if chosen is None:
        return None
    pairs = np.array([[motion, motion] for motion in motions]).reshape(-1, 2, len(frames), 3, 3)
    dark = JointModel.start(frames, pairs, np.zeros(len(pairs), bool), model.reference, density)
    searched = optimised(_with_reflections(*chosen, dark), SEARCH_STEPS)
    best = searched.losses[1:].argsort()[:_KEPT] + 1
    final = optimised(searched.selected([0, *best]), FINAL_STEPS)
    return final.selected([int(final.losses[1:].argmin()) + 1]), float(final.data_losses[0])


def _opaque_objects(
    models: Sequence[JointModel], frames: Floats, optimised: Callable[[JointModel], JointModel]
) -> tuple[JointModel, JointModel] | None:
    """Returns the best model with nothing but opaque objects in its second layer, and the one of which it was made;
    None if there are no objects."""
    size = frames.shape[1:3]
    tried = []
    for model in models:
        transmission, reflection = (
            cv2.GaussianBlur(layer.mean(-1), (0, 0), _SMOOTHING_PX) for layer in model.reference_layers(*size)
        )
        is_dominant = reflection > _DOMINANT * (transmission + reflection + 1e-3)
        regions = _regions(is_dominant)
        if 0 < np.sum(regions) <= _MAX_AREA * is_dominant.size:
            tried.append((model, regions, model.with_opacity(is_dominant.astype(np.float32))))
    if not tried:
        return None
    together = optimised(JointModel.stacked([start for _, _, start in tried]))
    best = int(together.losses.argmin())
    model, regions, _ = tried[best]
    opaque = together.selected([best])
    mask = _object_mask(model, opaque, frames, regions)
    return None if mask is None else (opaque.with_opacity(_FIXED_OPACITY * mask, elsewhere=0), model)


def _object_mask(
    transparent: JointModel, opaque: JointModel, frames: Floats, regions: Sequence[NDArray[np.bool_]]
) -> Floats | None:
    """Returns 1 in the regions that are objects, and 0 elsewhere, (h, w); None if there are none."""
    opacity = opaque.reference_opacity(*frames.shape[1:3])
    errors, errors_if_opaque = (model.collected_errors(frames, layer=1) for model in (transparent, opaque))
    around, inwards = np.ones((_RING_PX, _RING_PX), np.uint8), np.ones((3, 3), np.uint8)

    def error_share(where: NDArray[np.bool_]) -> float:
        return float(errors_if_opaque[where].mean() / errors[where].mean())

    def is_clear(region: NDArray[np.bool_]) -> bool:
        edge = _dilated(region, around) & ~cv2.erode(region.astype(np.uint8), inwards).astype(bool)
        return bool(
            region.mean() > _CLEAR_AREA
            and opacity[region].mean() > _CLEAR_OPACITY
            and error_share(_dilated(region, around)) < _CLEAR_ERROR
            and error_share(edge) < _CLEAR_EDGE_ERROR
        )

    near = _dilated(np.any(regions, 0), around)
    opaque_regions = _regions(near & (opacity > _LIKELY_OPACITY))
    if not any(map(is_clear, opaque_regions)):
        return None
    objects = [region for region in opaque_regions if error_share(_dilated(region, around)) < 1]
    return _dilated(np.any(objects, 0), inwards).astype(np.float32)


def _with_reflections(objects: JointModel, additive: JointModel, dark: JointModel) -> JointModel:
    """Returns candidates with a third layer: none (black), what `additive` has outside of the objects, and the second
    layer of each candidate of `dark`."""
    is_opaque = objects.layers[0, 1, ..., 3:] > 0
    first = objects.layers[0].copy()
    first[1] *= is_opaque
    rest = np.where(is_opaque, 0, additive.layers[0, 1])
    thirds = [np.zeros_like(rest), rest, *dark.layers[:, 1]]
    count = len(thirds)
    homographies, splines = (
        np.repeat(each[:, [0, 1, 1]], count, 0) for each in (objects.homographies, objects.splines)
    )
    homographies[2:, 2], splines[2:, 2] = dark.homographies[:, 1], 0
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
    return [labels == n for n in range(1, count) if statistics[n, cv2.CC_STAT_AREA] >= _MIN_AREA * mask.size]
