"""Converts out-of-memory errors to a DeviceError."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from typing import Final

import torch

from brewster.errors import DeviceError

_CPU_MEMORY_ERROR: Final = re.compile(r"out of memory|not enough memory|can't allocate memory", re.IGNORECASE)


@contextlib.contextmanager
def explain_out_of_memory(hint: str) -> Iterator[None]:
    """Converts out-of-memory errors of any device to a DeviceError; `hint` says what to reduce.

    Raises:
        DeviceError: out of memory.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or _CPU_MEMORY_ERROR.search(str(error)):
            first = str(error).splitlines()[0] if str(error) else "out of memory"
            raise DeviceError(
                f"the device ran out of memory ({first})", "expected enough memory for the model", hint
            ) from error
        raise
