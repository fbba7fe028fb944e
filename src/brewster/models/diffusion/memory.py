"""What a backbone needs of the machine: device, memory and disk. It is checked before anything is downloaded.

placement = choose_placement(count_weights("kontext", Kontext), requested="auto")
check_machine("kontext", Kontext, placement, requested="auto")
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import torch

from brewster.errors import DeviceError, DownloadError
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.registry import (
    build_on_meta,
    find_description,
    hub_id_of,
    is_registered,
)
from brewster.models.diffusion.hub_download import free_disk_bytes, is_transformer_cached
from brewster.models.diffusion.lazy_imports import import_bitsandbytes, import_library
from brewster.models.zoo import TINY_PREFIX
from brewster.options import Offload, Quantization

GIB: Final = 1 << 30
BYTES_PER_WEIGHT: Final[dict[Quantization | None, float]] = {
    None: 2.0, "int8": 1.01, "float8": 1.01, "nf4": 0.52,
}  # fmt: skip
"""Bytes with the quantization scales. The weights of FLUX.1 Kontext need 22.2, 11.2 (8 bits) and 5.8 GiB (4 bits)."""
_CPU_BYTES_PER_WEIGHT: Final = 4
"""On a CPU the transformer computes in float32, because most CPUs have no fast bfloat16."""
_FILE_BYTES_PER_WEIGHT: Final = 2
VAE_PARAMETERS: Final = 130_000_000
"""The VAE of Qwen-Image-Edit, the largest one."""
INFERENCE_OVERHEAD_GIB: Final = 3.0
"""CUDA context, VAE and activations of one prediction at the paper's size, without gradients."""
OFFLOADED_WEIGHTS_GIB: Final = 1.5
"""Weights on the GPU during offloading: the largest block (0.7 GiB), and the layers outside of the blocks."""
_HOST_OVERHEAD_GIB: Final = 2.0
_MIN_LARGE: Final = 500_000_000
"""A transformer with fewer parameters runs on any machine, so nothing is checked."""
_SMALLER_MODEL: Final = "close other programs, or choose a smaller backbone (klein) or another machine"
_DEVICES: Final = {"auto": "", "cuda": "cuda", "rocm": "cuda", "cpu": "cpu"}


@final
@dataclass(frozen=True)
class Placement:
    """Where and how the weights of the transformer are stored.

    `device` is torch's name of the device that computes. If `is_offloaded`, the weights are in host memory, and each
    block is copied to the device only while it computes.
    """

    device: str
    quantization: Quantization | None = None
    is_offloaded: bool = False

    def gpu_gib(self, weights: int) -> float:
        """The GPU memory in GiB for this number of weights and one prediction."""
        resident = OFFLOADED_WEIGHTS_GIB if self.is_offloaded else weights_gib(weights, self.quantization)
        return resident + INFERENCE_OVERHEAD_GIB

    def host_gib(self, weights: int) -> float:
        """The host memory in GiB for this number of weights. Without offloading, a GPU needs none for them."""
        if self.device != "cpu":
            return weights_gib(weights, self.quantization) if self.is_offloaded else 0
        return (
            weights_gib(weights, self.quantization)
            if self.quantization
            else weights * _CPU_BYTES_PER_WEIGHT / GIB
        )


def torch_device(device: str) -> str:
    """torch's name, "cuda" or "cpu", for a value of the option --device.

    Raises:
        DeviceError: diffusion models do not run on this device.
    """
    if device not in _DEVICES:
        raise DeviceError(
            f"diffusion models do not run on {device}",
            f"expected one of {', '.join(_DEVICES)}",
            "use --device auto",
        )
    return _DEVICES[device] or ("cuda" if torch.cuda.is_available() else "cpu")


