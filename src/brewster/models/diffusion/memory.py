"""What a backbone needs of the machine: device, memory and disk. It is checked before anything is downloaded.

placement = choose_placement(count_weights("kontext", Kontext), WeightChoice(), "auto")
check_machine("kontext", Kontext, placement, requested="auto")
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch

from brewster.errors import BrewsterError, DeviceError, DownloadError
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.loading import check_cuda
from brewster.models.diffusion.backbones.registry import (
    build_on_meta,
    find_description,
    hub_id_of,
    is_registered,
    local_folder,
)
from brewster.models.diffusion.hub_download import free_disk_bytes, is_transformer_cached
from brewster.models.diffusion.lazy_imports import import_bitsandbytes, import_library
from brewster.models.diffusion_resources import (
    GIB,
    INFERENCE_OVERHEAD_GIB,
    BackboneCost,
    Placement,
    WeightChoice,
    fitting_quantizations,
    place_on_gpu,
    weights_gib,
)
from brewster.models.zoo import TINY_PREFIX

_FILE_BYTES_PER_WEIGHT: Final = 2
_HOST_OVERHEAD_GIB: Final = 2.0
_MIN_LARGE: Final = 500_000_000
"""A transformer with fewer parameters runs on any machine, so nothing is checked."""
_SMALLER_MODEL: Final = "close other programs, or choose another machine"
_WINDOWS_HINT: Final = (
    "; if this machine has an NVIDIA GPU: pip installs torch for Windows without CUDA, so install the CUDA build "
    "with the line that pytorch.org/get-started shows"
)
_DEVICES: Final = {"auto": "", "cuda": "cuda", "rocm": "cuda", "cpu": "cpu"}


def torch_device(device: str) -> str:
    """torch's name, "cuda" or "cpu", for a value of the option --device."""
    if device not in _DEVICES:
        raise DeviceError(
            f"diffusion models do not run on {device}",
            f"expected one of {', '.join(_DEVICES)}",
            "use --device auto",
        )
    name = _DEVICES[device] or ("cuda" if torch.cuda.is_available() else "cpu")
    check_cuda(name)
    return name


def backbone_cost(source: str, backbone_class: type[Backbone]) -> BackboneCost:
    """The cost of a backbone. A folder, or a hub id in the cache, is counted by its configuration; another source by its class."""
    cost = backbone_class.cost
    if source.startswith(TINY_PREFIX):
        return cost.tiny()
    description = find_description(source)
    if description is None or is_registered(description):
        return cost
    backbone = build_on_meta(description)
    config = backbone.transformer.config
    blocks = len(backbone.transformer.transformer_blocks)
    blocks += len(getattr(backbone.transformer, "single_transformer_blocks", ()))
    width = int(config.num_attention_heads * config.attention_head_dim)
    cost = cost.scaled(int(backbone.transformer.num_parameters()), blocks=blocks, width=width)
    vae = sum(parameter.numel() for parameter in backbone.vae.parameters())
    return replace(
        cost, vae_parameters=vae, predictions_per_step=1 if backbone.distilled else cost.predictions_per_step
    )


def count_weights(source: str, backbone_class: type[Backbone], transformer_file: Path | None = None) -> int:
    """The number of parameters of the transformer; 0 for a tiny version. For a `transformer_file`, it is the number of
    bf16 weights that need the same memory."""
    if transformer_file:
        return transformer_file.stat().st_size // _FILE_BYTES_PER_WEIGHT
    return backbone_cost(source, backbone_class).parameters


def choose_placement(weights: int, choice: WeightChoice, device: str) -> Placement:
    """The placement of a transformer with this number of weights on this machine. `device` is what the user chose, or
    "auto". On a CPU the default is no quantization, because int8 is slower there."""
    device = torch_device(device)
    if device == "cpu":
        if choice.offload == "layers":
            raise DeviceError(
                "offload = layers was requested on the CPU",
                "expected a GPU, because on a CPU all weights are in host memory already",
                "leave offload out",
            )
        return Placement(device, choice.quantization)
    free, total = (memory / GIB for memory in torch.cuda.mem_get_info(device))
    return place_on_gpu(weights, choice, device=device, free_gib=free, total_gib=total)


