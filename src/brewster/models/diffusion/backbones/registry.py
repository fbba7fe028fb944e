"""The table of diffusion backbones: load one from the hub or a folder, or build a tiny version without a network connection.

    backbone = load_backbone("kontext", device="cuda", quantization="int8")
    backbone, prompt = tiny("kontext", seed=0)

diffusers reads the files; its exceptions are converted to brewster's errors.
"""

from __future__ import annotations

import contextlib
import difflib
import gc
import importlib.util
import json
import pkgutil
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, get_args

import torch
from torch import Tensor, nn

from brewster.errors import DeviceError, MissingExtra, ModelError
from brewster.models.diffusion.backbones.backbone import Architecture, Backbone
from brewster.models.diffusion.hub_download import resolve_model_folder
from brewster.models.diffusion.lazy_imports import (
    diffusers_class,
    disable_progress_bars_in_pipes,
    import_library,
)
from brewster.models.diffusion.out_of_memory import explain_out_of_memory
from brewster.models.diffusion.prompt import PROMPT, PromptEmbedding
from brewster.models.diffusion.text_encoders import check_text_encoders, text_encoder_device
from brewster.models.zoo import BACKBONE_CLASSES, TINY_PREFIX
from brewster.options import Quantization

BACKBONES: Final[dict[str, type[Backbone]]] = {
    name: pkgutil.resolve_name(path) for name, path in BACKBONE_CLASSES.items()
}
"""name -> Backbone class, for the models in `zoo.BACKBONE_CLASSES`. The class has hub id, licence and architecture."""

INDEX_FILE: Final = "model_index.json"
_CONFIG_FILES: Final = {
    "transformer": "config.json",
    "vae": "config.json",
    "scheduler": "scheduler_config.json",
}
_BACKBONE_PATTERNS: Final = [INDEX_FILE, *(f"{part}/*" for part in _CONFIG_FILES)]
_TEXT_ENCODER_PATTERNS: Final = [INDEX_FILE, "scheduler/*", "text_encoder*/*", "tokenizer*/*", "processor/*"]
_STATISTICS_SPREAD: Final = 0.2
"""The spread of a tiny version's latent statistics around 0 and 1, so that tests detect code without normalisation."""


def load_backbone(
    source: str,
    *,
    device: str = "cpu",
    dtype: torch.dtype | None = None,
    quantization: Quantization | None = None,
) -> Backbone:
    """Loads a backbone without its text encoders.

    `source` is a name in the table, a hub id, a folder in diffusers' layout, or "tiny:" and a name for a tiny version.
    By default `dtype` is bfloat16 on an accelerator and float32 on the CPU. `quantization` stores the transformer's weights
    in 8 bits (torchao) or 4 bits (bitsandbytes, CUDA only).

    Raises:
        DownloadError: no access to a gated model (the message says how to get it), an invalid token, or no network
            connection.
        ModelError: a file is missing or damaged, the architecture is not supported, or a name or quantization is unknown.
        DeviceError: there is no such device, or it is out of memory; the message says what to reduce.
        MissingExtra: diffusers, torchao or bitsandbytes is not installed.
    """
    _check_device(device)
    if source.startswith(TINY_PREFIX):
        return _load_tiny(source, device, quantization)
    options = _quantization_options(quantization, device) if quantization else {}
    dtype = dtype or (torch.float32 if device == "cpu" else torch.bfloat16)
    disable_progress_bars_in_pipes()
    folder = _model_folder(source, _BACKBONE_PATTERNS)
    backbone_class, index = _read_index(folder)
    if quantization == "nf4" and backbone_class.unquantized:
        options["quantization_config"].llm_int8_skip_modules = list(backbone_class.unquantized)
    with explain_out_of_memory(_memory_hint(quantization)):
        vae = _load_part(folder, backbone_class, "vae", dtype=dtype, **_device_map(device))
        transformer = _load_part(
            folder, backbone_class, "transformer", dtype=dtype, **_device_map(device), **options
        )
    scheduler = _load_part(folder, backbone_class, "scheduler")
    backbone = backbone_class(
        transformer, vae, scheduler, distilled=bool(index.get("is_distilled")), dtype=dtype
    )
    _check_channels(backbone, folder)
    if quantization:
        _check_quantized(backbone, quantization)
    return backbone


