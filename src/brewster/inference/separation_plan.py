"""Estimates the memory, the time and the download of a separation with a diffusion model, before anything is downloaded.

plan = plan_separation(Options(model="windowseat"), (4000, 3000), CARDS["RTX 4090"])
print(plan.table())
plan.check_fits()

The plan of a model in `brewster models list` needs neither torch nor a download. That of another model reads its files.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, final

from brewster.errors import ModelError
from brewster.inference.diffusion_work import DiffusionWork
from brewster.models.diffusion.hub_download import is_transformer_cached
from brewster.models.diffusion.panels import count_tokens
from brewster.models.diffusion.task import DecompositionTask, named_task
from brewster.models.diffusion_models import DIFFUSION_MODELS, DiffusionModel, licence_of
from brewster.models.diffusion_resources import (
    BACKBONE_COSTS,
    DECODING_BYTES_PER_PIXEL,
    EFFICIENCY,
    GIB,
    BackboneCost,
    GraphicsCard,
    Placement,
    WeightChoice,
    check_gpu_memory,
    cost_table,
    has_bitsandbytes,
    place_on_gpu,
    weights_gib,
)
from brewster.models.zoo import TINY_PREFIX, check_diffusion_model
from brewster.options import Options, Quantization

_CONTEXT_GIB: Final = 0.6
"""GPU memory of the CUDA context."""
_COPY_GB_PER_SECOND: Final = 10.0
"""Assumed speed of copies from host memory to the GPU."""


@final
@dataclass(frozen=True)
class SeparationPlan:
    """The estimated resources of the separation of one photo on a graphics card.

    `weights` is the number of bf16 weights of the transformer, or of its file. `panels` are the (width, height) of the panels of
    each tile, in px. `passes` is the number of passes of the transformer, and `tflop` that of their operations.
    `text_encoder_gib` is the host memory in which the text encoders are loaded; 0 if the prompt is part of the model.
    """

    model: str
    hub_id: str
    card: GraphicsCard
    cost: BackboneCost
    weights: int
    placement: Placement
    placement_with_nf4: Placement
    panels: tuple[tuple[int, int], ...]
    passes: int
    tflop: float
    activation_gib: float
    text_encoder_gib: float
    is_local: bool
    is_single_file: bool

    @property
    def memory_gib(self) -> dict[str, float]:
        """The GPU memory of each part in GiB."""
        return {
            "weights": self.placement.resident_gib(self.weights),
            "VAE": 2 * self.cost.vae_parameters / GIB,
            "activations": self.activation_gib,
            "CUDA": _CONTEXT_GIB,
        }

    @cached_property
    def is_downloaded(self) -> bool:
        """Whether nothing is downloaded: a tiny version, a folder, or a base in the cache."""
        has_hub = importlib.util.find_spec("huggingface_hub") is not None
        return self.is_local or (has_hub and is_transformer_cached(self.hub_id))

    @property
    def text_encoder_gb(self) -> float:
        """The download of the text encoders."""
        return 0.0 if self.is_downloaded else self.text_encoder_gib * GIB / 1e9

    @property
    def download_gb(self) -> float:
        """The size of all downloads."""
        if self.is_downloaded:
            return 0.0
        transformer = 0 if self.is_single_file else self.cost.parameters
        return 2e-9 * (self.cost.vae_parameters + transformer) + self.text_encoder_gb

    @property
    def host_gib(self) -> float:
        """The peak host memory in GiB. The text encoders are released before the transformer is loaded."""
        return max(self.placement.host_gib(self.weights), self.text_encoder_gib)

    @property
    def total_gib(self) -> float:
        """The peak GPU memory in GiB."""
        return sum(self.memory_gib.values())

    @property
    def seconds(self) -> float:
        """The time of the predictions for the photo, in seconds. Offloaded weights are copied in each pass."""
        copies = self.passes * self.placement.host_gib(self.weights) * GIB / 1e9
        return self.tflop / (EFFICIENCY * self.card.tflops) + copies / _COPY_GB_PER_SECOND

    def table(self) -> str:
        """Returns the plan as lines of name and value."""
        tiles = ", ".join(
            f"{count} of {width} x {height}" for (width, height), count in Counter(self.panels).items()
        )
        without_nf4 = (
            f"; {self.placement_with_nf4} after: pip install bitsandbytes"
            if self.placement_with_nf4 != self.placement
            else ""
        )
        is_for_prompt = self.host_gib == self.text_encoder_gib > 0
        return cost_table(
            {
                "model": f"{self.model}, {self.cost.parameters / 1e9:.2f} billion parameters",
                "licence": licence_of(self.hub_id),
                "weights": f"{self.placement}{without_nf4}",
                "tiles": f"{tiles} pixels a panel; {self.passes} passes of the transformer",
            },
            {
                "per photo": f"{self.tflop:.0f} TFLOP, {self.seconds:.1f} s (estimate); plus loading the model once, and "
                "decoding, VAE and guided upsampling of each photo"
            },
            memory_gib=self.memory_gib,
            card=self.card,
            host_memory=f"{self.host_gib:.1f} GiB {'while the text encoders encode the prompt' if is_for_prompt else 'for the weights'}",
            download_gb=self.download_gb,
            text_encoder_gb=self.text_encoder_gb,
        )

    def check_fits(self) -> None:
        """Checks that the separation fits into the memory of the card.

        Raises:
            DeviceError: it does not fit. The message names the first change with which it fits.
        """
        check_gpu_memory(self.model, self.total_gib, self.card, self._cure())

    def _cure(self) -> str:
        others = self.total_gib - self.memory_gib["weights"]
        install = "" if has_bitsandbytes() else " after: pip install bitsandbytes"
        int8, nf4, offloaded = (
            ("--quantization int8", Placement("cuda", "int8")),
            (f"--quantization nf4{install}", Placement("cuda", "nf4")),
            ("--offload layers", Placement("cuda", is_offloaded=True)),
        )
        if self.placement.quantization == "nf4":
            offloaded = ("--quantization int8 --offload layers", offloaded[1])
        for option, placement in (offloaded,) if self.is_single_file else (int8, nf4, offloaded):
            needed = others + placement.resident_gib(self.weights)
            if needed <= self.card.memory_gib:
                return f"use {option}, which needs {needed:.1f} GiB"
        return "use a GPU with more memory, or the model compact"


@final
@dataclass(frozen=True)
class _Model:
    """What a plan needs of a model. `is_local` is whether it is a folder or a tiny version."""

    hub_id: str
    task: DecompositionTask
    cost: BackboneCost
    quantization: Quantization | None
    needs_text_encoders: bool
    is_local: bool


def plan_separation(options: Options, size: tuple[int, int], card: GraphicsCard) -> SeparationPlan:
    """Estimates the separation of a photo of this (width, height) on a card.

    A base on the hub whose configuration is not in the cache is assumed to have the size of its backbone.

    Raises:
        ModelError: the model is unknown, is no diffusion model, or its files are damaged.
        DownloadError: the metadata of the model is not in the cache.
        PhotoError: the photo is too small for the model.
        DeviceError: the weights cannot be offloaded with the requested quantization.
        MissingExtra: the model is not in `brewster models list`, and diffusers is not installed.
    """
    check_diffusion_model(options.model)
    model = _find_model(options)
    cost, task = model.cost, model.task
    work = DiffusionWork(task, cost.size_divisor, options.steps, options.ensemble_size)
    panels = work.panel_sizes(size)
    file = _local_file(options.transformer) if options.transformer else None
    weights = file.stat().st_size // 2 if file else cost.parameters
    choice = WeightChoice(options.quantization, model.quantization, options.offload, file is not None)
    placement, with_nf4 = (
        place_on_gpu(weights, choice, free_gib=card.memory_gib, total_gib=card.memory_gib, has_nf4=has_nf4)
        for has_nf4 in (None, True)
    )
    # A few-step LoRA is trained without classifier-free guidance.
    guidance = options.guidance or (
        1 if options.fast_lora and cost.predictions_per_step == 2 else task.guidance
    )
    steps = work.sampling_steps(options.quality) * options.ensemble_size
    passes = steps * (cost.predictions_per_step if guidance > 1 else 1)
    is_direct = task.objective == "direct"  # generates one panel after the other, without condition
    tokens = [
        width * height // cost.size_divisor**2
        if is_direct
        else sum(count_tokens((width, height), task.layout, cost.size_divisor))
        for width, height in panels
    ]
    pixels = (1 if is_direct else len(task.layout.panels)) * max(width * height for width, height in panels)
    encoders_gib = weights_gib(cost.text_encoder_parameters, None) if model.needs_text_encoders else 0.0
    return SeparationPlan(
        options.model,
        model.hub_id,
        card,
        cost,
        weights,
        placement,
        with_nf4,
        tuple(panels),
        passes * len(panels),
        passes * sum(map(cost.forward_tflop, tokens)),
        max(cost.block_bytes(max(tokens)), pixels * DECODING_BYTES_PER_PIXEL) / GIB,
        encoders_gib,
        model.is_local,
        file is not None,
    )


def find_row(options: Options) -> DiffusionModel | None:
    """The row of the model in the table, which is enough for a plan; None if its files, or those of another base, are needed."""
    name = options.model.removeprefix(TINY_PREFIX)
    is_known = name in (DIFFUSION_MODELS if name == options.model else BACKBONE_COSTS)
    is_from_files = options.base_model or Path(options.model).is_dir()
    return DIFFUSION_MODELS[name] if is_known and not is_from_files else None


def _find_model(options: Options) -> _Model:
    """The model by the table, which needs no torch; or by its files, or those of another base."""
    if row := find_row(options):
        is_tiny, hub_id = options.model.startswith(TINY_PREFIX), row.base_model or row.hub_id
        cost = BACKBONE_COSTS[row.backbone]
        return _Model(
            hub_id,
            named_task(row.name),
            cost.tiny() if is_tiny else cost,
            row.quantization,
            not row.has_prompt and not is_tiny,
            is_tiny,
        )
    from brewster.models.diffusion.backbones.registry import hub_id_of  # noqa: PLC0415  (imports torch)
    from brewster.models.diffusion.memory import backbone_cost  # noqa: PLC0415
    from brewster.models.diffusion.model_source import find_model_source  # noqa: PLC0415

    source = find_model_source(options.model, options.base_model, allow_download=False)
    hub_id, is_tiny = hub_id_of(source.base), source.base.startswith(TINY_PREFIX)
    return _Model(
        hub_id,
        source.task,
        backbone_cost(source.base, source.backbone_class),
        source.trained_quantization,
        source.needs_text_encoders,
        is_tiny or Path(source.base).is_dir(),
    )


def _local_file(transformer: str) -> Path:
    path = Path(transformer)
    if path.is_file():
        return path
    raise ModelError(
        f"there is no file {transformer}",
        "expected a file of this machine, because a plan downloads nothing",
        "download the file first",
    )
