"""Photos whose ICC profile holds tables instead of curves and a matrix, as scanners and some cameras write them.

`colour` understands curves and a matrix, both ways and for any strip of a photo. Other RGB profiles are converted once, by
littleCMS inside libvips, to Display P3, the widest space whose profile libvips brings. Colours beyond it are clipped.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.errors import UnsupportedPhoto
from brewster.photo.colour import icc_tags
from brewster.photo.file_info import FileInfo

_MATRIX = {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"}
_TABLES = {b"A2B0", b"A2B1"}
_DEPTHS = {"uint8": ("uchar", "rgb", 8), "uint16": ("ushort", "rgb16", 16)}


def has_only_tables(icc: bytes | None) -> bool:
    """Whether it is an RGB profile that has tables, and no curves and matrix beside them."""
    if icc is None or icc[16:20] != b"RGB ":
        return False
    try:
        tags = icc_tags(icc).keys()
    except struct.error:
        return False
    return bool(tags & _TABLES) and not tags >= _MATRIX


def convert_to_display_p3(pixels: NDArray[Any], file_info: FileInfo) -> tuple[NDArray[Any], FileInfo]:
    """Pixels (H, W, 3) of 8 or 16 bits, converted from a profile of tables (relative colorimetric), and their new file_info.

    Raises:
        UnsupportedPhoto: the tables are damaged, or the pixels are grey or floats.
    """
    bands = pixels.shape[2]
    if bands != 3 or pixels.dtype.name not in _DEPTHS:
        raise UnsupportedPhoto(
            f"{bands} channels of {pixels.dtype} have a colour profile of tables",
            "tables are read for RGB of 8 or 16 bits",
            "convert the picture to sRGB or Display P3 first",
        )
    icc = file_info.icc or b""
    try:
        is_ignored = np.array_equal(
            _convert(_PROBE, icc), _convert(_PROBE, pyvips.Image.profile_load("srgb"))
        )
        array = _convert(pixels, icc)
    except pyvips.Error as error:
        raise _damaged_profile(icc, str(error).strip()) from error
    if is_ignored:
        raise _damaged_profile(icc, "libvips takes sRGB instead")
    return array, replace(file_info, icc=bytes(pyvips.Image.profile_load("p3")))


_LEVELS = np.arange(0, 256, 51).astype(np.uint8)
_PROBE = np.stack(np.meshgrid(_LEVELS, _LEVELS, _LEVELS), axis=-1).reshape(-1, 6, 3)
"""Colours by which an ignored profile is noticed: libvips takes sRGB in silence for one that it cannot use."""


def _convert(pixels: NDArray[Any], icc: bytes) -> NDArray[Any]:
    height, width, bands = pixels.shape
    kind, meaning, depth = _DEPTHS[pixels.dtype.name]
    contiguous = np.ascontiguousarray(pixels)
    image = pyvips.Image.new_from_memory(contiguous.data, width, height, bands, kind)
    image = image.copy(interpretation=meaning)
    image.set_type(pyvips.GValue.blob_type, "icc-profile-data", icc)
    converted = image.icc_transform("p3", embedded=True, intent="relative", depth=depth)
    return np.frombuffer(converted.write_to_memory(), pixels.dtype).reshape(pixels.shape)


def _damaged_profile(icc: bytes, reason: str) -> UnsupportedPhoto:
    return UnsupportedPhoto(
        f"the colour profile of tables ({len(icc)} bytes) cannot be used ({reason})",
        "a whole ICC profile is needed",
        "convert the picture to sRGB or Display P3 first",
    )
