"""What a diffusion model needs: the table of backbones, the table of GPUs, and the formulas for memory and operations.

    cost = BACKBONE_COSTS["kontext"]
    placement = place_on_gpu(cost.parameters, WeightChoice(), free_gib=24, total_gib=24)
    placement.resident_gib(cost.parameters), cost.forward_tflop(6144)

Plans and the checks before a download use the same numbers. The module needs neither torch nor a download.
"""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, final

from brewster.errors import DeviceError
from brewster.options import Offload, Quantization

GIB: Final = 1 << 30
BYTES_PER_WEIGHT: Final[dict[Quantization | None, float]] = {
    None: 2.0, "int8": 1.01, "float8": 1.01, "nf4": 0.52,
}  # fmt: skip
"""Bytes with the quantization scales. The weights of FLUX.1 Kontext need 22.2, 11.2 (8 bits) and 5.8 GiB (4 bits)."""
_CPU_BYTES_PER_WEIGHT: Final = 4
"""On a CPU the transformer computes in float32, because most CPUs have no fast bfloat16."""
INFERENCE_OVERHEAD_GIB: Final = 3.0
"""CUDA context, VAE and activations of one prediction at the paper's size, without gradients."""
OFFLOADED_WEIGHTS_GIB: Final = 1.5
"""Weights on the GPU during offloading: the largest block (0.7 GiB), and the layers outside of the blocks."""
DECODING_BYTES_PER_PIXEL: Final = 3000
"""Activations of a full-size VAE in bf16 for one pixel of the decoded image: about six maps of 256 channels."""
PROMPT_TOKENS: Final = 512
EFFICIENCY: Final = 0.4
"""Assumed speed of a transformer divided by the peak speed of the GPU."""
_HIDDEN_STATES_PER_BLOCK: Final = 36
"""Activations of one block while it computes, in hidden states."""


@final
@dataclass(frozen=True)
class BackboneCost:
    """What a backbone costs: its parameters, and the operations and activations of a prediction.

    `image_parameters` multiply each image token, and `text_parameters` each text token: the blocks with two streams have
    parameters for each. `predictions_per_step` is 2 with classifier-free guidance above 1.
    """

    parameters: int
    vae_parameters: int
    text_encoder_parameters: int
    blocks: int
    image_parameters: int
    text_parameters: int
    width: int = 3072
    predictions_per_step: int = 2
    size_divisor: int = 16

    def scaled(self, parameters: int, *, blocks: int, width: int) -> BackboneCost:
        """The cost of another size of the same architecture; the parameters of all streams grow alike."""
        streams = {
            name: round(getattr(self, name) * parameters / self.parameters)
            for name in ("image_parameters", "text_parameters")
        }
        return replace(self, parameters=parameters, blocks=blocks, width=width, **streams)

    def tiny(self) -> BackboneCost:
        """The cost of the tiny version, which is negligible: it has no text encoder, and is not downloaded."""
        return replace(self.scaled(0, blocks=0, width=0), vae_parameters=0, text_encoder_parameters=0)

    def forward_tflop(self, tokens: int) -> float:
        """The TFLOP of one prediction for this number of image tokens. A multiplication with addition is two
        operations. Attention multiplies queries with keys, and weights with values."""
        linear = 2 * (self.image_parameters * tokens + self.text_parameters * PROMPT_TOKENS)
        return (linear + 4 * self.blocks * self.width * (tokens + PROMPT_TOKENS) ** 2) / 1e12

    def activation_bytes(self, tokens: int, kept_blocks: int = 0) -> int:
        """The memory in bytes, in bf16, of the activations of one block while it computes, for this number of image tokens and
        the text. Training keeps the inputs of `kept_blocks` for the backward pass."""
        return (_HIDDEN_STATES_PER_BLOCK + kept_blocks) * 2 * (tokens + PROMPT_TOKENS) * self.width


BACKBONE_COSTS: Final = {
    "kontext": BackboneCost(  # text encoders: T5-XXL encoder 4.762, CLIP-L 0.123
        11_901_408_320, 83_819_683, 4_885_000_000, 57, 6_455_427_072, 6_474_020_352, predictions_per_step=1
    ),
    "klein": BackboneCost(  # text encoder: Qwen3-4B
        3_875_544_576, 84_046_115, 4_022_000_000, 25, 3_067_871_232, 3_091_011_072
    ),
    "qwen": BackboneCost(  # text encoder: Qwen2.5-VL-7B
        20_430_401_088, 126_892_531, 8_292_000_000, 60, 6_795_165_696, 6_819_110_400
    ),
}
"""name -> cost of the full size. A test counts the same numbers on torch's device "meta"."""


@final
@dataclass(frozen=True)
class GraphicsCard:
    """A GPU: memory in GiB, and peak dense bf16 speed in TFLOP/s from its data sheet."""

    name: str
    memory_gib: float
    tflops: float


