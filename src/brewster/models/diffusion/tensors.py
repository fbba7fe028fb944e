"""Safetensors files with the same bytes for the same tensors, and plain words for damaged ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from brewster.errors import ModelError
from brewster.files import write_atomically
from brewster.models.diffusion.lazy_imports import import_library


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Writes the tensors and what is said about them, whole or not at all, replacing an older file.

    Raises:
        TargetError: the file cannot be written.
        MissingExtra: safetensors is not installed.
    """
    cpu_tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    metadata = {"format": "pt", **metadata}
    # safetensors writes its metadata in an order that changes from run to run; offsets count from its end.
    data = with_metadata(import_library("safetensors.torch").save(cpu_tensors, metadata), metadata)
    write_atomically(path, data, overwrite=True)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a file by name, on the CPU, and what is said about them.

    Raises:
        ModelError: the file is missing or damaged.
        MissingExtra: safetensors is not installed.
    """
    safetensors = import_library("safetensors")
    try:
        # Not mapped but read: whoever writes the file anew would pull a mapped tensor from under our feet.
        data = path.read_bytes()
        tensors = import_library("safetensors.torch").load(data)
        return dict(sorted(tensors.items())), read_metadata(data)
    except FileNotFoundError as error:
        raise ModelError(f"{path} is missing", "a safetensors file", "copy the whole folder") from error
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        raise ModelError(
            f"{path} cannot be read: {error}", "a whole safetensors file", "copy or write it again"
        ) from error


def _header(data: bytes) -> dict[str, Any]:
    return json.loads(data[8 : _header_end(data)])  # type: ignore[no-any-return]


def _header_end(data: bytes) -> int:
    """Where the header ends: its length stands in the first eight bytes."""
    return 8 + int.from_bytes(data[:8], "little")


def read_metadata(data: bytes) -> dict[str, str]:
    """What is said about the tensors in a whole file's bytes."""
    metadata: dict[str, str] = _header(data).get("__metadata__", {})
    return metadata


def with_metadata(data: bytes, metadata: Mapping[str, str]) -> bytes:
    """The same tensors in a whole file's bytes, with something else said about them."""
    header = _header(data)
    header["__metadata__"] = dict(sorted(metadata.items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[_header_end(data) :]
