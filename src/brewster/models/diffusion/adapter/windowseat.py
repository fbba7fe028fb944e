"""The layout of the published WindowSeat models (Zakarin et al. 2025, "Reflection Removal through Efficient Adaptation
of Diffusion Transformers"): a peft LoRA of Qwen-Image-Edit that removes reflections in one step.

    model_index.json                                    base_model and processing_resolution
    transformer_lora/adapter_config.json                the settings of peft
    transformer_lora/pytorch_lora_weights.safetensors
    text_embeddings/state_dict.safetensors              prompt_embeds (n, tokens, width) and prompt_mask (n, tokens)

For its task, see `windowseat_task`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from torch import Tensor

from brewster.errors import ModelError
from brewster.models.diffusion.adapter.lora import LoraMetadata, attach_layers
from brewster.models.diffusion.adapter.lora_formats import read_lora_layers, scaling_from_config
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.qwen import Qwen
from brewster.models.diffusion.prompt import PromptEmbedding
from brewster.models.diffusion.task import windowseat_task
from brewster.models.diffusion.tensors import read_json, read_tensors
from brewster.models.diffusion_models import DIFFUSION_MODELS

INDEX_FILE: Final = "model_index.json"
CONFIG_FILE: Final = "transformer_lora/adapter_config.json"
WEIGHTS_FILE: Final = "transformer_lora/pytorch_lora_weights.safetensors"
PROMPT_FILE: Final = "text_embeddings/state_dict.safetensors"
FILES: Final = (INDEX_FILE, CONFIG_FILE, WEIGHTS_FILE, PROMPT_FILE)

BACKBONE: Final = Qwen
_PROMPT_TEXT: Final = "WindowSeat's trained embedding"


def read_metadata(folder: Path) -> LoraMetadata:
    """The base, rank, task and prompt digest of the model in this folder. The quantization is that of the published inference code.

    Raises:
        ModelError: a file is missing or damaged, or lacks a value.
    """
    index, config = read_json(folder / INDEX_FILE), read_json(folder / CONFIG_FILE)
    try:
        base, side = index["base_model"], int(index["processing_resolution"])
        rank, alpha = int(config["r"]), int(config["lora_alpha"])
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(
            f"{folder} lacks a setting of WindowSeat ({error!r})",
            f"expected base_model and processing_resolution in {INDEX_FILE}, and r and lora_alpha in {CONFIG_FILE}",
            "download the model again",
        ) from error
    if not isinstance(base, str):
        raise ModelError(
            f"base_model in {folder / INDEX_FILE} is {base!r}",
            "expected a hub id",
            "download the model again",
        )
    if side < Qwen.size_divisor or side % Qwen.size_divisor:
        raise ModelError(
            f"processing_resolution in {folder / INDEX_FILE} is {side}",
            f"expected a multiple of {Qwen.size_divisor}",
            "download the model again",
        )
    return LoraMetadata(
        BACKBONE.name,
        base,
        DIFFUSION_MODELS["windowseat"].quantization,
        rank,
        alpha,
        windowseat_task(side),
        _read_prompt(folder).sha256,
    )


def load(folder: Path, backbone: Backbone) -> tuple[LoraMetadata, PromptEmbedding]:
    """Adds the LoRA of this folder to its backbone.

    Returns:
        The metadata, and the trained prompt embedding.

    Raises:
        ModelError: a file is missing or damaged, or a weight belongs to no layer of the backbone.
    """
    metadata, prompt = read_metadata(folder), _read_prompt(folder)
    tensors, _ = read_tensors(folder / WEIGHTS_FILE)
    config = read_json(folder / CONFIG_FILE)
    attach_layers(
        backbone, read_lora_layers(tensors, backbone.transformer, backbone.name, scaling_from_config(config))
    )
    return metadata, prompt


def _read_prompt(folder: Path) -> PromptEmbedding:
    """The first prompt embedding without its masked tokens, which the transformer would ignore."""
    path = folder / PROMPT_FILE
    tensors, _ = read_tensors(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    embeds_shape = shapes.get("prompt_embeds", ())
    is_valid = len(embeds_shape) == 3 and embeds_shape[0] >= 1
    if not is_valid or shapes != {"prompt_embeds": embeds_shape, "prompt_mask": embeds_shape[:2]}:
        raise ModelError(
            f"{path} contains {shapes}",
            "expected prompt_embeds (n, tokens, width) and prompt_mask (n, tokens), with n of at least 1",
            "download the model again",
        )
    tokens = _count_tokens(path, tensors["prompt_mask"][0] > 0)
    return PromptEmbedding(Qwen.name, _PROMPT_TEXT, tensors["prompt_embeds"][:1, :tokens].contiguous())


def _count_tokens(path: Path, mask: Tensor) -> int:
    """The number of tokens that are not masked. They come first, so the position of each stays the same."""
    count = int(mask.sum())
    if count == 0 or not mask[:count].all():
        raise ModelError(
            f"prompt_mask in {path} masks tokens before the end, or all of them",
            "expected padding at the end only",
            "download the model again",
        )
    return count
