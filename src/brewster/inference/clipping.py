"""Keeps white areas white: sky and lamps whose light is clipped in the photo.

A clipped pixel received at least the light of white, and how much more is unknown. If the predicted change is small, the
transmission of such a pixel is assumed to be white, too. On the development pairs, 94 % of the clipped pixels that the compact model
darkened by 10 to 30 of 255 levels are above 245 in the ground truth, and none of those that it darkened by more than 55.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from brewster.inference.assessment import encoded_change
from brewster.inference.guided_upsampling import Floats, box_mean
from brewster.inference.predictor import Prediction
from brewster.srgb import to_encoded

if TYPE_CHECKING:
    from jaxtyping import Float32

_CLIPPING_RAMP: Final = (0.85, 0.97)
"""Darkest channel of the photo, sRGB-encoded: below the first value, a pixel is not clipped; above the second, it is.
The ramp is wide, because a clipped area with a hard edge is visible in a bright sky."""
_CHANGE_RAMP: Final = (0.2, 0.25)
"""Predicted change, sRGB-encoded: below the first value, a clipped pixel keeps the photo; above the second, the prediction."""
_SMOOTHINGS: Final = 3
"""Number of 5 x 5 box filters that smooth the edges of kept areas."""


def keep_clipped_white(photo: Float32[Floats, "h w 3"], prediction: Prediction) -> Prediction:
    """Returns the prediction without small changes of clipped pixels.

    Args:
        photo: the photo at the largest input scale of the model, linear light in 0..1.
        prediction: the prediction at this input scale.
    """
    transmission = np.clip(photo + prediction.change, 0, 1)
    clipped = _smooth_step(to_encoded(photo.min(axis=2, keepdims=True)), _CLIPPING_RAMP)
    changed = _smooth_step(encoded_change(photo, transmission)[..., None], _CHANGE_RAMP)
    kept = clipped * (1 - changed)
    for _ in range(_SMOOTHINGS):
        kept = box_mean(kept)
    weight = 1 - kept
    override = prediction.override
    return replace(
        prediction,
        change=prediction.change * weight,
        reflection=prediction.reflection * weight,
        override=override and replace(override, weight=override.weight * weight),
    )


def _smooth_step(values: Floats, limits: tuple[float, float]) -> Floats:
    """Returns 0 below the first limit, 1 above the second, and a cubic polynomial with derivative 0 at both limits between."""
    low, high = limits
    share = np.clip((values - np.float32(low)) / np.float32(high - low), 0, 1)
    smooth: Floats = share * share * (3 - 2 * share)
    return smooth
