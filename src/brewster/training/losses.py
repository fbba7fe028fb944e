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

_ROUNDING: Final = 1 / (12 * 255**2)
"""The mean squared error of rounding to 8 bits; pictures that differ by less are the same, at 58.9 dB."""
_SCALES = (1, 4, 16)
_LITTLE = 0.05
_GOOD_ENOUGH = 1e-3
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
        "transmission": _at_all_scales(transmission - batch.transmission_encoded).mean(),
        "reflection": 0.3
        * (_at_all_scales(reflection - batch.reflection_encoded) * batch.reflection_weight).mean(),
        "edges": edges,  # type: ignore[dict-item]
        "psnr": 0.02 * (squared + _GOOD_ENOUGH).log().mean(),
    }


def _at_all_scales(error: Tensor) -> Float[Tensor, " n"]:
    return sum(  # type: ignore[return-value]
        functional.avg_pool2d(error, scale).abs().mean(dim=(1, 2, 3)) for scale in _SCALES
    )


def gain_db(answer: Tensor, photo: Tensor, truth: Tensor) -> float:
    """How much nearer to the truth the answer is than the photo, in dB of PSNR; encoded pictures in 0..1."""
    errors = [functional.mse_loss(picture, truth).item() for picture in (photo, answer)]
    before, after = (max(error, _ROUNDING) for error in errors)
    return 10 * math.log10(before / after)


def tone(answer: Tensor, photo: Tensor, truth: Tensor) -> float:
    """Light of the answer over that of the photo where the truth says that little was added; 1 if that is nowhere.

    Encoded pictures in 0..1; little is less than a twentieth of the photo's own light in every channel.
    """
    before, after, wanted = (to_linear(picture) for picture in (photo, answer, truth))
    untouched = (before - wanted < _LITTLE * before + _LITTLE**2).all(dim=-3, keepdim=True).expand_as(before)
    light = before[untouched].sum()
    return (after[untouched].sum() / light).item() if light > 0 else 1.0


def finite(value: Tensor, step: int, name: str = "loss") -> Tensor:
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
