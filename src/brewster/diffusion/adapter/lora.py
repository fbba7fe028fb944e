"""LoRA: low-rank adapters of a backbone's linear layers (Hu et al. 2021), stored separately from
the backbone.

The paper uses rank 16 (Experimental Setup). It does not state alpha or the adapted layers; alpha 16
and all linear layers of the blocks are usual. During training, the LoRA is float32, because most of
Adam's updates are smaller than the rounding error of bf16.
"""

from __future__ import annotations

import fnmatch
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, final

import torch
from pydantic import Field, TypeAdapter, ValidationError
from torch import Tensor, nn

from brewster.diffusion.adapter.lora_formats import DOWN_SUFFIX, UP_SUFFIX, read_lora_layers
from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.registry import find_backbone
from brewster.diffusion.lazy_imports import import_library
from brewster.diffusion.prompt import PROMPT_FILE, PromptEmbedding, load_prompt
from brewster.diffusion.task import DecompositionTask
from brewster.diffusion.tensors import read_tensors, write_tensors
from brewster.errors import ModelError, RecipeError, invalid_value
from brewster.options import Quantization

LORA_FILE: Final = "pytorch_lora_weights.safetensors"
"""The file name that diffusers expects."""
PREFIX: Final = "transformer."
_METADATA_KEY: Final = "brewster"
PEFT_KEY: Final = "lora_adapter_metadata"
ADAPTER_NAME: Final = "default"


@final
@dataclass(frozen=True)
class LoraMetadata:
    """The metadata of a LoRA: backbone, base and its quantization, rank, alpha, task, and the
    digest of the prompt.

    `base_model` is a hub id, a folder, or a name in the table of backbones. `target_modules`: see
    `select_target_modules`.
    """

    backbone: str
    base_model: str
    quantization: Quantization | None
    rank: Annotated[int, Field(ge=1)]
    alpha: Annotated[int, Field(ge=1)]
    task: DecompositionTask
    prompt_sha256: str
    target_modules: tuple[str, ...] = ()
    imported: bool = False
    """Whether another program trained the LoRA. Then it may adapt any layers, each with its own
    rank up to `rank`.
    """

    def to_json(self) -> str:
        """The metadata as one line of JSON."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> LoraMetadata:
        """Parses the result of `to_json`."""
        text = re.sub(
            r'"last_sigma": null, |, "timestep_shift": null', "", text
        )  # tasks had these before version 1
        try:
            return TypeAdapter(LoraMetadata).validate_json(text, strict=True, extra="forbid")
        except (RecipeError, ValidationError) as error:
            problem = error if isinstance(error, RecipeError) else invalid_value(error.errors()[0])
            raise ModelError(
                f"the metadata of the LoRA cannot be read: {problem.happened}",
                f"{problem.expected}, as in the metadata that brewster writes",
                "copy the folder again, save the LoRA again, or update brewster, if a newer "
                "version wrote it",
            ) from error


def select_target_modules(backbone: Backbone, patterns: Sequence[str] = ()) -> list[str]:
    """The full names of the linear layers of the blocks that match a pattern; without patterns, of
    all of them. In a pattern, * and ? are wildcards as in a shell: "*.attn.*" selects the layers of
    the attention.
    """
    names = backbone.lora_targets()
    selected = {pattern: fnmatch.filter(names, pattern) for pattern in patterns or "*"}
    for pattern, found in selected.items():
        if not found:
            raise ModelError(
                f"no linear layer of {backbone.name} matches the target {pattern!r}",
                "expected a name with wildcards, such as *.attn.*, that matches layers such as "
                f"{names[0]}",
                "correct target_modules, or leave it out to adapt all linear layers of the blocks",
            )
    return [name for name in names if any(name in found for found in selected.values())]


def add_lora(
    backbone: Backbone,
    *,
    rank: int = 16,
    alpha: int = 16,
    seed: int = 0,
    target_modules: Sequence[str] = (),
) -> list[nn.Parameter]:
    """Adds a LoRA to the linear layers of the blocks; for `target_modules` see
    `select_target_modules`. Its B matrices are zero, so predictions do not change yet. Returns the
    parameters to train.
    """
    names = select_target_modules(backbone, target_modules)
    config = import_library("peft").LoraConfig(r=rank, lora_alpha=alpha, target_modules=names)
    with torch.random.fork_rng(devices=[backbone.device] if backbone.device.type == "cuda" else []):
        torch.manual_seed(seed)
        _add_adapter(backbone, config)
    return lora_parameters(backbone)


def attach_layers(backbone: Backbone, state: Mapping[str, Tensor]) -> None:
    """Adds a LoRA with the weights of `read_lora_layers` to a backbone for inference, each layer
    with its own rank.
    """
    peft = import_library("peft")
    _add_adapter(backbone, peft.LoraConfig(**layer_settings(state)))
    _convert_for_inference(backbone)
    peft.set_peft_model_state_dict(backbone.transformer, dict(state), adapter_name=ADAPTER_NAME)


def lora_parameters(backbone: Backbone) -> list[nn.Parameter]:
    """The LoRA's parameters, the only ones that require gradients, always in the same order."""
    return [parameter for parameter in backbone.transformer.parameters() if parameter.requires_grad]


