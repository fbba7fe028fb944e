"""The table of folder layouts of LoRAs. To support another published layout, write a module and add a row here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from brewster.models.diffusion.adapter import lora, windowseat
from brewster.models.diffusion.adapter.lora import LORA_FILE, LoraMetadata
from brewster.models.diffusion.backbones.backbone import Backbone
from brewster.models.diffusion.prompt import PROMPT_FILE, PromptEmbedding


@final
@dataclass(frozen=True)
class LoraLayout:
    """A row of LAYOUTS."""

    name: str
    weights: str
    """The file with the weights. A folder with this file has this layout."""
    files: tuple[str, ...]
    """All files to download."""
    read_metadata: Callable[[Path], LoraMetadata]
    """Reads the metadata of a folder. May raise ModelError."""
    load: Callable[[Path, Backbone], tuple[LoraMetadata, PromptEmbedding]]
    """Adds the LoRA of a folder to a backbone, and returns its metadata and prompt. May raise ModelError."""


LAYOUTS: Final = (
    LoraLayout(
        "brewster", LORA_FILE, (LORA_FILE, PROMPT_FILE), lora.read_lora_metadata, lora.load_lora
    ),
    LoraLayout(
        "windowseat", windowseat.WEIGHTS_FILE, windowseat.FILES, windowseat.read_metadata, windowseat.load
    ),
)  # fmt: skip
"""The layouts of LoRA folders."""


def layout_of(folder: Path) -> LoraLayout | None:
    """The layout of a folder, or None if it contains no LoRA."""
    return next((layout for layout in LAYOUTS if (folder / layout.weights).is_file()), None)
