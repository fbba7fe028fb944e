"""Adds a second LoRA to a backbone that has one, such as a few-step LoRA (Lightning, turbo).

The changes of the weights are summed: B1 A1 + B2 A2 = [B1 B2] [A1; A2]. So the sum of two LoRAs is again a LoRA, whose
rank is the sum of both ranks, and which also fits a quantized base.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from brewster.models.diffusion.adapter.lora import ADAPTER_NAME, attach_layers, lora_state_dict, remove_lora
from brewster.models.diffusion.adapter.lora_formats import (
    DOWN_SUFFIX,
    UP_SUFFIX,
    LowRankLayer,
    adapted_layers,
)
from brewster.models.diffusion.backbones.backbone import Backbone


def stack_layers(backbone: Backbone, layers: Mapping[str, LowRankLayer]) -> None:
    """Adds these layers to the LoRA of a backbone for inference. If it has none, they become its LoRA.

    Raises:
        ModelError: a layer is not in the backbone or has another shape.
        MissingExtra: peft is not installed.
    """
    stacked = _attached_layers(backbone)
    for name, layer in layers.items():
        stacked[name] = _sum(stacked[name], layer) if name in stacked else layer
    remove_lora(backbone)
    attach_layers(backbone, stacked)


def _attached_layers(backbone: Backbone) -> dict[str, LowRankLayer]:
    """The layers of the LoRA of a backbone, float32, on the CPU, with the scale alpha / rank multiplied in."""
    state = {name: tensor.float().cpu() for name, tensor in lora_state_dict(backbone).items()}
    layers = {}
    for name in adapted_layers(state):
        scale: float = backbone.transformer.get_submodule(name).scaling[ADAPTER_NAME]
        layers[name] = LowRankLayer(state[name + DOWN_SUFFIX], scale * state[name + UP_SUFFIX])
    return layers


def _sum(first: LowRankLayer, second: LowRankLayer) -> LowRankLayer:
    return LowRankLayer(torch.cat([first.down, second.down]), torch.cat([first.up, second.up], dim=1))
