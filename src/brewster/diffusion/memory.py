"""What a backbone needs of the machine: device and memory. It is checked before a backbone is
downloaded.

`brewster models list` prints the same numbers. torch is imported only to find the GPU.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

from brewster.diffusion.lazy_imports import import_bitsandbytes, import_library
from brewster.errors import DeviceError
from brewster.options import Offload, Quantization

GIB: Final = 1 << 30
BYTES_PER_WEIGHT: Final[dict[Quantization | None, float]] = {None: 2.0, "int8": 1.01, "nf4": 0.52}
"""Bytes with the quantization scales. The weights of FLUX.1 Kontext need 22.2, 11.2 (8 bits) and
5.8 GiB (4 bits).
"""
FILE_BYTES_PER_WEIGHT: Final = 2
_CPU_BYTES_PER_WEIGHT: Final = 4
"""On a CPU the transformer computes in float32, because most CPUs have no fast bfloat16."""
_INFERENCE_OVERHEAD_GIB: Final = 3.0
"""CUDA context, VAE and activations of one prediction at the paper's size, without gradients."""
_OFFLOADED_WEIGHTS_GIB: Final = 1.5
"""Weights on the GPU during offloading: the largest block (0.7 GiB), and the layers outside of the
blocks.
"""
_HOST_OVERHEAD_GIB: Final = 2.0
_MIN_LARGE: Final = 500_000_000
"""A transformer with fewer parameters runs on any machine, so nothing is checked."""
_SMALLER_MODEL: Final = "close other programs, or choose another machine"
_DEVICES: Final = {"auto": "", "cuda": "cuda", "rocm": "cuda", "cpu": "cpu"}


@final
@dataclass(frozen=True)
class BackboneCost:
    """The parameters of a backbone. `transformer`: their number, or that of bf16 weights of equal
    size.
    """

    transformer: int
    vae: int
    text_encoders: int


BACKBONE_COSTS: Final = {
    "kontext": BackboneCost(
        11_901_408_320, 83_819_683, 4_885_000_000
    ),  # T5-XXL encoder 4.762, CLIP-L 0.123
    "klein": BackboneCost(3_875_544_576, 84_046_115, 4_022_000_000),  # Qwen3-4B
    "qwen": BackboneCost(20_430_401_088, 126_892_531, 8_292_000_000),  # Qwen2.5-VL-7B
}
"""name -> cost of the full size. A test counts the same numbers on torch's device "meta"."""


@final
@dataclass(frozen=True)
class Placement:
    """Where and how the weights of the transformer are stored: torch's name of the device that
    computes, and whether the weights are in host memory, and each block is copied to the device
    only while it computes.
    """

    device: str
    quantization: Quantization | None = None
    is_offloaded: bool = False

    def gpu_gib(self, weights: int) -> float:
        """The GPU memory in GiB for this number of weights and one prediction."""
        resident = (
            _OFFLOADED_WEIGHTS_GIB if self.is_offloaded else weights_gib(weights, self.quantization)
        )
        return resident + _INFERENCE_OVERHEAD_GIB

    def host_gib(self, weights: int) -> float:
        """The host memory in GiB for this number of weights. Without offloading, a GPU needs none
        for them.
        """
        if self.device != "cpu" and not self.is_offloaded:
            return 0
        if self.device == "cpu" and not self.quantization:
            return weights * _CPU_BYTES_PER_WEIGHT / GIB
        return weights_gib(weights, self.quantization)


def weights_gib(parameters: int, quantization: Quantization | None) -> float:
    """The memory in GiB of a transformer with this number of parameters."""
    return parameters * BYTES_PER_WEIGHT[quantization] / GIB


def fitting_quantizations(
    parameters: int, budget_gib: float, candidates: Sequence[Quantization | None] = ("int8", "nf4")
) -> Sequence[Quantization | None]:
    """The candidates with which the weights fit into the budget, in their order."""
    return [each for each in candidates if weights_gib(parameters, each) <= budget_gib]


@final
@dataclass(frozen=True)
class WeightChoice:
    """How the weights of a transformer may be stored: as the user chose, as trained (`preferred`),
    offloaded.
    """

    quantization: Quantization | None = None
    preferred: Quantization | None = None
    offload: Offload = "auto"


