"""Estimates the memory, the time and the download of a separation with a diffusion model, before anything is downloaded.

plan = plan_separation(Options(model="windowseat"), (4000, 3000), CARDS["RTX 4090"])
print(plan.table())
plan.check_fits()

The plan needs no GPU and downloads nothing. It counts on the backbone on the device "meta", with the tiles that
`DiffusionPredictor` would use.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import torch

from brewster.errors import ModelError
from brewster.inference.diffusion_predictor import DiffusionPredictor
from brewster.models.diffusion.backbones.registry import (
    build_on_meta,
    find_description,
    hub_id_of,
    is_registered,
)
from brewster.models.diffusion.cost import (
    EFFICIENCY,
    PROMPT_TOKENS,
    GraphicsCard,
    block_bytes,
    check_gpu_memory,
    cost_table,
    count_parameters,
    forward_tflop,
)
from brewster.models.diffusion.hub_download import is_transformer_cached
from brewster.models.diffusion.memory import (
    GIB,
    OFFLOADED_WEIGHTS_GIB,
    Placement,
    count_weights,
    place_on_gpu,
    weights_gib,
)
from brewster.models.diffusion.model_source import find_model_source
from brewster.models.diffusion.offloading import DECODING_BYTES_PER_PIXEL
from brewster.models.diffusion.panels import count_tokens
from brewster.models.diffusion.pipeline import DecompositionPipeline, task_with_options
from brewster.models.diffusion.task import DecompositionTask
from brewster.models.diffusion_models import licence_of
from brewster.models.zoo import TINY_PREFIX, check_diffusion_model
from brewster.options import Options

_CONTEXT_GIB: Final = 0.6
"""GPU memory of the CUDA context."""
_COPY_GB_PER_SECOND: Final = 10.0
"""Assumed speed of copies from host memory to the GPU."""


@final
@dataclass(frozen=True)
class SeparationPlan:
    """The estimated resources of the separation of one photo on a graphics card.

    `panels` are the (width, height) of the panels of each tile, in px. `passes` is the number of passes of the transformer, and `tflop` that of
    their operations. `memory_gib` contains the GPU memory of each part. `text_encoder_gib` is the host memory in which the
    text encoders are loaded; 0 if the prompt is part of the model.
    """

    model: str
    licence: str
    card: GraphicsCard
    parameter_count: int
    placement: Placement
    panels: tuple[tuple[int, int], ...]
    passes: int
    tflop: float
    memory_gib: dict[str, float]
    download_gb: float
    text_encoder_gb: float
    text_encoder_gib: float

    @property
    def host_gib(self) -> float:
        """The peak host memory in GiB. The text encoders are released before the transformer is loaded."""
        return max(self.placement.host_gib(self.parameter_count), self.text_encoder_gib)

    @property
    def total_gib(self) -> float:
        """The peak GPU memory in GiB."""
        return sum(self.memory_gib.values())

    @property
    def seconds(self) -> float:
        """The time for the photo, in seconds, without loading. Offloaded weights are copied in each pass."""
        copies = self.passes * self.placement.host_gib(self.parameter_count) * GIB / 1e9
        return self.tflop / (EFFICIENCY * self.card.tflops) + copies / _COPY_GB_PER_SECOND

    def table(self) -> str:
        """Returns the plan as lines of name and value."""
        tiles = ", ".join(
            f"{count} of {width} x {height}" for (width, height), count in Counter(self.panels).items()
        )
        is_for_prompt = self.host_gib == self.text_encoder_gib > 0
        model = {
            "model": f"{self.model}, {self.parameter_count / 1e9:.2f} billion parameters",
            "licence": self.licence,
            "weights": f"{self.placement.quantization or 'bf16'}, {'offloaded by layers' if self.placement.is_offloaded else 'on the GPU'}",
            "tiles": f"{tiles} pixels a panel; {self.passes} passes of the transformer",
        }
        return cost_table(
            model,
            {"per photo": f"{self.tflop:.0f} TFLOP, {self.seconds:.1f} s (estimate)"},
            memory_gib=self.memory_gib,
            card=self.card,
            host_memory=f"{self.host_gib:.1f} GiB {'while the text encoders encode the prompt' if is_for_prompt else 'for the weights'}",
            download_gb=self.download_gb,
            text_encoder_gb=self.text_encoder_gb,
        )

    def check_fits(self) -> None:
        """Checks that the separation fits into the memory of the card.

        Raises:
            DeviceError: it does not fit.
        """
        cure = "use --offload layers, --quantization int8 or nf4, the model klein, or a larger card"
        check_gpu_memory(self.model, self.total_gib, self.card, cure)


def plan_separation(options: Options, size: tuple[int, int], card: GraphicsCard) -> SeparationPlan:
    """Estimates the separation of a photo of this (width, height) on a card. This takes a few seconds.

    A base on the hub whose configuration is not in the cache is assumed to have the size of its backbone.

    Raises:
        ModelError: the model is unknown, is no diffusion model, or its files are damaged.
        DownloadError: the metadata of the model is not in the cache.
        PhotoError: the photo is too small for the model.
        DeviceError: the weights cannot be offloaded with the requested quantization.
        MissingExtra: diffusers is not installed.
    """
    check_diffusion_model(options.model)
    source = find_model_source(options.model, options.base_model, allow_download=False)
    description = source.base if is_registered(source.base) else find_description(source.base)
    backbone = build_on_meta(str(description or source.backbone_class.name), dtype=torch.bfloat16)
    task = task_with_options(
        source,
        guidance=options.guidance,
        timestep_shift=options.timestep_shift,
        has_few_step_lora=options.fast_lora is not None,
    )
    prompt = backbone.random_prompt(backbone.transformer, 0)
    predictor = DiffusionPredictor(
        DecompositionPipeline(backbone, prompt, task),
        steps=options.steps,
        ensemble_size=options.ensemble_size,
    )
    parameters = count_parameters(backbone.transformer)
    file = _local_file(options.transformer) if options.transformer else None
    placement = place_on_gpu(
        count_weights(source.base, source.backbone_class, file) if file else parameters,
        free_gib=card.memory_gib,
        total_gib=card.memory_gib,
        quantization=options.quantization,
        preferred=source.trained_quantization,
        offload=options.offload,
        is_single_file=file is not None,
    )
    panels = predictor.panel_sizes(size)
    steps = predictor.sampling_steps(options.quality) * options.ensemble_size
    is_guided_twice = task.guidance > 1 and not backbone.guided_by_embedding and not backbone.distilled
    passes = steps * (2 if is_guided_twice else 1)
    tokens = [_tokens(panel, task=task, size_divisor=backbone.size_divisor) for panel in panels]
    tflop = {pair: forward_tflop(backbone, *pair) for pair in set(tokens)}
    composites = 1 if task.objective == "direct" else len(task.layout.panels)
    pixels = composites * max(width * height for width, height in panels)
    block = max(block_bytes(backbone, sum(pair) + PROMPT_TOKENS) for pair in tokens)
    is_stored = source.base.startswith(TINY_PREFIX) or Path(source.base).is_dir()
    is_stored = is_stored or is_transformer_cached(hub_id_of(source.base))
    encoders_gib = weights_gib(backbone.text_encoder_parameters, None) if source.needs_text_encoders else 0.0
    encoders_gb = 0.0 if is_stored else encoders_gib * GIB / 1e9
    vae = count_parameters(backbone.vae)
    return SeparationPlan(
        options.model,
        licence_of(hub_id_of(source.base)),
        card,
        parameters,
        placement,
        tuple(panels),
        passes * len(panels),
        passes * sum(tflop[pair] for pair in tokens),
        {
            "weights": OFFLOADED_WEIGHTS_GIB
            if placement.is_offloaded
            else file.stat().st_size / GIB
            if file
            else weights_gib(parameters, placement.quantization),
            "VAE": 2 * vae / GIB,
            "activations": max(block, pixels * DECODING_BYTES_PER_PIXEL) / GIB,
            "CUDA": _CONTEXT_GIB,
        },
        0.0 if is_stored else 2e-9 * (vae + (0 if file else parameters)) + encoders_gb,
        encoders_gb,
        encoders_gib,
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


def _tokens(panel: tuple[int, int], *, task: DecompositionTask, size_divisor: int) -> tuple[int, int]:
    """The numbers of generated tokens and of conditioning tokens. The objective "direct" generates one panel, without condition."""
    if task.objective == "direct":
        return panel[0] * panel[1] // size_divisor**2, 0
    return count_tokens(panel, task.layout, size_divisor)
