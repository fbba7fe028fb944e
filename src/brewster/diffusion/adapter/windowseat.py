"""The layout of the published WindowSeat models (Zakarin et al. 2025, "Reflection Removal through
Efficient Adaptation of Diffusion Transformers"): a peft LoRA of Qwen-Image-Edit that removes
reflections in one step.

    model_index.json                                     base_model and processing_resolution
    transformer_lora/adapter_config.json                 the settings of peft
    transformer_lora/pytorch_lora_weights.safetensors    the weights
    text_embeddings/state_dict.safetensors               prompt_embeds (n, tokens, width) and
                                                         prompt_mask (n, tokens)

For its task, see `windowseat_task`.
"""

from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, Field, ValidationError

from brewster.diffusion.adapter.lora import LoraMetadata, attach_layers
from brewster.diffusion.adapter.lora_formats import read_lora_layers, scaling_from_config
from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.qwen import Qwen
from brewster.diffusion.model_table import DIFFUSION_MODELS
from brewster.diffusion.prompt import PromptEmbedding
from brewster.diffusion.task import windowseat_task
from brewster.diffusion.tensors import read_json, read_tensors
from brewster.errors import ModelError, invalid_value

INDEX_FILE: Final = "model_index.json"
CONFIG_FILE: Final = "transformer_lora/adapter_config.json"
WEIGHTS_FILE: Final = "transformer_lora/pytorch_lora_weights.safetensors"
PROMPT_FILE: Final = "text_embeddings/state_dict.safetensors"
FILES: Final = (INDEX_FILE, CONFIG_FILE, WEIGHTS_FILE, PROMPT_FILE)

BACKBONE: Final = Qwen
_CURE: Final = "download the model again"
_PROMPT_TEXT: Final = "WindowSeat's trained embedding"


class _Index(BaseModel):
    base_model: str
    processing_resolution: Annotated[
        int, Field(ge=Qwen.size_divisor, multiple_of=Qwen.size_divisor)
    ]


class _Config(BaseModel):
    r: int
    lora_alpha: int


def read_metadata(folder: Path) -> LoraMetadata:
    """The base, rank, task and prompt digest of a model, with the quantization of the published
    inference code.
    """
    try:
        index = _Index.model_validate(read_json(folder / INDEX_FILE))
        config = _Config.model_validate(read_json(folder / CONFIG_FILE))
    except ValidationError as error:
        problem = invalid_value(error.errors()[0])
        happened = f"{folder} lacks a setting of WindowSeat ({problem.happened})"
        raise ModelError(happened, problem.expected, _CURE) from error
    return LoraMetadata(
        BACKBONE.name,
        index.base_model,
        DIFFUSION_MODELS["windowseat"].quantization,
        config.r,
        config.lora_alpha,
        windowseat_task(index.processing_resolution),
        _read_prompt(folder).sha256,
    )


def load(folder: Path, backbone: Backbone) -> tuple[LoraMetadata, PromptEmbedding]:
    """Adds the LoRA of this folder to its backbone. Returns the metadata, and the trained prompt
    embedding. Raises ModelError if a file is missing or damaged, or a weight belongs to no layer of
    the backbone.
    """
    metadata = read_metadata(folder)
    prompt = _read_prompt(folder)
    tensors, _ = read_tensors(folder / WEIGHTS_FILE)
    scale = scaling_from_config(read_json(folder / CONFIG_FILE))
    attach_layers(backbone, read_lora_layers(tensors, backbone.transformer, backbone.name, scale))
    return metadata, prompt


def _read_prompt(folder: Path) -> PromptEmbedding:
    """The first prompt embedding without its masked tokens, which the transformer would ignore."""
    path = folder / PROMPT_FILE
    tensors, _ = read_tensors(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    embeds_shape = shapes.get("prompt_embeds", ())
    is_valid = len(embeds_shape) == 3 and embeds_shape[0] >= 1
    if not is_valid or shapes != {"prompt_embeds": embeds_shape, "prompt_mask": embeds_shape[:2]}:
        expected = (
            "expected prompt_embeds (n, tokens, width) and prompt_mask (n, tokens), with "
            "n of at least 1"
        )
        raise ModelError(f"{path} contains {shapes}", expected, _CURE)
    mask = tensors["prompt_mask"][0] > 0
    count = int(mask.sum())
    # The tokens that are not masked come first, so the position of each stays the same.
    if count == 0 or not mask[:count].all():
        happened = f"prompt_mask in {path} masks tokens before the end, or all of them"
        raise ModelError(happened, "expected padding at the end only", _CURE)
    return PromptEmbedding(
        Qwen.name, _PROMPT_TEXT, tensors["prompt_embeds"][:1, :count].contiguous()
    )
