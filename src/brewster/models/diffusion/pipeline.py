"""Inference with a backbone, its LoRA and its prompt: generates the panels of a photo.

    pipeline = load_pipeline("out/kontext/lora", device="cuda")
    panels = pipeline(photo, steps=20, seeds=[0, 1])     # {"I": ..., "T": ..., "R": ...}

A backbone without a LoRA generates panel T only, with the photo as its control image. This is the baseline of the paper
("Comparing to original Flux model").
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import torch
from torch import Tensor

from brewster.errors import DeviceError, ModelError
from brewster.models.diffusion.adapter.layouts import LAYOUTS, LoraLayout, layout_of
from brewster.models.diffusion.adapter.lora import LORA_FILE, LoraMetadata
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.backbones.registry import (
    BACKBONES,
    INDEX_FILE,
    backbone_class_of,
    encode_prompt,
    load_backbone,
)
from brewster.models.diffusion.hub_download import resolve_model_folder
from brewster.models.diffusion.memory import check_machine, choose_quantization
from brewster.models.diffusion.out_of_memory import explain_out_of_memory
from brewster.models.diffusion.panels import PanelLayout, compose, conditioning_image, split
from brewster.models.diffusion.prompt import PROMPT_FILE, PROMPTS, PromptEmbedding, load_prompt
from brewster.models.diffusion.sampling import euler, sample
from brewster.models.diffusion.task import TASK_FILE, DecompositionTask, load_task
from brewster.models.diffusion_models import DIFFUSION_MODELS
from brewster.models.zoo import TINY_PREFIX, model_name
from brewster.options import Quantization

if TYPE_CHECKING:
    from jaxtyping import Float

_MEMORY_HINT: Final = "use a quantized or a smaller backbone"
_FINGERPRINT_BYTES: Final = 1 << 20
"""The number of bytes at the start and at the end of a file that `fingerprint` reads."""
_DEVICES: Final = {"auto": "", "cuda": "cuda", "rocm": "cuda", "cpu": "cpu"}


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

        With the objectives "one_step" and "direct", `steps` and `seeds` have no effect, and there is one prediction.
        `on_progress(done, total)` is called after each step.

        Returns:
            The panels by name, (seeds, 3, H, W) in [-1, 1], float32, on the CPU.

        Raises:
            ModelError: a side is not a multiple of 16, or there is no step or no seed.
            DeviceError: out of memory; the message says what to reduce.
        """
        layout = self.task.layout
        if self.task.objective == "direct":
            return self._direct(photo, on_progress)
        if self.task.objective == "one_step":
            return split(self._one_step(photo, on_progress), layout)
        height, width = photo.shape[-2:]
        images = sample(
            self.backbone,
            conditioning_image(photo, layout),
            self.prompt,
            size=layout.composite_size((width, height)),
            steps=self.task.steps if steps is None else steps,
            guidance=self.task.guidance,
            timestep_shift=self.task.timestep_shift,
            last_sigma=self.task.last_sigma,
            seeds=seeds,
            on_progress=on_progress,
        )
        return split(images, layout)

    @torch.no_grad()
    def _one_step(self, photo: Tensor, on_progress: Callable[[int, int], None] | None) -> Tensor:
        backbone, layout = self.backbone, self.task.layout
        with explain_out_of_memory(_MEMORY_HINT):
            latents = euler(
                backbone,
                one_step_latents(photo, backbone, layout),
                backbone.encode(conditioning_image(photo, layout)),
                self.prompt,
                sigmas=torch.tensor([1.0, 0.0]),
                guidance=self.task.guidance,
            )
            image = backbone.decode(latents).clamp(-1, 1).cpu()
        if on_progress:
            on_progress(1, 1)
        return image

    @torch.no_grad()
    def _direct(self, photo: Tensor, on_progress: Callable[[int, int], None] | None) -> dict[str, Tensor]:
        """Transmission = photo - prediction, as latents (Zakarin et al. 2025). Each panel is decoded separately."""
        backbone, task = self.backbone, self.task
        with explain_out_of_memory(_MEMORY_HINT):
            latents = backbone.encode(photo)
            time = torch.full((len(latents),), task.time, device=latents.device)
            prediction = backbone.predict(latents, backbone.no_condition(), time, self.prompt, task.guidance)
            panels = {"I": latents, "T": latents - prediction}
            images: dict[str, Tensor] = {
                name: backbone.decode(panels[name]).clamp(-1, 1).cpu() for name in task.layout.panels
            }
        if on_progress:
            on_progress(1, 1)
        return images


