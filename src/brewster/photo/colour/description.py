"""The colour space of a file: an ICC profile, code points (ITU-T H.273), PNG gAMA and cHRM, TIFF
chromaticities.

Descriptions that are no ICC profile are converted to one, so that layers of all formats keep them.
"""

import struct
from collections.abc import Sequence

import numpy as np
import pyvips

from brewster.errors import UnsupportedPhoto
from brewster.photo import metadata
from brewster.photo.blocks.tiff_tags import Tags, numbers, rationals
from brewster.photo.colour.spaces import REC709_CHROMATICITIES, to_d50, valid_chromaticities

_SRGB_TRANSFERS = (
    1,
    2,
    6,
    13,
    14,
    15,
)  # BT.709, unspecified, BT.601, sRGB, BT.2020 of 10 and 12 bits
_SRGB_GAMMA = 45455
_GAMMA_TOLERANCE = 500  # PNG 11.3.2.2: gAMA of an sRGB image
_TIFF_GAMMA = 2.2  # the default transfer function (TIFF 6.0, section 20)
_SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
_MAX_CURVE_SAMPLES = 4096


def profile_of(
    data: bytes, format_name: str, icc: bytes | None, *, is_grey: bool, tags: Tags
) -> bytes | None:
    """Returns the ICC profile for the pixels of a file, or None for sRGB. `icc` is the embedded
    profile, and `tags` are those of a TIFF. Raises UnsupportedPhoto for a description that is not
    supported.
    """
    codes = metadata.cicp(data)
    if (
        format_name == "png"
    ):  # the order of PNG, third edition, 4.3: cICP, iCCP, sRGB, gAMA and cHRM
        chunks = dict(metadata.png_chunks(data))
        if codes:
            return _code_point_profile("png", *codes)
        return icc or (None if b"sRGB" in chunks else _png_profile(chunks, is_grey=is_grey))
    if icc or not codes:
        return icc or _tiff_profile(tags, is_grey=is_grey)
    # the decoder applies the others
    return _code_point_profile(format_name, codes[0], codes[1], 0, is_full=True)


def _code_point_profile(
    format_name: str, primaries: int, transfer: int, matrix: int, is_full: bool
) -> bytes | None:
    """Returns Display P3 if the primaries are those of Display P3; otherwise None, which means
    sRGB. Raises UnsupportedPhoto if the file has other primaries, a transfer function unlike that
    of sRGB (for example linear (8), or PQ (16) or HLG (18) of HDR video), values that are not RGB,
    or only a narrow range of them.
    """
    if (
        transfer not in _SRGB_TRANSFERS
        or primaries not in (1, 2, 5, 6, 12)
        or matrix
        or not is_full
    ):
        values = f"with the matrix {matrix} and the {'full' if is_full else 'narrow'} range"
        found = (
            f"the primaries {primaries} and the transfer function {transfer} of ITU-T H.273 (cICP)"
        )
        raise UnsupportedPhoto(
            f"the {format_name} has {found}, {values}",
            "expected those of sRGB or Display P3 in the full range, or an ICC profile",
            "export the image with one of these",
        )
    return bytes(pyvips.Image.profile_load("p3")) if primaries == 12 else None


def _png_profile(chunks: dict[bytes, bytes], *, is_grey: bool) -> bytes | None:
    gamma = int.from_bytes(chunks.get(b"gAMA", b""), "big")
    has_srgb_curve = gamma == 0 or abs(gamma - _SRGB_GAMMA) <= _GAMMA_TOLERANCE
    if not has_srgb_curve and not 0.1 <= 100_000 / gamma <= 10:
        raise UnsupportedPhoto(
            f"the png has the chunk gAMA with the value {gamma}",
            "expected a value from 10000 to 1000000",
            "convert the image to sRGB",
        )
    chromaticities = chunks.get(b"cHRM", b"")
    values = struct.unpack(">8I", chromaticities) if len(chromaticities) == 32 else ()
    points = [value / 100_000 for value in values]
    primaries = _other_primaries([*points[2:], *points[:2]])
    if has_srgb_curve and (primaries is None or is_grey):
        return None
    curve = _parametric(*_SRGB_CURVE) if has_srgb_curve else _parametric(100_000 / gamma)
    return build_profile(primaries, [curve], is_grey=is_grey)


