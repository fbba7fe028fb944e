"""A photo in a panel, the other panels out: a backbone with what it has learnt, ready for use.

    pipeline = load_pipeline("out/kontext/lora", device="cuda")
    panels = pipeline(photo, steps=20, seeds=[0, 1])     # {"I": ..., "T": ..., "R": ...}

A backbone without a LoRA is asked for T alone, from the photo as its control image: what the paper compares with
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
from brewster.models.diffusion.adapter.lora import LORA_FILE, LoraCard, load_lora, read_card
from brewster.models.diffusion.backbones import BACKBONES, encode_prompt, family_of, load_backbone
from brewster.models.diffusion.families.family import Backbone
from brewster.models.diffusion.lazy_imports import explain_out_of_memory, fetch
from brewster.models.diffusion.panels import PanelLayout, compose, conditioning_image, split
from brewster.models.diffusion.prompt import PROMPT_FILE, PROMPTS, PromptEmbedding
from brewster.models.diffusion.sampling import STEPS, euler, sample
from brewster.models.diffusion.task import DecompositionTask
from brewster.models.zoo import TINY, model_name
from brewster.options import Quantisation

if TYPE_CHECKING:
    from jaxtyping import Float

_MEMORY_HINT: Final = "use a quantised or a smaller backbone"
_FINGERPRINT_BYTES: Final = 1 << 20
"""So many bytes of each end of a file are read to tell it from others."""
_DEVICES: Final = {"auto": "", "cuda": "cuda", "rocm": "cuda", "cpu": "cpu"}


@final
@dataclass(frozen=True, eq=False)
class DecompositionPipeline:
    """A backbone, its prompt, and the task that it learnt."""

    backbone: Backbone
    prompt: PromptEmbedding
    task: DecompositionTask
    name: str = "custom"
    sha256: str | None = None

    def __call__(
        self,
        photo: Float[Tensor, "1 3 h w"],
        *,
        steps: int = STEPS,
        seeds: Sequence[int] = (0,),
        on_progress: Callable[[int, int], None] | None = None,
    ) -> Mapping[str, Float[Tensor, "seeds 3 h w"]]:
        """The panels by name, [-1, 1], float32, on the CPU, one of each for every seed.

        Where one step is the task, `steps` and `seeds` change nothing: there is one answer. `on_progress(done, all)` is
        called after each step.

        Raises:
            ModelError: sides that are not multiples of 16, no step or no seed.
            DeviceError: out of memory (says what to lower).
        """
        layout = self.task.layout
        if self.task.objective == "one_step":
            return split(self._one_step(photo, on_progress), layout)
        height, width = photo.shape[-2:]
        pictures = sample(
            self.backbone,
            conditioning_image(photo, layout),
            self.prompt,
            size=layout.composite_size((width, height)),
            steps=steps,
            guidance=self.task.guidance,
            seeds=seeds,
            on_progress=on_progress,
        )
        return split(pictures, layout)

    @torch.no_grad()
    def _one_step(self, photo: Tensor, on_progress: Callable[[int, int], None] | None) -> Tensor:
        backbone, layout = self.backbone, self.task.layout
        with explain_out_of_memory(_MEMORY_HINT):
            latents = euler(
                backbone,
                one_step_latents(photo, backbone, layout),
                backbone.encode(conditioning_image(photo, layout)),
                self.prompt,
                steps=1,
                guidance=self.task.guidance,
            )
            picture = backbone.decode(latents).clamp(-1, 1).cpu()
        if on_progress:
            on_progress(1, 1)
        return picture


def one_step_latents(
    photo: Float[Tensor, "1 3 h w"], backbone: Backbone, layout: PanelLayout
) -> Float[Tensor, "1 c p q"]:
    """Where the one step starts, encoded: the photo in every panel."""
    return backbone.encode(compose(dict.fromkeys(layout.panels, photo), layout))


def load_pipeline(
    model: str,
    *,
    device: str = "auto",
    base: str | None = None,
    quantise: Quantisation | None = None,
    prompt: str = "detailed",
) -> DecompositionPipeline:
    """A LoRA by its folder or hub id, on its base; or a backbone as it is, by name, folder or hub id.

    Args:
        model: what to open.
        device: "auto" takes an NVIDIA or AMD card where torch sees one.
        base: the LoRA's base, if it does not lie where it was trained; none for a backbone.
        quantise: how the base is stored; by default as it was for the LoRA's training, on a card.
        prompt: what a backbone without a LoRA is told: a name in `PROMPTS`, or words.

    Raises:
        DownloadError: no access to a gated model, a wrong token, no network.
        ModelError: a missing or damaged file, a LoRA of another backbone, an unknown name.
        DeviceError: no such device, or out of memory (says what to lower).
        MissingExtra: diffusers, torchao or bitsandbytes is not installed.
    """
    torch_name = torch_device(device)
    folder = _lora_folder(model)
    if folder:
        return _load_with_lora(model, folder, torch_name, base, quantise)
    if base:
        raise ModelError(
            f"{model} is a base itself, and {base} was named as its base",
            f"a LoRA, a folder with {LORA_FILE}",
            "leave the base out",
        )
    embedding = encode_prompt(
        model, PROMPTS.get(prompt, prompt), device=torch_name
    )  # first: there is room for one of the two
    backbone = load_backbone(model, device=torch_name, quantise=quantise)
    digest = fingerprint(model, device=device, quantise=quantise, prompt=prompt)
    return DecompositionPipeline(
        backbone, embedding, DecompositionTask(PanelLayout(("T",))), model_name(model), digest
    )


def fingerprint(
    model: str,
    *,
    device: str = "auto",
    base: str | None = None,
    quantise: Quantisation | None = None,
    prompt: str = "detailed",
) -> str:
    """SHA-256 of what `load_pipeline` would open: LoRA, prompt, base, and how the base is stored.

    A base on the hub counts by its name; one in a folder by the names, sizes and ends of its files, since reading
    all of them takes a minute.

    Raises:
        ModelError, DownloadError, DeviceError: there is no such LoRA or device, or the LoRA is damaged.
    """
    folder = _lora_folder(model)
    if folder is None:
        parts = [_source_id(model), str(quantise), PROMPTS.get(prompt, prompt)]
    else:
        card = read_card(folder)
        weights = hashlib.sha256((folder / LORA_FILE).read_bytes()).hexdigest()
        stored_as = _base_quantisation(card, torch_device(device), quantise)
        parts = [weights, card.prompt_sha256, _source_id(base or card.base), str(stored_as)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _source_id(source: str) -> str:
    """A folder by its files, anything else by its name."""
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


def _base_quantisation(card: LoraCard, device: str, quantise: Quantisation | None) -> Quantisation | None:
    """As it is asked for, or as the LoRA has learnt on it; on the CPU nothing is gained by it."""
    return quantise or (card.quantise if device != "cpu" else None)


def torch_device(device: str) -> str:
    """The name that torch has for one of the devices that a user can ask for.

    Raises:
        DeviceError: large models do not run there.
    """
    if device not in _DEVICES:
        raise DeviceError(
            f"large models do not run on {device}", f"one of {', '.join(_DEVICES)}", "use --device auto"
        )
    return _DEVICES[device] or ("cuda" if torch.cuda.is_available() else "cpu")


def _lora_folder(model: str) -> Path | None:
    """Where the LoRA lies, fetched if it is on the hub; None for a backbone."""
    if model in BACKBONES or model.startswith(TINY) or (Path(model) / "model_index.json").is_file():
        return None
    folder = fetch(model, [LORA_FILE, PROMPT_FILE])
    if (folder / LORA_FILE).is_file():
        return folder
    if Path(model).is_dir():
        raise ModelError(
            f"{model} holds no model",
            f"a LoRA ({LORA_FILE}) or a backbone in diffusers' layout (model_index.json)",
            "name the folder that brewster train wrote: its lora/",
        )
    return None


def _load_with_lora(
    model: str, folder: Path, device: str, base: str | None, quantise: Quantisation | None
) -> DecompositionPipeline:
    card = read_card(folder)
    source = base or card.base
    if base is None and _is_local(source) and not Path(source).is_dir():
        raise ModelError(
            f"the base of {model} was {source}, which is not there",
            f"a {card.backbone} in diffusers' layout",
            "name its folder or hub id with --base",
        )
    family = family_of(source)  # before it is loaded, which may take an hour
    if family.name != card.backbone:
        raise ModelError(
            f"{model} is a LoRA of {card.backbone}", f"its base, not a {family.name}", "name another base"
        )
    backbone = load_backbone(source, device=device, quantise=_base_quantisation(card, device, quantise))
    card, prompt = load_lora(folder, backbone)
    torch_name = "cpu" if device == "cpu" else "cuda"
    digest = fingerprint(model, device=torch_name, base=base, quantise=quantise)
    return DecompositionPipeline(backbone, prompt, card.task, model_name(model), digest)


def _is_local(source: str) -> bool:
    return Path(source).is_absolute() or source.startswith((".", "~"))