def lora_state_dict(backbone: Backbone) -> dict[str, Tensor]:
    """The LoRA's weights by name, such as transformer_blocks.0.attn.to_q.lora_A.weight."""
    state = import_library("peft").get_peft_model_state_dict(
        backbone.transformer, adapter_name=ADAPTER_NAME
    )
    return dict(sorted(state.items()))


def load_lora_state(backbone: Backbone, state: Mapping[str, Tensor]) -> None:
    """Loads weights from `lora_state_dict` into a backbone with a LoRA of the same shapes."""
    found, expected = (
        {name: tuple(tensor.shape) for name, tensor in weights.items()}
        for weights in (state, lora_state_dict(backbone))
    )
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            raise ModelError(
                f"{name} of the LoRA has the shape {found.get(name)}",
                f"expected {expected.get(name)}",
                "use the rank and the backbone with which it was trained",
            )
    import_library("peft").set_peft_model_state_dict(
        backbone.transformer, dict(state), adapter_name=ADAPTER_NAME
    )


def save_lora(
    folder: Path,
    backbone: Backbone,
    prompt: PromptEmbedding,
    task: DecompositionTask,
    *,
    base_model: str = "",
    quantization: Quantization | None = None,
    target_modules: Sequence[str] = (),
) -> LoraMetadata:
    """Writes a folder with the LoRA, in a file that diffusers can load, and the prompt. The bytes
    are reproducible. By default `base_model` is the backbone's hub id. `target_modules` are those
    of `add_lora`. Returns the metadata.
    """
    config = backbone.transformer.peft_config[ADAPTER_NAME]
    source = base_model or backbone.hub_id
    rank = config.r
    alpha = config.lora_alpha
    metadata = LoraMetadata(
        backbone.name, source, quantization, rank, alpha, task, prompt.sha256, tuple(target_modules)
    )
    # Without lora_alpha, diffusers assumes that alpha equals the rank.
    settings = {"r": rank, "lora_alpha": alpha, "target_modules": sorted(config.target_modules)}
    write_lora(folder, lora_state_dict(backbone), settings, prompt, metadata)
    return metadata


def write_lora(
    folder: Path,
    state: Mapping[str, Tensor],
    settings: Mapping[str, Any],
    prompt: PromptEmbedding,
    metadata: LoraMetadata,
) -> None:
    """Writes prompt and weights. `settings` are those that diffusers reads from the file."""
    tensors = {PREFIX + name: tensor for name, tensor in state.items()}
    prefixed = {PREFIX + name: value for name, value in settings.items()}
    prompt.save(folder / PROMPT_FILE)
    entries = {_METADATA_KEY: metadata.to_json(), PEFT_KEY: json.dumps(prefixed, sort_keys=True)}
    write_tensors(folder / LORA_FILE, tensors, entries)


def read_lora_metadata(folder: Path) -> LoraMetadata:
    """The metadata of the LoRA in this folder. It names the backbone to load."""
    return read_lora(folder)[1]


