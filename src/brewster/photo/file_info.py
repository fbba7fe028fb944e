"""What a photograph remembers of its file, beside the pixels, and what each container can hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brewster.errors import UnsupportedPhoto
from brewster.files import SUFFIXES

DEPTHS = {
    "jpeg": (8,),
    "png": (8, 16),
    "tiff": (8, 16, 32),
    "webp": (8,),
    "avif": (8, 10, 12),
    "heic": (8, 10),
    "exr": (16, 32),
    "hdr": (32,),
}
"""Bits per channel that can be written; those of EXR and HDR, and the 32 of TIFF, are floats."""

LINEAR = ("exr", "hdr")
"""Containers whose pixels are linear light."""


@dataclass(frozen=True)
class FileInfo:
    """The file behind a photo. `exif` starts at its TIFF header; its orientation is reset to 1 already."""

    container: str = "png"
    bits: int = 8
    """Bits per channel in the file."""
    icc: bytes | None = None
    exif: bytes | None = None
    xmp: bytes | None = None
    iptc: bytes | None = None
    resolution: tuple[float, float] | None = None
    """Pixels per millimetre, across and down."""
    jpeg_quality: int | None = None
    """The least quality whose quantisation tables are nowhere coarser in sum than the file's, 1..100."""
    subsampling: str | None = None
    """Chroma subsampling of a JPEG, such as "4:2:0"."""
    compression: str | None = None
    """Compression of a TIFF, in the words of libvips."""
    lossless: bool = False
    """Whether a WebP or AVIF says that it is stored without loss."""
    primaries: tuple[float, ...] | None = None
    """Chromaticities (xy of red, green, blue and white) where an EXR or HDR states them."""
    header: Mapping[str, Any] | None = None
    """The remaining attributes of an EXR or HDR."""


def container_of(path: Path) -> str:
    """The container that a file name asks for; UnsupportedPhoto for a suffix that cannot be written."""
    container = SUFFIXES.get(path.suffix.lower())
    if container not in DEPTHS:
        raise UnsupportedPhoto(
            f"{path.name!r} asks for the format {path.suffix or 'of no suffix'!r}",
            f"brewster writes {', '.join(DEPTHS)}",
            "choose one of their suffixes",
        )
    return container


def depth_for(file_info: FileInfo, container: str, bit_depth: int | None) -> int:
    """Bits per channel to write: those asked for, else those of the file_info or the nearest below.

    Raises UnsupportedPhoto for a container or a depth that cannot be written.
    """
    if container not in DEPTHS or (bit_depth is not None and bit_depth not in DEPTHS[container]):
        raise UnsupportedPhoto(
            f"{container} with {bit_depth or 'any'} bits per channel was asked for",
            f"brewster writes {', '.join(f'{name} {depths}' for name, depths in DEPTHS.items())}",
            "choose one of these",
        )
    fitting = [bits for bits in DEPTHS[container] if bits <= file_info.bits]
    return bit_depth or max(fitting, default=DEPTHS[container][0])
