"""Reads and writes the files of models: safetensors and JSON. The same content gives the same
bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brewster.base.files import write_atomically
from brewster.diffusion.lazy_imports import import_library
from brewster.errors import ModelError, OutputError

if TYPE_CHECKING:
    from torch import Tensor


def check_new(target: Path) -> None:
    """Checks that nothing exists at this path, because a model is never overwritten. Raises
    OutputError.
    """
    if target.exists():
        raise OutputError(
            f"{target} exists already", "expected a new file or folder", "choose another target"
        )


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Writes the tensors and their metadata atomically, and replaces an existing file."""
    cpu_tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    metadata = {"format": "pt", **metadata}
    # safetensors writes metadata in an order that differs between runs, so the header is written
    # again in sorted order. This is safe, because the offsets of the tensors count from the end of
    # the header.
    data = with_metadata(import_library("safetensors.torch").save(cpu_tensors, metadata), metadata)
    write_atomically(path, data, overwrite=True)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a file by name, on the CPU, and its metadata."""
    safetensors = import_library("safetensors")
    try:
        # Not memory-mapped: mapped tensors would change if another process rewrote the file.
        data = path.read_bytes()
        tensors = import_library("safetensors.torch").load(data)
        return dict(sorted(tensors.items())), read_metadata(data)
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        problem = (
            "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
        )
        cure = "copy the whole folder of the model, or write it again"
        raise ModelError(
            f"{path} {problem}", "expected a safetensors file that is complete", cure
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file of a model."""
    try:
        value = json.loads(path.read_text("utf-8"))
        problem = "contains no settings"
        cause = None
    except (OSError, ValueError) as error:
        value = None
        cause = error
        problem = "is missing" if isinstance(error, FileNotFoundError) else f"is not JSON: {error}"
    if isinstance(value, dict):
        return value
    raise ModelError(
        f"{path} {problem}", "expected a JSON object", "copy or download it again"
    ) from cause


def _header(data: bytes) -> tuple[dict[str, Any], int]:
    """The header, and the offset of its end. The first eight bytes of the file hold its length."""
    end = 8 + int.from_bytes(data[:8], "little")
    return json.loads(data[8:end]), end


def read_metadata(data: bytes) -> dict[str, str]:
    """The metadata in the bytes of a safetensors file."""
    return dict(_header(data)[0].get("__metadata__", {}))


def with_metadata(data: bytes, metadata: Mapping[str, str]) -> bytes:
    """Replaces the metadata in the bytes of a safetensors file, and returns the new bytes."""
    header, end = _header(data)
    header["__metadata__"] = dict(sorted(metadata.items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[end:]
