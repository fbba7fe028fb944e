"""Converts a LoRA of another program to the folder that brewster opens.

The file of a LoRA contains neither its base model nor its prompt nor its panels, so the user states
them; and alpha, if peft's configuration is missing. Names and shapes of the layers are compared
with those of the base model.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from torch import Tensor

from brewster.diffusion.adapter import lora_formats
from brewster.diffusion.adapter.lora import (
    PEFT_KEY,
    PREFIX,
    LoraMetadata,
    layer_settings,
    write_lora,
)
from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.loading import encode_prompt
from brewster.diffusion.backbones.registry import build_on_meta, local_folder
from brewster.diffusion.prompt import PROMPTS
from brewster.diffusion.task import DecompositionTask, Panel, PanelLayout
from brewster.diffusion.tensors import check_new, read_json, read_tensors
from brewster.errors import ModelError, read_errors

PEFT_CONFIG_FILE: Final = "adapter_config.json"
"""The file with peft's settings of a LoRA, next to its weights."""


def import_lora(
    source: Path,
    folder: Path,
    *,
    base_model: str,
    prompt: str,
    panels: tuple[Panel, ...],
    alpha: int | None = None,
    device: str = "cpu",
) -> LoraMetadata:
    """Reads the LoRA, encodes the prompt, and writes the folder. Returns the metadata of the
    written LoRA.

    For `source`, see `find_lora_file`; for `base_model`, `load_backbone`; for `alpha`,
    `read_layers`. `prompt` is a name in `PROMPTS`, or the text itself, which `device` encodes.
    `panels` are its output.
    """
    check_new(folder)
    task = DecompositionTask(PanelLayout(panels))
    base = build_on_meta(base_model)
    state = read_layers(find_lora_file(source), base, alpha)
    settings = layer_settings(state)
    embedding = encode_prompt(base_model, PROMPTS.get(prompt, prompt), device=device)
    rank = settings["r"]
    source_of_base = str(local_folder(base_model) or base_model)
    written = LoraMetadata(
        base.name, source_of_base, None, rank, rank, task, embedding.sha256, imported=True
    )
    write_lora(folder, state, settings, embedding, written)
    return written


def find_lora_file(source: Path) -> Path:
    """The file with the weights of a LoRA: `source`, or the only one in this folder."""
    found = [source] if source.is_file() else sorted(source.glob("*.safetensors"))
    if len(found) != 1:
        raise ModelError(
            f"{source} contains {', '.join(path.name for path in found) or 'no such file'}"
            if source.is_dir()
            else f"there is no file {source}",
            "expected one .safetensors file",
            "pass its path; for a LoRA on the hub, the path that this prints: hf download "
            "OWNER/NAME",
        )
    return found[0]


def read_layers(path: Path, base: Backbone, alpha: int | None = None) -> dict[str, Tensor]:
    """The layers of the LoRA in a file, see `read_lora_layers`. The base must have no LoRA. `alpha`
    is that of all layers, for a LoRA of peft without its adapter_config.json.
    """
    tensors, metadata = read_tensors(path)
    scale = _scale(path, metadata)
    if alpha is not None:
        if scale or any(key.endswith(".alpha") for key in tensors):
            happened = f"alpha = {alpha} was given for {path}, which has its own alpha"
            raise ModelError(
                happened, "expected alpha only for a LoRA without one", "leave alpha out"
            )
        scale = lora_formats.scaling_from_config({"lora_alpha": alpha})
    elif scale is None and lora_formats.lora_format(tensors) == "peft":
        scale = _refuse_unknown_alpha
    return lora_formats.read_lora_layers(tensors, base.transformer, base.name, scale)


def _refuse_unknown_alpha(name: str, rank: int) -> float:  # noqa: ARG001  (a ScalingFunction)
    raise ModelError(
        f"the LoRA has no alpha for {name}",
        f"expected {PEFT_CONFIG_FILE} next to the file, where peft stores alpha",
        f"copy {PEFT_CONFIG_FILE} into its folder, or state alpha: brewster models import "
        "--alpha NUMBER",
    )


def _scale(path: Path, metadata: Mapping[str, str]) -> lora_formats.ScalingFunction | None:
    """The scale of the layers by the settings in the file (diffusers) or next to it (peft), if
    there are any.
    """
    config = path.with_name(PEFT_CONFIG_FILE)
    if PEFT_KEY not in metadata:
        return lora_formats.scaling_from_config(read_json(config)) if config.is_file() else None
    file = f"the settings of {path}"
    expected = "expected a JSON object"
    with read_errors(file, ModelError, expected, "copy it again", (ValueError, TypeError)):
        return lora_formats.scaling_from_config(dict(json.loads(metadata[PEFT_KEY])), PREFIX)
