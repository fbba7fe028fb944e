"""The loss of the compact network, and the validation metrics of both trainers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torch.nn import functional

from brewster.errors import ModelError
from brewster.photo.srgb import to_linear
from brewster.training.data.mixtures import TrainingBatch

if TYPE_CHECKING:
    from jaxtyping import Float

_QUANTIZATION_MSE: Final = 1 / (12 * 255**2)
"""The mean squared error of rounding to 8 bits (58.9 dB). Smaller errors are raised to it: no PSNR
is infinite.
"""
_SCALES = (1, 4, 16)
"""Side of the averaging windows of the loss, in pixels."""
_MAX_ADDED_FRACTION = 0.05
"""A pixel counts as unchanged if the glass added less light than about this fraction of the photo's
light.
"""
_CLIPPED = 0.98
"""An encoded value from which a channel counts as clipped: 250 of 255."""
_MSE_FLOOR = 1e-4
"""Added to the mean squared error before the logarithm, so that the gradient tends to 0 above a
PSNR of 40 dB.
"""


def separation_loss(
    layers: Float[Tensor, "n 6 h w"],
    batch: TrainingBatch,
    edge_weight: float = 1.0,
    edge_scales_px: Sequence[int] = (1,),
    clipped_weight: float = 0.0,
) -> dict[str, Tensor]:
    """Computes the loss of predicted layers: channels 0-2 are the transmission, 3-5 the reflection,
    sRGB-encoded.

    Returns its parts by name, each a scalar; the loss is their sum:

    - transmission: mean absolute error at three scales, so that a wrong exposure counts as much as
      wrong detail.
    - reflection: 0.3 times the same error of the reflection, multiplied by the `reflection_weight`
      of each image.
    - edges: `edge_weight` times the mean absolute error of the transmission's gradients, summed
      over averaging windows with the sides `edge_scales_px` (compare the gradient loss of CEILNet,
      Fan et al. 2017).
    - clipped: `clipped_weight` times the mean absolute error where photo and transmission are
      clipped.
    - log_mse: 0.04 times the mean logarithm of each image's mean squared error: easy images count
      as much as hard ones.

    A prediction above 1 is no error where the ground truth is clipped: the true light there is
    unknown.
    """
    transmission = layers[:, :3]
    reflection = layers[:, 3:]
    is_white = batch.transmission_encoded >= _CLIPPED
    error = (
        torch.where(is_white, transmission.clamp(max=1), transmission) - batch.transmission_encoded
    )
    edges = sum(
        functional.avg_pool2d(error, scale).diff(dim=axis).abs().mean()
        for scale in edge_scales_px
        for axis in (2, 3)
    )
    squared = error.square().mean(dim=(1, 2, 3))
    return {
        "transmission": _multiscale_error(error).mean(),
        "reflection": 0.3
        * (
            _multiscale_error(reflection - batch.reflection_encoded) * batch.reflection_weight
        ).mean(),
        "edges": edge_weight * edges,  # type: ignore[dict-item]
        "clipped": clipped_weight
        * (error.abs() * (is_white & (batch.photo_encoded >= _CLIPPED))).mean(),
        "log_mse": 0.04 * (squared + _MSE_FLOOR).log().mean(),
    }


def total(parts: Mapping[str, Tensor]) -> Tensor:
    """Returns the loss: the sum of its parts."""
    return torch.stack(list(parts.values())).sum()


def _multiscale_error(error: Tensor) -> Float[Tensor, " n"]:
    return sum(  # type: ignore[return-value]
        functional.avg_pool2d(error, scale).abs().mean(dim=(1, 2, 3)) for scale in _SCALES
    )


def psnr_gain_db(prediction: Tensor, photo: Tensor, ground_truth: Tensor) -> float:
    """Returns the PSNR of the prediction minus the PSNR of the photo, in dB, of sRGB-encoded images
    of one shape.
    """
    errors = [functional.mse_loss(image, ground_truth).item() for image in (photo, prediction)]
    before, after = (max(error, _QUANTIZATION_MSE) for error in errors)
    return 10 * math.log10(before / after)


def exposure_ratio(prediction: Tensor, photo: Tensor, ground_truth: Tensor) -> float:
    """Returns the linear light of the prediction divided by that of the photo, where the glass
    changed nothing.

    There, photo - ground truth < 0.05 photo + 0.0025 in every channel, in linear light; a pixel
    that became darker counts as unchanged. 1 for equal exposures, or without such pixels. Images
    are (..., 3, h, w), sRGB-encoded.
    """
    before, after, truth = (to_linear(image) for image in (photo, prediction, ground_truth))
    unchanged = (
        (before - truth < _MAX_ADDED_FRACTION * before + _MAX_ADDED_FRACTION**2)
        .all(dim=-3, keepdim=True)
        .expand_as(before)
    )
    light = before[unchanged].sum()
    return (after[unchanged].sum() / light).item() if light > 0 else 1.0


def check_finite(value: Tensor, step: int, name: str = "loss") -> Tensor:
    """Returns `value`, a scalar, if it is finite, else raises ModelError. The last checkpoint is
    still valid.
    """
    if value.isfinite():
        return value
    raise ModelError(
        f"the {name} is {value.item()} at step {step}",
        f"expected a finite {name}",
        "resume from the last checkpoint with a lower learning rate",
    )
