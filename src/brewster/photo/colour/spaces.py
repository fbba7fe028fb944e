"""Converts stored pixels to linear Rec.709 light and back.

A `ColourSpace` has a tone curve for each channel, and a matrix from linear RGB to linear Rec.709.
It is read from an ICC matrix profile (ICC.1:2022) or from the chromaticities of an EXR file.
Without a profile and chromaticities, integers are sRGB and floats are linear Rec.709. Colours
outside Rec.709 have values below 0 or above 1, not clipped.

A photo with a LUT-based profile, which scanners and some cameras write, or with CMYK colours is
converted to Display P3 when it is opened, by littleCMS in libvips. Display P3 is the largest colour
space whose profile libvips includes. Colours outside Display P3 are clipped.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.errors import UnsupportedPhoto
from brewster.photo import srgb
from brewster.photo.file_info import FileInfo, with_notes

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Stored = NDArray[Any]
Matrix = tuple[tuple[float, float, float], ...]

REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_D50 = np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


@dataclass(frozen=True)
class ToneCurve:
    """A tone curve from stored values 0..1 to linear light (ICC.1:2022 10.6 and 10.18). If
    `samples` is not empty, the curve interpolates them linearly over 0..1. Otherwise it is
    parametric, with the parameters g, a, b, c, d, e, f: (a x + b)^g + e for x >= d, and c x + f for
    x < d.
    """

    samples: tuple[float, ...] = ()
    parameters: tuple[float, ...] = (1, 1, 0, 0, 0, 0, 0)

    def decode(self, stored: Float64) -> Float64:
        """Converts stored values of any shape to linear light."""
        if self.samples:
            return np.interp(stored, np.linspace(0, 1, len(self.samples)), self.samples)
        g, a, b, c, d, e, f = self.parameters
        return np.where(stored >= d, np.maximum(a * stored + b, 0) ** g + e, c * stored + f)

    def encode(self, linear: Float64) -> Float64:
        """Converts linear light of any shape to stored values; the inverse of `decode`."""
        if self.samples:
            rising = np.maximum.accumulate(np.array(self.samples))
            return np.interp(linear, rising, np.linspace(0, 1, len(self.samples)))
        g, a, b, c, d, e, f = self.parameters
        bright = (np.maximum(linear - e, 0) ** (1 / g) - b) / a
        return np.where(linear >= (a * d + b) ** g + e, bright, (linear - f) / c if c else 0.0)


@dataclass(frozen=True)
class SrgbToneCurve(ToneCurve):
    """The sRGB transfer function, extended above 1 and below 0 (brewster.photo.srgb)."""

    def decode(self, stored: Float64) -> Float64:
        """Converts stored values of any shape to linear light."""
        return srgb.to_linear(stored)

    def encode(self, linear: Float64) -> Float64:
        """Converts linear light of any shape to stored values."""
        return srgb.to_encoded(linear)


@dataclass(frozen=True)
class ColourSpace:
    """A tone curve per channel, followed by an optional matrix to linear Rec.709."""

    curves: tuple[ToneCurve, ToneCurve, ToneCurve]
    matrix: Matrix | None = None

    def to_linear(self, stored: Stored) -> Float32:
        """Converts stored pixels (H, W, 1|3) of uint8, uint16 or float32 to linear Rec.709, (H, W,
        3) float32.
        """
        curves = self._curves(stored)
        if stored.dtype.kind == "u" and self._is_one_curve(curves):
            return _decoded(stored, curves[0])
        channels = [_decoded(stored[..., i], curve) for i, curve in enumerate(curves)]
        if len(channels) == 1:
            return np.repeat(channels[0][..., None], 3, axis=2)
        return np.stack(_apply_matrix(self.matrix, channels) if self.matrix else channels, axis=2)

    def to_stored(self, linear: Float32, original: Stored) -> Stored:
        """Converts linear Rec.709 (H, W, 3) to stored pixels with the dtype and the channels of
        `original`. `original` has the stored pixels before a change. Pixels with unchanged light
        keep exactly these stored values. In integers, NaN becomes black; floats keep NaN.
        """
        curves = self._curves(original)
        stored = (
            _encoded(linear, curves[0], original.dtype)
            if self._is_one_curve(curves)
            else self._channels_to_stored(linear, original, curves)
        )
        is_exact = self == LINEAR_REC709 or (self == SRGB and original.dtype.kind == "u")
        if (
            not is_exact
        ):  # in an exact space, encoding returns the decoded values; a test checks this
            same = np.all(linear == self.to_linear(original), axis=2)
            stored[same] = original[same]
        return stored

    def _channels_to_stored(
        self, linear: Float32, original: Stored, curves: tuple[ToneCurve, ...]
    ) -> Stored:
        stored = np.empty_like(original)
        channels = [linear[..., i] for i in range(3)]
        if len(curves) == 1:
            red, green, blue = channels
            weights = np.array(srgb.REC709_LUMINANCE, np.float32)
            luminance = weights[0] * red + weights[1] * green + weights[2] * blue
            channels = [
                np.where((red == green) & (green == blue), green, luminance)
            ]  # equal ones stay exact
        elif self.matrix:
            channels = _apply_matrix(_inverse(self.matrix), channels)
        for i, curve in enumerate(curves):
            stored[..., i] = _encoded(channels[i], curve, original.dtype)
        return stored

    def _is_one_curve(self, curves: tuple[ToneCurve, ...]) -> bool:
        """Whether three channels have one curve and no matrix: they are converted together, which
        is faster.
        """
        return len(curves) == 3 and self.matrix is None and len({*curves}) == 1

    def _curves(self, stored: Stored) -> tuple[ToneCurve, ...]:
        """Grey uses the green curve; in most profiles all three are the same."""
        return self.curves if stored.shape[-1] == 3 else (self.curves[1],)


SRGB = ColourSpace((SrgbToneCurve(),) * 3)
LINEAR_REC709 = ColourSpace((ToneCurve(),) * 3)


@lru_cache(maxsize=16)
def colour_space_of(
    icc: bytes | None, primaries: tuple[float, ...] | None, is_float: bool
) -> ColourSpace:
    """Returns the colour space of stored pixels from their ICC profile or chromaticities. Without a
    profile and chromaticities, integers are sRGB and floats are linear Rec.709. Raises
    UnsupportedPhoto if the profile is neither a grey profile with a curve nor an RGB profile with
    curves and a matrix.
    """
    if icc is not None:
        return _profile_space(icc)
    if primaries is not None and not np.allclose(primaries, REC709_CHROMATICITIES, atol=1e-4):
        return ColourSpace((ToneCurve(),) * 3, _to_rec709(to_d50(primaries)))
    return LINEAR_REC709 if is_float else SRGB


def _decoded(stored: Stored, curve: ToneCurve) -> Float32:
    if stored.dtype.kind == "f":
        return (
            stored
            if curve == ToneCurve()
            else curve.decode(stored.astype(np.float64)).astype(np.float32)
        )
    return _decode_table(curve, np.iinfo(stored.dtype).max).take(stored)


def _encoded(linear: Float32, curve: ToneCurve, dtype: np.dtype[Any]) -> Stored:
    if dtype.kind == "f":
        return (
            linear
            if curve == ToneCurve()
            else curve.encode(linear.astype(np.float64)).astype(np.float32)
        )
    table = _encode_table(curve, np.iinfo(dtype).max)
    position = np.fmax(linear, np.float32(0))
    np.fmin(position, np.float32(1), out=position)
    np.sqrt(position, out=position)
    position *= np.float32(len(table) - 1)
    position += np.float32(0.5)
    # Of these types, NumPy makes indices in small pieces, twice as fast as an array of them
    return table.take(position.astype(np.uint16 if len(table) <= 2**16 else np.uint32))


@lru_cache(maxsize=16)
def _decode_table(curve: ToneCurve, white: int) -> Float32:
    return curve.decode(np.arange(white + 1) / white).astype(np.float32)


@lru_cache(maxsize=16)
def _encode_table(curve: ToneCurve, white: int) -> NDArray[Any]:
    """Returns a lookup table from the square root of linear light to stored integers. With the
    square root, dark values have more entries, as in tone curves. With 2**16 entries, the rounding
    error is below 0.01 levels of 8 bits; with 2**20 entries, it is below 0.1 levels of 16 bits.
    """
    sqrt_light = np.linspace(0, 1, 2**16 if white < 256 else 2**20)
    levels = np.rint(np.clip(curve.encode(sqrt_light**2), 0, 1) * white)
    return levels.astype(np.uint8 if white < 256 else np.uint16)


def _apply_matrix(matrix: Matrix, channels: list[Float32]) -> list[Float32]:
    """Without BLAS, whose rounding depends on the position of a pixel in the strip."""
    red, green, blue = channels
    rows = np.array(matrix, np.float32)
    return [row[0] * red + row[1] * green + row[2] * blue for row in rows]


def _inverse(matrix: Matrix) -> Matrix:
    return _as_matrix(np.linalg.inv(np.array(matrix)))


def _as_matrix(array: Float64) -> Matrix:
    return tuple((float(row[0]), float(row[1]), float(row[2])) for row in array)


def valid_chromaticities(chromaticities: Sequence[float | str]) -> tuple[float, ...] | None:
    """Returns x and y of red, green, blue and white, or None if they form no triangle: some
    programs write zeros.
    """
    try:
        points = np.array(chromaticities, np.float64).reshape(4, 2)
    except ValueError:
        return None
    red, green, blue, _ = points
    area = np.linalg.det([green - red, blue - red])
    is_gamut = np.isfinite(points).all() and points[:, 1].all() and abs(area) > 1e-6
    return tuple(points.ravel().tolist()) if is_gamut else None


def to_d50(primaries: tuple[float, ...]) -> Float64:
    """The matrix from linear RGB to XYZ, adapted to D50 by the Bradford transform (ICC.1:2022 annex
    E).
    """
    points = zip(primaries[::2], primaries[1::2], strict=True)
    xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in points]).T
    white = xyz[:, 3]
    to_xyz = xyz[:, :3] * np.linalg.solve(xyz[:, :3], white)
    gains = np.diag((_BRADFORD @ _D50) / (_BRADFORD @ white))
    return np.asarray(np.linalg.inv(_BRADFORD) @ gains @ _BRADFORD @ to_xyz)


def _to_rec709(matrix: Float64) -> Matrix:
    return _as_matrix(np.linalg.inv(to_d50(REC709_CHROMATICITIES)) @ matrix)


def _profile_space(icc: bytes) -> ColourSpace:
    try:
        tags = icc_tags(icc)
        if icc[16:20] == b"GRAY":
            return _snap_to_srgb(ColourSpace((_parse_curve(tags[b"kTRC"]),) * 3))
        points = [struct.unpack_from(">3i", tags[name], 8) for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        matrix = np.array(points).T / 65536
        red, green, blue = (_parse_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC"))
        space = _snap_to_srgb(ColourSpace((red, green, blue), _to_rec709(matrix)))
        _inverse(space.matrix or _as_matrix(np.eye(3)))
    except (KeyError, ValueError, struct.error, np.linalg.LinAlgError) as error:
        raise UnsupportedPhoto(
            f"the embedded colour profile ({len(icc)} bytes) does not consist of curves and a "
            "matrix",
            "expected an RGB or grey profile such as sRGB, Display P3, Adobe RGB or ProPhoto",
            "convert the photo to one of these profiles first",
        ) from error
    return space


def _snap_to_srgb(space: ColourSpace) -> ColourSpace:
    """Returns SRGB for a profile that equals sRGB except for rounding errors; otherwise returns
    `space`.
    """
    levels = np.arange(256) / 255
    curve_errors = [
        np.abs(curve.decode(levels) - srgb.to_linear(levels)).max() for curve in space.curves
    ]
    matrix_error = np.abs(np.array(space.matrix) - np.eye(3)).max() if space.matrix else 0.0
    return SRGB if max(curve_errors) < 2e-4 and matrix_error < 1e-3 else space


def icc_tags(icc: bytes) -> dict[bytes, bytes]:
    """Returns the data of each tag of an ICC profile by its signature. Raises struct.error if it is
    truncated.
    """
    (count,) = struct.unpack_from(">I", icc, 128)
    rows = (struct.unpack_from(">4sII", icc, 132 + 12 * i) for i in range(min(count, 100)))
    return {name: icc[start : start + size] for name, start, size in rows}


_PARAMETRIC_NAMES = (
    "g",
    "gab",
    "gabc",
    "gabcd",
    "gabcdef",
)  # parameters of ICC function types 0 to 4


def _parse_curve(tag: bytes) -> ToneCurve:
    """Parses a tag of curveType or parametricCurveType (ICC.1:2022 10.6 and 10.18)."""
    kind, count = struct.unpack_from(">4s4xI", tag)
    if kind == b"para":
        function = count >> 16
        names = _PARAMETRIC_NAMES[function] if function < len(_PARAMETRIC_NAMES) else ""
        values = dict(zip(names, struct.unpack_from(f">{len(names)}i", tag, 12), strict=True))
        g, a, b, c, d, e, f = (
            values.get(name, 65536 * (name == "a")) / 65536 for name in "gabcdef"
        )
        if g <= 0 or a <= 0:
            raise ValueError(names)
        if function in (1, 2):  # types 1 and 2 are constant for x < -b/a
            d = -b / a
            e = f = c
            c = 0.0
        return ToneCurve(parameters=(g, a, b, c, d, e, f))
    if kind != b"curv":
        raise ValueError(kind)
    if count == 0:
        return ToneCurve()
    numbers = struct.unpack_from(f">{count}H", tag, 12)
    if count == 1:
        if numbers[0] == 0:  # the exponent 0 has no inverse
            raise ValueError(numbers)
        return ToneCurve(parameters=(numbers[0] / 256, 1, 0, 0, 0, 0, 0))
    return ToneCurve(samples=tuple(number / 65535 for number in numbers))


_MATRIX_TAGS = {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"}
_TABLE_TAGS = {b"A2B0", b"A2B1"}
_VIPS_FORMATS = {"uint8": ("rgb", 8), "uint16": ("rgb16", 16)}


def has_only_tables(icc: bytes | None) -> bool:
    """Returns whether an ICC profile is an RGB profile with lookup tables, but without curves and a
    matrix.
    """
    if icc is None or icc[16:20] != b"RGB ":
        return False
    try:
        tags = icc_tags(icc).keys()
    except struct.error:
        return False
    return bool(tags & _TABLE_TAGS) and not tags >= _MATRIX_TAGS


def convert_to_display_p3(
    pixels: NDArray[Any], file_info: FileInfo
) -> tuple[NDArray[Any], FileInfo]:
    """Returns pixels (H, W, 3) of 8 or 16 bits in Display P3 (relative colorimetric), and
    `file_info` with its profile. Raises UnsupportedPhoto if the profile is damaged, or the pixels
    are grey or floats.
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
        own, srgb = (
            _convert(_PROBE_COLOURS, used) for used in (icc, pyvips.Image.profile_load("srgb"))
        )
        array = _convert(pixels, icc)
    except pyvips.Error as error:
        raise _damaged_profile(icc) from error
    if np.array_equal(own, srgb):
        raise _damaged_profile(icc)
    return array, replace(file_info, icc=bytes(pyvips.Image.profile_load("p3")))