def find_base(
    model: str, metadata: LoraMetadata, base_model: str | None
) -> tuple[str, type[Backbone]]:
    """The base of a LoRA, by default that in its metadata, and its class."""
    base = base_model or metadata.base_model
    is_path = Path(base).is_absolute() or base.startswith((".", "~"))
    if base_model is None and is_path and not Path(base).is_dir():
        raise ModelError(
            f"the base model of {model} was {base}, which does not exist",
            f"expected a {metadata.backbone} in diffusers' layout",
            "pass its folder or hub id with --base-model",
        )
    backbone_class, _ = find_backbone(base)  # checked before the download, which may take an hour
    if backbone_class.name != metadata.backbone:
        raise ModelError(
            f"{model} is a LoRA of {metadata.backbone}",
            f"expected a base model of {metadata.backbone}, not of {backbone_class.name}",
            "choose another base model",
        )
    return base, backbone_class


def read_prompt(folder: Path, metadata: LoraMetadata) -> PromptEmbedding:
    """The prompt of the LoRA in this folder."""
    prompt = load_prompt(folder / PROMPT_FILE, metadata.backbone)
    if prompt.sha256 != metadata.prompt_sha256:
        raise ModelError(
            f"{folder / PROMPT_FILE} is not the prompt with which the LoRA was trained",
            f"expected SHA-256 {metadata.prompt_sha256[:12]}...",
            "copy the whole folder again",
        )
    return prompt


def load_lora(folder: Path, backbone: Backbone) -> tuple[LoraMetadata, PromptEmbedding]:
    """Adds the LoRA of a folder to its backbone for inference. Returns its metadata and its
    prompt.
    """
    state, metadata = read_lora(folder)
    prompt = read_prompt(folder, metadata)
    if metadata.imported:
        attach_layers(backbone, read_lora_layers(state, backbone.transformer, backbone.name))
        return metadata, prompt
    add_lora(
        backbone, rank=metadata.rank, alpha=metadata.alpha, target_modules=metadata.target_modules
    )
    load_lora_state(backbone, state)
    _convert_for_inference(backbone)
    return metadata, prompt


def _convert_for_inference(backbone: Backbone) -> None:
    # A float32 LoRA would convert the activations of every layer of a bf16 base twice.
    for parameter in lora_parameters(backbone):
        parameter.data = parameter.data.to(backbone.dtype)


def read_lora(folder: Path) -> tuple[dict[str, Tensor], LoraMetadata]:
    """The weights of the LoRA in this folder, as `lora_state_dict` names them, and its metadata."""
    tensors, entries = read_tensors(folder / LORA_FILE)
    if _METADATA_KEY not in entries:
        raise ModelError(
            f"{folder / LORA_FILE} was not written by brewster",
            f"expected a LoRA with the entry {_METADATA_KEY} in its metadata",
            "convert it: brewster models import SOURCE FOLDER --base-model BASE --prompt TEXT "
            "--panels T",
        )
    metadata = LoraMetadata.from_json(entries[_METADATA_KEY])
    return {name.removeprefix(PREFIX): tensor for name, tensor in tensors.items()}, metadata


def _add_adapter(backbone: Backbone, config: Any) -> None:  # noqa: ANN401
    """Adds a LoRA with random A matrices, float32. peft creates it in the dtype of the base, which
    may be bf16.
    """
    backbone.transformer.add_adapter(config, adapter_name=ADAPTER_NAME)
    import_library("diffusers.training_utils").cast_training_params(
        backbone.transformer, torch.float32
    )


def layer_settings(state: Mapping[str, Tensor]) -> dict[str, Any]:
    """The settings of peft for layers of any rank. The names are regular expressions that match
    only the full name.
    """
    names = sorted(key.removesuffix(UP_SUFFIX) for key in state if key.endswith(UP_SUFFIX))
    ranks = {re.escape(name): len(state[name + DOWN_SUFFIX]) for name in names}
    rank = max(ranks.values())
    pattern = {f"^{name}": value for name, value in ranks.items() if value != rank}
    return {
        "r": rank,
        "lora_alpha": rank,
        "target_modules": "|".join(ranks),
        "rank_pattern": pattern,
        "alpha_pattern": pattern,
    }
