"""Base classes of the diffusion backbones: encode, decode, predict the velocity, and list the
layers for a LoRA.

Latents are grids (N, C, H/16, W/16): the VAE's latents with each 2 x 2 patch packed into the
channels. One grid cell is one token of the transformer and 16 x 16 pixels of the image, and a panel
is a block of whole cells.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.diffusion.offloading import tiled_if_large
from brewster.diffusion.prompt import PROMPT, PromptEmbedding
from brewster.errors import ModelError

if TYPE_CHECKING:
    from jaxtyping import Float

PATCH: Final = 2
"""Side of a token in VAE latent pixels: all backbones pack 2 x 2 latent pixels into one token."""
_BLOCKS: Final = ("transformer_blocks", "single_transformer_blocks")
_LORA_PARTS: Final = ("lora_A", "lora_B")

Architecture = Mapping[str, Mapping[str, Any]]
"""The constructor arguments of the three parts "transformer", "vae" and "scheduler"."""


@final
@dataclass(frozen=True)
class Licence:
    """The licence of a base, which also applies to every LoRA of it."""

    title: str
    hub: Mapping[str, str]
    """The fields of the licence in the front matter of a model card on the hub."""
    allows_commercial_use: bool = True


APACHE_2: Final = Licence("Apache-2.0", {"license": "apache-2.0"})


@final
@dataclass(frozen=True)
class DiffusersUsage:
    """Python source for model cards: how to call the pipeline of diffusers so that it generates the
    same composite.
    """

    parts: str
    """Arguments of `from_pretrained` that leave out the text encoders."""
    options: str
    """Arguments of the call. {area}: the pixels of the composite. `prompt`: a dict with its
    tensors.
    """
    caution: str
    """One sentence on what the pipeline does without these options."""


class Backbone(ABC):
    """A flow-matching transformer that generates an image from a conditioning image, with its VAE
    and scheduler.

    Time is sigma: 1 is noise, 0 is the image. The transformer predicts velocity = noise - latents
    of the image.
    """

    name: ClassVar[str]
    hub_id: ClassVar[str]
    licence: ClassVar[Licence]
    diffusers_usage: ClassVar[DiffusersUsage | str]
    """For model cards: how to call the pipeline of diffusers, or a clause "but ..." on why its
    image differs.
    """
    classes: ClassVar[Mapping[str, str]]
    """Class names in diffusers of the "pipeline", "transformer", "vae" and "scheduler"."""
    full_size: ClassVar[Architecture]
    tiny: ClassVar[Architecture]
    other_pipelines: ClassVar[tuple[str, ...]] = ()
    """Class names in diffusers of other pipelines for the same transformer, VAE and scheduler."""
    unquantized: ClassVar[tuple[str, ...]] = ()
    """Layers that stay in full precision with nf4."""
    text_encoder_requirements: ClassVar[tuple[str, ...]] = ()
    """Libraries that the text encoders need in addition to the extra `diffusion`."""
    size_divisor: ClassVar[int] = 16
    """The sides of a panel must be multiples of this, in pixels."""

    def __init__(
        self,
        transformer: Any,  # noqa: ANN401
        vae: Any,  # noqa: ANN401
        scheduler: Any,  # noqa: ANN401
        *,
        distilled: bool = False,
        dtype: torch.dtype | None = None,
    ) -> None:
        """`dtype` is the data type of the transformer's computations, by default that of its
        parameters. It cannot be read from a quantized transformer: with nf4, only a few float32
        layers are floating-point.
        """
        self.dtype: torch.dtype = dtype or transformer.dtype
        self.transformer = transformer.eval().requires_grad_(False)
        self.vae = vae.eval().requires_grad_(False)
        self.scheduler = scheduler
        self.distilled = distilled

    @property
    def device(self) -> torch.device:
        """The device of the transformer."""
        device = self.transformer.device
        assert isinstance(device, torch.device)
        return device

    @property
    def channels(self) -> int:
        """The number of channels of a latent grid, that is, values per token."""
        return int(self.transformer.config.in_channels)

    @torch.no_grad()
    def encode(self, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c h/16 w/16"]:
        """Encodes images in [-1, 1] to normalised latent grids, float32: the mode of the VAE's
        distribution. Encode the whole composite at once. Panels that are encoded separately differ
        at the seams and, because of GroupNorm, everywhere. The sides must be multiples of
        `size_divisor`.
        """
        mean, deviation = self.statistics()
        cells = self._vae_encode(image.to(self.vae.device, self.vae.dtype))
        return (functional.pixel_unshuffle(cells, PATCH).float() - mean) / deviation

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 3 16*h 16*w"]:
        """Decodes latent grids to images, float32, about [-1, 1], not clamped. Large ones are
        decoded in tiles.
        """
        mean, deviation = self.statistics()
        grid = latents.to(self.vae.device).float() * deviation + mean
        latents = functional.pixel_shuffle(grid, PATCH).to(self.vae.dtype)
        with tiled_if_large(self.vae, pixels=grid[:, 0].numel() * self.size_divisor**2):
            return self._vae_decode(latents).float()

    @abstractmethod
    def statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the packed latents of natural images, float32 (1, C, 1, 1)
        or (1, 1, 1, 1).
        """

    @abstractmethod
    def predict(
        self,
        latents: Float[Tensor, "n c h w"],
        condition: Float[Tensor, "n c p q"],
        sigma: Float[Tensor, " n"],
        prompt: PromptEmbedding,
        guidance: float,
    ) -> Float[Tensor, "n c h w"]:
        """The velocity (noise - latents) at time sigma, differentiable. `condition` may be
        `no_condition()`.
        """

    @abstractmethod
    def positions(self, latents: Tensor, condition: Tensor) -> Any:  # noqa: ANN401 - each backbone has its own type
        """The position ids of the generated tokens, then of the conditioning tokens, as the
        transformer takes them.
        """

    @classmethod
    @abstractmethod
    def embed(cls, pipeline: Any, text: str) -> PromptEmbedding:  # noqa: ANN401 - a pipeline of diffusers
        """Encodes a prompt with the text encoders of a diffusers pipeline."""

    @classmethod
    @abstractmethod
    def random_prompt(cls, transformer: Any, seed: int) -> PromptEmbedding:  # noqa: ANN401 - a transformer of diffusers
        """A random embedding with the shapes of a prompt, for tiny versions, which have no text
        encoder.
        """

    def no_condition(self) -> Float[Tensor, "1 c 0 0"]:
        """An encoded conditioning image without tokens, for `predict`."""
        return torch.empty(1, self.channels, 0, 0, device=self.device)

    def noise(self, size: tuple[int, int], seed: int) -> Float[Tensor, "1 c h w"]:
        """The noise from which the diffusers pipeline starts for a composite of this (width,
        height) and seed. It is drawn on the CPU, so it is the same for every device. The sides must
        be multiples of `size_divisor`.
        """
        width, height = (side // self.size_divisor * PATCH for side in size)
        shape = (1, self.channels // PATCH**2, height, width)
        return functional.pixel_unshuffle(_seeded_noise(shape, seed), PATCH)

    def shift(self, tokens: int, steps: int) -> float:  # noqa: ARG002 - the shift of klein depends on the steps
        """The schedule's shift mu for a composite of this many generated tokens, without those of
        the condition. A linear function of the number of tokens, through the points
        (base_image_seq_len, base_shift) and (max_image_seq_len, max_shift) of the scheduler (Esser
        et al. 2024; FLUX).
        """
        config = self.scheduler.config
        low = config.base_image_seq_len
        high = config.max_image_seq_len
        slope = (config.max_shift - config.base_shift) / (high - low)
        return float(config.base_shift + slope * (tokens - low))

    def shifted(self, sigma: Tensor, tokens: int, steps: int = 20) -> Tensor:
        """Shifts times in (0, 1] towards noise, as the sampling schedule does. Used in training."""
        scheduler = self.scheduler
        if scheduler.config.use_dynamic_shifting:
            shifted = scheduler.time_shift(self.shift(tokens, steps), 1.0, sigma)
            assert isinstance(shifted, Tensor)
            return shifted
        factor: float = scheduler.shift
        return factor * sigma / (1 + (factor - 1) * sigma)

    def schedule(self, tokens: int, steps: int) -> Float[Tensor, " sigmas"]:
        """The sigmas of the scheduler of diffusers: steps + 1 decreasing values from 1 to 0.

        Before the shift towards noise (see `shift`), they are evenly spaced from 1 to 1 / steps,
        and then 0. Some schedulers then also stretch the sigmas, so that the last one above 0 is
        their `shift_terminal`.
        """
        # A shift does not change sigma 1, but stretching to `shift_terminal` would divide 0 by 0.
        if steps == 1:
            return torch.tensor([1.0, 0.0])
        scheduler = type(self.scheduler).from_config(self.scheduler.config)
        options = {"mu": self.shift(tokens, steps)} if scheduler.config.use_dynamic_shifting else {}
        scheduler.set_timesteps(sigmas=np.linspace(1.0, 1 / steps, steps), **options)
        sigmas = scheduler.sigmas
        assert isinstance(sigmas, Tensor)
        return sigmas

    def lora_targets(self) -> list[str]:
        """The full names of all linear layers in the blocks. Full names are necessary, because a
        short name such as proj_out also matches layers outside the blocks.
        """
        return [
            name.removesuffix(".base_layer")
            for name, module in self.transformer.named_modules()
            if isinstance(module, nn.Linear)
            and name.split(".")[0] in _BLOCKS
            and not set(name.split(".")) & set(_LORA_PARTS)
        ]

    def _vae_encode(self, image: Tensor) -> Tensor:
        return self.vae.encode(image).latent_dist.mode()  # type: ignore[no-any-return]

    def _vae_decode(self, latent: Tensor) -> Tensor:
        return self.vae.decode(latent, return_dict=False)[0]  # type: ignore[no-any-return]

    def _run(
        self, latents: Tensor, condition: Tensor, sigma: Tensor, embeds: Tensor, **inputs: object
    ) -> Tensor:
        """The transformer's prediction for a prompt embedding (1, tokens, width), as a grid,
        float32. `inputs` are the inputs that only this transformer has.
        """
        # Generated tokens, then conditioning tokens, each row by row.
        grids = [latents, condition.expand(len(latents), -1, -1, -1)]
        tokens = self.transformer(
            hidden_states=torch.cat([grid.flatten(2).mT for grid in grids], dim=1).to(
                self.device, self.dtype
            ),
            encoder_hidden_states=embeds.to(self.device, self.dtype).expand(len(latents), -1, -1),
            timestep=sigma.to(self.device, self.dtype),
            return_dict=False,
            **inputs,
        )[0]
        generated: Tensor = tokens[:, : latents.shape[2] * latents.shape[3]].mT.float()
        return generated.reshape(latents.shape)


class ClassifierFreeBackbone(Backbone):
    """A backbone with classifier-free guidance (Ho & Salimans 2022): a guidance above 1 needs a
    second prediction.
    """

    random_empty_tokens: ClassVar[int] = 8
    """The tokens of the empty prompt in `random_prompt`."""

    @classmethod
    def random_prompt(cls, transformer: Any, seed: int) -> PromptEmbedding:  # noqa: ANN401 - a transformer of diffusers
        """Eight random tokens for the prompt, and `random_empty_tokens` for the empty prompt."""
        width = transformer.config.joint_attention_dim
        count = cls.random_empty_tokens
        return random_prompt(cls.name, seed, embeds=(1, 8, width), negative=(1, count, width))

    def predict(
        self,
        latents: Tensor,
        condition: Tensor,
        sigma: Tensor,
        prompt: PromptEmbedding,
        guidance: float,
    ) -> Tensor:
        """See `Backbone.predict`. A distilled model ignores the guidance."""
        conditional = self._velocity(latents, condition, sigma, prompt.embeds)
        if guidance <= 1 or self.distilled:
            return conditional
        if prompt.negative is None:
            raise ModelError(
                f"the prompt for {prompt.backbone} has no embedding of the empty prompt",
                "expected this embedding for a guidance above 1",
                "encode the prompt again or set the guidance to 1",
            )
        unconditional = self._velocity(latents, condition, sigma, prompt.negative)
        return self._guided(conditional, unconditional, guidance)

    @abstractmethod
    def _velocity(
        self, latents: Tensor, condition: Tensor, sigma: Tensor, embeds: Tensor
    ) -> Tensor:
        """The transformer's prediction for this prompt embedding, (1, tokens, width)."""

    def _guided(self, conditional: Tensor, unconditional: Tensor, guidance: float) -> Tensor:
        """Extrapolates from the prediction for the empty prompt to that for the prompt."""
        return unconditional + guidance * (conditional - unconditional)


FLUX_SCHEDULER: Final = {
    "shift": 3.0,
    "use_dynamic_shifting": True,
    "base_shift": 0.5,
    "max_shift": 1.15,
    "base_image_seq_len": 256,
    "max_image_seq_len": 4096,
}
"""The scheduler of FLUX.1 and FLUX.2."""


def flux_positions(
    latents: Tensor, condition: Tensor, condition_id: int, *last_columns: Tensor
) -> Tensor:
    """Position ids of FLUX, a row for each token: image (0: generated, else `condition_id`), row,
    column, others.
    """
    ids = [
        torch.cartesian_prod(
            torch.tensor([image]), *map(torch.arange, grid.shape[2:]), *last_columns
        )
        for grid, image in ((latents, 0), (condition, condition_id))
    ]
    return torch.cat(ids)


def random_prompt(backbone: str, seed: int, **shapes: tuple[int, ...]) -> PromptEmbedding:
    """The paper's prompt with random tensors of these shapes as its embedding."""
    tensors = {
        name: _seeded_noise(shape, seed + i)
        for i, (name, shape) in enumerate(sorted(shapes.items()))
    }
    return PromptEmbedding(backbone, PROMPT, **tensors)


def _seeded_noise(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))