def _tiff_profile(tags: Tags, *, is_grey: bool) -> bytes | None:
    white = rationals(tags, 318) or [*REC709_CHROMATICITIES[6:]]
    primaries = _other_primaries([*rationals(tags, 319), *white])
    table = numbers(tags, 301)
    if not table and (primaries is None or is_grey):
        return None
    level_count = 1 << next(iter(numbers(tags, 258)), 8)
    if table and (len(table) % level_count or len(table) // level_count not in (1, 3)):
        raise UnsupportedPhoto(
            f"the tiff has a TransferFunction of {len(table)} values",
            f"expected {level_count}, or three times as many",
            "convert the image to sRGB",
        )
    curves = [
        _sampled(table[start : start + level_count]) for start in range(0, len(table), level_count)
    ]
    return build_profile(primaries, curves or [_parametric(_TIFF_GAMMA)], is_grey=is_grey)


def _other_primaries(chromaticities: Sequence[float]) -> tuple[float, ...] | None:
    """Returns None for those of sRGB, and for invalid ones."""
    primaries = valid_chromaticities(chromaticities)
    is_srgb = primaries is None or np.allclose(primaries, REC709_CHROMATICITIES, atol=2e-3)
    return None if is_srgb else primaries


# --- ICC profiles (ICC.1:2022)


def build_profile(
    primaries: tuple[float, ...] | None, curves: Sequence[bytes], *, is_grey: bool
) -> bytes:
    """Returns an ICC profile with these chromaticities (by default those of sRGB), and one curve,
    or three.
    """
    columns = to_d50(primaries or REC709_CHROMATICITIES).T
    text = "RGB built by brewster".encode("utf-16-be")
    name = b"mluc" + struct.pack(">4xII4sII", 1, 12, b"enUS", len(text), 28) + text
    tags = {b"desc": name, b"cprt": name, b"wtpt": _xyz((0.9642, 1.0, 0.8249))}
    if is_grey:
        tags[b"kTRC"] = curves[0]
    else:
        tags |= {
            b"%cXYZ" % letter: _xyz(column) for letter, column in zip(b"rgb", columns, strict=True)
        }
        tags |= {b"%cTRC" % letter: curves[i % len(curves)] for i, letter in enumerate(b"rgb")}
    position = 132 + 12 * len(tags)
    rows = b""
    content = b""
    for tag, value in tags.items():
        rows += struct.pack(">4sII", tag, position + len(content), len(value))
        content += value + bytes(-len(value) % 4)
    kind = b"GRAY" if is_grey else b"RGB "
    head = struct.pack(
        ">I4xI4s4s4s12x4s28x", position + len(content), 0x04400000, b"mntr", kind, b"XYZ ", b"acsp"
    )
    illuminant = _xyz((0.9642, 1.0, 0.8249))[8:]
    return (head + illuminant).ljust(128, b"\0") + struct.pack(">I", len(tags)) + rows + content


def _fixed(values: Sequence[float]) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))


def _xyz(values: Sequence[float]) -> bytes:
    return b"XYZ \0\0\0\0" + _fixed(values)


def _parametric(*parameters: float) -> bytes:
    """A curve of function type 0 (one parameter) or 3 (five parameters)."""
    return b"para" + struct.pack(">4xHH", 0 if len(parameters) == 1 else 3, 0) + _fixed(parameters)


def _sampled(table: Sequence[int]) -> bytes:
    at = np.linspace(0, len(table) - 1, min(len(table), _MAX_CURVE_SAMPLES))
    values = np.interp(at, np.arange(len(table)), table)
    return b"curv" + struct.pack(f">4xI{len(at)}H", len(at), *np.rint(values).astype(int).tolist())
