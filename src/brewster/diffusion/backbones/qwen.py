"""Qwen-Image-Edit: 20 billion parameters, Apache-2.0. The method WindowSeat uses it."""

from typing import Any, ClassVar, Final, final

import torch
from torch import Tensor

from brewster.diffusion.backbones.backbone import APACHE_2, PATCH, ClassifierFreeBackbone
from brewster.diffusion.prompt import PromptEmbedding

_SCHEDULER: Final = {
    "shift": 1.0,
    "use_dynamic_shifting": True,
    "base_shift": 0.5,
    "max_shift": 0.9,
    "base_image_seq_len": 256,
    "max_image_seq_len": 8192,
    "shift_terminal": 0.02,
}
_GREY_SIDE_PX: Final = 448


@final
class Qwen(ClassifierFreeBackbone):
    """Qwen-Image-Edit (Qwen team 2025), with classifier-free guidance that preserves the norm of
    each token. Unlike in diffusers, the conditioning image is not resized, and the text encoder
    gets a grey image.
    """

    name = "qwen"
    hub_id = "Qwen/Qwen-Image-Edit"
    licence = APACHE_2
    diffusers_usage = "but resizes the conditioning image to one megapixel, unlike in training"
    other_pipelines = ("QwenImageEditPlusPipeline",)
    unquantized = ("transformer_blocks.0.img_mod",)
    random_empty_tokens = 6
    text_encoder_requirements = ("torchvision",)
    classes: ClassVar = {
        "pipeline": "QwenImageEditPipeline",
        "transformer": "QwenImageTransformer2DModel",
        "vae": "AutoencoderKLQwenImage",
        "scheduler": "FlowMatchEulerDiscreteScheduler",
    }
    full_size: ClassVar = {"transformer": {}, "vae": {}, "scheduler": _SCHEDULER}
    tiny: ClassVar = {
        "transformer": {
            "num_layers": 2,
            "attention_head_dim": 16,
            "num_attention_heads": 2,
            "joint_attention_dim": 32,
            "axes_dims_rope": (4, 6, 6),
        },
        "vae": {"base_dim": 8, "num_res_blocks": 1},
        "scheduler": _SCHEDULER,
    }

    def statistics(self) -> tuple[Tensor, Tensor]:
        """See `Backbone.statistics`: one value per channel of the VAE, repeated for the four cells
        of a patch.
        """
        config = self.vae.config
        device = self.vae.device
        mean = torch.tensor(config.latents_mean, device=device).repeat_interleave(PATCH**2)
        deviation = torch.tensor(config.latents_std, device=device).repeat_interleave(PATCH**2)
        return mean.view(1, -1, 1, 1), deviation.view(1, -1, 1, 1)

    def positions(self, latents: Tensor, condition: Tensor) -> list[list[tuple[int, int, int]]]:
        """For each sample, (frames, rows, columns) of the generated image and of the conditioning
        image. The transformer computes the rotary position embedding from them, centred on each
        image that has tokens.
        """
        grids = (latents, condition) if condition.numel() else (latents,)
        shapes = [(1, int(grid.shape[2]), int(grid.shape[3])) for grid in grids]
        return [shapes] * len(latents)

    @classmethod
    def embed(cls, pipeline: Any, text: str) -> PromptEmbedding:  # noqa: ANN401 - a pipeline of diffusers
        """Qwen2.5-VL's last hidden states with a grey image, for the prompt and for an empty
        prompt.
        """
        grey = torch.full((3, _GREY_SIDE_PX, _GREY_SIDE_PX), 128, dtype=torch.uint8)
        embeds, _ = pipeline.encode_prompt(prompt=text, image=grey)
        negative, _ = pipeline.encode_prompt(prompt=" ", image=grey)
        return PromptEmbedding(cls.name, text, embeds.detach(), negative=negative.detach())

    def _velocity(
        self, latents: Tensor, condition: Tensor, sigma: Tensor, embeds: Tensor
    ) -> Tensor:
        shapes = self.positions(latents, condition)
        return self._run(latents, condition, sigma, embeds, img_shapes=shapes)

    def _guided(self, conditional: Tensor, unconditional: Tensor, guidance: float) -> Tensor:
        """The guided prediction, rescaled per token to the norm of the conditional one."""
        combined = super()._guided(conditional, unconditional, guidance)
        norm, new_norm = (
            torch.linalg.vector_norm(x, dim=1, keepdim=True) for x in (conditional, combined)
        )
        guided: Tensor = combined * (norm / new_norm)
        return guided

    def _vae_encode(self, image: Tensor) -> Tensor:
        return self.vae.encode(image[:, :, None]).latent_dist.mode()[:, :, 0]  # type: ignore[no-any-return]

    def _vae_decode(self, latent: Tensor) -> Tensor:
        return self.vae.decode(latent[:, :, None], return_dict=False)[0][:, :, 0]  # type: ignore[no-any-return]
