"""Assesses a separation without ground truth: how much light was removed, where, and how reliable
the result is.

bench/verdict.py measures on photos with ground truth how often, and by how much, photos with each
verdict improve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, final

import numpy as np
from numpy.typing import NDArray

from brewster.photo.srgb import to_encoded
from brewster.separation.guided_upsampling import Floats
from brewster.separation.predictor import SPREAD_AT_1_E

if TYPE_CHECKING:
    from jaxtyping import Float32

Verdict = Literal["removed", "partly removed", "reflection remains", "little found", "doubtful"]
"""What the user sees, in the order of the measured gain.

- removed: the outputs of the model agree about a large change; only for a calibrated model.
- partly removed: a part of the reflection remains; also the best verdict of an uncalibrated model,
  and that of a model that does not estimate its confidence.
- reflection remains: the outputs differ about as much as they change; most of the reflection
  remains, as sharp reflections do.
- little found: the prediction differs little from the photo.
- doubtful: the result may be worse than the photo.

Layers that were measured in several photos have one of these verdicts from the measurement instead:
removed, partly removed, little found or doubtful (brewster/film/self_check.py).
"""

RECONSTRUCTION_ERROR_LIMIT: Final = 0.06
"""A separation with a larger reconstruction error is doubtful. The value is chosen, not measured:
about three times the error of encoding and decoding with the VAE of a diffusion model.
"""
_VISIBLE_CHANGE: Final = 0.03
"""The smallest change of a pixel that counts as visible, sRGB-encoded."""
_MIN_FOUND_AREA: Final = 0.1
"""If the prediction changes a smaller share of the separated pixels visibly, the verdict is "little
found".
"""
_AGREEMENTS: Final[tuple[tuple[float, Verdict], ...]] = (
    (3.0, "removed"),
    (1.5, "partly removed"),
    (0.7, "reflection remains"),
)
"""The smallest agreement of each verdict: the mean change divided by the mean spread
(bench/verdict.py fits them).
"""
_FILM: Final = "film the window for three seconds while moving the camera in a circle of 5 to 10 cm"
_CLOTH: Final = "take a second photo with a dark cloth behind a camera that stands"
_UNKNOWN_CONFIDENCE: Final = 1e-6
"""Lower confidences count as this one, so that the spread is finite."""


@final
@dataclass(frozen=True)
class Assessment:
    """What a separation found.

    `removed_light` and `changed_area` describe the transmission that is written, with its strength
    and its mask. `verdict` and `confidence` describe the prediction of the model where the strength
    is above 0.
    """

    verdict: Verdict
    removed_light: float
    """The removed light divided by the light of the photo, both linear, 0..1."""
    changed_area: float
    """The pixels that changed visibly (by more than 0.03 in sRGB values of 0..1), divided by all
    pixels.
    """
    confidence: float
    """Mean confidence, 0..1, weighted by the predicted change of each pixel; 1 if nothing changes.
    """


def assess(
    photo: Float32[NDArray[np.float32], "h w 3"],
    transmission: Float32[NDArray[np.float32], "h w 3"],
    confidence_map: Float32[NDArray[np.float32], "h w 1"],
    reconstruction_error: float | None = None,
    strength: Float32[NDArray[np.float32], "h w 1"] | float = 1.0,
    *,
    is_calibrated: bool = False,
) -> Assessment:
    """Assesses a separation.

    Args:
        photo: (h, w, 3), linear light.
        transmission: (h, w, 3), the predicted transmission in linear light.
        confidence_map: (h, w, 1), the confidence of the prediction, 0..1.
        reconstruction_error: mean of |generated input - input|, sRGB-encoded, or None.
        strength: the strength, 0..1, the same for all pixels or, with a mask, one for each pixel,
            (h, w, 1).
        is_calibrated: whether the verdicts were fitted to the model at this quality. Otherwise none
            is "removed".
    """
    written = photo + np.float32(strength) * (transmission - photo)
    light = float(photo.sum(dtype=np.float64))
    removed = float(np.maximum(photo - written, 0).sum(dtype=np.float64))
    is_separated = np.broadcast_to(strength, confidence_map.shape)[..., 0] > 0
    change = encoded_change(photo, transmission) * is_separated
    total = float(change.sum(dtype=np.float64))
    confidence = (
        float((change * confidence_map[..., 0]).sum(dtype=np.float64)) / total if total else 1.0
    )
    removed_light = removed / light if light else 0.0
    changed_area = float((encoded_change(photo, written) > _VISIBLE_CHANGE).mean())
    if not is_separated.any():
        return Assessment(
            verdict="little found",
            removed_light=removed_light,
            changed_area=changed_area,
            confidence=confidence,
        )
    found_area = float((change[is_separated] > _VISIBLE_CHANGE).mean())
    if reconstruction_error is not None and reconstruction_error > RECONSTRUCTION_ERROR_LIMIT:
        verdict: Verdict = "doubtful"
    elif found_area < _MIN_FOUND_AREA:
        verdict = "little found"
    elif not confidence:  # the model does not estimate its confidence
        verdict = "partly removed"
    else:
        spread = spread_from_confidence(confidence_map[..., 0])[is_separated].sum(dtype=np.float64)
        verdict = next((name for limit, name in _AGREEMENTS if total >= limit * spread), "doubtful")
    if verdict == "removed" and not is_calibrated:
        verdict = "partly removed"
    return Assessment(
        verdict=verdict,
        removed_light=removed_light,
        changed_area=changed_area,
        confidence=confidence,
    )


def next_step(
    verdict: Verdict, *, takes_hints: bool, where: str = "option hints", takes_films: bool = True
) -> str | None:
    """Returns what may help with a single photo, or None.

    Args:
        verdict: that of the single photo.
        takes_hints: whether the model takes hints.
        where: the control for hints.
        takes_films: whether films can be separated here.
    """
    steps = [_FILM] if takes_films else []
    if takes_hints:
        steps.append(f"mark the reflection ({where})")
    if verdict == "reflection remains":
        steps += [_CLOTH] if takes_films else []
        return f"To remove more, {', or '.join([*steps, 'use a larger model'])}."
    if verdict == "little found" and steps:
        return f"If you see a reflection, {', or '.join(steps)}."
    return None


def encoded_change(photo: Floats, transmission: Floats) -> Floats:
    """Returns the largest change of the three channels of each pixel, sRGB-encoded, (h, w)."""
    encoded = (to_encoded(np.clip(image, 0, 1)) for image in (photo, transmission))
    change: Floats = np.abs(np.subtract(*encoded)).max(axis=2)
    return change


def spread_from_confidence(confidence: Floats) -> Floats:
    """Returns the spread of the outputs, sRGB-encoded: the inverse of `confidence_from_spread`."""
    spread: Floats = -np.float32(SPREAD_AT_1_E) * np.log(
        np.maximum(confidence, np.float32(_UNKNOWN_CONFIDENCE))
    )
    return spread
