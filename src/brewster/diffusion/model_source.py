"""Finds out what a value of --model is: a backbone or a LoRA with its base. Its files are looked up
once.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from brewster.diffusion.adapter import lora, windowseat
from brewster.diffusion.adapter.lora import LORA_FILE, LoraMetadata
from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.backbones.registry import (
    DESCRIPTION_FILES,
    INDEX_FILE,
    find_backbone_class,
    is_registered,
    local_folder,
    read_index,
)
from brewster.diffusion.hub_download import resolve_model_folder
from brewster.diffusion.model_table import DIFFUSION_MODELS, TINY_PREFIX
from brewster.diffusion.prompt import PROMPT_FILE, PromptEmbedding
from brewster.diffusion.task import DecompositionTask, named_task
from brewster.errors import ModelError
from brewster.options import Quantization


@final
@dataclass(frozen=True)
class LoraLayout:
    """A row of LAYOUTS. A folder with the file `weights` has this layout, and `files` are all files
    to download. `load` adds the LoRA of a folder to a backbone.
    """

    weights: str
    files: tuple[str, ...]
    read_metadata: Callable[[Path], LoraMetadata]
    load: Callable[[Path, Backbone], tuple[LoraMetadata, PromptEmbedding]]


LAYOUTS: Final = (
    LoraLayout(LORA_FILE, (LORA_FILE, PROMPT_FILE), lora.read_lora_metadata, lora.load_lora),
    LoraLayout(
        windowseat.WEIGHTS_FILE, windowseat.FILES, windowseat.read_metadata, windowseat.load
    ),
)
"""The layouts of LoRA folders. To support another published layout, write a module and add a row.
"""

_FINGERPRINT_BYTES: Final = 1 << 20
"""The number of bytes at the start and at the end of a file that a digest reads."""
_FILES: Final = [name for layout in LAYOUTS for name in layout.files] + [*DESCRIPTION_FILES]


@final
@dataclass(frozen=True)
class ModelSource:
    """A backbone, or a LoRA with its base.

    `base` is the source of the backbone, see `load_backbone`. `trained_quantization` is the
    quantization of the base with which a LoRA was trained, and `has_prompt` is whether the encoded
    prompt is stored with the model. `folder` has the files of a LoRA or of a finetuned backbone;
    None for a backbone that is given by its name. `layout` and `metadata`: of a LoRA.
    """

    base: str
    backbone_class: type[Backbone]
    task: DecompositionTask
    trained_quantization: Quantization | None = None
    has_prompt: bool = False
    folder: Path | None = None
    layout: LoraLayout | None = None
    metadata: LoraMetadata | None = None

    @property
    def needs_text_encoders(self) -> bool:
        """Whether the prompt must be encoded before the first separation."""
        return not self.has_prompt and not self.base.startswith(TINY_PREFIX)

    def digest_parts(self) -> list[str]:
        """Returns the digests of the LoRA, its settings and its prompt, and that of the base. A
        base on the hub is identified by its name. A base in a folder is identified by the names,
        sizes, and first and last MiB of its files, because reading them completely takes a minute.
        """
        base = self.base
        if folder := local_folder(base):
            digest = hashlib.sha256()
            for path in sorted(path for path in folder.rglob("*") if path.is_file()):
                digest.update(f"{path.relative_to(folder)} {path.stat().st_size}\0".encode())
                digest.update(_ends(path))
            base = digest.hexdigest()
        if not (self.layout and self.folder and self.metadata):
            return [base]
        # The task and the scale of the LoRA are in the file of the weights, or in the JSON files of
        # the layout.
        files = [
            self.layout.weights,
            *(name for name in self.layout.files if name.endswith(".json")),
        ]
        digests = [hashlib.sha256((self.folder / name).read_bytes()).hexdigest() for name in files]
        return [*digests, self.metadata.prompt_sha256, base]


def find_model_source(model: str, base_model: str | None = None) -> ModelSource:
    """Looks up a model. Downloads the files of a LoRA, or the index and the prompt of a
    backbone.
    """
    if is_registered(model):
        _check_no_base(model, base_model)
        return ModelSource(
            model, find_backbone_class(model.removeprefix(TINY_PREFIX)), named_task(model)
        )
    row = DIFFUSION_MODELS.get(model)
    source = row.hub_id if row else model
    folder = resolve_model_folder(source, _FILES)
    if layout := next((each for each in LAYOUTS if (folder / each.weights).is_file()), None):
        metadata = layout.read_metadata(folder)
        base, backbone_class = lora.find_base(model, metadata, base_model)
        quantization = metadata.quantization
        return ModelSource(
            base, backbone_class, metadata.task, quantization, True, folder, layout, metadata
        )
    if not (folder / INDEX_FILE).is_file():
        raise _unknown_layout(model)
    _check_no_base(model, base_model)
    has_prompt = (folder / PROMPT_FILE).is_file()
    return ModelSource(
        source, read_index(folder)[0], named_task(model), has_prompt=has_prompt, folder=folder
    )


def _unknown_layout(model: str) -> ModelError:
    """The error for a folder or hub id that is neither a LoRA nor a backbone."""
    local = model if Path(model).is_dir() else f"$(hf download {model})"
    return ModelError(
        f"{model} contains no model in a known layout",
        f"expected a LoRA ({LORA_FILE}) or a backbone in diffusers' layout ({INDEX_FILE})",
        "pass the folder lora/ that brewster train wrote, or convert another LoRA with: "
        f"brewster models import {local} FOLDER --base-model BASE --prompt TEXT",
    )


def _check_no_base(model: str, base_model: str | None) -> None:
    if base_model:
        raise ModelError(
            f"{model} is a backbone, and the base model {base_model} was given for it",
            f"expected a base model only for a LoRA, which is a folder with {LORA_FILE}",
            "leave the base model out",
        )


def _ends(path: Path) -> bytes:
    with path.open("rb") as file:
        start = file.read(_FINGERPRINT_BYTES)
        file.seek(max(0, path.stat().st_size - _FINGERPRINT_BYTES))
        return start + file.read()
