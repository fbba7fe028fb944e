"""Converts a LoRA of another program to the folder that brewster opens.

    import_lora("someone/glass-lora", Path("glass"), base_model="kontext", prompt="remove the reflection", panels=("T",))

Such a file does not say for which base model and prompt it was trained, nor what it generates; the user states them. The prompt is
encoded here, once. The names and shapes of the layers are compared with the configuration of the base model; its weights are not
loaded.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from torch import nn

from brewster.errors import ModelError
from brewster.models.diffusion.adapter.lora import LoraMetadata, save_layers
from brewster.models.diffusion.adapter.lora_formats import (
    ScalingFunction,
    read_lora_layers,
    scaling_from_config,
)
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.registry import (
    BACKBONES,
    INDEX_FILE,
    backbone_class_of,
    build,
    encode_prompt,
)
from brewster.models.diffusion.hub_download import resolve_model_folder
from brewster.models.diffusion.lazy_imports import diffusers_class
from brewster.models.diffusion.panels import Panel, PanelLayout
from brewster.models.diffusion.prompt import PROMPTS
from brewster.models.diffusion.task import DecompositionTask
from brewster.models.diffusion.tensors import read_tensors
from brewster.models.zoo import TINY_PREFIX

_PEFT_CONFIG_FILE: Final = "adapter_config.json"
_DIFFUSERS_KEY: Final = "lora_adapter_metadata"
_PREFIX: Final = "transformer."


def import_lora(
    source: str,
    folder: Path,
    *,
    base_model: str,
    prompt: str,
    panels: tuple[Panel, ...],
    device: str = "cpu",
) -> LoraMetadata:
    """Reads the LoRA, encodes the prompt, and writes the folder.

    Args:
        source: a .safetensors file, or a folder or hub id with one.
        folder: the folder to write.
        base_model: the base model of the LoRA: a name in `BACKBONES`, a folder or a hub id.
        prompt: a name in `PROMPTS`, or the text itself.
        panels: what the LoRA generates from the photo.
        device: the device that encodes the prompt.

    Returns:
        The metadata of the written LoRA.

    Raises:
        ModelError: there is no LoRA, or a key or shape does not belong to the base model; the message names the key style.
        RecipeError: the panels do not contain T, or are repeated.
        DownloadError, DeviceError, MissingExtra: see `encode_prompt`.
        OutputError: the folder cannot be written.
    """
    task = DecompositionTask(PanelLayout(panels))
    path = _find_file(source)
    tensors, metadata = read_tensors(path)
    backbone_class = backbone_class_of(base_model)
    layers = read_lora_layers(
        tensors, _skeleton(base_model, backbone_class), backbone_class.name, _scale(path, metadata)
    )
    embedding = encode_prompt(base_model, PROMPTS.get(prompt, prompt), device=device)
    rank = max(layer.rank for layer in layers.values())
    written = LoraMetadata(
        backbone_class.name, base_model, None, rank, rank, task, embedding.sha256, imported=True
    )
    save_layers(folder, layers, embedding, written)
    return written


def _find_file(source: str) -> Path:
    """The file with the weights, downloaded if it is on the hub."""
    if Path(source).is_file():
        return Path(source)
    folder = resolve_model_folder(source, ["*.safetensors", _PEFT_CONFIG_FILE])
    files = sorted(folder.glob("*.safetensors"))
    if len(files) != 1:
        names = ", ".join(path.name for path in files) or "no such file"
        raise ModelError(
            f"{source} contains {names}", "expected one .safetensors file", "pass the path of the file"
        )
    return files[0]


def _scale(path: Path, metadata: Mapping[str, str]) -> ScalingFunction | None:
    """alpha / rank from the settings in the file's metadata (diffusers) or next to it (peft)."""
    config = path.with_name(_PEFT_CONFIG_FILE)
    try:
        if _DIFFUSERS_KEY in metadata:
            return scaling_from_config(dict(json.loads(metadata[_DIFFUSERS_KEY])), _PREFIX)
        return scaling_from_config(dict(json.loads(config.read_text("utf-8")))) if config.is_file() else None
    except (OSError, ValueError, TypeError) as error:
        raise ModelError(
            f"the settings of {path} cannot be read ({error})", "expected a JSON object", "copy it again"
        ) from error


def _skeleton(base_model: str, backbone_class: type[Backbone]) -> nn.Module:
    """The transformer of the base model on the device "meta": names and shapes without weights."""
    if base_model in BACKBONES or base_model.startswith(TINY_PREFIX):
        architecture = backbone_class.tiny if base_model.startswith(TINY_PREFIX) else backbone_class.full_size
        transformer: nn.Module = build(backbone_class.name, architecture, device="meta").transformer
        return transformer
    path = (
        resolve_model_folder(base_model, [INDEX_FILE, "transformer/config.json"])
        / "transformer"
        / "config.json"
    )
    try:
        config: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ModelError(
            f"{path} cannot be read ({error})",
            "expected the configuration of the transformer",
            "copy it again",
        ) from error
    with torch.device("meta"):
        skeleton: nn.Module = diffusers_class(backbone_class.classes["transformer"]).from_config(config)
    return skeleton