def encode_prompt(source: str, text: str = PROMPT, *, device: str = "cpu") -> PromptEmbedding:
    """Encodes a prompt with a backbone's text encoders, which are loaded only for this call.

    For `source`, see `load_backbone`. A tiny version has no text encoder: its embedding is random, seeded by the text.

    They are loaded in bfloat16, on `device` if its free memory suffices, otherwise on the CPU. Call this before
    `load_backbone`: together with the base, most text encoders fit no consumer GPU.

    Returns:
        The embedding on the CPU, bfloat16; float32 for a tiny version.

    Raises:
        DownloadError, ModelError, DeviceError, MissingExtra: see `load_backbone`.
    """
    _check_device(device)
    if source.startswith(TINY_PREFIX):
        seed = 0 if text == PROMPT else zlib.crc32(text.encode()) or 1  # the sum of "" is 0
        return replace(tiny(source.removeprefix(TINY_PREFIX), seed)[1], text=text)
    # Checked before the download, which may take an hour.
    for name in backbone_class_of(source).text_encoder_requirements:
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(
                f"{name} is not installed",
                f"expected {name}, which the text encoder of {source} needs",
                f"run: pip install {name} (the version for your torch)",
            )
    disable_progress_bars_in_pipes()
    folder = _model_folder(source, _TEXT_ENCODER_PATTERNS)
    backbone_class, index = _read_index(folder)
    check_text_encoders(folder, index)
    dtype, device = torch.bfloat16, text_encoder_device(folder, device)
    pipeline_class = diffusers_class(index["_class_name"])
    with (
        explain_out_of_memory("close other programs, or pass an encoded prompt"),
        _translate_load_errors(folder),
    ):
        pipeline = pipeline_class.from_pretrained(
            folder, transformer=None, vae=None, dtype=dtype, local_files_only=True
        ).to(device)
        with torch.no_grad():
            embedding = backbone_class.embed(pipeline, text).to("cpu", dtype)
    del pipeline
    gc.collect()  # modules refer to each other, so the text encoders would stay in memory while the base is loaded
    if device != "cpu":
        torch.cuda.empty_cache()
    return embedding


def tiny(name: str, seed: int = 0) -> tuple[Backbone, PromptEmbedding]:
    """Builds a tiny version of a backbone, with the same classes and seeded random weights, and a random prompt for it.

    Raises:
        ModelError: the name is not in the table.
    """
    backbone_class = find_backbone_class(name)
    backbone = build(name, backbone_class.tiny, seed=seed)
    return backbone, backbone_class.random_prompt(backbone.transformer, seed)


