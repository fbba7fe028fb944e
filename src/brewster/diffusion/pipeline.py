"""Inference with a backbone, its LoRA and its prompt: generates the panels of a photo.

    pipeline = load_pipeline("out/kontext/lora")
    panels = pipeline(photo, steps=20, seeds=[0, 1])  # {"I": ..., "T": ..., "R": ...}

A backbone without a LoRA generates panel T only, the baseline of the paper ("Comparing to original
Flux model"). Euler steps are those of diffusers, without rescaling.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Unpack, final

import torch
from torch import Tensor

from brewster.diffusion import memory
from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.loading import encode_prompt, load_backbone
from brewster.diffusion.backbones.registry import BACKBONES, backbone_cost
from brewster.diffusion.model_source import ModelSource, find_model_source
from brewster.diffusion.model_table import DIFFUSION_MODELS, name_of
from brewster.diffusion.offloading import explain_out_of_memory, offload_layers
from brewster.diffusion.prompt import PROMPT_FILE, PROMPTS, PromptEmbedding, load_prompt
from brewster.diffusion.task import (
    GUIDANCE,
    STEPS,
    DecompositionTask,
    PanelLayout,
    compose,
    conditioning_image,
    split,
)
from brewster.options import Device, LoadOptions, Options

if TYPE_CHECKING:
    from jaxtyping import Float

_MEMORY_HINT: Final = (
    "store the base in fewer bits (quantization), or use a smaller base_model "
    "or a GPU with more memory"
)


@final
@dataclass(frozen=True, eq=False)
class DecompositionPipeline:
    """A backbone, its prompt, and the task for which it was trained."""

    backbone: Backbone
    prompt: PromptEmbedding
    task: DecompositionTask
    name: str = "custom"
    sha256: str | None = None

    def __call__(
        self,
        photo: Float[Tensor, "1 3 h w"],
        *,
        steps: int | None = None,
        seeds: Sequence[int] = (0,),
        on_progress: Callable[[int, int], None] | None = None,
    ) -> Mapping[str, Float[Tensor, "seeds 3 h w"]]:
        """Generates the panels for a photo in [-1, 1], by default with the steps of the task.

        With the objectives "one_step" and "direct", `steps` and `seeds` have no effect, and there
        is one prediction. `on_progress(done, total)` is called after each step.

        Returns the panels by name, (seeds, 3, H, W) in [-1, 1], float32, on the CPU.
        """
        task = self.task
        layout = self.task.layout
        if task.objective == "direct":
            return self._direct(photo, on_progress)
        height, width = photo.shape[-2:]
        is_one_step = task.objective == "one_step"
        images = sample(
            self.backbone,
            conditioning_image(photo, layout),
            self.prompt,
            size=layout.composite_size((width, height)),
            steps=1 if is_one_step else task.steps if steps is None else steps,
            guidance=task.guidance,
            seeds=(0,) if is_one_step else seeds,
            start=one_step_start(photo, layout) if is_one_step else None,
            on_progress=on_progress,
        )
        return split(images, layout)

    @torch.no_grad()
    def _direct(
        self, photo: Tensor, on_progress: Callable[[int, int], None] | None
    ) -> dict[str, Tensor]:
        """Transmission = photo - prediction, as latents (Zakarin et al. 2025). Each panel is
        decoded separately.
        """
        backbone = self.backbone
        task = self.task
        with explain_out_of_memory("use a quantized or a smaller backbone"):
            latents = backbone.encode(photo)
            time = torch.full((len(latents),), task.time, device=latents.device)
            prediction = backbone.predict(
                latents, backbone.no_condition(), time, self.prompt, task.guidance
            )
            panels = {"I": latents, "T": latents - prediction}
            images: dict[str, Tensor] = {
                name: backbone.decode(panels[name]).clamp(-1, 1).cpu()
                for name in task.layout.panels
            }
        if on_progress:
            on_progress(1, 1)
        return images


@torch.no_grad()
def sample(
    backbone: Backbone,
    condition: Float[Tensor, "1 3 p q"],
    prompt: PromptEmbedding,
    *,
    size: tuple[int, int],
    steps: int = STEPS,
    guidance: float = GUIDANCE,
    seeds: Sequence[int] = (0,),
    start: Float[Tensor, "1 3 h w"] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Float[Tensor, "seeds 3 h w"]:
    """Generates one composite per seed, of this (width, height) in pixels.

    The noise is drawn on the CPU, so a seed gives the same noise on every device. A `start` image
    in [-1, 1] replaces it. Returns the composites in [-1, 1], float32, on the CPU. `.mean(0,
    keepdim=True)` averages them.
    """
    done = itertools.count(1)
    images = []
    with explain_out_of_memory(_MEMORY_HINT):
        condition_latents = backbone.encode(condition)
        for seed in seeds:
            noise = backbone.noise(size, seed) if start is None else backbone.encode(start)
            tokens = noise.shape[2] * noise.shape[3]
            sigmas = backbone.schedule(tokens, steps)
            latents = noise.to(backbone.device)
            # An Euler step in float32: x(next sigma) = x(sigma) + (next sigma - sigma) velocity.
            for sigma, next_sigma in itertools.pairwise(sigmas.to(latents.device)):
                time = sigma.expand(len(latents))
                velocity = backbone.predict(latents, condition_latents, time, prompt, guidance)
                latents = latents + (next_sigma - sigma) * velocity
                if on_progress:
                    on_progress(next(done), steps * len(seeds))
            images.append(backbone.decode(latents).clamp(-1, 1).cpu())
    return torch.cat(images)


def one_step_start(photo: Float[Tensor, "1 3 h w"], layout: PanelLayout) -> Tensor:
    """The image from which the single step starts: the photo in every panel."""
    return compose(dict.fromkeys(layout.panels, photo), layout)


def load_pipeline(
    model: str, *, prompt: str = "detailed", **options: Unpack[LoadOptions]
) -> DecompositionPipeline:
    """Loads a LoRA with its base model, or a backbone without a LoRA, by its name, folder or hub
    id.

    `prompt` is for a backbone without a LoRA or a stored prompt: a name in `PROMPTS`, or the text.
    For the options, see `brewster.options.Options`.
    """
    chosen = Options(model=model, **options)
    _check_before_download(chosen)
    source = find_model_source(model, chosen.base_model)
    cost = backbone_cost(source.base, source.backbone_class)
    placement = _choose_placement(source, chosen, cost)
    memory.check_machine(
        source.base,
        cost,
        placement,
        requested=chosen.device,
        with_text_encoders=source.needs_text_encoders,
    )
    text = PROMPTS.get(prompt, prompt)
    # The prompt is encoded before the backbone is loaded, because memory may be too small for both.
    if source.layout:
        embedding = None
    elif source.has_prompt and source.folder:  # a finetuned backbone, which has no text encoder
        embedding = load_prompt(source.folder / PROMPT_FILE, source.backbone_class.name)
    else:
        embedding = encode_prompt(source.base, text, device=placement.device)
    backbone = load_backbone(
        source.base,
        device="cpu" if placement.is_offloaded else placement.device,
        dtype=torch.float32 if placement.device == "cpu" else torch.bfloat16,
        quantization=placement.quantization,
    )
    if source.layout and source.folder:
        _, embedding = source.layout.load(source.folder, backbone)
    assert embedding is not None
    if placement.is_offloaded:
        offload_layers(backbone.transformer, backbone.vae, placement.device)
    task = replace(
        source.task, guidance=source.task.guidance if chosen.guidance is None else chosen.guidance
    )
    digest = _digest(source, placement.quantization, text, task.guidance)
    return DecompositionPipeline(backbone, embedding, task, name_of(model), digest)


def fingerprint(model: str, *, device: Device = "auto") -> str:
    """The SHA-256 of what `load_pipeline` would load by default, which also raises the same errors:
    LoRA, prompt, base model (see `ModelSource.digest_parts`), and the quantization of the base
    model.
    """
    source = find_model_source(model)
    cost = backbone_cost(source.base, source.backbone_class)
    placement = _choose_placement(source, Options(device=device), cost)
    return _digest(source, placement.quantization, PROMPTS["detailed"], source.task.guidance)


def _digest(source: ModelSource, quantization: str | None, text: str, guidance: float) -> str:
    parts = [*source.digest_parts(), str(quantization), *([] if source.layout else [text])]
    parts += [] if guidance == source.task.guidance else [f"guidance {guidance}"]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _check_before_download(options: Options) -> None:
    """Checks the device of a model with a name before its files are downloaded."""
    device = memory.torch_device(options.device)
    row = DIFFUSION_MODELS.get(options.model)
    if row and row.base_model and not options.base_model:
        cost = backbone_cost(row.base_model, BACKBONES[row.backbone])
        memory.check_device(row.base_model, cost.transformer, device, requested=options.device)


def _choose_placement(
    source: ModelSource, options: Options, cost: memory.BackboneCost
) -> memory.Placement:
    choice = memory.WeightChoice(options.quantization, source.trained_quantization, options.offload)
    return memory.choose_placement(cost.transformer, choice, options.device)
