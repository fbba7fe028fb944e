"""Where the text encoders of a backbone are loaded, and whether its folder has them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import torch

from brewster.errors import ModelError

_OVERHEAD_BYTES: Final = 2 << 30
"""GPU memory for the activations of the text encoders and the CUDA context."""


def check_text_encoders(folder: Path, parts: Iterable[str]) -> None:
    """Checks that the folder of a model has all text encoders and tokenizers among the parts in its index.

    Raises:
        ModelError: a text encoder or tokenizer is missing; the message says what to do.
    """
    names = [name for name in parts if name.startswith(("text_encoder", "tokenizer", "processor"))]
    missing = [name for name in names if not (folder / name).is_dir()]
    if missing or not names:
        raise ModelError(
            f"{folder} has no {', '.join(missing) or 'text_encoder'}",
            "expected the text encoders of the model, because the prompt must be encoded",
            "copy the complete model, or, in a training recipe, set prompt to an encoded prompt, such as the prompt.safetensors of a LoRA",
        )


def text_encoder_device(folder: Path, device: str) -> str:
    """The device for the text encoders: `device` if their weights fit into its free memory, otherwise the CPU."""
    if not device.startswith("cuda"):
        return "cpu"
    size = sum(path.stat().st_size for path in folder.glob("text_encoder*/*.safetensors"))
    free, _ = torch.cuda.mem_get_info(device)
    return device if size + _OVERHEAD_BYTES < free else "cpu"