def one_step_latents(
    photo: Float[Tensor, "1 3 h w"], backbone: Backbone, layout: PanelLayout
) -> Float[Tensor, "1 c p q"]:
    """The latents at the start of the single step: the photo in every panel, encoded."""
    return backbone.encode(compose(dict.fromkeys(layout.panels, photo), layout))


def load_pipeline(
    model: str,
    *,
    device: str = "auto",
    base_model: str | None = None,
    quantization: Quantization | None = None,
    prompt: str = "detailed",
) -> DecompositionPipeline:
    """Loads a LoRA with its base model, or a backbone without a LoRA.

    Args:
        model: a LoRA by its folder or hub id, or a backbone by its name, folder or hub id.
        device: "auto" uses an NVIDIA or AMD GPU if torch finds one, otherwise the CPU.
        base_model: the folder or hub id of the LoRA's base model; by default the one used in training. Only for a LoRA.
        quantization: the quantization of the base model; by default the one used in training, or int8 or nf4 if only these fit into
            the GPU, and none on the CPU.
        prompt: for a backbone without a LoRA: a name in `PROMPTS`, or the text itself. A finetuned backbone with a
            stored prompt uses that one.

    Raises:
        DownloadError: no access to a gated model, an invalid token, or no network connection.
        ModelError: a file is missing or damaged, the LoRA belongs to another backbone, or the name is unknown.
        DeviceError: there is no such device, or it is out of memory; the message says what to reduce.
        MissingExtra: diffusers, torchao or bitsandbytes is not installed.
    """
    device_name = torch_device(device)
    lora = _find_lora(model)
    if lora:
        return _load_with_lora(model, lora, device, base_model, quantization)
    if base_model:
        raise ModelError(
            f"{model} is a backbone, and the base model {base_model} was given for it",
            f"expected a base model only for a LoRA, which is a folder with {LORA_FILE}",
            "leave the base model out",
        )
    digest = fingerprint(model, device=device, quantization=quantization, prompt=prompt)
    quantization = quantization or choose_quantization(model, device_name)
    check_machine(
        model, requested=device, device=device_name, quantization=quantization, with_text_encoders=True
    )
    # The prompt is encoded before the backbone is loaded, because memory may be too small for both.
    embedding, task = _prompt_and_task(model, PROMPTS.get(prompt, prompt), device_name)
    backbone = load_backbone(model, device=device_name, quantization=quantization)
    return DecompositionPipeline(backbone, embedding, task, model_name(model), digest)


def _prompt_and_task(model: str, text: str, device: str) -> tuple[PromptEmbedding, DecompositionTask]:
    """Those stored with a finetuned base model, which has no text encoder; otherwise the encoded text, and panel T only."""
    task = DecompositionTask(PanelLayout(("T",)))
    if model in BACKBONES or model.startswith(TINY_PREFIX):
        return encode_prompt(model, text, device=device), task
    folder = resolve_model_folder(model, [INDEX_FILE, PROMPT_FILE, TASK_FILE])
    if (folder / TASK_FILE).is_file():
        task = load_task(folder / TASK_FILE)
    if (folder / PROMPT_FILE).is_file():
        return load_prompt(folder / PROMPT_FILE, backbone_class_of(model).name), task
    return encode_prompt(model, text, device=device), task


