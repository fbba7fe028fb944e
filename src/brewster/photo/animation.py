"""Reads animated WebP files, which FFmpeg cannot decode."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.errors import UnreadablePhoto


def is_webp(source: str | os.PathLike[str] | bytes) -> bool:
    """Returns whether a file, a path or its bytes, is a WebP file."""
    if isinstance(source, bytes):
        head = source[:12]
    else:
        with Path(source).open("rb") as file:
            head = file.read(12)
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


def webp_frames(
    source: str | os.PathLike[str] | bytes,
) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Yields the frames of an animated WebP file with their times in seconds, each (h, w, 3) 8-bit
    sRGB, over black where they are transparent.

    Raises:
        UnreadablePhoto: the file is damaged.
    """
    try:
        if isinstance(source, bytes):
            pages = pyvips.Image.webpload_buffer(source, n=-1, access="sequential")
        else:
            pages = pyvips.Image.webpload(os.fspath(source), n=-1, access="sequential")
        height = pages.get("page-height") if pages.get_typeof("page-height") else pages.height
        delays_ms = pages.get("delay") if pages.get_typeof("delay") else []
        opaque = pages.flatten() if pages.hasalpha() else pages
        time_ms = 0
        for index in range(pages.height // height):
            yield time_ms / 1000, opaque.crop(0, index * height, pages.width, height).numpy()
            time_ms += delays_ms[index] if index < len(delays_ms) else 100
    except pyvips.Error as error:
        raise UnreadablePhoto(
            f"an animated WebP file cannot be decoded ({str(error).strip()})",
            "expected a complete file",
            "copy the file again",
        ) from error
