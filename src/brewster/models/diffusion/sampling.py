"""Generates panels from noise with the Euler steps of the pipelines in diffusers, but without their rescaling.

    images = sample(backbone, condition, prompt, size=(1536, 512), seeds=[0, 1])

The paper uses 20 steps and guidance 4 (Experimental Setup). Fewer steps are faster and less accurate. Averaging the
images of several seeds reduces details that the model invents, because they differ between seeds.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.offloading import explain_out_of_memory
from brewster.models.diffusion.prompt import PromptEmbedding
from brewster.models.diffusion.task import GUIDANCE, STEPS

if TYPE_CHECKING:
    from jaxtyping import Float

_MEMORY_HINT: Final = (
    "store the base in fewer bits (quantization), or use a smaller base_model or a GPU with more memory"
)


@torch.no_grad()
def sample(
    backbone: Backbone,
    condition: Float[Tensor, "1 3 p q"],
    prompt: PromptEmbedding,
    *,
    size: tuple[int, int],
    steps: int = STEPS,
    guidance: float = GUIDANCE,
    timestep_shift: float | None = None,
    last_sigma: float | None = None,
    seeds: Sequence[int] = (0,),
    start: Float[Tensor, "1 3 h w"] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Float[Tensor, "seeds 3 h w"]:
    """Generates one composite per seed, of this (width, height) in pixels.

    The noise is drawn on the CPU, so a seed gives the same noise on every device. A `start` image in [-1, 1] replaces it. For
    `timestep_shift` and `last_sigma`, see `Backbone.schedule`. `on_progress(done, total)` is called after each step.

    Returns the composites in [-1, 1], float32, on the CPU. `.mean(0, keepdim=True)` averages them.
    """
    done = itertools.count(1)
    images = []
    with explain_out_of_memory(_MEMORY_HINT):
        condition_latents = backbone.encode(condition)
        for seed in seeds:
            noise = backbone.noise(size, seed) if start is None else backbone.encode(start)
            tokens = noise.shape[2] * noise.shape[3]
            sigmas = backbone.schedule(tokens, steps, timestep_shift=timestep_shift, last_sigma=last_sigma)
            latents = noise.to(backbone.device)
            # An Euler step in float32: x(next sigma) = x(sigma) + (next sigma - sigma) velocity.
            for sigma, next_sigma in itertools.pairwise(sigmas.to(latents.device)):
                time = sigma.expand(len(latents))
                velocity = backbone.predict(latents, condition_latents, time, prompt, guidance)
                latents = latents + (next_sigma - sigma) * velocity
                if on_progress:
                    on_progress(next(done), steps * len(seeds))
            images.append(backbone.decode(latents).clamp(-1, 1).cpu())
    return torch.cat(images)