CARDS: Final = {
    card.name: card
    for card in (
        GraphicsCard("RTX 4060", 8, 30), GraphicsCard("RTX 3060", 12, 25), GraphicsCard("RTX 4070", 12, 58),
        GraphicsCard("RTX 4060 Ti 16 GB", 16, 44), GraphicsCard("RTX 4080", 16, 97), GraphicsCard("RTX 5080", 16, 113),
        GraphicsCard("RTX 3090", 24, 71), GraphicsCard("RTX 4090", 24, 165), GraphicsCard("RTX 5090", 32, 210), GraphicsCard("L40S", 48, 362),
        GraphicsCard("A100", 80, 312), GraphicsCard("H100", 80, 989), GraphicsCard("H200", 141, 989),
        GraphicsCard("RX 7900 XT", 20, 103), GraphicsCard("RX 7900 XTX", 24, 123), GraphicsCard("RX 9070 XT", 16, 195),
        GraphicsCard("Radeon PRO W7900", 48, 123), GraphicsCard("MI300X", 192, 1307),
    )
}  # fmt: skip
"""Name -> GPU. The paper uses the RTX 4090."""
PAPER_GPU: Final = CARDS["RTX 4090"]
_OTHER_MAKERS: Final = {"Apple": ("apple", "m1", "m2", "m3", "m4", "m5"), "Intel": ("intel", "arc")}
"""The first words of the names of GPUs that run no diffusion models, by maker."""


def _model_number(name: str) -> str:
    """Returns the name in lower case without the words of its maker: `rtx 4090` for `NVIDIA GeForce RTX 4090`."""
    maker_words = {"nvidia", "geforce", "amd", "radeon", "instinct"}
    return " ".join(word for word in name.lower().split() if word not in maker_words)


def find_gpu(name: str) -> GraphicsCard:
    """Returns the GPU of this name, such as `RTX 4090`, `nvidia geforce rtx 4090` or `AMD Radeon RX 7900 XTX`."""
    known = {_model_number(other): card for other, card in CARDS.items()}
    if (number := _model_number(name)) in known:
        return known[number]
    for maker, words in _OTHER_MAKERS.items():
        if number.startswith(words):
            raise DeviceError(
                f"the GPU {name} is by {maker}",
                "expected an NVIDIA or AMD GPU, because diffusion models run on no other",
                "use the model compact, which runs on any machine",
            )
    raise DeviceError(
        f"there is no GPU {name!r} in the table",
        f"expected one of {', '.join(f'{card.name} ({card.memory_gib} GiB)' for card in CARDS.values())}",
        "choose one with as much memory as yours",
    )


def local_gpu() -> GraphicsCard | None:
    """Returns the GPU of this machine, or None. torch finds it, or the driver of NVIDIA if torch is not installed. Its
    speed is that of the GPU in `CARDS` whose name it begins with, or of the RTX 4090 if there is none."""
    if importlib.util.find_spec("torch"):
        import torch  # noqa: PLC0415  (slow to import)

        if not torch.cuda.is_available():
            return None
        found = torch.cuda.get_device_properties(0)
        name, memory_gib = found.name, found.total_memory / GIB
    else:
        query = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader,nounits"]
        try:
            name, mib = subprocess.check_output(query, text=True).splitlines()[0].split(", ")  # noqa: S603
            memory_gib = float(mib) / 1024
        except (OSError, subprocess.SubprocessError, ValueError, IndexError):
            return None
    similar = [key for key in CARDS if _model_number(name).startswith(_model_number(key))]
    return GraphicsCard(name, memory_gib, CARDS[max(similar, key=len, default=PAPER_GPU.name)].tflops)


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

    def resident_gib(self, weights: int) -> float:
        """The GPU memory in GiB that this number of weights occupies."""
        return OFFLOADED_WEIGHTS_GIB if self.is_offloaded else weights_gib(weights, self.quantization)

    def gpu_gib(self, weights: int) -> float:
        """The GPU memory in GiB for this number of weights and one prediction."""
        return self.resident_gib(weights) + INFERENCE_OVERHEAD_GIB

    def host_gib(self, weights: int) -> float:
        """The host memory in GiB for this number of weights. Without offloading, a GPU needs none for them."""
        if self.device != "cpu" and not self.is_offloaded:
            return 0
        if self.device == "cpu" and not self.quantization:
            return weights * _CPU_BYTES_PER_WEIGHT / GIB
        return weights_gib(weights, self.quantization)

    def __str__(self) -> str:
        place = "offloaded by layers" if self.is_offloaded else "on the GPU"
        return f"{self.quantization or 'bf16'}, {place}"


def weights_gib(parameters: int, quantization: Quantization | None) -> float:
    """The memory in GiB of a transformer with this number of parameters."""
    return parameters * BYTES_PER_WEIGHT[quantization] / GIB


def fitting_quantizations(
    parameters: int, budget_gib: float, candidates: Sequence[Quantization | None] = ("int8", "nf4")
) -> Sequence[Quantization | None]:
    """The candidates with which the weights fit into the budget, in their order."""
    return [each for each in candidates if weights_gib(parameters, each) <= budget_gib]


