"""What a backbone needs of the machine: device, memory and disk. It is checked before anything is downloaded.

check_machine("kontext", requested="auto", device="cuda", quantization="int8")
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Final

import torch

from brewster.errors import DeviceError, DownloadError
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.registry import BACKBONES, backbone_class_of
from brewster.models.diffusion.hub_download import free_disk_bytes, is_transformer_cached
from brewster.models.diffusion.lazy_imports import import_library
from brewster.models.zoo import TINY_PREFIX
from brewster.options import Quantization

GIB: Final = 1 << 30
BYTES_PER_WEIGHT: Final[dict[Quantization | None, float]] = {
    None: 2.0, "int8": 1.01, "float8": 1.01, "nf4": 0.52,
}  # fmt: skip
"""Bytes with the quantization scales. The weights of FLUX.1 Kontext need 22.2, 11.2 (8 bits) and 5.8 GiB (4 bits)."""
_CPU_BYTES_PER_WEIGHT: Final = 4
"""On a CPU the transformer computes in float32, because most CPUs have no fast bfloat16."""
_FILE_BYTES_PER_WEIGHT: Final = 2
_VAE_PARAMETERS: Final = 130_000_000
"""The VAE of Qwen-Image-Edit, the largest one."""
INFERENCE_OVERHEAD_GIB: Final = 3.0
"""CUDA context, VAE and activations of one prediction at the paper's size, without gradients."""
_MIN_LARGE: Final = 500_000_000
"""A transformer with fewer parameters runs on any machine, so nothing is checked."""


def check_machine(
    source: str,
    *,
    requested: str,
    device: str,
    quantization: Quantization | None = None,
    with_text_encoders: bool = False,
) -> None:
    """Checks that a backbone can run on this machine: device, free memory, and free disk for the download.

    Args:
        source: see `load_backbone`.
        requested: the device that the user chose, or "auto".
        device: torch's name of the device that will be used.
        quantization: the quantization of the transformer.
        with_text_encoders: whether the prompt must be encoded, so that the text encoders are downloaded too.

    Raises:
        DeviceError: there is no GPU and the CPU was not chosen explicitly, or the free memory is too small.
        DownloadError: the free disk is too small, or the hub id of a finetuned model cannot be looked up.
        ModelError: the source is unknown.
    """
    if source.startswith(TINY_PREFIX):
        return
    backbone_class = backbone_class_of(source)
    weights = _count_weights(source, backbone_class)
    if weights < _MIN_LARGE:
        return
    if device == "cpu" and requested != "cpu":
        raise DeviceError(
            f"torch finds no GPU, and {source} has {weights / 1e9:.1f} billion parameters",
            "expected an NVIDIA or AMD GPU, because one photo takes hours on a CPU",
            "use the model compact, or choose --device cpu explicitly",
        )
    _check_memory(source, weights, device, quantization)
    hub_id = BACKBONES[source].hub_id if source in BACKBONES else source
    if not Path(source).is_dir() and not is_transformer_cached(hub_id):
        _check_disk(
            hub_id, weights + _VAE_PARAMETERS + with_text_encoders * backbone_class.text_encoder_parameters
        )


def choose_quantization(
    source: str, device: str, preferred: Quantization | None = None
) -> Quantization | None:
    """The first quantization of (`preferred`, int8, nf4) whose weights fit into the GPU; `preferred` if none fits.

    The total memory of the GPU decides, not the free one: the same machine always gives the same result. Then
    `check_machine` compares the choice with the free memory. On a CPU the result is None, because int8 is slower there.

    Raises:
        DownloadError, ModelError: see `check_machine`.
    """
    if not device.startswith("cuda") or source.startswith(TINY_PREFIX):
        return preferred if device != "cpu" else None
    weights, total = (
        _count_weights(source, backbone_class_of(source)),
        torch.cuda.mem_get_info(device)[1] / GIB,
    )
    candidates: list[Quantization | None] = [preferred, "int8"]
    if importlib.util.find_spec("bitsandbytes"):
        candidates.append("nf4")
    fitting = (each for each in candidates if weights_gib(weights, each) + INFERENCE_OVERHEAD_GIB <= total)
    return next(fitting, preferred)


def weights_gib(parameters: int, quantization: Quantization | None) -> float:
    """The GPU memory in GiB of a transformer with this number of parameters."""
    return parameters * BYTES_PER_WEIGHT[quantization] / GIB


def _count_weights(source: str, backbone_class: type[Backbone]) -> int:
    """The number of parameters of the transformer: of the files in a folder, otherwise of the backbone_class."""
    if not Path(source).is_dir():
        return backbone_class.parameter_count
    size = sum(path.stat().st_size for path in (Path(source) / "transformer").glob("*.safetensors"))
    return size // _FILE_BYTES_PER_WEIGHT


def _check_memory(source: str, weights: int, device: str, quantization: Quantization | None) -> None:
    if device == "cpu":
        free = import_library("psutil").virtual_memory().available / GIB
        needed = (
            weights_gib(weights, quantization) if quantization else weights * _CPU_BYTES_PER_WEIGHT / GIB
        ) + 2
    else:
        free = torch.cuda.mem_get_info(device)[0] / GIB
        needed = weights_gib(weights, quantization) + INFERENCE_OVERHEAD_GIB
    if needed <= free:
        return
    fitting = next(
        (each for each in ("int8", "nf4") if weights_gib(weights, each) + INFERENCE_OVERHEAD_GIB <= free),
        None,
    )
    raise DeviceError(
        f"{source} needs about {needed:.1f} GiB of memory on {device}, and {free:.1f} GiB are free",
        "expected enough memory for the weights and one prediction",
        f"choose quantization {fitting}"
        if fitting and device != "cpu"
        else "close other programs, or choose a smaller backbone (klein) or another machine",
    )


def _check_disk(hub_id: str, parameters: int) -> None:
    cache = Path(import_library("huggingface_hub.constants").HF_HUB_CACHE)
    free, needed = free_disk_bytes(cache), parameters * _FILE_BYTES_PER_WEIGHT
    if needed > free:
        raise DownloadError(
            f"{hub_id} needs about {needed / 1e9:.0f} GB on the disk, and {cache} has {free / 1e9:.0f} GB free",
            "expected enough free disk for the download",
            "free disk space, or set HF_HOME to a folder on a larger disk",
        )