def convert_cmyk(image: pyvips.Image, file_info: FileInfo) -> tuple[pyvips.Image, FileInfo]:
    """Returns a CMYK image in Display P3 (relative colorimetric), and `file_info` with its profile
    and a note. Without a usable CMYK profile, the default profile of libvips is used.
    """
    is_cmyk = file_info.icc is not None and file_info.icc[16:20] == b"CMYK"
    reason = "its own is not for CMYK" if file_info.icc else "it has none"
    profile = "its profile" if is_cmyk else f"a default profile, because {reason}"
    depth = 16 if image.format == "ushort" else 8
    given = {"embedded": is_cmyk, "input_profile": "cmyk", "intent": "relative", "depth": depth}
    converted = image.icc_transform("p3", **given)
    note = f"its CMYK colours were converted to RGB (Display P3) with {profile}"
    return converted, with_notes(
        replace(file_info, icc=bytes(pyvips.Image.profile_load("p3"))), note
    )


_PROBE_LEVELS = np.arange(0, 256, 51).astype(np.uint8)
_PROBE_COLOURS = np.stack(
    np.meshgrid(_PROBE_LEVELS, _PROBE_LEVELS, _PROBE_LEVELS), axis=-1
).reshape(-1, 6, 3)
"""Test colours. If a profile converts them exactly as sRGB does, libvips could not use the profile
and used sRGB.
"""


def _convert(pixels: NDArray[Any], icc: bytes) -> NDArray[Any]:
    interpretation, depth = _VIPS_FORMATS[pixels.dtype.name]
    image = pyvips.Image.new_from_array(pixels, interpretation=interpretation)
    image.set_type(pyvips.GValue.blob_type, "icc-profile-data", icc)
    converted = image.icc_transform("p3", embedded=True, intent="relative", depth=depth)
    return np.frombuffer(converted.write_to_memory(), pixels.dtype).reshape(pixels.shape)


def _damaged_profile(icc: bytes) -> UnsupportedPhoto:
    return UnsupportedPhoto(
        f"the LUT-based colour profile ({len(icc)} bytes) cannot be used",
        "expected a complete ICC profile",
        "convert the photo to sRGB or Display P3 first",
    )
