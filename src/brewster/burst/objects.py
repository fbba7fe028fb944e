"""Opaque objects between the glass and the wall, which move like a second layer: the measurement gives them back to the transmission.

A reflection adds its light to the transmission; an object hides it. Where the second layer has most of the light, the optimisation
starts again as if it were opaque. Where the photos show the transmission through it, it becomes transparent; where they show that
the transmission is hidden, most clearly at the edges that move over the wall, it stays opaque, and the photos are explained better.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.burst.joint_model import Floats, JointModel
from brewster.burst.optimiser import Rates, Weights, optimise

STEPS: Final = 120
_MIN_AREA: Final = 0.004
"""Smaller regions are ignored, as shares of the frame."""
_DOMINANT: Final = 0.55
"""The share of the second layer in the light of a region that may be an object."""
_CLEAR_OPACITY: Final = 0.6
_CLEAR_ERROR: Final = 0.85
"""A region is an object if its mean opacity is larger than the one, and the error in and around it falls below this share. On 32 simulated
bursts with objects, 23 of 26 such regions were objects; in five real bursts without objects there is none."""
_LIKELY_OPACITY: Final = 0.4
"""In a burst with an object, other regions with more than this opacity are parts of objects, too."""
_FIXED_OPACITY: Final = 1.5
"""Of objects: above 1, so that the next levels do not change it."""
_SMOOTHING_PX: Final = 2
_RING_PX: Final = 9


def with_objects(
    model: JointModel,
    frames: Floats,
    prior: Floats,
    *,
    rates: Rates,
    weights: Weights,
    on_step: Callable[[], None] = lambda: None,
) -> JointModel:
    """Returns the model with the objects of its second layer opaque, or the same model if there are none.

    Args:
        model: a single candidate with two transparent layers, after its optimisation.
        frames: (K, h, w, 4) linear light.
        prior: T of the reference frame from a single photo, (h, w, 4).
        rates, weights, on_step: see `optimise`.
    """
    size = frames.shape[1:3]
    transmission, reflection = (
        cv2.GaussianBlur(layer.mean(-1), (0, 0), _SMOOTHING_PX) for layer in model.reference_layers(*size)
    )
    is_dominant = reflection > _DOMINANT * (transmission + reflection + 1e-3)
    regions = _regions(is_dominant)
    if not regions:
        return model
    opaque = optimise(
        model.with_opacity(is_dominant.astype(np.float32)),
        frames,
        prior,
        STEPS,
        rates=rates,
        weights=weights,
        on_step=on_step,
    )
    opacity = opaque.reference_opacity(*size)
    errors, errors_if_opaque = (some.collected_errors(frames, layer=1) for some in (model, opaque))
    around = np.ones((_RING_PX, _RING_PX), np.uint8)

    def is_clear(region: NDArray[np.bool_]) -> bool:
        ring = cv2.dilate(region.astype(np.uint8), around) > 0
        is_better = errors_if_opaque[ring].mean() < _CLEAR_ERROR * errors[ring].mean()
        return bool(is_better and opacity[region].mean() > _CLEAR_OPACITY)

    if not any(is_clear(region) for region in regions):
        return model
    objects = np.any([region for region in regions if opacity[region].mean() > _LIKELY_OPACITY], 0)
    mask = cv2.dilate(objects.astype(np.float32), np.ones((3, 3), np.uint8))
    return opaque.with_opacity(_FIXED_OPACITY * mask, elsewhere=0)


def _regions(mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Returns the connected regions of a mask, without small and thin ones."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(opened)
    return [labels == n for n in range(1, count) if statistics[n, cv2.CC_STAT_AREA] >= _MIN_AREA * mask.size]
