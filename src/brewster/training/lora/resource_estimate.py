"""Estimates the tokens, memory and time of a LoRA recipe before any weights are downloaded.

estimate = estimate_resources(recipe, CARDS["RTX 4090"])
print(estimate.table())
estimate.check_fits()

The layers of the LoRA are counted on a backbone without storage (torch's device "meta"); the rest is that of `BACKBONE_COSTS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import torch

from brewster.models.diffusion.adapter.lora import select_target_modules
from brewster.models.diffusion.backbones.registry import build_on_meta, local_folder
from brewster.models.diffusion.memory import backbone_cost
from brewster.models.diffusion.panels import count_tokens
from brewster.models.diffusion_resources import (
    EFFICIENCY,
    GIB,
    PROMPT_TOKENS,
    CostEstimate,
    GraphicsCard,
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
@dataclass(frozen=True, kw_only=True)
class ResourceEstimate(CostEstimate):
    """The estimated resources of a training step of a recipe."""

    generated_tokens: int
    condition_tokens: int
    lora_parameters: int


def estimate_resources(recipe: LoraRecipe, card: GraphicsCard) -> ResourceEstimate:
    """Estimates the resources of a recipe on a GPU. This takes a few seconds. For a backbone on the hub that is not in
    the table of backbones, its configuration files are downloaded. Raises DownloadError or ModelError if the backbone
    is unknown or damaged, or its configuration cannot be downloaded; MissingExtra if diffusers is not installed."""
    backbone = build_on_meta(recipe.backbone, dtype=torch.bfloat16)
    width, height = recipe.task.fit(SQUARE_PHOTO_PX, backbone.size_divisor).panel
    generated_tokens, condition_tokens = count_tokens((width, height), recipe.layout, backbone.size_divisor)
    cost = backbone_cost(recipe.backbone, type(backbone))
    layers = map(backbone.transformer.get_submodule, select_target_modules(backbone, recipe.target_modules))
    lora_parameters = sum(recipe.rank * (layer.in_features + layer.out_features) for layer in layers)
    tokens = generated_tokens + condition_tokens
    passes = cost.predictions_per_step if recipe.guidance > 1 else 1
    memory = {
        "backbone": weights_gib(cost.parameters, recipe.quantization),
        "VAE": 2 * cost.vae_parameters / GIB,
        "LoRA and AdamW": lora_parameters * _BYTES_PER_LORA_WEIGHT[recipe.optimizer] / GIB,
        "activations": passes * cost.activation_bytes(tokens, kept_blocks=cost.blocks) / GIB,
        "rest": _OVERHEAD_GIB,
    }
    tflop = _FORWARD_PASSES_PER_STEP * recipe.batch_size * passes * cost.forward_tflop(tokens)
    seconds = tflop / (EFFICIENCY * card.tflops)
    # A tiny version has random weights and no text encoders.
    is_tiny = recipe.backbone.startswith(TINY_PREFIX)
    is_encoded = is_tiny or recipe.prompt.endswith(ENCODED_SUFFIX)
    encoders_gib = 0.0 if is_encoded else weights_gib(cost.text_encoder_parameters, None)
    cure = (
        "lower max_composite_pixels or rank, or choose a smaller backbone (klein) or a GPU with more memory"
    )
    others = sum(memory.values()) - memory["backbone"]
    if fitting := fitting_quantizations(cost.parameters, card.memory_gib - others):
        total = others + weights_gib(cost.parameters, fitting[0])
        cure = f'set quantization = "{fitting[0]}", which needs {total:.1f} GiB'
    return ResourceEstimate(
        name=recipe.backbone,
        card=card,
        cost=cost,
        generated_tokens=generated_tokens,
        condition_tokens=condition_tokens,
        lora_parameters=lora_parameters,
        memory_gib=memory,
        text_encoder_gib=encoders_gib,
        host_memory=f"{encoders_gib + _HOST_OVERHEAD_GIB:.1f} GiB{'' if is_encoded else ', while the text encoders encode the prompt'}",
        tflop=tflop,
        seconds=seconds,
        downloaded_weights=cost.parameters,
        is_local=is_tiny or local_folder(recipe.backbone) is not None,
        cure=cure,
        model_rows={
            "backbone": f"{recipe.backbone}, {cost.parameters / 1e9:.2f} billion parameters",
            "LoRA": f"rank {recipe.rank}, {lora_parameters / 1e6:.1f} million parameters",
            "panels": f"{' '.join(recipe.panels)}, {width} x {height} each, for a square photo",
            "tokens": f"{generated_tokens} generated, {condition_tokens} condition, {PROMPT_TOKENS} text",
        },
        time_rows={
            "per step": f"{tflop:.0f} TFLOP, {seconds:.1f} s (estimate)",
            "total": f"{recipe.steps} steps, {seconds * recipe.steps / 3600:.1f} hours (estimate)",
        },
    )
