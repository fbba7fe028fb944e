"""Exports a LoRA: as one file for ComfyUI, or merged into its base.

export_comfyui(Path("out/kontext/lora"), Path("glass.safetensors"))
export_merged(Path("out/kontext/lora"), Path("kontext-glass"))
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from brewster.errors import OutputError
from brewster.models.diffusion.adapter.lora import PREFIX, find_base, read_lora, read_prompt
from brewster.models.diffusion.adapter.lora_formats import DOWN_SUFFIX, UP_SUFFIX, adapted_layers, check_shape
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.loading import load_backbone
from brewster.models.diffusion.backbones.registry import backbone_cost
from brewster.models.diffusion.hub_download import free_disk_bytes
from brewster.models.diffusion.memory import GIB, check_free, free_host_gib, weights_gib
from brewster.models.diffusion.prompt import PROMPT_FILE
from brewster.models.diffusion.task import TASK_FILE, save_task
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


def export_merged(folder: Path, target: Path, base_model: str | None = None) -> None:
    """Adds the LoRA to the weights of its base, and writes the result as a folder in diffusers' layout, in bfloat16.

    The sums are computed in float32 on the CPU. The folder also gets the encoded prompt and the task, but no text
    encoders. It is for programs that cannot load a LoRA; `load_pipeline` opens it, too.

    `base_model` is the folder or hub id of the base, if it has moved since training.
    """
    check_new(target)
    state, metadata = read_lora(folder)
    prompt = read_prompt(folder, metadata)
    base, backbone_class = find_base(str(folder), metadata, base_model)
    cost = backbone_cost(base, backbone_class)
    needed = weights_gib(cost.transformer + cost.vae, None)
    purpose = "for all weights in bfloat16"
    cure = "close other programs, or export on another machine"
    check_free(base, needed, free_host_gib(), "of host memory", cure, purpose=purpose)
    free, cure = free_disk_bytes(target) / GIB, "free disk space, or choose a larger disk"
    check_free(target, needed, free, "on the disk", cure, purpose=purpose, error=OutputError)
    backbone = load_backbone(base, dtype=torch.bfloat16)
    merge(backbone, state, 1.0 if metadata.imported else metadata.alpha / metadata.rank)
    backbone.save(target)
    prompt.save(target / PROMPT_FILE)
    save_task(metadata.task, target / TASK_FILE)


@torch.no_grad()
def merge(backbone: Backbone, state: Mapping[str, Tensor], scale: float) -> None:
    """Replaces the weight W of each adapted layer by W + scale B A (Hu et al. 2021). `state` is that of `lora_state_dict`."""
    modules = dict(backbone.transformer.named_modules())
    for layer in adapted_layers(state):
        down, up = state[layer + DOWN_SUFFIX], state[layer + UP_SUFFIX]
        check_shape(layer, down, up, modules.get(layer))
        weight, change = modules[layer].weight, scale * up.float() @ down.float()
        weight.copy_(weight.float() + change.to(weight.device))