def count_weights(source: str, backbone_class: type[Backbone], transformer_file: Path | None = None) -> int:
    """The number of parameters of the transformer; 0 for a tiny version.

    They are counted by the configuration of a folder or of a hub id in the cache. For another source it is the number of
    the backbone, and for a `transformer_file` the number of bf16 weights that need the same memory.

    Raises:
        ModelError: the configuration is damaged.
    """
    if transformer_file:
        return transformer_file.stat().st_size // _FILE_BYTES_PER_WEIGHT
    if source.startswith(TINY_PREFIX):
        return 0
    if is_registered(source) or (folder := find_description(source)) is None:
        return backbone_class.parameter_count
    return int(build_on_meta(str(folder)).transformer.num_parameters())


def weights_gib(parameters: int, quantization: Quantization | None) -> float:
    """The memory in GiB of a transformer with this number of parameters."""
    return parameters * BYTES_PER_WEIGHT[quantization] / GIB


def fitting_quantizations(
    parameters: int, budget_gib: float, candidates: Sequence[Quantization | None] = ("int8", "nf4")
) -> Sequence[Quantization | None]:
    """The candidates with which the weights fit into the budget, in their order."""
    return [each for each in candidates if weights_gib(parameters, each) <= budget_gib]


def choose_placement(
    weights: int,
    *,
    requested: str,
    quantization: Quantization | None = None,
    preferred: Quantization | None = None,
    offload: Offload = "auto",
    is_single_file: bool = False,
) -> Placement:
    """The placement of a transformer with this number of weights on this machine.

    Args:
        weights: the number of parameters of the transformer.
        requested: the device that the user chose, or "auto".
        quantization: the quantization that the user chose. By default it is chosen: see `place_on_gpu`. On a CPU the default
            is none, because int8 is slower there.
        preferred: the quantization with which the model was trained.
        offload: whether to offload the weights.
        is_single_file: whether the weights are in a file that cannot be quantized again.

    Raises:
        DeviceError: diffusion models do not run on this device, or cannot be offloaded in this way.
    """
    device = torch_device(requested)
    if device == "cpu":
        if offload == "layers":
            raise DeviceError(
                "offload = layers was requested on the CPU",
                "expected a GPU, because on a CPU all weights are in host memory already",
                "leave offload out",
            )
        return Placement(device, quantization)
    free, total = (memory / GIB for memory in torch.cuda.mem_get_info(device))
    return place_on_gpu(
        weights,
        device=device,
        free_gib=free,
        total_gib=total,
        quantization=quantization,
        preferred=preferred,
        offload=offload,
        is_single_file=is_single_file,
    )


