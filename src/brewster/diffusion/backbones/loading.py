"""Loads backbones from the hub or from a folder with diffusers, and encodes prompts with their text
encoders.
"""

import contextlib
import gc
import importlib.util
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.registry import (
    CONFIG_FILES,
    INDEX_FILE,
    MEMORY_HINT,
    find_backbone,
    hub_id_of,
    read_index,
    tiny,
)
from brewster.diffusion.hub_download import resolve_model_folder
from brewster.diffusion.lazy_imports import (
    diffusers_class,
    disable_progress_bars_in_pipes,
    import_bitsandbytes,
    import_library,
)
from brewster.diffusion.memory import check_cuda
from brewster.diffusion.model_table import TINY_PREFIX
from brewster.diffusion.offloading import explain_out_of_memory
from brewster.diffusion.prompt import PROMPT, PromptEmbedding
from brewster.diffusion.tensors import read_json
from brewster.errors import DeviceError, MissingExtra, ModelError
from brewster.options import Quantization

_BACKBONE_PATTERNS: Final = [INDEX_FILE, *(f"{part}/*" for part in CONFIG_FILES)]
_ENCODING_BYTES: Final = 2 << 30
"""GPU memory for the activations of the text encoders and the CUDA context."""
_TEXT_ENCODER_PATTERNS: Final = [
    INDEX_FILE,
    "scheduler/*",
    "text_encoder*/*",
    "tokenizer*/*",
    "processor/*",
]


def load_backbone(
    source: str,
    *,
    device: str = "cpu",
    dtype: torch.dtype | None = None,
    quantization: Quantization | None = None,
) -> Backbone:
    """Loads a backbone without its text encoders.

    `source` is a name in the table, a hub id, a folder in diffusers' layout, or "tiny:" and a name
    for a tiny version. By default `dtype` is bfloat16 on an accelerator and float32 on the CPU.
    `quantization` stores the transformer's weights in 8 bits (torchao) or 4 bits (bitsandbytes,
    CUDA only).
    """
    check_cuda(device)
    if source.startswith(TINY_PREFIX):
        if quantization:
            happened = f"quantization={quantization} was given for {source}"
            raise ModelError(happened, "expected none for a tiny version", "leave quantization out")
        backbone, _ = tiny(source.removeprefix(TINY_PREFIX))
        backbone.transformer.to(device)
        backbone.vae.to(device)
        return backbone
    options = _quantization_options(quantization, device) if quantization else {}
    dtype = dtype or (torch.float32 if device == "cpu" else torch.bfloat16)
    disable_progress_bars_in_pipes()
    folder = resolve_model_folder(hub_id_of(source), _BACKBONE_PATTERNS)
    backbone_class, index = read_index(folder)
    if quantization == "nf4" and backbone_class.unquantized:
        options["quantization_config"].llm_int8_skip_modules = list(backbone_class.unquantized)
    fewer_bits = f'use quantization="{"nf4" if quantization else "int8"}"'
    cure = "close other programs that use the GPU" if quantization == "nf4" else fewer_bits
    with explain_out_of_memory(f"{cure}, or {MEMORY_HINT}"):
        vae = _load_part(folder, backbone_class, "vae", dtype=dtype, **_device_map(device))
        options |= {"dtype": dtype, **_device_map(device)}
        transformer = _load_part(folder, backbone_class, "transformer", **options)
    scheduler = _load_part(folder, backbone_class, "scheduler")
    distilled = bool(index.get("is_distilled"))
    backbone = backbone_class(transformer, vae, scheduler, distilled=distilled, dtype=dtype)
    packed = backbone.statistics()[0].shape[1]
    if packed not in {1, backbone.channels}:
        raise ModelError(
            f"the VAE in {folder} has {packed} values per token",
            f"expected {backbone.channels}, the input channels of its transformer",
            "copy both from the same model",
        )
    if quantization:
        # diffusers silently leaves parts on the CPU unquantized.
        name = next(
            name for name in backbone.lora_targets() if not name.startswith(backbone.unquantized)
        )
        weight = backbone.transformer.get_submodule(name).weight
        if type(weight) in {Tensor, nn.Parameter}:
            raise ModelError(
                f"the weights were loaded as {weight.dtype}",
                f"expected weights stored as {quantization}",
                "update diffusers and torchao (constraints.txt lists versions that work)",
            )
    return backbone