def place_on_gpu(
    weights: int, choice: WeightChoice, *, free_gib: float, total_gib: float, device: str = "cuda"
) -> Placement:
    """The placement on a GPU with this memory. Weights in nf4 cannot be offloaded.

    By default the quantization is the first of (`preferred`, int8, nf4) that fits into the total
    memory, so that a machine always gives the same result; else `preferred`. Int8 replaces nf4
    without bitsandbytes, and for offloaded weights. With `offload` "auto", weights are offloaded if
    they do not fit into the free memory.
    """
    quantization = choice.quantization
    preferred = choice.preferred
    offload = choice.offload
    if offload == "layers" and quantization == "nf4":
        raise DeviceError(
            "offload = layers was requested with quantization = nf4",
            "expected int8 or no quantization, because weights in nf4 cannot be moved between "
            "devices",
            "use --quantization int8, or leave offload out",
        )
    has_nf4 = importlib.util.find_spec("bitsandbytes") is not None
    movable: Quantization | None = "int8" if preferred == "nf4" else preferred
    preferred = preferred if has_nf4 else movable
    chosen = quantization
    if quantization is None:
        candidates = [preferred, "int8", *(("nf4",) if has_nf4 else ())]
        fitting = fitting_quantizations(weights, total_gib - _INFERENCE_OVERHEAD_GIB, candidates)
        if offload == "layers":
            chosen = movable
        elif fitting:
            chosen = fitting[0]
        else:
            chosen = preferred if offload == "none" else movable or "int8"
    fits = Placement(device, chosen).gpu_gib(weights) <= free_gib
    is_offloaded = offload == "layers" or (
        offload == "auto" and not fits and chosen != "nf4" and weights > 0
    )
    return Placement(device, chosen, is_offloaded)


def check_cuda(device: str) -> None:
    """Checks that torch finds a GPU if the device is one."""
    if device.startswith("cuda") and not import_library("torch").cuda.is_available():
        raise DeviceError(
            "there is no CUDA device",
            "expected an NVIDIA or AMD GPU and a torch built for it",
            "use device cpu, or install torch with CUDA (on Windows, pip alone installs it "
            "without: see pytorch.org)",
        )


def torch_device(device: str) -> str:
    """torch's name, "cuda" or "cpu", for a value of the option --device."""
    if device not in _DEVICES:
        happened = f"diffusion models do not run on {device}"
        raise DeviceError(happened, f"expected one of {', '.join(_DEVICES)}", "use --device auto")
    name = _DEVICES[device] or ("cuda" if import_library("torch").cuda.is_available() else "cpu")
    check_cuda(name)
    return name


def choose_placement(weights: int, choice: WeightChoice, device: str) -> Placement:
    """The placement of a transformer with this number of weights on this machine. `device` is what
    the user chose, or "auto". On a CPU the default is no quantization, because int8 is slower
    there.
    """
    device = torch_device(device)
    if device == "cpu":
        if choice.offload == "layers":
            raise DeviceError(
                "offload = layers was requested on the CPU",
                "expected a GPU, because on a CPU all weights are in host memory already",
                "leave offload out",
            )
        return Placement(device, choice.quantization)
    free, total = (memory / GIB for memory in import_library("torch").cuda.mem_get_info(device))
    return place_on_gpu(weights, choice, device=device, free_gib=free, total_gib=total)


def check_machine(
    source: str,
    cost: BackboneCost,
    placement: Placement,
    *,
    requested: str,
    with_text_encoders: bool = False,
) -> None:
    """Checks that a backbone can run on this machine: device and free memory.

    For `source`, see `load_backbone`. `requested` is the device that the user chose, or "auto".
    `with_text_encoders` is whether the prompt must be encoded. Text encoders are released before
    the transformer is loaded.
    """
    weights = cost.transformer
    if weights < _MIN_LARGE:
        return
    check_device(source, weights, placement.device, requested=requested)
    is_cpu = placement.device == "cpu"
    encoders = with_text_encoders * cost.text_encoders
    free = import_library("psutil").virtual_memory().available / GIB
    where = "of memory on cpu" if is_cpu else "of host memory, because it is offloaded"
    for needed_gib, host_memory in (
        (weights_gib(encoders, None), "of host memory, because its text encoders are loaded there"),
        (placement.host_gib(weights), where),
    ):
        if needed_gib:
            _check_free(source, needed_gib + _HOST_OVERHEAD_GIB, free, host_memory, _SMALLER_MODEL)
    if not is_cpu:
        free = import_library("torch").cuda.mem_get_info(placement.device)[0] / GIB
        fitting = fitting_quantizations(weights, free - _INFERENCE_OVERHEAD_GIB)
        cure = f"choose quantization {fitting[0]}" if fitting else _SMALLER_MODEL
        _check_free(
            source, placement.gpu_gib(weights), free, f"of memory on {placement.device}", cure
        )
    if placement.quantization == "nf4" and not is_cpu:
        import_bitsandbytes()


def check_device(source: str, weights: int, device: str, *, requested: str) -> None:
    """Checks that a transformer with this number of weights does not run on the CPU, unless the
    user chose the CPU.
    """
    if weights >= _MIN_LARGE and device == "cpu" and requested != "cpu":
        raise DeviceError(
            f"torch finds no GPU, and {source} has {weights / 1e9:.1f} billion parameters",
            "expected an NVIDIA or AMD GPU, because one photo takes hours on a CPU",
            "use the model compact, or a larger one for the CPU (brewster models install rdnet), "
            "or --device cpu, or install torch with CUDA (Windows: see pytorch.org)",
        )


def _check_free(source: str, needed_gib: float, free_gib: float, where: str, cure: str) -> None:
    if needed_gib > free_gib:
        happened = (
            f"{source} needs about {needed_gib:.1f} GiB {where}, and {free_gib:.1f} GiB are free"
        )
        raise DeviceError(
            happened, "expected enough memory for the weights and one prediction", cure
        )
