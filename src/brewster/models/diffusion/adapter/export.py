"""Exports a LoRA as one file for ComfyUI."""

from __future__ import annotations

from pathlib import Path

import torch

from brewster.models.diffusion.adapter.lora import PREFIX, read_lora
from brewster.models.diffusion.adapter.lora_formats import DOWN_SUFFIX, adapted_layers
from brewster.models.diffusion.tensors import check_new, write_tensors


def export_comfyui(folder: Path, target: Path) -> None:
    """Writes the LoRA as one file with the keys that ComfyUI reads: those of diffusers, and alpha for each layer."""
    check_new(target)
    state, metadata = read_lora(folder)
    tensors = {PREFIX + name: tensor for name, tensor in state.items()}
    # safetensors refuses tensors that share memory, so each layer gets its own. An imported layer has alpha = rank.
    alphas = {
        layer + ".alpha": torch.tensor(
            float(len(tensors[layer + DOWN_SUFFIX]) if metadata.imported else metadata.alpha)
        )
        for layer in adapted_layers(tensors)
    }
    write_tensors(target, tensors | alphas, {})
