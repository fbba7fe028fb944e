"""Gives memory back to the system."""

import ctypes
import sys
from contextlib import suppress


def give_back_memory() -> None:
    """Gives memory that was freed back to the system. glibc keeps hundreds of megabytes of it,
    which the next step or another process could use.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # another C library, such as musl
            ctypes.CDLL(None).malloc_trim(0)
