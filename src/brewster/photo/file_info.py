"""The metadata of an image file, library and pixel limit for reading, format and bit depth for
writing.
"""

import hashlib
import importlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO

from numpy.typing import NDArray

from brewster.base.image_formats import FORMATS, WRITABLE, format_of
from brewster.base.remote_path import Location
from brewster.errors import MissingExtra, PhotoTooLarge, UnsupportedPhoto
from brewster.photo.blocks.tiff_tags import has_fixed_maker_note, read_tags

_SAMPLE_BYTES = 1 << 16
WHITE_LEVELS = {"uint8": 255, "uint16": 65535, "float16": 1, "float32": 1, "float64": 1}
"""The value of white for each supported dtype."""


@dataclass(frozen=True)
class FileInfo:
    """The metadata of the file of a photo."""

    format_name: str = "png"
    """The name of the file format, a key of `brewster.base.image_formats.FORMATS`."""
    bits: int = 8
    """Bits per channel in the file."""
    icc: bytes | None = None
    """The ICC profile."""
    exif: bytes | None = None
    """The EXIF block without the leading `Exif\\0\\0`. Its orientation is set to 1."""
    xmp: bytes | None = None
    """The XMP packet."""
    iptc: bytes | None = None
    """The IPTC block with the other image resources of Photoshop, without thumbnails."""
    texts: tuple[bytes, ...] = ()
    """The chunks with texts of a PNG, or the comment segments of a JPEG."""
    resolution_px_per_mm: tuple[float, float] | None = None
    """Horizontal and vertical resolution."""
    jpeg_quality: int | None = None
    """The lowest libvips quality, 1..100, whose quantization tables have no larger sums than those
    of the file.
    """
    subsampling: str | None = None
    """Chroma subsampling of a JPEG, such as "4:2:0"."""
    compression: str | None = None
    """Compression of a TIFF, by its libvips name."""
    lossless: bool = False
    """Whether a WebP or AVIF is compressed without loss."""
    primaries: tuple[float, ...] | None = None
    """Chromaticities of an EXR or HDR: x and y of red, green, blue and white. None if they are
    unknown.
    """
    header: Mapping[str, Any] | None = None
    """The other attributes of an EXR or HDR."""
    extra_channel: NDArray[Any] | None = field(default=None, compare=False, repr=False)
    """(H, W): the second or fourth channel of a TIFF if it is no transparency (ExtraSamples 0)."""
    software: str | None = None
    """The program that created the pixels. It is written to EXR and HDR files, which have neither
    EXIF nor XMP.
    """
    other_parts: tuple[str, ...] = ()
    """The names of the parts of the file that its layers do not have, such as a gain map."""
    note: str | None = None
    """What changed when the file was read, for its user: for example, that CMYK colours were
    converted.
    """
    digest: str | None = None
    """See `sampled_digest`; None if the photo was not read from a file."""
    sha256: str | None = None
    """The SHA-256 of the file; None if the photo was not read from a file."""


@dataclass(frozen=True)
class Decoded:
    """Stored pixels (H, W, 1|3) and alpha (H, W) or None: uint8, uint16 or float32; the EXIF
    orientation is applied.
    """

    pixels: NDArray[Any]
    alpha: NDArray[Any] | None
    file_info: FileInfo


def with_notes(file_info: FileInfo, *notes: str) -> FileInfo:
    """Adds notes on what changed when the file was read."""
    return replace(file_info, note="; ".join(filter(None, (file_info.note, *notes))) or None)


