"""Develops the RAW files of cameras with LibRaw (package rawpy) to 16-bit Display P3.

LibRaw computes linear light with the white balance and the colour matrix of the camera, without
automatic brightening. The pixels are stored with the tone curve of Display P3, so all programs show
a TIFF file of them correctly.
"""

import importlib.util
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.base.image_formats import FORMATS
from brewster.errors import UnreadablePhoto, UnsupportedPhoto, install_command
from brewster.photo import metadata
from brewster.photo.blocks import tiff_tags
from brewster.photo.colour.spaces import colour_space_of
from brewster.photo.file_info import FileInfo, check_pixel_count, library_of

_MAKER_NOTE = 37500
_GPS_TAG = 34853
_DAMAGED = "the RAW file cannot be read completely"


def read_raw(data: bytes, max_pixels: int) -> tuple[NDArray[np.uint16], FileInfo]:
    """Returns the pixels (H, W, 1|3) in Display P3, upright, and the metadata of a RAW file. Raises
    the errors of `read_raw_size`.
    """
    with _opened(data) as raw:
        rows, columns = _upright_crop(
            raw, data, max_pixels
        )  # checks the limit before the pixels are decoded
        options = {"use_camera_wb": True, "no_auto_bright": True, "gamma": (1, 1), "output_bps": 16}
        linear = raw.postprocess(**options, output_color=library_of("raw").ColorSpace.P3D65)
    icc = bytes(pyvips.Image.profile_load("p3"))
    curve = colour_space_of(icc, None, is_float=False).curves[1]
    encoded = np.rint(65535 * np.clip(curve.encode(np.arange(65536) / 65535), 0, 1)).astype(
        np.uint16
    )
    linear = linear[rows, columns].reshape(rows.stop - rows.start, columns.stop - columns.start, -1)
    exif = _exif(data)
    exif = exif and tiff_tags.upright_exif(exif, (linear.shape[1], linear.shape[0]))
    return encoded[linear], FileInfo(FORMATS["raw"].written_as, bits=16, icc=icc, exif=exif)


def read_raw_size(data: bytes, max_pixels: int) -> tuple[int, int]:
    """Returns (width, height) of the upright image of a RAW file. Raises MissingExtra if rawpy is
    not installed; PhotoTooLarge if the image has more pixels than `max_pixels`; UnreadablePhoto if
    the file is damaged, or LibRaw does not support the camera; UnsupportedPhoto if LibRaw does not
    support the compression of a DNG.
    """
    with _opened(data) as raw:
        rows, columns = _upright_crop(raw, data, max_pixels)
        return columns.stop - columns.start, rows.stop - rows.start


def with_raw_suffix(error: UnreadablePhoto, suffix: str) -> UnreadablePhoto:
    """Returns the error for a file with the suffix of a RAW file: a damaged one may look like
    another format.
    """
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
    """Yields the file as a `rawpy.RawPy`. Errors of LibRaw in the block are raised as
    `UnreadablePhoto`.
    """
    rawpy = library_of("raw")
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        version = f"LibRaw {'.'.join(map(str, rawpy.libraw_version))}"
        if unsupported := tiff_tags.compressions(data) & tiff_tags.COMPRESSION_NAMES.keys():
            compression = tiff_tags.COMPRESSION_NAMES[min(unsupported)]
            raise UnsupportedPhoto(
                f"this DNG is compressed with {compression}, which {version} does not support",
                "expected a DNG without compression, or with that of JPEG",
                "convert the file to such a DNG or to TIFF, for example with Adobe DNG Converter",
            ) from error
        raise UnreadablePhoto(
            _DAMAGED,
            f"expected a complete RAW file of a camera that {version} supports",
            "copy the file again from the camera, or convert it to DNG or TIFF",
        ) from error


def _upright_crop(raw: Any, data: bytes, max_pixels: int) -> tuple[slice, slice]:  # noqa: ANN401  (rawpy has no types)
    """Returns the rows and columns of the upright image that a photo has: all, or the default crop
    of a DNG.
    """
    sizes = raw.sizes
    height, width = sizes.iheight, sizes.iwidth
    check_pixel_count(width, height, max_pixels)
    rows, columns = slice(0, height), slice(0, width)
    if crop := tiff_tags.default_crop(data):
        left, top, crop_width, crop_height = crop
        if (
            crop_width
            and crop_height
            and left + crop_width <= width
            and top + crop_height <= height
        ):
            rows, columns = slice(top, top + crop_height), slice(left, left + crop_width)
    # LibRaw's code for the orientation: bit 0 mirrors columns, bit 1 mirrors rows, and then bit 2
    # swaps them
    columns = slice(width - columns.stop, width - columns.start) if sizes.flip & 1 else columns
    rows = slice(height - rows.stop, height - rows.start) if sizes.flip & 2 else rows
    return (columns, rows) if sizes.flip & 4 else (rows, columns)


def _exif(data: bytes) -> bytes | None:
    """Returns the camera tags of a RAW file as an EXIF block, without the maker note, whose offsets
    become invalid.
    """
    if data[4:8] == b"ftyp":  # CR3: one TIFF block for each directory, each in a separate box
        blocks = {name: metadata.iso_box(data, name) for name in (b"CMT1", b"CMT2", b"CMT4")}
        tags = tiff_tags.read_tags(blocks[b"CMT1"])
        subdirectories = {tiff_tags.EXIF_POINTER: blocks[b"CMT2"], _GPS_TAG: blocks[b"CMT4"]}
        tags |= {tag: tiff_tags.read_tags(block) for tag, block in subdirectories.items() if block}
    elif data.startswith(b"FUJIFILM"):  # RAF: the position of a JPEG with EXIF is in the header
        start, size = (int.from_bytes(data[at : at + 4], "big") for at in (84, 88))
        tags = tiff_tags.read_tags(metadata.jpeg_exif(data[start : start + size]))
    else:  # ORF and RW2 have another number than 42 after the byte order
        tags = tiff_tags.read_tags(data[:2] + (b"*\0" if data[:2] == b"II" else b"\0*") + data[4:])
    exif = tags.get(tiff_tags.EXIF_POINTER)
    if isinstance(exif, dict):
        exif.pop(_MAKER_NOTE, None)
    return tiff_tags.tiff_exif(tags)