def build(
    name: str,
    architecture: Architecture | None = None,
    *,
    seed: int = 0,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Backbone:
    """Builds a backbone with seeded random weights, by default in full size. Device "meta" needs no memory.

    Raises:
        ModelError: the name is not in the table.
        DeviceError: out of memory.
    """
    backbone_class = find_backbone_class(name)
    architecture = architecture or backbone_class.full_size
    part_classes = {part: diffusers_class(backbone_class.classes[part]) for part in _CONFIG_FILES}
    with (
        torch.random.fork_rng(devices=[]),
        torch.device(device),
        _default_dtype(dtype),
        explain_out_of_memory(_memory_hint(None)),
    ):
        torch.manual_seed(seed)
        transformer = part_classes["transformer"](**architecture["transformer"])
        vae = part_classes["vae"](**architecture["vae"])
        _randomise_batch_norms(vae)
    return backbone_class(transformer, vae, part_classes["scheduler"](**architecture["scheduler"]))


def find_backbone_class(name: str) -> type[Backbone]:
    """The Backbone class of this name.

    Raises:
        ModelError: the name is not in the table; the message suggests the closest one.
    """
    if name in BACKBONES:
        return BACKBONES[name]
    close = difflib.get_close_matches(name, BACKBONES, n=1)
    raise ModelError(
        f"there is no backbone {name!r}",
        f"expected one of {', '.join(BACKBONES)}",
        f"did you mean {close[0]}?" if close else "choose one of them",
    )


def backbone_class_of(source: str) -> type[Backbone]:
    """The Backbone class that `load_backbone` would use for this source. No weights are downloaded.

    Raises:
        DownloadError, ModelError, MissingExtra: see `load_backbone`.
    """
    if source in BACKBONES or source.startswith(TINY_PREFIX):
        return find_backbone_class(source.removeprefix(TINY_PREFIX))
    return _read_index(resolve_model_folder(source, [INDEX_FILE]))[0]


def _load_tiny(source: str, device: str, quantization: str | None) -> Backbone:
    if quantization:
        raise ModelError(
            f"{source} was requested with quantization={quantization}",
            "expected a tiny version without quantization",
            "leave quantization out",
        )
    backbone, _ = tiny(source.removeprefix(TINY_PREFIX))
    backbone.transformer.to(device)
    backbone.vae.to(device)
    return backbone


def _model_folder(source: str, patterns: list[str]) -> Path:
    return resolve_model_folder(BACKBONES[source].hub_id if source in BACKBONES else source, patterns)


def _read_index(folder: Path) -> tuple[type[Backbone], dict[str, Any]]:
    index = _read_json(folder / INDEX_FILE)
    class_name = index.get("_class_name")
    for backbone_class in BACKBONES.values():
        if class_name in (backbone_class.classes["pipeline"], *backbone_class.other_pipelines):
            return backbone_class, index
    raise ModelError(
        f"{folder} contains a {class_name}",
        f"expected one of {', '.join(backbone_class.classes['pipeline'] for backbone_class in BACKBONES.values())}",
        f"use {', '.join(backbone_class.hub_id for backbone_class in BACKBONES.values())} or a finetune of one",
    )


def _load_part(folder: Path, backbone_class: type[Backbone], part: str, **options: Any) -> Any:  # noqa: ANN401 - passed on
    """Loads the transformer, VAE or scheduler of a folder. Checks its class, and that its weights are complete."""
    part_folder, expected = folder / part, backbone_class.classes[part]
    found = _read_json(part_folder / _CONFIG_FILES[part]).get("_class_name")
    if found != expected:
        raise ModelError(
            f"{part_folder} contains a {found}",
            f"expected a {expected}",
            f"use a folder of {backbone_class.hub_id}",
        )
    part_class = diffusers_class(expected)
    if part == "scheduler":
        return part_class.from_pretrained(part_folder)
    with _translate_load_errors(part_folder):
        model, report = part_class.from_pretrained(
            part_folder, use_safetensors=True, local_files_only=True, output_loading_info=True, **options
        )
    mismatched = [*report["missing_keys"], *report["unexpected_keys"]]
    if mismatched:
        raise ModelError(
            f"{part_folder} has {len(mismatched)} missing or unexpected weights, for example {mismatched[0]}",
            f"expected the weights of a {expected}",
            "copy the model again",
        )
    return model


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ModelError(
            f"{path} is missing",
            "expected a model's folder in diffusers' layout",
            "copy or download it again",
        ) from error
    except ValueError as error:
        raise ModelError(
            f"{path} is not JSON: {error}", "expected a complete JSON file", "copy it again"
        ) from error
    if not isinstance(value, dict):
        raise ModelError(f"{path} contains no settings", "expected a JSON object", "copy it again")
    return value


@contextlib.contextmanager
def _translate_load_errors(folder: Path) -> Iterator[None]:
    """Converts the exceptions of diffusers; `explain_out_of_memory` converts those about memory."""
    safetensors_error = import_library("safetensors").SafetensorError
    try:
        yield
    except ImportError as error:
        raise MissingExtra(
            f"{folder} needs a library that is not installed ({' '.join(str(error).split())[:200]})",
            "expected all libraries that its classes use",
            "install this library in addition to brewster[diffusion]",
        ) from error
    except (OSError, KeyError, ValueError, TypeError, safetensors_error) as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(
            f"{folder} cannot be loaded: {reason}",
            "expected complete weights that match config.json",
            "copy or download the model again",
        ) from error


def _quantization_options(quantization: str, device: str) -> dict[str, Any]:
    """The keyword argument of from_pretrained for a quantization. The quantization is checked before any download."""
    if quantization not in get_args(Quantization):
        raise ModelError(
            f"there is no quantization {quantization!r}",
            f"expected one of {', '.join(get_args(Quantization))}",
            "choose one of them",
        )
    if quantization == "nf4":
        if not device.startswith("cuda"):
            raise DeviceError(
                f"nf4 does not run on {device}", "expected an NVIDIA GPU", 'use quantization="int8"'
            )
        import_library("bitsandbytes")
        config = diffusers_class("BitsAndBytesConfig")(
            load_in_4bit=True, bnb_4bit_quant_type="nf4", bnb_4bit_compute_dtype=torch.bfloat16
        )
        return {"quantization_config": config}
    torchao = import_library("torchao.quantization")
    configs = {"int8": torchao.Int8WeightOnlyConfig, "float8": torchao.Float8WeightOnlyConfig}
    return {"quantization_config": diffusers_class("TorchAoConfig")(configs[quantization]())}


def _device_map(device: str) -> dict[str, Any]:
    """The keyword argument of from_pretrained that loads weights directly to an accelerator, not through host memory."""
    return {} if device == "cpu" else {"device_map": {"": device}}


def _memory_hint(quantization: str | None) -> str:
    hints = {
        None: 'use quantization="int8"',
        "int8": 'use quantization="nf4"',
        "float8": 'use quantization="nf4"',
    }
    return f"{hints.get(quantization, 'close other programs that use the GPU')}, a smaller backbone (klein) or a GPU with more memory"


def _check_device(device: str) -> None:
    device_type = torch.device(device).type
    if device_type == "cuda" and not torch.cuda.is_available():
        raise DeviceError(
            "there is no CUDA device",
            "expected an NVIDIA or AMD GPU and a torch built for it",
            "use device cpu",
        )
    if device_type == "mps" and not torch.backends.mps.is_available():
        raise DeviceError("there is no MPS device", "expected an Apple GPU", "use device cpu")


def _check_channels(backbone: Backbone, folder: Path) -> None:
    packed = backbone.statistics()[0].shape[1]
    if packed not in {1, backbone.channels}:
        raise ModelError(
            f"the VAE in {folder} has {packed} values per token",
            f"expected {backbone.channels}, the input channels of its transformer",
            "copy both from the same model",
        )


def _check_quantized(backbone: Backbone, quantization: str) -> None:
    """Checks that the weights are quantized: diffusers silently leaves parts on the CPU unquantized."""
    weight = backbone.transformer.get_submodule(backbone.lora_targets()[0]).weight
    if type(weight) in {Tensor, nn.Parameter}:
        raise ModelError(
            f"the weights were loaded as {weight.dtype}",
            f"expected weights stored as {quantization}",
            "update diffusers and torchao (constraints.txt lists versions that work)",
        )


@contextlib.contextmanager
def _default_dtype(dtype: torch.dtype) -> Iterator[None]:
    previous_dtype = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(previous_dtype)


def _randomise_batch_norms(vae: nn.Module) -> None:
    """Sets random running statistics. Their default is exactly 0 and 1; see _STATISTICS_SPREAD."""
    for module in vae.modules():
        if isinstance(module, nn.BatchNorm2d) and module.running_mean is not None:
            assert module.running_var is not None
            module.running_mean.normal_(0, _STATISTICS_SPREAD)
            module.running_var.uniform_(1 - _STATISTICS_SPREAD, 1 + _STATISTICS_SPREAD)
