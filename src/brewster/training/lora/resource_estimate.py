"""Estimates the tokens, memory and time of a LoRA recipe before anything is downloaded.

estimate = estimate_resources(recipe, CARDS["RTX 4090"])
print(estimate.table())
estimate.check_fits()

Parameters and operations are counted on a backbone without storage (torch's device "meta"). Memory and time are computed from
these counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from typing import Final, final

import torch
from torch.utils.flop_counter import FlopCounterMode

from brewster.errors import DeviceError
from brewster.models.diffusion.adapter.lora import select_target_modules
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.registry import build, find_backbone_class
from brewster.models.diffusion.memory import GIB, weights_gib
from brewster.models.diffusion.panels import fit_panel
from brewster.models.diffusion.prompt import PromptEmbedding
from brewster.models.zoo import TINY_PREFIX
from brewster.options import Quantization
from brewster.training.recipe import ENCODED_SUFFIX, LoraRecipe

_SQUARE_PHOTO_PX: Final = (4096, 4096)
"""A large square photo: its panels fill the pixel budget best."""
_PROMPT_TOKENS: Final = 512
_BYTES_PER_LORA_WEIGHT: Final = {"adamw": 16, "adamw8bit": 10}
"""Bytes of a weight, its gradient, and its two moments in AdamW. The moments are float32 or have 8 bits."""
_HIDDEN_STATES_PER_BLOCK: Final = 36
"""Size of the activations of one block, divided by the size of a hidden state. Gradient checkpointing recomputes one block at a
time. In addition, the input of each block is stored, which is one hidden state."""
_OVERHEAD_GIB: Final = 1.5
"""GPU memory of the CUDA context and the activations of the VAE."""
_HOST_OVERHEAD_GIB: Final = 4.0
"""Host memory of Python, torch and the data. The backbone is loaded directly to the GPU."""
_FORWARD_PASSES_PER_STEP: Final = 3
"""Forward pass, recomputation for gradient checkpointing, and backward pass. The backward pass costs as much as one forward
pass, because the frozen backbone has no weight gradients."""
_EFFICIENCY: Final = 0.4
"""Assumed speed of training divided by the peak speed of the GPU."""


@final
@dataclass(frozen=True)
class GraphicsCard:
    """A GPU: its memory in GiB, and its peak dense bf16 speed in TFLOP/s from the data sheet."""

    name: str
    memory_gib: float
    tflops: float


CARDS: Final = {
    card.name: card
    for card in (
        GraphicsCard("RTX 3090", 24, 71), GraphicsCard("RTX 4090", 24, 165), GraphicsCard("RTX 5090", 32, 210), GraphicsCard("L40S", 48, 362),
        GraphicsCard("A100", 80, 312), GraphicsCard("H100", 80, 989), GraphicsCard("H200", 141, 989),
    )
}  # fmt: skip
"""Name -> GPU. The paper uses the RTX 4090."""


@final
@dataclass(frozen=True)
class ResourceEstimate:
    """The estimated resources of a recipe on a GPU.

    `panel` is (width, height) in px. `memory_gib` contains the memory of each part. `tflop` is the number of operations of one
    training step in TFLOP.
    """

    recipe: LoraRecipe
    card: GraphicsCard
    panel: tuple[int, int]
    generated_tokens: int
    condition_tokens: int
    parameter_count: int
    lora_parameters: int
    memory_gib: dict[str, float]
    tflop: float
    text_encoder_parameters: int

    @property
    def total_gib(self) -> float:
        """Total memory in GiB."""
        return sum(self.memory_gib.values())

    @property
    def seconds(self) -> float:
        """Duration of one training step on the GPU, in seconds."""
        return self.tflop / (_EFFICIENCY * self.card.tflops)

    def table(self) -> str:
        """Returns the estimate as lines of name and value."""
        recipe, (width, height) = self.recipe, self.panel
        encoders = 0 if recipe.prompt.endswith(ENCODED_SUFFIX) else 2 * self.text_encoder_parameters
        download = 2 * self.parameter_count + self.memory_gib["VAE"] * GIB + encoders
        rows = {
            "backbone": f"{recipe.backbone}, {self.parameter_count / 1e9:.2f} billion parameters",
            "LoRA": f"rank {recipe.rank}, {self.lora_parameters / 1e6:.1f} million parameters",
            "panels": f"{' '.join(recipe.panels)}, {width} x {height} each, for a square photo",
            "tokens": f"{self.generated_tokens} generated, {self.condition_tokens} condition, {_PROMPT_TOKENS} text",
            **{f"memory, {name}": f"{gib:.1f} GiB" for name, gib in self.memory_gib.items()},
            "memory": f"{self.total_gib:.1f} GiB of {self.card.memory_gib:g} on {self.card.name} (estimate)",
            "host memory": f"{encoders / GIB + _HOST_OVERHEAD_GIB:.1f} GiB, while the text encoders encode the prompt (estimate)",
            "download": f"{download / 1e9:.0f} GB, of which {encoders / 1e9:.0f} GB are text encoders (estimate)",
            "per step": f"{self.tflop:.0f} TFLOP, {self.seconds:.1f} s (estimate)",
            "total": f"{recipe.steps} steps, {self.seconds * recipe.steps / 3600:.1f} hours (estimate)",
        }
        return "\n".join(f"{name:24}{value}" for name, value in rows.items())

    def check_fits(self) -> None:
        """Checks that the recipe fits into the memory of the GPU.

        Raises:
            DeviceError: the recipe does not fit. The message says which values to change.
        """
        if self.total_gib <= self.card.memory_gib:
            return
        raise DeviceError(
            f"{self.recipe.backbone} needs about {self.total_gib:.1f} GiB",
            f"expected at most the {self.card.memory_gib:g} GiB of {self.card.name}",
            self._cure(),
        )

    def _cure(self) -> str:
        candidates: tuple[Quantization, ...] = ("int8", "nf4")
        for quantization in candidates:
            saved = self.memory_gib["backbone"] - weights_gib(self.parameter_count, quantization)
            if saved > 0 and self.total_gib - saved <= self.card.memory_gib:
                return f'set quantization = "{quantization}", which needs {self.total_gib - saved:.1f} GiB'
        return "lower max_composite_pixels or rank, or choose a smaller backbone (klein) or a GPU with more memory"


def find_gpu(name: str | None = None) -> GraphicsCard:
    """Returns the GPU of this name. Without a name, returns the local GPU, or the RTX 4090 if there is no local GPU.

    Raises:
        DeviceError: the name is not in `CARDS`.
    """
    if name is None:
        return _local_gpu() if torch.cuda.is_available() else CARDS["RTX 4090"]
    known = {other.lower(): card for other, card in CARDS.items()}
    if name.lower() in known:
        return known[name.lower()]
    matches = get_close_matches(name.lower(), known, n=1)
    raise DeviceError(
        f"there is no GPU {name!r} in the table",
        f"expected one of {', '.join(CARDS)}",
        f"did you mean {known[matches[0]].name}?" if matches else "choose the most similar GPU",
    )


def is_local_gpu(card: GraphicsCard) -> bool:
    """Whether this is the GPU of this machine."""
    return torch.cuda.is_available() and card == _local_gpu()


def estimate_resources(recipe: LoraRecipe, card: GraphicsCard) -> ResourceEstimate:
    """Estimates the resources of a recipe on a GPU. This takes a few seconds.

    Raises:
        ModelError: the backbone is not in the table of backbones.
        MissingExtra: diffusers is not installed.
    """
    backbone = _meta_backbone(recipe)
    fit = fit_panel(
        _SQUARE_PHOTO_PX,
        recipe.layout,
        max_composite_pixels=recipe.max_composite_pixels,
        size_divisor=backbone.size_divisor,
    )
    tokens_per_panel = (fit.panel[0] // backbone.size_divisor) * (fit.panel[1] // backbone.size_divisor)
    generated_tokens = tokens_per_panel * len(recipe.panels)
    condition_tokens = generated_tokens if recipe.layout.has_white_space else tokens_per_panel
    parameters, vae, lora_parameters = (
        _count_parameters(backbone),
        sum(each.numel() for each in backbone.vae.parameters()),
        _count_lora_parameters(backbone, recipe),
    )
    memory = {
        "backbone": weights_gib(parameters, recipe.quantization),
        "VAE": 2 * vae / GIB,
        "LoRA and AdamW": lora_parameters * _BYTES_PER_LORA_WEIGHT[recipe.optimizer] / GIB,
        "activations": _activation_bytes(backbone, generated_tokens + condition_tokens + _PROMPT_TOKENS)
        / GIB,
        "rest": _OVERHEAD_GIB,
    }
    tflop = (
        _FORWARD_PASSES_PER_STEP
        * recipe.batch_size
        * _forward_tflop(backbone, generated_tokens, condition_tokens)
    )
    return ResourceEstimate(
        recipe,
        card,
        fit.panel,
        generated_tokens,
        condition_tokens,
        parameters,
        lora_parameters,
        memory,
        tflop,
        find_backbone_class(recipe.backbone.removeprefix(TINY_PREFIX)).text_encoder_parameters,
    )


def _local_gpu() -> GraphicsCard:
    """Returns the local GPU. Its speed is that of the GPU in `CARDS` with its name, or of the RTX 4090 if no name matches."""
    found = torch.cuda.get_device_properties(0)
    speed = next(
        (card.tflops for name, card in CARDS.items() if name in found.name), CARDS["RTX 4090"].tflops
    )
    return GraphicsCard(found.name, found.total_memory / GIB, speed)


def _meta_backbone(recipe: LoraRecipe) -> Backbone:
    name = recipe.backbone.removeprefix(TINY_PREFIX)
    backbone_class = find_backbone_class(name)
    size = backbone_class.tiny if recipe.backbone.startswith(TINY_PREFIX) else backbone_class.full_size
    return build(name, size, device="meta", dtype=torch.bfloat16)


def _count_parameters(backbone: Backbone) -> int:
    return sum(parameter.numel() for parameter in backbone.transformer.parameters())


def _count_lora_parameters(backbone: Backbone, recipe: LoraRecipe) -> int:
    layers = map(backbone.transformer.get_submodule, select_target_modules(backbone, recipe.target_modules))
    return sum(recipe.rank * (layer.in_features + layer.out_features) for layer in layers)


def _activation_bytes(backbone: Backbone, tokens: int) -> int:
    """Returns the memory in bytes of the inputs of all blocks and the activations of one block, in bf16."""
    transformer, config = backbone.transformer, backbone.transformer.config
    blocks = len(transformer.transformer_blocks) + len(getattr(transformer, "single_transformer_blocks", ()))
    hidden: int = config.num_attention_heads * config.attention_head_dim
    return 2 * tokens * hidden * (blocks + _HIDDEN_STATES_PER_BLOCK)


def _forward_tflop(backbone: Backbone, generated_tokens: int, condition_tokens: int) -> float:
    """Returns the number of operations of one prediction in TFLOP, counted on the device "meta", which computes nothing."""
    prompt = backbone.random_prompt(backbone.transformer, 0)
    prompt_tensors = {
        name: (tensor[:, :1].expand(1, _PROMPT_TOKENS, -1) if tensor.ndim == 3 else tensor).to("meta")
        for name, tensor in prompt.tensors.items()
    }
    latents, condition = (
        torch.empty(1, backbone.channels, 1, count, device="meta")
        for count in (generated_tokens, condition_tokens)
    )
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        embedding = PromptEmbedding(prompt.backbone, prompt.text, **prompt_tensors)
        backbone.predict(latents, condition, torch.empty(1, device="meta"), embedding, 1.0)
    return float(counter.get_total_flops()) / 1e12
