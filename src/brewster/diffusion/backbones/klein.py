"""FLUX.2 klein base-4B: 3.9 billion parameters, small enough for bf16 training on a 24 GB GPU."""

from typing import Any, ClassVar, Final, final

import torch
from torch import Tensor

from brewster.diffusion.backbones import backbone
from brewster.diffusion.prompt import PromptEmbedding

_CONDITION_TIME: Final = 10
"""The time coordinate of conditioning tokens. Generated tokens have 0; FLUX.2's first reference
image has 10.
"""


@final
class Klein(backbone.ClassifierFreeBackbone):
    """FLUX.2 klein (Black Forest Labs 2026) with classifier-free guidance, ignored by distilled
    models.
    """

    name = "klein"
    hub_id = "black-forest-labs/FLUX.2-klein-base-4B"
    licence = backbone.APACHE_2
    diffusers_usage = backbone.DiffusersUsage(
        "text_encoder=None, tokenizer=None",
        'negative_prompt_embeds=prompt["negative"],',
        "The pipeline silently rescales a condition of more than 1024 x 1024 pixels.",
    )
    classes: ClassVar = {
        "pipeline": "Flux2KleinPipeline",
        "transformer": "Flux2Transformer2DModel",
        "vae": "AutoencoderKLFlux2",
        "scheduler": "FlowMatchEulerDiscreteScheduler",
    }
    full_size: ClassVar = {
        "transformer": {
            "guidance_embeds": False,
            "num_layers": 5,
            "num_single_layers": 20,
            "num_attention_heads": 24,
            "joint_attention_dim": 7680,
        },
        "vae": {},
        "scheduler": backbone.FLUX_SCHEDULER,
    }
    tiny: ClassVar = {
        "transformer": {
            "guidance_embeds": False,
            "num_layers": 2,
            "num_single_layers": 2,
            "attention_head_dim": 16,
            "num_attention_heads": 2,
            "joint_attention_dim": 32,
            "timestep_guidance_channels": 32,
            "axes_dims_rope": (4, 4, 4, 4),
        },
        "vae": {"block_out_channels": (8, 8, 16, 16), "layers_per_block": 1, "norm_num_groups": 4},
        "scheduler": backbone.FLUX_SCHEDULER,
    }

    def statistics(self) -> tuple[Tensor, Tensor]:
        """See `Backbone.statistics`: the running statistics of the VAE's batch norm, one value per
        packed channel.
        """
        norm = self.vae.bn
        deviation = (norm.running_var.float() + self.vae.config.batch_norm_eps).sqrt()
        return norm.running_mean.float().view(1, -1, 1, 1), deviation.view(1, -1, 1, 1)

    def noise(self, size: tuple[int, int], seed: int) -> Tensor:
        """See `Backbone.noise`. For klein, diffusers draws the noise on the packed grid."""
        width, height = (side // self.size_divisor for side in size)
        return torch.randn(
            1, self.channels, height, width, generator=torch.Generator().manual_seed(seed)
        )

    def shift(self, tokens: int, steps: int) -> float:
        """mu by the empirical formula of Black Forest Labs. Up to 4300 tokens it is linear in the
        steps, through its values at 10 and 200 steps; above, it does not depend on them.
        """
        at_200 = 0.00016927 * tokens + 0.45666666
        if tokens > 4300:
            return at_200
        at_10 = 8.73809524e-05 * tokens + 1.89833333
        return at_200 + (at_200 - at_10) / 190 * (steps - 200)

    def positions(self, latents: Tensor, condition: Tensor) -> Tensor:
        """See `flux_positions`, (tokens, 4). The last column is the index in the text, which is 0
        for images.
        """
        return backbone.flux_positions(latents, condition, _CONDITION_TIME, torch.arange(1)).to(
            self.device
        )

    @classmethod
    def embed(cls, pipeline: Any, text: str) -> PromptEmbedding:  # noqa: ANN401 - a pipeline of diffusers
        """Hidden states of three layers of Qwen3, for the prompt and for the empty prompt."""
        embeds, _ = pipeline.encode_prompt(prompt=text)
        negative, _ = pipeline.encode_prompt(prompt="")
        return PromptEmbedding(cls.name, text, embeds.detach(), negative=negative.detach())

    def _velocity(
        self, latents: Tensor, condition: Tensor, sigma: Tensor, embeds: Tensor
    ) -> Tensor:
        zero = torch.arange(1)
        return self._run(
            latents,
            condition,
            sigma,
            embeds,
            guidance=None,
            txt_ids=torch.cartesian_prod(zero, zero, zero, torch.arange(embeds.shape[1])).to(
                self.device
            ),
            img_ids=self.positions(latents, condition),
        )