def check_machine(
    source: str,
    backbone_class: type[Backbone],
    placement: Placement,
    *,
    requested: str,
    with_text_encoders: bool = False,
    transformer_file: Path | None = None,
) -> None:
    """Checks that a backbone can run on this machine: device, free memory, and free disk for the download.

    For `source` and `transformer_file`, see `load_backbone`. `requested` is the device that the user chose, or "auto".
    `with_text_encoders` is whether the prompt must be encoded, so that the text encoders are downloaded too. They are
    loaded in host memory, also if they compute on the GPU, and released before the transformer is loaded. If there is no
    GPU, the CPU must be chosen explicitly.
    """
    weights = count_weights(source, backbone_class, transformer_file)
    if weights < _MIN_LARGE:
        return
    check_device(source, weights, placement.device, requested=requested)
    cost, is_cpu = backbone_class.cost, placement.device == "cpu"
    encoders = with_text_encoders * cost.text_encoder_parameters
    where = "of memory on cpu" if is_cpu else "of host memory, because it is offloaded"
    for needed_gib, host_memory in (
        (weights_gib(encoders, None), "of host memory, because its text encoders are loaded there"),
        (placement.host_gib(weights), where),
    ):
        if needed_gib:
            check_free(source, needed_gib + _HOST_OVERHEAD_GIB, free_host_gib(), host_memory, _SMALLER_MODEL)
    if not is_cpu:
        free = torch.cuda.mem_get_info(placement.device)[0] / GIB
        fitting = fitting_quantizations(weights, free - INFERENCE_OVERHEAD_GIB)
        cure = f"choose quantization {fitting[0]}" if fitting else _SMALLER_MODEL
        check_free(source, placement.gpu_gib(weights), free, f"of memory on {placement.device}", cure)
    if placement.quantization == "nf4" and not is_cpu:
        import_bitsandbytes()
    hub_id = hub_id_of(source)
    if not transformer_file and not local_folder(source) and not is_transformer_cached(hub_id):
        cache = Path(import_library("huggingface_hub.constants").HF_HUB_CACHE)
        needed = (weights + cost.vae_parameters + encoders) * _FILE_BYTES_PER_WEIGHT
        if needed > (free := free_disk_bytes(cache)):
            raise DownloadError(
                f"{hub_id} needs about {needed / 1e9:.0f} GB on the disk, and {cache} has {free / 1e9:.0f} GB free",
                "expected enough free disk for the download",
                "free disk space, or set HF_HOME to a folder on a larger disk",
            )


def check_device(source: str, weights: int, device: str, *, requested: str) -> None:
    """Checks that a transformer with this number of weights does not run on the CPU, unless the user chose the CPU."""
    if weights >= _MIN_LARGE and device == "cpu" and requested != "cpu":
        raise DeviceError(
            f"torch finds no GPU, and {source} has {weights / 1e9:.1f} billion parameters",
            "expected an NVIDIA or AMD GPU, because one photo takes hours on a CPU",
            f"use the model compact, or choose --device cpu explicitly{_WINDOWS_HINT if sys.platform == 'win32' else ''}",
        )


def free_host_gib() -> float:
    """The free memory of this machine in GiB."""
    return float(import_library("psutil").virtual_memory().available) / GIB


def check_free(
    source: object,
    needed_gib: float,
    free_gib: float,
    where: str,
    cure: str,
    *,
    purpose: str = "memory for the weights and one prediction",
    error: type[BrewsterError] = DeviceError,
) -> None:
    """Checks that enough is free. `where` is that of the memory or the disk, and `purpose` is what it is needed for."""
    if needed_gib > free_gib:
        raise error(
            f"{source} needs about {needed_gib:.1f} GiB {where}, and {free_gib:.1f} GiB are free",
            f"expected enough {purpose}",
            cure,
        )