def fingerprint(
    model: str,
    *,
    device: str = "auto",
    base_model: str | None = None,
    quantization: Quantization | None = None,
    prompt: str = "detailed",
) -> str:
    """The SHA-256 of what `load_pipeline` would load: LoRA, prompt, base_model, and the quantization of the base model.

    A base model on the hub is identified by its name. A base model in a folder is identified by the names, sizes, and first and
    last MiB of its files, because reading them completely takes a minute.

    Raises:
        ModelError, DownloadError: the LoRA does not exist or is damaged.
        DeviceError: diffusion models do not run on this device.
    """
    lora = _find_lora(model)
    if lora is None:
        quantization = quantization or choose_quantization(model, torch_device(device))
        parts = [_source_id(model), str(quantization), PROMPTS.get(prompt, prompt)]
    else:
        layout, folder = lora
        metadata = layout.read_metadata(folder)
        weights = hashlib.sha256((folder / layout.weights).read_bytes()).hexdigest()
        source = base_model or metadata.base_model
        quantization = _base_quantization(metadata, source, torch_device(device), quantization)
        parts = [weights, metadata.prompt_sha256, _source_id(source), str(quantization)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _source_id(source: str) -> str:
    """The digest of a folder's files; for any other source its name."""
    folder, digest = Path(source), hashlib.sha256()
    if source in BACKBONES or not folder.is_dir():
        return source
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(folder)} {path.stat().st_size}\0".encode())
        with path.open("rb") as file:
            digest.update(file.read(_FINGERPRINT_BYTES))
            file.seek(max(0, path.stat().st_size - _FINGERPRINT_BYTES))
            digest.update(file.read())
    return digest.hexdigest()


def _base_quantization(
    metadata: LoraMetadata, base_model: str, device: str, quantization: Quantization | None
) -> Quantization | None:
    """The requested quantization; by default the one used in training, or a smaller one that fits; none on the CPU."""
    return quantization or choose_quantization(base_model, device, metadata.quantization)


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


def _find_lora(model: str) -> tuple[LoraLayout, Path] | None:
    """The layout and the folder of a LoRA, downloaded if it is on the hub; None for a backbone."""
    if model in BACKBONES or model.startswith(TINY_PREFIX):
        return None
    source = DIFFUSION_MODELS[model].hub_id if model in DIFFUSION_MODELS else model
    folder = resolve_model_folder(source, [name for layout in LAYOUTS for name in layout.files])
    if layout := layout_of(folder):
        return layout, folder
    if not (folder / INDEX_FILE).is_file():
        raise ModelError(
            f"{model} contains no model",
            f"expected a LoRA ({LORA_FILE}) or a backbone in diffusers' layout ({INDEX_FILE})",
            "pass the folder lora/ that brewster train wrote, or convert a LoRA with: brewster models import",
        )
    return None


def _load_with_lora(
    model: str,
    lora: tuple[LoraLayout, Path],
    requested: str,
    base_model: str | None,
    quantization: Quantization | None,
) -> DecompositionPipeline:
    layout, folder = lora
    metadata, device = layout.read_metadata(folder), torch_device(requested)
    source = base_model or metadata.base_model
    if base_model is None and _is_local(source) and not Path(source).is_dir():
        raise ModelError(
            f"the base model of {model} was {source}, which does not exist",
            f"expected a {metadata.backbone} in diffusers' layout",
            "pass its folder or hub id with --base-model",
        )
    backbone_class = backbone_class_of(source)  # checked before the download, which may take an hour
    if backbone_class.name != metadata.backbone:
        raise ModelError(
            f"{model} is a LoRA of {metadata.backbone}",
            f"expected a base model of {metadata.backbone}, not of {backbone_class.name}",
            "choose another base model",
        )
    quantization = _base_quantization(metadata, source, device, quantization)
    check_machine(source, requested=requested, device=device, quantization=quantization)
    backbone = load_backbone(source, device=device, quantization=quantization)
    metadata, prompt = layout.load(folder, backbone)
    digest = fingerprint(model, device=requested, base_model=base_model, quantization=quantization)
    return DecompositionPipeline(backbone, prompt, metadata.task, model_name(model), digest)


def _is_local(source: str) -> bool:
    return Path(source).is_absolute() or source.startswith((".", "~"))
