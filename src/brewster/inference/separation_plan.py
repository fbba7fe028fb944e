"""Estimates the memory, the time and the download of a separation with a diffusion model, before anything is downloaded.

plan = plan_separation(Options(model="windowseat"), (4000, 3000), CARDS["RTX 4090"])
print(plan.table())
plan.check_fits()

The plan of a model in `brewster models list` needs neither torch nor a download. That of another model reads its files.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Mapping
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
    CostEstimate,
    GraphicsCard,
    Placement,
    WeightChoice,
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
@dataclass(frozen=True, kw_only=True)
class SeparationPlan(CostEstimate):
    """The estimated resources of the separation of one photo."""

    hub_id: str
    placement: Placement

    @cached_property
    def is_downloaded(self) -> bool:
        """Whether nothing is downloaded: a tiny version, a folder, or a base in the cache."""
        has_hub = importlib.util.find_spec("huggingface_hub") is not None
        return self.is_local or (has_hub and is_transformer_cached(self.hub_id))


def plan_separation(options: Options, size: tuple[int, int], card: GraphicsCard) -> SeparationPlan:
    """Estimates the separation of a photo of this (width, height) on a card.

    A base on the hub whose configuration is not in the cache is assumed to have the size of its backbone.
    """
    check_diffusion_model(options.model)
    hub_id, task, cost, quantization, has_prompt = _find_model(options)
    work = DiffusionWork(task, cost.size_divisor, options.steps, options.ensemble_size)
    panels = work.panel_sizes(size)
    file = Path(options.transformer) if options.transformer else None
    if file and not file.is_file():
        raise ModelError(
            f"there is no file {options.transformer}",
            "expected a file of this machine, because a plan downloads nothing",
            "download the file first",
        )
    weights = file.stat().st_size // 2 if file else cost.parameters
    choice = WeightChoice(options.quantization, quantization, options.offload, file is not None)
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
    tflop = passes * sum(map(cost.forward_tflop, tokens))
    passes *= len(panels)
    # Offloaded weights are copied in each pass.
    copies = passes * placement.host_gib(weights) * GIB / 1e9
    seconds = tflop / (EFFICIENCY * card.tflops) + copies / _COPY_GB_PER_SECOND
    memory = {
        "weights": placement.resident_gib(weights),
        "VAE": 2 * cost.vae_parameters / GIB,
        "activations": max(cost.activation_bytes(max(tokens)), pixels * DECODING_BYTES_PER_PIXEL) / GIB,
        "CUDA": _CONTEXT_GIB,
    }
    # The text encoders are released before the transformer is loaded.
    encoders_gib = 0.0 if has_prompt else weights_gib(cost.text_encoder_parameters, None)
    host_gib = max(placement.host_gib(weights), encoders_gib)
    tiles = ", ".join(f"{count} of {width} x {height}" for (width, height), count in Counter(panels).items())
    without_nf4 = f"; {with_nf4} after: pip install bitsandbytes" if with_nf4 != placement else ""
    return SeparationPlan(
        name=options.model,
        hub_id=hub_id,
        card=card,
        cost=cost,
        placement=placement,
        tflop=tflop,
        seconds=seconds,
        memory_gib=memory,
        text_encoder_gib=encoders_gib,
        host_memory=f"{host_gib:.1f} GiB "
        + (
            "while the text encoders encode the prompt" if host_gib == encoders_gib > 0 else "for the weights"
        ),
        downloaded_weights=0 if file else cost.parameters,
        is_local=cost.parameters == 0 or Path(hub_id).is_dir(),
        cure=_cure(memory, weights, card, placement, is_single_file=file is not None),
        model_rows={
            "model": f"{options.model}, {cost.parameters / 1e9:.2f} billion parameters",
            "licence": licence_of(hub_id),
            "weights": f"{placement}{without_nf4}",
            "tiles": f"{tiles} pixels a panel; {passes} passes of the transformer",
        },
        time_rows={
            "per photo": f"{tflop:.0f} TFLOP, {seconds:.1f} s (estimate); plus loading the model once, and "
            "decoding, VAE and guided upsampling of each photo"
        },
    )


def find_row(options: Options) -> DiffusionModel | None:
    """The row of the model in the table, which is enough for a plan; None if its files, or those of another base, are needed."""
    name = options.model.removeprefix(TINY_PREFIX)
    is_known = name in (DIFFUSION_MODELS if name == options.model else BACKBONE_COSTS)
    is_from_files = options.base_model or Path(options.model).is_dir()
    return DIFFUSION_MODELS[name] if is_known and not is_from_files else None


def _find_model(options: Options) -> tuple[str, DecompositionTask, BackboneCost, Quantization | None, bool]:
    """Hub id or folder, task, cost, trained quantization, and whether the prompt is stored."""
    if row := find_row(options):
        cost = BACKBONE_COSTS[row.backbone]
        if options.model.startswith(TINY_PREFIX):
            cost = cost.tiny()
        return row.base_model or row.hub_id, named_task(row.name), cost, row.quantization, row.has_prompt
    from brewster.models.diffusion.backbones.registry import hub_id_of  # noqa: PLC0415  (imports torch)
    from brewster.models.diffusion.memory import backbone_cost  # noqa: PLC0415
    from brewster.models.diffusion.model_source import find_model_source  # noqa: PLC0415

    source = find_model_source(options.model, options.base_model, allow_download=False)
    cost = backbone_cost(source.base, source.backbone_class)
    return hub_id_of(source.base), source.task, cost, source.trained_quantization, source.has_prompt


def _cure(
    memory_gib: Mapping[str, float],
    weights: int,
    card: GraphicsCard,
    placement: Placement,
    *,
    is_single_file: bool,
) -> str:
    others = sum(memory_gib.values()) - memory_gib["weights"]
    install = "" if has_bitsandbytes() else " after: pip install bitsandbytes"
    offload = (
        "--quantization int8 --offload layers" if placement.quantization == "nf4" else "--offload layers"
    )
    options = {
        "--quantization int8": Placement("cuda", "int8"),
        f"--quantization nf4{install}": Placement("cuda", "nf4"),
        offload: Placement("cuda", is_offloaded=True),
    }
    for option, other in options.items():
        needed = others + other.resident_gib(weights)
        if needed <= card.memory_gib and (other.is_offloaded or not is_single_file):
            return f"use {option}, which needs {needed:.1f} GiB"
    return "use a GPU with more memory, or the model compact"
