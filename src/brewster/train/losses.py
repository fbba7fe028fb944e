"""What a good separation is, as a number to minimise."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor
from torch.nn import functional

from brewster.dataset.mix import Batch

if TYPE_CHECKING:
    from jaxtyping import Float

_SCALES = (1, 4, 16)
_GOOD_ENOUGH = 1e-3
"""Mean squared error, 30 dB, past which a picture no longer pulls."""


def separation_loss(layers: Float[Tensor, "n 6 h w"], batch: Batch) -> dict[str, Tensor]:
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
