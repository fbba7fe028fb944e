"""Estimates the tokens, memory and time of a LoRA recipe before any weights are downloaded.

estimate = estimate_resources(recipe, CARDS["RTX 4090"])
print(estimate.table())
estimate.check_fits()

The layers of the LoRA are counted on a backbone without storage (torch's device "meta"); the rest is that of `BACKBONE_COSTS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import torch

from brewster.models.diffusion.adapter.lora import select_target_modules
from brewster.models.diffusion.backbones.registry import build_on_meta
from brewster.models.diffusion.memory import backbone_cost
from brewster.models.diffusion.panels import count_tokens
from brewster.models.diffusion_resources import (
    EFFICIENCY,
    GIB,
    PROMPT_TOKENS,
    BackboneCost,
    GraphicsCard,
    check_gpu_memory,
    cost_table,
    fitting_quantizations,
    weights_gib,
)
from brewster.models.zoo import TINY_PREFIX
from brewster.training.recipe import ENCODED_SUFFIX, SQUARE_PHOTO_PX, LoraRecipe

_BYTES_PER_LORA_WEIGHT: Final = {"adamw": 16, "adamw8bit": 10}
"""Weight, gradient and two moments of AdamW; the moments are float32 or have 8 bits."""
_OVERHEAD_GIB: Final = 1.5
"""GPU memory of the CUDA context and the activations of the VAE."""
_HOST_OVERHEAD_GIB: Final = 4.0
"""Host memory of Python, torch and the data. The backbone is loaded directly to the GPU."""
_FORWARD_PASSES_PER_STEP: Final = 3
"""Forward pass, recomputation for gradient checkpointing, and backward pass. The backward pass costs as much as one forward
pass, because the frozen backbone has no weight gradients."""


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
    cost: BackboneCost
    lora_parameters: int
    memory_gib: dict[str, float]
    tflop: float

    @property
    def total_gib(self) -> float:
        """Total memory in GiB."""
        return sum(self.memory_gib.values())

    @property
    def seconds(self) -> float:
        """Duration of one training step on the GPU, in seconds."""
        return self.tflop / (EFFICIENCY * self.card.tflops)

    def table(self) -> str:
        """Returns the estimate as lines of name and value."""
        recipe, (width, height) = self.recipe, self.panel
        # A tiny version has random weights and no text encoders.
        is_tiny = recipe.backbone.startswith(TINY_PREFIX)
        is_stored = is_tiny or Path(recipe.backbone).is_dir()
        is_encoded = is_tiny or recipe.prompt.endswith(ENCODED_SUFFIX)
        encoders = 0 if is_encoded else 2 * self.cost.text_encoder_parameters
        download = 0 if is_stored else 2 * self.cost.parameters + self.memory_gib["VAE"] * GIB + encoders
        model = {
            "backbone": f"{recipe.backbone}, {self.cost.parameters / 1e9:.2f} billion parameters",
            "LoRA": f"rank {recipe.rank}, {self.lora_parameters / 1e6:.1f} million parameters",
            "panels": f"{' '.join(recipe.panels)}, {width} x {height} each, for a square photo",
            "tokens": f"{self.generated_tokens} generated, {self.condition_tokens} condition, {PROMPT_TOKENS} text",
        }
        time = {
            "per step": f"{self.tflop:.0f} TFLOP, {self.seconds:.1f} s (estimate)",
            "total": f"{recipe.steps} steps, {self.seconds * recipe.steps / 3600:.1f} hours (estimate)",
        }
        return cost_table(
            model,
            time,
            memory_gib=self.memory_gib,
            card=self.card,
            host_memory=f"{encoders / GIB + _HOST_OVERHEAD_GIB:.1f} GiB{'' if is_encoded else ', while the text encoders encode the prompt'}",
            download_gb=download / 1e9,
            text_encoder_gb=0 if is_stored else encoders / 1e9,
        )

    def check_fits(self) -> None:
        """Checks that the recipe fits into the memory of the GPU. Raises DeviceError if the recipe does not fit. The message
        says which values to change."""
        cure = "lower max_composite_pixels or rank, or choose a smaller backbone (klein) or a GPU with more memory"
        others = self.total_gib - self.memory_gib["backbone"]
        if fitting := fitting_quantizations(self.cost.parameters, self.card.memory_gib - others):
            total = others + weights_gib(self.cost.parameters, fitting[0])
            cure = f'set quantization = "{fitting[0]}", which needs {total:.1f} GiB'
        check_gpu_memory(self.recipe.backbone, self.total_gib, self.card, cure)


def estimate_resources(recipe: LoraRecipe, card: GraphicsCard) -> ResourceEstimate:
    """Estimates the resources of a recipe on a GPU. This takes a few seconds.

    For a backbone on the hub that is not in the table of backbones, its configuration files are downloaded.

    Raises:
        DownloadError, ModelError: the backbone is unknown or damaged, or its configuration cannot be downloaded.
        MissingExtra: diffusers is not installed.
    """
    backbone = build_on_meta(recipe.backbone, dtype=torch.bfloat16)
    panel = recipe.task.fit(SQUARE_PHOTO_PX, backbone.size_divisor).panel
    generated_tokens, condition_tokens = count_tokens(panel, recipe.layout, backbone.size_divisor)
    cost = backbone_cost(recipe.backbone, type(backbone))
    layers = map(backbone.transformer.get_submodule, select_target_modules(backbone, recipe.target_modules))
    lora_parameters = sum(recipe.rank * (layer.in_features + layer.out_features) for layer in layers)
    tokens = generated_tokens + condition_tokens
    # The inputs of all blocks are kept, and the activations of one block while it computes.
    activations = cost.blocks * cost.hidden_state_bytes(tokens) + cost.block_bytes(tokens)
    memory = {
        "backbone": weights_gib(cost.parameters, recipe.quantization),
        "VAE": 2 * cost.vae_parameters / GIB,
        "LoRA and AdamW": lora_parameters * _BYTES_PER_LORA_WEIGHT[recipe.optimizer] / GIB,
        "activations": activations / GIB,
        "rest": _OVERHEAD_GIB,
    }
    tflop = _FORWARD_PASSES_PER_STEP * recipe.batch_size * cost.forward_tflop(tokens)
    return ResourceEstimate(
        recipe, card, panel, generated_tokens, condition_tokens, cost, lora_parameters, memory, tflop
    )
