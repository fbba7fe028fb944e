"""Converts a LoRA of another program to the folder that brewster opens.

    import_lora("someone/glass-lora", Path("glass"), base="kontext", prompt="remove the reflection", panels=("T",))

Such a file does not say for which base and prompt it was trained, nor what it generates; the user states them. The prompt is
encoded here, once. The names and shapes of the layers are compared with the configuration of the base; its weights are not
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
from brewster.models.diffusion.adapter.key_styles import Scale, alpha_scale, read_layers
from brewster.models.diffusion.adapter.lora import LoraMetadata, save_layers
from brewster.models.diffusion.backbones import BACKBONES, INDEX_FILE, build, encode_prompt, family_of
from brewster.models.diffusion.families.family import Backbone
from brewster.models.diffusion.lazy_imports import diffusers_class, fetch
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
    base: str,
    prompt: str,
    panels: tuple[Panel, ...],
    device: str = "cpu",
) -> LoraMetadata:
    """Reads the LoRA, encodes the prompt, and writes the folder.

    Args:
        source: a .safetensors file, or a folder or hub id with one.
        folder: the folder to write.
        base: the base of the LoRA: a name in `BACKBONES`, a folder or a hub id.
        prompt: a name in `PROMPTS`, or the text itself.
        panels: what the LoRA generates from the photo.
        device: the device that encodes the prompt.

    Returns:
        The metadata of the written LoRA.

    Raises:
        ModelError: there is no LoRA, or a key or shape does not belong to the base; the message names the key style.
        RecipeError: the panels do not contain T, or are repeated.
        DownloadError, DeviceError, MissingExtra: see `encode_prompt`.
        TargetError: the folder cannot be written.
    """
    task = DecompositionTask(PanelLayout(panels))
    path = _find_file(source)
    tensors, metadata = read_tensors(path)
    family = family_of(base)
    layers = read_layers(tensors, _skeleton(base, family), family.name, _scale(path, metadata))
    embedding = encode_prompt(base, PROMPTS.get(prompt, prompt), device=device)
    rank = max(layer.rank for layer in layers.values())
    written = LoraMetadata(family.name, base, None, rank, rank, task, embedding.sha256, imported=True)
    save_layers(folder, layers, embedding, written)
    return written


def _find_file(source: str) -> Path:
    """The file with the weights, downloaded if it is on the hub."""
    if Path(source).is_file():
        return Path(source)
    folder = fetch(source, ["*.safetensors", _PEFT_CONFIG_FILE])
    files = sorted(folder.glob("*.safetensors"))
    if len(files) != 1:
        names = ", ".join(path.name for path in files) or "no such file"
        raise ModelError(
            f"{source} contains {names}", "expected one .safetensors file", "pass the path of the file"
        )
    return files[0]


def _scale(path: Path, metadata: Mapping[str, str]) -> Scale | None:
    """alpha / rank from the settings in the file's metadata (diffusers) or next to it (peft)."""
    config = path.with_name(_PEFT_CONFIG_FILE)
    try:
        if _DIFFUSERS_KEY in metadata:
            return alpha_scale(dict(json.loads(metadata[_DIFFUSERS_KEY])), _PREFIX)
        return alpha_scale(dict(json.loads(config.read_text("utf-8")))) if config.is_file() else None
    except (OSError, ValueError, TypeError) as error:
        raise ModelError(
            f"the settings of {path} cannot be read ({error})", "expected a JSON object", "copy it again"
        ) from error


def _skeleton(base: str, family: type[Backbone]) -> nn.Module:
    """The transformer of the base on the device "meta": names and shapes without weights."""
    if base in BACKBONES or base.startswith(TINY_PREFIX):
        architecture = family.tiny if base.startswith(TINY_PREFIX) else family.full_size
        transformer: nn.Module = build(family.name, architecture, device="meta").transformer
        return transformer
    path = fetch(base, [INDEX_FILE, "transformer/config.json"]) / "transformer" / "config.json"
    try:
        config: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ModelError(
            f"{path} cannot be read ({error})",
            "expected the configuration of the transformer",
            "copy it again",
        ) from error
    with torch.device("meta"):
        skeleton: nn.Module = diffusers_class(family.classes["transformer"]).from_config(config)
    return skeleton