def sampled_digest(file: BinaryIO) -> str:
    """Returns 16 hexadecimal digits that identify a file: the start of the SHA-256 of at most 192
    KiB of it.

    The samples are 64 KiB long: at the end of the file, at a distance of d from the end, and at
    d/2, where d is the largest power of two that is not larger than the file. So they do not change
    with metadata at the start of a JPEG. They suffice, because the pixels of photos contain noise.
    For an archive, reading whole files would take hours.
    """
    size = file.seek(0, os.SEEK_END)
    distance = 1 << max(size.bit_length() - 1, 0)
    digest = hashlib.sha256()
    for position in (size - distance, size - distance // 2, size - _SAMPLE_BYTES):
        file.seek(max(position, 0))
        digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()[:16]


_BLOCK_NAMES = {"exif": "EXIF", "xmp": "XMP", "iptc": "IPTC", "texts": "texts"}


def lost_metadata(file_info: FileInfo, format_name: str) -> str | None:
    """Returns a note on the metadata of a photo that its layers in this format do not have, or
    None.
    """
    keeps = {*FORMATS[format_name].keeps}
    if format_name != file_info.format_name:
        keeps.discard("texts")  # comments of JPEG and chunks of PNG are not converted
    lost = [
        name
        for block, name in _BLOCK_NAMES.items()
        if getattr(file_info, block) and block not in keeps
    ]
    if format_name == "tiff" and has_fixed_maker_note(read_tags(file_info.exif or b"")):
        lost.append("maker note (it is readable only at its position in the photo)")
    if file_info.extra_channel is not None and format_name != "tiff":
        lost.append("extra channel, which is no transparency,")
    return f"its {', '.join(lost)} cannot be kept in {format_name}" if lost else None


def library_of(format_name: str) -> Any:  # noqa: ANN401  (these libraries have no types)
    """Imports and returns the library that reads and writes a format. An extra of brewster installs
    it. Raises MissingExtra if the library is not installed.
    """
    row = FORMATS[format_name]
    try:
        return importlib.import_module(row.library.replace("-", "_"))
    except ImportError as error:
        raise MissingExtra.for_extra(
            row.extra or "",
            f"the {row.library} package is not installed",
            f"expected it to be installed, because {format_name.upper()} files need it",
        ) from error


def check_pixel_count(width: int, height: int, max_pixels: int) -> None:
    """Checks the size of an image before it is decoded. Raises PhotoTooLarge for more than
    `max_pixels` pixels.
    """
    if width * height > max_pixels:
        raise PhotoTooLarge(
            f"the image has {width} x {height} pixels ({width * height / 1e6:.3g} million)",
            f"expected at most {max_pixels / 1e6:g} million",
            "raise --max-pixels (in Python max_pixels) if you trust the file",
        )


def format_name_of(path: Location) -> str:
    """Returns the name of the format for the suffix of a file name. Raises UnsupportedPhoto if
    brewster writes none.
    """
    image_format = format_of(path)
    if image_format is None or not image_format.is_writable:
        raise UnsupportedPhoto(
            f"the file name {path.name!r} has the suffix {path.suffix!r}",
            "expected one of the suffixes "
            f"{' '.join(suffix for row in WRITABLE.values() for suffix in row.suffixes)}",
            "choose one of these suffixes",
        )
    return image_format.name


def depth_for(file_info: FileInfo, format_name: str, bit_depth: int | None) -> int:
    """Returns the bits per channel to write. The result is `bit_depth` if it is not None. Otherwise
    it is the largest depth of the format that is not larger than the depth of the file, or the
    smallest depth of the format if all its depths are larger. Raises UnsupportedPhoto if brewster
    does not write this format or bit depth.
    """
    depths = WRITABLE[format_name].bit_depths if format_name in WRITABLE else ()
    if not depths or (bit_depth is not None and bit_depth not in depths):
        raise UnsupportedPhoto(
            f"{format_name} with {bit_depth or 'any'} bits per channel was requested",
            "expected one of "
            f"{', '.join(f'{name} {row.bit_depths}' for name, row in WRITABLE.items())}",
            "choose one of these formats and depths",
        )
    fitting = [bits for bits in depths if bits <= file_info.bits]
    return bit_depth or max(fitting, default=depths[0])
