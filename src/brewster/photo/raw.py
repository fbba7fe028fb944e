"""Develops the RAW files of cameras with LibRaw (package rawpy) to 16-bit Display P3.

LibRaw computes linear light with the white balance and the colour matrix of the camera, without automatic brightening.
The pixels are stored with the tone curve of Display P3, so that all programs show a TIFF file of these pixels
correctly."""

from __future__ import annotations

import importlib.util
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.errors import UnreadablePhoto, install_command
from brewster.image_formats import FORMATS
from brewster.photo import metadata
from brewster.photo.colour import colour_space_of
from brewster.photo.file_info import FileInfo, check_pixel_count, library_of

_MAKER_NOTE = 37500
_EXIF_TAG, _GPS_TAG = 34665, 34853
_DAMAGED = "the RAW file cannot be read completely"


def is_raw(tags: metadata.Tags) -> bool:
    """Returns whether the first directory of a TIFF is that of a RAW file. A DNG has the tag DNGVersion (50706). Other
    RAW files begin with a reduced image (NewSubfileType, bit 0), or with colour filter array data
    (PhotometricInterpretation 32803)."""
    is_reduced = metadata.number_of(tags, 254, 0) & 1 == 1
    return 50706 in tags or is_reduced or metadata.number_of(tags, 262, 0) == 32803


def read_raw(data: bytes, max_pixels: int) -> tuple[NDArray[np.uint16], FileInfo]:
    """Returns the pixels (H, W, 1|3) in Display P3, upright, and the metadata of a RAW file. Raises the errors of
    `read_raw_size`."""
    with _opened(data) as raw:
        _upright_size(raw, max_pixels)  # checks the limit before the pixels are decoded
        options = {"use_camera_wb": True, "no_auto_bright": True, "gamma": (1, 1), "output_bps": 16}
        linear = raw.postprocess(**options, output_color=library_of("raw").ColorSpace.P3D65)
    icc = bytes(pyvips.Image.profile_load("p3"))
    curve = colour_space_of(icc, None, is_float=False).curves[1]
    encoded = np.rint(65535 * np.clip(curve.encode(np.arange(65536) / 65535), 0, 1)).astype(np.uint16)
    file_info = FileInfo(FORMATS["raw"].written_as, bits=16, icc=icc, exif=_exif(data))
    return encoded[linear.reshape(*linear.shape[:2], -1)], file_info


def read_raw_size(data: bytes, max_pixels: int) -> tuple[int, int]:
    """Returns (width, height) of the upright image of a RAW file. Raises MissingExtra if rawpy is not installed;
    PhotoTooLarge if the image has more pixels than `max_pixels`; UnreadablePhoto if the file is damaged, or LibRaw
    does not support the camera."""
    with _opened(data) as raw:
        return _upright_size(raw, max_pixels)


def with_raw_suffix(error: UnreadablePhoto, suffix: str) -> UnreadablePhoto:
    """Returns the error for a file with the suffix of a RAW file. The content of a damaged RAW file may look like another format."""
    if error.happened == _DAMAGED:
        return error
    extra = f", and install the extra raw, which RAW files need: {install_command('raw')}"
    extra = "" if importlib.util.find_spec("rawpy") else extra
    return UnreadablePhoto(
        f"{error.happened}, and its suffix {suffix} is that of a RAW file",
        "expected a complete RAW file",
        f"copy the file again from the camera{extra}",
    )


@contextmanager
def _opened(data: bytes) -> Iterator[Any]:
    """Yields the file as a `rawpy.RawPy`. Errors of LibRaw in the block are raised as `UnreadablePhoto`."""
    rawpy = library_of("raw")
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        raise UnreadablePhoto(
            _DAMAGED,
            f"expected a complete RAW file of a camera that LibRaw {'.'.join(map(str, rawpy.libraw_version))} supports",
            "copy the file again from the camera, or convert it to DNG or TIFF",
        ) from error


def _upright_size(raw: Any, max_pixels: int) -> tuple[int, int]:  # noqa: ANN401  (rawpy has no types)
    sizes = raw.sizes
    is_transposed = sizes.flip in (4, 5, 6, 7)  # LibRaw's code: bit 2 swaps rows and columns
    width, height = (sizes.iheight, sizes.iwidth) if is_transposed else (sizes.iwidth, sizes.iheight)
    check_pixel_count(width, height, max_pixels)
    return width, height


# --- EXIF


def _exif(data: bytes) -> bytes | None:
    """Returns the camera tags of a RAW file as an EXIF block, without the maker note, because its offsets become invalid."""
    if data[4:8] == b"ftyp":  # CR3: one TIFF block for each directory, each in a separate box
        blocks = {name: _box(data, name) for name in (b"CMT1", b"CMT2", b"CMT4")}
        tags = metadata.read_tags(blocks[b"CMT1"])
        subdirectories = {_EXIF_TAG: blocks[b"CMT2"], _GPS_TAG: blocks[b"CMT4"]}
        tags |= {tag: metadata.read_tags(block) for tag, block in subdirectories.items() if block}
    elif data.startswith(b"FUJIFILM"):  # RAF: the position of a JPEG with EXIF is in the header
        start, size = (int.from_bytes(data[at : at + 4], "big") for at in (84, 88))
        tags = metadata.read_tags(metadata.jpeg_exif(data[start : start + size]))
    else:  # ORF and RW2 have another number than 42 after the byte order
        tags = metadata.read_tags(data[:2] + (b"*\0" if data[:2] == b"II" else b"\0*") + data[4:])
    exif = tags.get(_EXIF_TAG)
    if isinstance(exif, dict):
        exif.pop(_MAKER_NOTE, None)
    return metadata.tiff_exif(tags)


def _box(data: bytes, name: bytes) -> bytes:
    """Returns the content of the first box with this name (ISO/IEC 14496-12 4.2), or no bytes."""
    found = re.search(rb"(....)" + name, data[: 1 << 20], re.DOTALL)
    return data[found.end() : found.start() + int.from_bytes(found[1], "big")] if found else b""
