"""Converts photos with LUT-based ICC profiles, which scanners and some cameras write, and CMYK photos to Display P3.

colour.py uses profiles with curves and a matrix, and converts in both directions. A photo with another RGB profile is
converted to Display P3 when it is opened, by littleCMS in libvips. Display P3 is the largest colour space whose profile
libvips includes. Colours outside Display P3 are clipped.
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

_MATRIX_TAGS = {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"}
_TABLE_TAGS = {b"A2B0", b"A2B1"}
_VIPS_FORMATS = {"uint8": ("uchar", "rgb", 8), "uint16": ("ushort", "rgb16", 16)}


def has_only_tables(icc: bytes | None) -> bool:
    """Returns whether an ICC profile is an RGB profile with lookup tables, but without curves and a matrix."""
    if icc is None or icc[16:20] != b"RGB ":
        return False
    try:
        tags = icc_tags(icc).keys()
    except struct.error:
        return False
    return bool(tags & _TABLE_TAGS) and not tags >= _MATRIX_TAGS


def convert_to_display_p3(pixels: NDArray[Any], file_info: FileInfo) -> tuple[NDArray[Any], FileInfo]:
    """Returns pixels (H, W, 3) of 8 or 16 bits in Display P3 (relative colorimetric), and `file_info` with its profile.

    Raises:
        UnsupportedPhoto: the profile is damaged, or the pixels are grey or floats.
    """
    channels = pixels.shape[2]
    if channels != 3 or pixels.dtype.name not in _VIPS_FORMATS:
        raise UnsupportedPhoto(
            f"{channels} channels of {pixels.dtype} have a LUT-based colour profile",
            "expected RGB of 8 or 16 bits for such a profile",
            "convert the photo to sRGB or Display P3 first",
        )
    icc = file_info.icc or b""
    try:
        profile_is_ignored = np.array_equal(
            _convert(_PROBE_COLOURS, icc), _convert(_PROBE_COLOURS, pyvips.Image.profile_load("srgb"))
        )
        array = _convert(pixels, icc)
    except pyvips.Error as error:
        raise _damaged_profile(icc) from error
    if profile_is_ignored:
        raise _damaged_profile(icc)
    return array, replace(file_info, icc=bytes(pyvips.Image.profile_load("p3")))


def convert_cmyk(image: pyvips.Image, file_info: FileInfo) -> tuple[pyvips.Image, FileInfo]:
    """Returns a CMYK image in Display P3 (relative colorimetric), and `file_info` with its profile and a note.

    Without a usable CMYK profile, the default profile of libvips is used.
    """
    is_cmyk = file_info.icc is not None and file_info.icc[16:20] == b"CMYK"
    profile = "its profile" if is_cmyk else "a default profile, because it has none"
    depth = 16 if image.format == "ushort" else 8
    converted = image.icc_transform(
        "p3", embedded=is_cmyk, input_profile="cmyk", intent="relative", depth=depth
    )
    note = f"its CMYK colours were converted to RGB (Display P3) with {profile}"
    return converted, replace(file_info, icc=bytes(pyvips.Image.profile_load("p3")), note=note)


_PROBE_LEVELS = np.arange(0, 256, 51).astype(np.uint8)
_PROBE_COLOURS = np.stack(np.meshgrid(_PROBE_LEVELS, _PROBE_LEVELS, _PROBE_LEVELS), axis=-1).reshape(-1, 6, 3)
"""Test colours. If a profile converts them exactly as sRGB does, libvips could not use the profile and used sRGB."""


def _convert(pixels: NDArray[Any], icc: bytes) -> NDArray[Any]:
    height, width, channels = pixels.shape
    band_format, interpretation, depth = _VIPS_FORMATS[pixels.dtype.name]
    contiguous = np.ascontiguousarray(pixels)
    image = pyvips.Image.new_from_memory(contiguous.data, width, height, channels, band_format)
    image = image.copy(interpretation=interpretation)
    image.set_type(pyvips.GValue.blob_type, "icc-profile-data", icc)
    converted = image.icc_transform("p3", embedded=True, intent="relative", depth=depth)
    return np.frombuffer(converted.write_to_memory(), pixels.dtype).reshape(pixels.shape)


def _damaged_profile(icc: bytes) -> UnsupportedPhoto:
    return UnsupportedPhoto(
        f"the LUT-based colour profile ({len(icc)} bytes) cannot be used",
        "expected a complete ICC profile",
        "convert the photo to sRGB or Display P3 first",
    )