def has_bitsandbytes() -> bool:
    """Whether bitsandbytes is installed, which stores weights in nf4."""
    return importlib.util.find_spec("bitsandbytes") is not None


@final
@dataclass(frozen=True)
class WeightChoice:
    """How the weights of a transformer may be stored.

    `quantization` is what the user chose; None: it is chosen. `preferred` is the one with which the model was trained. Weights in
    a single file cannot be quantized again.
    """

    quantization: Quantization | None = None
    preferred: Quantization | None = None
    offload: Offload = "auto"
    is_single_file: bool = False


def place_on_gpu(
    weights: int,
    choice: WeightChoice,
    *,
    free_gib: float,
    total_gib: float,
    device: str = "cuda",
    has_nf4: bool | None = None,
) -> Placement:
    """The placement on a GPU with this memory. Weights in nf4 cannot be offloaded.

    If no quantization is given, it is the first of (`preferred`, int8, nf4) with which the weights fit into the total memory: the
    same machine always gives the same result. If none fits, or the weights are offloaded on request, it is `preferred`. Int8
    replaces nf4 without `has_nf4` (by default, if bitsandbytes is not installed), or if the weights are offloaded. With `offload`
    "auto", they are offloaded if they do not fit into the free memory.
    """
    quantization, preferred, offload = choice.quantization, choice.preferred, choice.offload
    if offload == "layers" and quantization == "nf4":
        raise DeviceError(
            "offload = layers was requested with quantization = nf4",
            "expected int8, float8 or no quantization, because weights in nf4 cannot be moved between devices",
            "use --quantization int8, or leave offload out",
        )
    has_nf4 = has_bitsandbytes() if has_nf4 is None else has_nf4
    movable: Quantization | None = "int8" if preferred == "nf4" else preferred
    preferred = preferred if has_nf4 else movable
    chosen = quantization
    if quantization is None and not choice.is_single_file:
        candidates = [preferred, "int8", *(("nf4",) if has_nf4 else ())]
        fitting = fitting_quantizations(weights, total_gib - INFERENCE_OVERHEAD_GIB, candidates)
        if offload == "layers":
            chosen = movable
        elif fitting:
            chosen = fitting[0]
        else:
            chosen = preferred if offload == "none" else movable or "int8"
    fits = Placement(device, chosen).gpu_gib(weights) <= free_gib
    is_offloaded = offload == "layers" or (offload == "auto" and not fits and chosen != "nf4" and weights > 0)
    return Placement(device, chosen, is_offloaded)


@dataclass(frozen=True, kw_only=True)
class CostEstimate:
    """The estimated resources of a separation or of a training step on a GPU.

    `memory_gib` is the GPU memory of each part, `tflop` the operations of the transformer, and `seconds` their time.
    `text_encoder_gib` is the host memory of the text encoders; 0 if the prompt is encoded already. `downloaded_weights` is the
    number of the transformer's weights on the hub. `cure` says what to do if the memory is too small. `model_rows` and `time_rows`
    are the first and the last rows of the table.
    """

    name: str
    card: GraphicsCard
    cost: BackboneCost
    memory_gib: Mapping[str, float]
    host_memory: str
    text_encoder_gib: float
    tflop: float
    seconds: float
    downloaded_weights: int
    is_local: bool
    cure: str
    model_rows: Mapping[str, str]
    time_rows: Mapping[str, str]

    @cached_property
    def is_downloaded(self) -> bool:
        """Whether nothing is downloaded: a tiny version or a folder."""
        return self.is_local

    @property
    def text_encoder_gb(self) -> float:
        """The download of the text encoders."""
        return 0.0 if self.is_downloaded else self.text_encoder_gib * GIB / 1e9

    @property
    def download_gb(self) -> float:
        """The size of all downloads."""
        weights = 0 if self.is_downloaded else self.cost.vae_parameters + self.downloaded_weights
        return 2e-9 * weights + self.text_encoder_gb

    @property
    def total_gib(self) -> float:
        """The peak GPU memory in GiB."""
        return sum(self.memory_gib.values())

    def table(self) -> str:
        """Returns the estimate as lines of name and value."""
        rows = {
            **self.model_rows,
            **{f"memory, {name}": f"{gib:.1f} GiB" for name, gib in self.memory_gib.items()},
            "memory": f"{self.total_gib:.1f} GiB of {self.card.memory_gib:g} on {self.card.name} (estimate)",
            "host memory": f"{self.host_memory} (estimate)",
            "download": f"{self.download_gb:.0f} GB, of which {self.text_encoder_gb:.0f} GB are text encoders (estimate)",
            **self.time_rows,
        }
        return "\n".join(f"{name:24}{value}" for name, value in rows.items())

    def check_fits(self) -> None:
        """Checks that the estimate fits into the memory of the GPU. The error has the first change with which it fits."""
        if self.total_gib > self.card.memory_gib:
            raise DeviceError(
                f"{self.name} needs about {self.total_gib:.1f} GiB",
                f"expected at most the {self.card.memory_gib:g} GiB of {self.card.name}",
                self.cure,
            )
