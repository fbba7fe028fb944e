"""The loss of the compact network, and the validation metrics of both trainers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from torch import Tensor
from torch.nn import functional

from brewster.errors import ModelError
from brewster.srgb import to_linear
from brewster.training.data.mixtures import TrainingBatch

if TYPE_CHECKING:
    from jaxtyping import Float

_QUANTIZATION_MSE: Final = 1 / (12 * 255**2)
"""The mean squared error of rounding to 8 bits, 58.9 dB: smaller errors count as this one, so that no score is infinite."""
_SCALES = (1, 4, 16)
"""Side of the averaging windows of the loss, in pixels."""
_MAX_ADDED_SHARE = 0.05
"""Pixels where the glass added less light than this share of the photo's light count as unchanged."""
_MSE_FLOOR = 1e-3
"""Added to the mean squared error in the logarithm: below it, 30 dB, the gradient of a picture fades out."""


def separation_loss(layers: Float[Tensor, "n 6 h w"], batch: TrainingBatch) -> dict[str, Tensor]:
    """The loss of transmission and reflection, the channels of `layers`, on sRGB-encoded values as benchmarks measure them.

    - transmission, reflection: mean absolute error at three scales, so that a wrong overall tone weighs as much as wrong
      detail.
    - edges: mean absolute error of the transmission's gradients, so that edges of the reflection are removed
      (Zhang et al. 2018).
    - psnr: logarithm of each picture's squared error, so that easy pictures count as much as hard ones.

    Returns:
        The parts by name, scalars; the loss is their sum.
    """
    transmission, reflection = layers[:, :3], layers[:, 3:]
    edges = sum(
        functional.l1_loss(transmission.diff(dim=axis), batch.transmission_encoded.diff(dim=axis))
        for axis in (2, 3)
    )
    squared = (transmission - batch.transmission_encoded).square().mean(dim=(1, 2, 3))
    return {
        "transmission": _multiscale_error(transmission - batch.transmission_encoded).mean(),
        "reflection": 0.3
        * (_multiscale_error(reflection - batch.reflection_encoded) * batch.reflection_weight).mean(),
        "edges": edges,  # type: ignore[dict-item]
        "psnr": 0.02 * (squared + _MSE_FLOOR).log().mean(),
    }


def _multiscale_error(error: Tensor) -> Float[Tensor, " n"]:
    return sum(  # type: ignore[return-value]
        functional.avg_pool2d(error, scale).abs().mean(dim=(1, 2, 3)) for scale in _SCALES
    )


def psnr_gain_db(prediction: Tensor, photo: Tensor, ground_truth: Tensor) -> float:
    """PSNR of the prediction minus PSNR of the photo, in dB; pictures of one shape, encoded in 0..1."""
    errors = [functional.mse_loss(picture, ground_truth).item() for picture in (photo, prediction)]
    before, after = (max(error, _QUANTIZATION_MSE) for error in errors)
    return 10 * math.log10(before / after)


def tone_ratio(prediction: Tensor, photo: Tensor, ground_truth: Tensor) -> float:
    """Linear light of the prediction divided by that of the photo, over the pixels where the glass added almost no light.

    It is 1 for a network that keeps the exposure, and 1 if there is no such pixel. Pictures are (..., 3, h, w), encoded in
    0..1; the added light is photo - ground truth, and less than a twentieth of the photo's light in every channel.
    """
    before, after, wanted = (to_linear(picture) for picture in (photo, prediction, ground_truth))
    untouched = (
        (before - wanted < _MAX_ADDED_SHARE * before + _MAX_ADDED_SHARE**2)
        .all(dim=-3, keepdim=True)
        .expand_as(before)
    )
    light = before[untouched].sum()
    return (after[untouched].sum() / light).item() if light > 0 else 1.0


def check_finite(value: Tensor, step: int, name: str = "loss") -> Tensor:
    """Returns `value`, a scalar, if it is finite.

    Raises:
        ModelError: the value is NaN or infinite. The last checkpoint is still valid.
    """
    if value.isfinite():
        return value
    raise ModelError(
        f"the {name} is {value.item()} at step {step}",
        f"a finite {name}",
        "resume from the last checkpoint with a lower learning rate",
    )
