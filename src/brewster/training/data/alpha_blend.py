"""8-bit mixtures of the layers of a rendered sample: the baseline of the paper's ablation (Table 4, Figure 7).

RDNet blends two tone-mapped images, I = alpha T + beta R - T o R, where o is the element-wise product. In this formula, T is the
background and R the mirror image of a rendered sample, so that the mixture shows the same two scenes as the rendered photo.
"""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Final

from torch import Tensor

from brewster.render.camera_response import DevelopedSample
from brewster.scene.scene import Scene

ALPHA: Final = (0.8, 1.0)
BETA: Final = (0.4, 1.0)


def blend(transmission_encoded: Tensor, reflection_encoded: Tensor, alpha: float, beta: float) -> Tensor:
    """Returns I = alpha T + beta R - T o R (RDNet) of encoded images of one shape, rounded to 8 bits, in 0..1."""
    t, r = (_eight_bits(layer) for layer in (transmission_encoded, reflection_encoded))
    return _eight_bits(alpha * t + beta * r - t * r)


def blended(developed: DevelopedSample) -> DevelopedSample:
    """Returns the sample as an 8-bit mixture: T is the background, R is beta times the mirror image, and I is their blend."""
    photo, transmission, reflection = blended_layers(
        developed.background_encoded, developed.mirror_encoded, developed.scene
    )
    return replace(
        developed, photo_encoded=photo, transmission_encoded=transmission, reflection_encoded=reflection
    )


def blended_layers(
    background_encoded: Tensor, mirror_encoded: Tensor, scene: Scene
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns I, T and R of an 8-bit mixture, each (3, H, W) in 0..1, from encoded background and mirror image.

    T is the background. R is the mirror image times beta. alpha is uniform in 0.8..1, beta is uniform in 0.4..1. Both depend on
    the seed and the index of the scene only.
    """
    rng = Random(f"blend/{scene.seed}/{scene.index}")  # noqa: S311  (not for secrets)
    alpha, beta = rng.uniform(*ALPHA), rng.uniform(*BETA)
    background, mirror = _eight_bits(background_encoded), _eight_bits(mirror_encoded)
    return blend(background, mirror, alpha, beta), background, _eight_bits(beta * mirror)


def _eight_bits(encoded: Tensor) -> Tensor:
    return (encoded.clamp(0, 1) * 255).round() / 255
