"""FLUX.1 Kontext [dev], the paper's backbone: 11.9 billion parameters, with distilled guidance."""

from typing import Any, ClassVar, Final, final

import torch
from torch import Tensor

from brewster.diffusion.backbones import backbone
from brewster.diffusion.prompt import PromptEmbedding

_VAE: Final = {
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "latent_channels": 16,
    "scaling_factor": 0.3611,
    "shift_factor": 0.1159,
    "use_quant_conv": False,
    "use_post_quant_conv": False,
}


@final
class Kontext(backbone.Backbone):
    """FLUX.1 Kontext [dev] (Black Forest Labs 2025)."""

    name = "kontext"
    hub_id = "black-forest-labs/FLUX.1-Kontext-dev"
    licence = backbone.Licence(
        "FLUX.1 [dev] Non-Commercial License",
        {
            "license": "other",
            "license_name": "flux-1-dev-non-commercial-license",
            "license_link": "https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev/blob/main/LICENSE.md",
        },
        allows_commercial_use=False,
    )
    diffusers_usage = backbone.DiffusersUsage(
        "text_encoder=None, text_encoder_2=None, tokenizer=None, tokenizer_2=None",
        'pooled_prompt_embeds=prompt["pooled"], max_area={area}, _auto_resize=False,',
        "Without `max_area` and `_auto_resize=False` the pipeline silently rescales both images.",
    )
    classes: ClassVar = {
        "pipeline": "FluxKontextPipeline",
        "transformer": "FluxTransformer2DModel",
        "vae": "AutoencoderKL",
        "scheduler": "FlowMatchEulerDiscreteScheduler",
    }
    full_size: ClassVar = {
        "transformer": {"guidance_embeds": True},
        "vae": {**_VAE, "block_out_channels": (128, 256, 512, 512), "layers_per_block": 2},
        "scheduler": backbone.FLUX_SCHEDULER,
    }
    tiny: ClassVar = {
        "transformer": {
            "guidance_embeds": True,
            "num_layers": 2,
            "num_single_layers": 2,
            "attention_head_dim": 16,
            "num_attention_heads": 2,
            "joint_attention_dim": 32,
            "pooled_projection_dim": 16,
            "axes_dims_rope": (4, 6, 6),
        },
        "vae": {
            **_VAE,
            "block_out_channels": (8, 8, 16, 16),
            "layers_per_block": 1,
            "norm_num_groups": 4,
        },
        "scheduler": backbone.FLUX_SCHEDULER,
    }

    def statistics(self) -> tuple[Tensor, Tensor]:
        """See `Backbone.statistics`: FLUX.1's VAE has one shift and one scale for all channels."""
        config = self.vae.config
        mean = torch.full((1, 1, 1, 1), config.shift_factor, device=self.vae.device)
        return mean, 1 / torch.full_like(mean, config.scaling_factor)

    def positions(self, latents: Tensor, condition: Tensor) -> Tensor:
        """See `flux_positions`, (tokens, 3)."""
        return backbone.flux_positions(latents, condition, 1).to(self.device)

    def predict(
        self,
        latents: Tensor,
        condition: Tensor,
        sigma: Tensor,
        prompt: PromptEmbedding,
        guidance: float,
    ) -> Tensor:
        """See `Backbone.predict`. The guidance scale is an input of the transformer."""
        count = len(latents)
        has_guidance = self.transformer.config.guidance_embeds
        assert prompt.pooled is not None
        return self._run(
            latents,
            condition,
            sigma,
            prompt.embeds,
            pooled_projections=prompt.pooled.to(self.device, self.dtype).expand(count, -1),
            guidance=torch.full((count,), guidance, device=self.device) if has_guidance else None,
            txt_ids=torch.zeros(prompt.embeds.shape[1], 3, device=self.device),
            img_ids=self.positions(latents, condition).float(),
        )

    @classmethod
    def embed(cls, pipeline: Any, text: str) -> PromptEmbedding:  # noqa: ANN401 - a pipeline of diffusers
        """The token embeddings of T5 and the pooled vector of CLIP."""
        embeds, pooled, _ = pipeline.encode_prompt(prompt=text, prompt_2=text)
        return PromptEmbedding(cls.name, text, embeds.detach(), pooled.detach())

    @classmethod
    def random_prompt(cls, transformer: Any, seed: int) -> PromptEmbedding:  # noqa: ANN401 - a transformer of diffusers
        """Eight random tokens and a random pooled vector."""
        config = transformer.config
        shapes = {
            "embeds": (1, 8, config.joint_attention_dim),
            "pooled": (1, config.pooled_projection_dim),
        }
        return backbone.random_prompt(cls.name, seed, **shapes)
