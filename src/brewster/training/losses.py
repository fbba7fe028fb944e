"""What a good separation is, as a number to minimise."""

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
"""The mean squared error of rounding to 8 bits; pictures that differ by less are the same, at 58.9 dB."""
_SCALES = (1, 4, 16)
_MAX_ADDED_SHARE = 0.05
_MSE_FLOOR = 1e-3
"""Mean squared error, 30 dB, past which a picture no longer pulls."""


def separation_loss(layers: Float[Tensor, "n 6 h w"], batch: TrainingBatch) -> dict[str, Tensor]:
    """The parts of the loss, scalars to be summed, on sRGB-encoded values as benchmarks measure them.

    Mean absolute error at three scales, so that a wrong overall tone weighs as much as wrong detail, and of
    the transmission's gradients, so that edges of the reflection do not stay behind (Zhang et al. 2018); and
    each picture's logarithmic error, which is its PSNR, so that easy pictures count as much as hard ones.
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
    """How much nearer to the ground truth the prediction is than the photo, in dB of PSNR; encoded pictures in 0..1."""
    errors = [functional.mse_loss(picture, ground_truth).item() for picture in (photo, prediction)]
    before, after = (max(error, _QUANTIZATION_MSE) for error in errors)
    return 10 * math.log10(before / after)


def tone_ratio(prediction: Tensor, photo: Tensor, ground_truth: Tensor) -> float:
    """Light of the prediction over that of the photo where the ground truth says that little was added; 1 if that is nowhere.

    Encoded pictures in 0..1; little is less than a twentieth of the photo's own light in every channel.
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
    """The loss, or what is named, if it is a number.

    Raises:
        ModelError: it is not; the last checkpoint is still good.
    """
    if value.isfinite():
        return value
    raise ModelError(
        f"the {name} is {value.item()} at step {step}",
        f"a finite {name}",
        "resume from the last checkpoint with a lower learning rate",
    )