def encode_prompt(source: str, text: str = PROMPT, *, device: str = "cpu") -> PromptEmbedding:
    """Encodes a prompt with a backbone's text encoders, which are loaded for this call only: in
    bfloat16, on `device` if its free memory suffices, otherwise on the CPU. A tiny version has
    none: its embedding is random, seeded by the text. Returns the embedding on the CPU, bfloat16;
    float32 for a tiny version.
    """
    check_cuda(device)
    if source.startswith(TINY_PREFIX):
        seed = 0 if text == PROMPT else zlib.crc32(text.encode()) or 1  # the sum of "" is 0
        return replace(tiny(source.removeprefix(TINY_PREFIX), seed)[1], text=text)
    # Checked before the download, which may take an hour.
    for name in find_backbone(source)[0].text_encoder_requirements:
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(
                f"{name} is not installed",
                f"expected {name}, which the text encoder of {source} needs",
                f"run: pip install {name} (the version for your torch)",
            )
    disable_progress_bars_in_pipes()
    folder = resolve_model_folder(hub_id_of(source), _TEXT_ENCODER_PATTERNS)
    backbone_class, index = read_index(folder)
    names = [name for name in index if name.startswith(("text_encoder", "tokenizer", "processor"))]
    missing = [name for name in names if not (folder / name).is_dir()]
    if missing or not names:
        raise ModelError(
            f"{folder} has no {', '.join(missing) or 'text_encoder'}",
            "expected the text encoders of the model, because the prompt must be encoded",
            "copy the complete model, or set prompt in a recipe to an encoded prompt "
            "(prompt.safetensors)",
        )
    size = sum(path.stat().st_size for path in folder.glob("text_encoder*/*.safetensors"))
    if device != "cpu" and size + _ENCODING_BYTES >= torch.cuda.mem_get_info(device)[0]:
        device = "cpu"
    dtype = torch.bfloat16
    with (
        explain_out_of_memory("close other programs, or pass an encoded prompt"),
        _translate_load_errors(folder),
    ):
        parts = {"transformer": None, "vae": None, "dtype": dtype, "local_files_only": True}
        pipeline = diffusers_class(index["_class_name"]).from_pretrained(folder, **parts).to(device)
        with torch.no_grad():
            embedding = backbone_class.embed(pipeline, text).to("cpu", dtype)
    del pipeline
    # Modules refer to each other, so the text encoders would stay in memory while the base is
    # loaded
    gc.collect()
    if device != "cpu":
        torch.cuda.empty_cache()
    return embedding


def _load_part(folder: Path, backbone_class: type[Backbone], part: str, **options: Any) -> Any:  # noqa: ANN401
    """Loads a part in CONFIG_FILES. Checks its class, and that its weights are complete."""
    part_folder = folder / part
    expected = backbone_class.classes[part]
    found = read_json(part_folder / CONFIG_FILES[part]).get("_class_name")
    if found != expected:
        happened = f"{part_folder} contains a {found}"
        raise ModelError(
            happened, f"expected a {expected}", f"use a folder of {backbone_class.hub_id}"
        )
    part_class = diffusers_class(expected)
    if part == "scheduler":
        return part_class.from_pretrained(part_folder)
    with _translate_load_errors(part_folder):
        model, report = part_class.from_pretrained(
            part_folder,
            use_safetensors=True,
            local_files_only=True,
            output_loading_info=True,
            **options,
        )
    mismatched = [*report["missing_keys"], *report["unexpected_keys"]]
    if mismatched:
        raise ModelError(
            f"{part_folder} has {len(mismatched)} missing or unexpected weights, for example "
            f"{mismatched[0]}",
            f"expected the weights of a {expected}",
            "copy the model again",
        )
    return model


@contextlib.contextmanager
def _translate_load_errors(folder: Path) -> Iterator[None]:
    """Converts the exceptions of diffusers; `explain_out_of_memory` converts those about memory."""
    safetensors_error = import_library("safetensors").SafetensorError
    try:
        yield
    except ImportError as error:
        raise MissingExtra(
            f"{folder} needs a library that is not installed "
            f"({' '.join(str(error).split())[:200]})",
            "expected all libraries that its classes use",
            "install this library in addition to the extra diffusion",
        ) from error
    except (OSError, KeyError, ValueError, TypeError, safetensors_error) as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(
            f"{folder} cannot be loaded: {reason}",
            "expected complete weights that match config.json",
            "copy or download the model again",
        ) from error


def _quantization_options(quantization: Quantization, device: str) -> dict[str, Any]:
    """The keyword argument of from_pretrained for a quantization, whose libraries are checked
    before any download.
    """
    if quantization == "nf4":
        if not device.startswith("cuda"):
            raise DeviceError(
                f"nf4 does not run on {device}", "expected an NVIDIA GPU", 'use quantization="int8"'
            )
        import_bitsandbytes()
        config = diffusers_class("BitsAndBytesConfig")(
            load_in_4bit=True, bnb_4bit_quant_type="nf4", bnb_4bit_compute_dtype=torch.bfloat16
        )
        return {"quantization_config": config}
    torchao = import_library("torchao.quantization")
    return {"quantization_config": diffusers_class("TorchAoConfig")(torchao.Int8WeightOnlyConfig())}


def _device_map(device: str) -> dict[str, Any]:
    """The keyword argument of from_pretrained that loads weights directly to a GPU, not through
    host memory.
    """
    return {} if device == "cpu" else {"device_map": {"": device}}