def place_on_gpu(
    weights: int,
    *,
    device: str = "cuda",
    free_gib: float,
    total_gib: float,
    quantization: Quantization | None = None,
    preferred: Quantization | None = None,
    offload: Offload = "auto",
    is_single_file: bool = False,
) -> Placement:
    """The placement on a GPU with this memory.

    If no quantization is given, it is the first of (`preferred`, int8, nf4) with which the weights fit into the GPU. The
    total memory decides, not the free one: the same machine always gives the same result. If none fits, or the weights
    are offloaded on request, it is `preferred`. Int8 replaces nf4 if bitsandbytes is not installed, or the weights are
    offloaded.

    Weights in a single file stay as they are. With `offload` "auto", the weights are offloaded if they do not fit into the free memory.

    Raises:
        DeviceError: offloading was requested with nf4, which cannot be offloaded.
    """
    if offload == "layers" and quantization == "nf4":
        raise DeviceError(
            "offload = layers was requested with quantization = nf4",
            "expected int8, float8 or no quantization, because weights in nf4 cannot be moved between devices",
            "use --quantization int8, or leave offload out",
        )
    movable: Quantization | None = "int8" if preferred == "nf4" else preferred
    has_nf4 = importlib.util.find_spec("bitsandbytes") is not None
    if not has_nf4:
        preferred = movable
    chosen = quantization
    if quantization is None and offload == "layers" and not is_single_file:
        chosen = movable
    elif quantization is None and not is_single_file:
        candidates: list[Quantization | None] = [preferred, "int8"]
        if has_nf4:
            candidates.append("nf4")
        fitting = fitting_quantizations(weights, total_gib - INFERENCE_OVERHEAD_GIB, candidates)
        fallback = preferred if offload == "none" else movable or "int8"
        chosen = fitting[0] if fitting else fallback
    resident = Placement(device, chosen)
    fits = resident.gpu_gib(weights) <= free_gib
    is_offloaded = offload == "layers" or (offload == "auto" and not fits and chosen != "nf4" and weights > 0)
    return Placement(device, chosen, is_offloaded)


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

    Args:
        source: see `load_backbone`.
        backbone_class: the class of the backbone.
        placement: where its weights will be.
        requested: the device that the user chose, or "auto".
        with_text_encoders: whether the prompt must be encoded, so that the text encoders are downloaded too. They are
            loaded in host memory, also if they compute on the GPU, and released before the transformer is loaded.
        transformer_file: see `load_backbone`.

    Raises:
        DeviceError: there is no GPU and the CPU was not chosen explicitly, or the free memory is too small.
        DownloadError: the free disk is too small.
        MissingExtra: the weights will be stored in nf4, and bitsandbytes is not installed.
    """
    weights = count_weights(source, backbone_class, transformer_file)
    if weights < _MIN_LARGE:
        return
    check_device(source, weights, placement.device, requested=requested)
    if with_text_encoders:
        encoders = weights_gib(backbone_class.text_encoder_parameters, None)
        _check_host_memory(source, encoders, "of host memory, because its text encoders are loaded there")
    _check_memory(source, weights, placement)
    if placement.quantization == "nf4" and placement.device != "cpu":
        import_bitsandbytes()
    hub_id = hub_id_of(source)
    if not transformer_file and not Path(source).is_dir() and not is_transformer_cached(hub_id):
        _check_disk(
            hub_id, weights + VAE_PARAMETERS + with_text_encoders * backbone_class.text_encoder_parameters
        )


def check_device(source: str, weights: int, device: str, *, requested: str) -> None:
    """Checks that a transformer with this number of weights does not run on the CPU, unless the user chose the CPU.

    Raises:
        DeviceError: there is no GPU, and the CPU was not chosen explicitly.
    """
    if weights >= _MIN_LARGE and device == "cpu" and requested != "cpu":
        raise DeviceError(
            f"torch finds no GPU, and {source} has {weights / 1e9:.1f} billion parameters",
            "expected an NVIDIA or AMD GPU, because one photo takes hours on a CPU",
            "use the model compact, or choose --device cpu explicitly",
        )


def _check_memory(source: str, weights: int, placement: Placement) -> None:
    if host := placement.host_gib(weights):
        is_cpu = placement.device == "cpu"
        _check_host_memory(
            source, host, "of memory on cpu" if is_cpu else "of host memory, because it is offloaded"
        )
    if placement.device == "cpu":
        return
    free = torch.cuda.mem_get_info(placement.device)[0] / GIB
    fitting = fitting_quantizations(weights, free - INFERENCE_OVERHEAD_GIB)
    cure = f"choose quantization {fitting[0]}" if fitting else _SMALLER_MODEL
    _check_fits(source, placement.gpu_gib(weights), free, f"of memory on {placement.device}", cure)


def _check_host_memory(source: str, needed_gib: float, where: str) -> None:
    available = import_library("psutil").virtual_memory().available / GIB
    _check_fits(source, needed_gib + _HOST_OVERHEAD_GIB, available, where, _SMALLER_MODEL)


def _check_fits(source: str, needed_gib: float, free_gib: float, where: str, cure: str) -> None:
    if needed_gib > free_gib:
        raise DeviceError(
            f"{source} needs about {needed_gib:.1f} GiB {where}, and {free_gib:.1f} GiB are free",
            "expected enough memory for the weights and one prediction",
            cure,
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
