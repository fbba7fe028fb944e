"""`Photo`: stored pixels with their colour space and the metadata of their file."""

from __future__ import annotations

import hashlib
import io
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from brewster.base.files import DEFAULT_MAX_PIXELS, write_atomically
from brewster.base.image_formats import FORMATS, canonical_format, format_of, format_of_content
from brewster.base.remote_path import Location, location, read_image
from brewster.errors import PhotoError, UnreadablePhoto, UnsupportedPhoto
from brewster.photo.colour.spaces import (
    SRGB,
    ColourSpace,
    colour_space_of,
    convert_to_display_p3,
    has_only_tables,
)
from brewster.photo.decode import decode
from brewster.photo.encode import encode
from brewster.photo.file_info import (
    WHITE_LEVELS,
    Decoded,
    FileInfo,
    check_pixel_count,
    depth_for,
    format_name_of,
    sampled_digest,
    with_notes,
)
from brewster.photo.formats.raw import with_raw_suffix
from brewster.photo.in_memory import (
    BinaryFile,
    Encoding,
    PilImage,
    WritableFile,
    decode_array,
    decode_pil,
    pil_image,
)

Float32 = NDArray[np.float32]
Stored = NDArray[Any]
Source: TypeAlias = (
    "str | os.PathLike[str] | bytes | bytearray | memoryview | BinaryFile | "
    "Stored | PilImage | Photo"
)
"""A path, the URL of an object store, the bytes of a file, a binary file, a numpy array, a PIL
image or a `Photo`.
"""
_PREVIEW_PX = 1024

_STRIP_PIXELS = 1 << 18  # a strip of floats needs a few MB; a whole photo may not fit into memory
_BAND_PIXELS = 1 << 20  # of rows whose columns are reduced together


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo: stored pixels, alpha and file metadata, with the EXIF orientation applied. Immutable
    and thread-safe.

    The ICC profile in `file_info` defines the encoding of the pixels. Without a profile, integers
    are sRGB and floats are linear Rec.709 light.
    """

    pixels: Stored = field(repr=False)
    """The stored values, (H, W, 1|3): uint8, uint16 or float32."""
    alpha: Stored | None = field(default=None, repr=False)
    """The alpha channel, (H, W) with the dtype of the pixels, not premultiplied; or None."""
    file_info: FileInfo = field(default_factory=FileInfo, repr=False)
    """The metadata of the file."""

    def __post_init__(self) -> None:
        """Makes the arrays read-only, so that several photos can use the same arrays."""
        pixels = self.pixels
        alpha = self.alpha
        is_image = pixels.ndim == 3 and pixels.shape[2] in (1, 3) and pixels.size > 0
        alpha_fits = alpha is None or (
            alpha.shape == pixels.shape[:2] and alpha.dtype == pixels.dtype
        )
        if not (is_image and alpha_fits and pixels.dtype.name in ("uint8", "uint16", "float32")):
            raise UnsupportedPhoto(
                f"pixels are {pixels.shape} of {pixels.dtype}, and alpha is "
                f"{None if alpha is None else alpha.shape}",
                "expected (H, W, 1|3) pixels of uint8, uint16 or float32, and alpha (H, W) of "
                "the same dtype or None",
                "use Photo.from_array",
            )
        pixels.flags.writeable = False
        if alpha is not None:
            alpha.flags.writeable = False

    @classmethod
    def open(
        cls,
        source: Source,
        *,
        encoding: Encoding | None = None,
        max_pixels: int = DEFAULT_MAX_PIXELS,
    ) -> Photo:
        """Opens a photo.

        Args:
            source: a path, the URL of an object store such as s3://bucket/a.jpg, the bytes of a
                file, a file opened for reading in binary mode, a numpy array, a PIL image, or a
                `Photo`.
            encoding: the encoding of an array, "srgb" or "linear" (see `from_array`); None for all
                other sources.
            max_pixels: photos with more pixels are refused before they are decoded.

        Raises:
            UnreadablePhoto: the file is missing, empty, truncated, or not an image.
            UnsupportedPhoto: the image has several frames, five channels, NaN values, or a damaged
                profile; or the file is a video, by its suffix or by its content.
            PhotoTooLarge: the image has more pixels than `max_pixels`.
            MissingExtra: the reader of EXR, HEIC or RAW is not installed.
            PhotoError: the encoding of an array is unknown, or missing for floats; or another
                source has one.
            BrewsterError: the URL cannot be read, for example because it is a web address; see
                `location`.
            TypeError: the source has an unsupported type, such as None, a list or a file in text
                mode.
        """
        if isinstance(source, np.ndarray):
            height, width = (*source.shape, 1, 1)[:2]
            check_pixel_count(width, height, max_pixels)
            return cls.from_array(source, encoding=encoding)
        if encoding is not None:
            raise PhotoError(
                f"encoding={encoding!r} was passed with a {type(source).__name__}",
                "expected no encoding, because only arrays need an encoding",
                "leave the argument out",
            )
        if isinstance(source, Photo):
            return source
        if isinstance(source, PilImage):
            check_pixel_count(source.width, source.height, max_pixels)
            return cls.from_pil(source)
        data = _read_source(source)
        try:
            decoded = decode(data, max_pixels)
        except UnreadablePhoto as error:
            path = Path(os.fspath(source)) if isinstance(source, str | os.PathLike) else Path()
            if format_of(path) == FORMATS["raw"]:
                raise with_raw_suffix(error, path.suffix) from error
            raise
        digest = sampled_digest(io.BytesIO(data))
        sha256 = hashlib.sha256(data).hexdigest()
        file_info = replace(decoded.file_info, digest=digest, sha256=sha256)
        if isinstance(source, str | os.PathLike):
            file_info = with_notes(file_info, *misleading_suffix(location(source), data))
        return cls._from_decoded(replace(decoded, file_info=file_info))

    @classmethod
    def _from_decoded(cls, decoded: Decoded) -> Photo:
        pixels = decoded.pixels
        file_info = decoded.file_info
        if has_only_tables(file_info.icc):
            pixels, file_info = convert_to_display_p3(pixels, file_info)
        photo = cls(pixels, decoded.alpha, file_info)
        # Raises the error of an invalid profile now instead of during a separation
        photo.colour_space()
        return photo

    @classmethod
    def from_array(cls, array: Stored, *, encoding: Encoding | None = None) -> Photo:
        """Creates a photo from an array (H, W) or (H, W, 1|3|4) of uint8, uint16 or floats; for
        floats, 1.0 is white.

        Integers are sRGB-encoded by default, as in most files; floats need an `encoding`.
        sRGB-encoded integers are stored unchanged. All other values are stored as linear float32.

        Args:
            array: (H, W) or (H, W, 1|3|4); the fourth channel is alpha, not premultiplied.
            encoding: "srgb" or "linear"; None is "srgb" for integers, and an error for floats.

        Raises:
            UnsupportedPhoto: the array has another shape or dtype, no pixel, values that are not
                finite, sRGB-encoded floats or an alpha channel outside 0..1.
            PhotoError: the encoding is neither "srgb" nor "linear".
        """
        decoded = decode_array(array, encoding)
        return cls(decoded.pixels, decoded.alpha, decoded.file_info)

    @classmethod
    def from_pil(cls, image: PilImage) -> Photo:
        """Creates a photo from a PIL image with its profile and EXIF. Palettes become RGB,
        transparent colours alpha.

        Args:
            image: an image with one frame: grey, RGB or a palette, with or without alpha.

        Raises:
            UnsupportedPhoto: the image has several frames, or another mode than RGB or grey, such
                as CMYK.
        """
        return cls._from_decoded(decode_pil(image))

    def __repr__(self) -> str:
        """Returns a short description: `Photo(4000 x 3000, RGB, uint8, jpeg, ICC profile,
        EXIF)`.
        """
        width, height = self.size
        mode = "grey" if self.pixels.shape[2] == 1 else "RGB"
        info = self.file_info
        mode += "" if self.alpha is None else " with alpha"
        present = {"ICC profile": info.icc, "EXIF": info.exif, "XMP": info.xmp}
        parts = (f"{width} x {height}", mode, self.pixels.dtype.name, info.format_name)
        return f"Photo({', '.join((*parts, *(name for name, block in present.items() if block)))})"

    def __array__(self, dtype: np.dtype[Any] | None = None, copy: bool | None = None) -> Stored:
        """Returns the stored pixels (H, W, 1|3) for `np.asarray(photo)`, without alpha, in the
        encoding of the file.

        For linear light, use `linear()`. For sRGB values, use `srgb_8bit()`.
        """
        return np.array(self.pixels, dtype=dtype, copy=copy)

    def to_pil(self) -> Any:  # noqa: ANN401  (Pillow is optional, so its types cannot be named)
        """Returns a PIL image with the ICC profile and the EXIF of the photo: L, LA, RGB, RGBA,
        I;16 (16-bit grey).

        Other 16-bit photos and floats are converted to 8 bits, because Pillow has no such colour
        images. Raises MissingExtra if Pillow is not installed.
        """
        has_16_bit_mode = (
            self.pixels.dtype == np.uint16 and self.pixels.shape[2] == 1 and self.alpha is None
        )
        stored = self if has_16_bit_mode else self.stored_as("png", 8)
        return pil_image(stored.pixels, stored.alpha, stored.file_info)

    def _repr_png_(self) -> bytes:
        """Returns a PNG for notebooks: 8-bit sRGB, at most 1024 pixels on each side."""
        return self.thumbnail(_PREVIEW_PX).encode("png", depth=8)

    def thumbnail(self, max_side: int) -> Photo:
        """Returns a copy with at most `max_side` pixels on each side, without metadata, clipped to
        the sRGB gamut.

        Args:
            max_side: the limit of width and height, in pixels. Smaller photos keep their size.
        """
        scale = min(1, max_side / max(self.size))
        linear = self.resized(*(max(1, round(scale * side)) for side in self.size))
        return Photo.from_array(np.clip(linear, 0, 1), encoding="linear")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def colour_space(self) -> ColourSpace:
        """Returns the colour space of the stored pixels."""
        return colour_space_of(
            self.file_info.icc, self.file_info.primaries, self.pixels.dtype.kind == "f"
        )

    def linear(self) -> Float32:
        """Returns linear Rec.709 light, (H, W, 3) float32. Colours outside Rec.709 have values
        below 0 or above 1.
        """
        linear = np.empty((*self.pixels.shape[:2], 3), np.float32)
        for rows in self.strips():
            linear[rows] = self.linear_rows(rows.start, rows.stop)
        return linear

    def linear_rows(self, top: int, bottom: int) -> Float32:
        """Returns the rows `top` to `bottom` (exclusive) of `linear()`.

        Args:
            top: the first row, counted from 0.
            bottom: the row after the last one.
        """
        return self.colour_space().to_linear(self.pixels[top:bottom])

    def stored_rows(self, linear: Float32, top: int) -> Stored:
        """Converts new linear light (n, W, 3) for n rows to stored pixels in the colour space and
        dtype of this photo.

        This is the inverse of `linear_rows`: pixels with unchanged light keep their stored values
        exactly. Other pixels are clipped to the range of the dtype. To process a photo in strips,
        write the strips to an array with the shape and dtype of `pixels`, and call `with_pixels`.

        Args:
            linear: linear Rec.709 light (n, W, 3).
            top: the first of these rows, counted from 0.
        """
        original = self.pixels[top : top + len(linear)]
        return self.colour_space().to_stored(np.asarray(linear, np.float32), original)

    def srgb_8bit(self) -> NDArray[np.uint8]:
        """Returns 8-bit sRGB values (H, W, 3), clipped to the sRGB gamut, without alpha: those that
        benchmarks compare.

        For an 8-bit sRGB photo, these are the stored values. Grey values are repeated in all three
        channels.
        """
        dtype = np.dtype(np.uint8)
        if self.colour_space() == SRGB and self.pixels.dtype.kind == "u":
            pixels = _rescaled(self.pixels, dtype) if self.pixels.dtype != dtype else self.pixels
            return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels
        encoded = np.empty((*self.pixels.shape[:2], 3), dtype)
        for rows in self.strips():
            encoded[rows] = SRGB.to_stored(self.linear_rows(rows.start, rows.stop), encoded[rows])
        return encoded

    def with_linear(self, linear: Float32) -> Photo:
        """Returns a copy of the photo with other linear light (H, W, 3).

        Pixels with unchanged light keep their stored values exactly.

        Args:
            linear: linear Rec.709 light of the size of the photo.
        """
        pixels = np.empty_like(self.pixels)
        for rows in self.strips():
            pixels[rows] = self.stored_rows(linear[rows], rows.start)
        return self.with_pixels(pixels)

    def with_pixels(self, pixels: Stored) -> Photo:
        """Returns a copy of the photo with other stored pixels of the same shape and dtype. The
        array becomes read-only.

        Args:
            pixels: values in the colour space of the photo, (H, W, 1|3), as in `Photo.pixels`.

        Raises:
            PhotoError: the shape or the dtype is another one.
        """
        if pixels.shape != self.pixels.shape or pixels.dtype != self.pixels.dtype:
            raise PhotoError(
                f"the new pixels have the shape {pixels.shape} and the dtype {pixels.dtype}",
                f"expected {self.pixels.shape} and {self.pixels.dtype}, as in the photo",
                "use with_linear to convert the pixels",
            )
        return replace(self, pixels=pixels)

    def strips(self) -> Iterator[slice]:
        """Returns slices of rows that cover the photo from top to bottom. Each has about 2**18
        pixels.
        """
        height, width = self.pixels.shape[:2]
        step = max(1, _STRIP_PIXELS // width)
        return (slice(top, min(top + step, height)) for top in range(0, height, step))

    def resized(self, width: int, height: int) -> Float32:
        """Returns the photo resized by area averaging: linear light, (height, width, 3) float32.

        Args:
            width: the new width in pixels, at least 1.
            height: the new height in pixels, at least 1.
        """
        if self.size == (width, height):
            return self.linear()
        out = np.empty((height, width, 3), np.float32)
        columns = np.linspace(0, self.size[0], width + 1)
        count = max(1, _BAND_PIXELS // self.size[0])
        for first in range(0, height, count):
            last = min(first + count, height)
            rows = self._means_of_rows(np.linspace(0, self.size[1], height + 1)[first : last + 1])
            out[first:last] = area_means(rows.swapaxes(0, 1), columns).swapaxes(0, 1)
        return out

    def _means_of_rows(self, edges: NDArray[np.float64]) -> Float32:
        """Returns the means of the rows between edges (m + 1,): (m, W, 3) linear light."""
        means = np.empty((len(edges) - 1, self.size[0], 3), np.float32)
        height = (edges[-1] - edges[0]) / len(means)
        count = max(1, int(_STRIP_PIXELS / (self.size[0] * height)))
        for first in range(0, len(means), count):
            strip = edges[first : first + count + 1]
            top = math.floor(strip[0])
            linear = self.linear_rows(top, math.ceil(strip[-1]))
            means[first : first + count] = area_means(linear, strip - top)
        return means

    def encode(
        self,
        format_name: str | None = None,
        *,
        depth: int | None = None,
        quality: int | None = None,
    ) -> bytes:
        """Returns the bytes of a file.

        Args:
            format_name: a key of `image_formats.FORMATS` or one of its suffixes, such as "jpeg" or
                "jpg"; by default, the format of the photo's file.
            depth: bits per channel (see `image_formats.FORMATS`); by default, the depth of the
                photo or, if the format does not have it, the next smaller depth.
            quality: 1..100, for JPEG, WebP, AVIF and HEIC. By default, a JPEG has the quality of
                the source and the other formats have 95 (WebP) or 90. The chroma subsampling of a
                JPEG is that of the source.

        Raises:
            UnsupportedPhoto: the format cannot store this photo, cannot store it at this bit depth,
                or has no quality.
            MissingExtra: the writer of EXR or HEIC is not installed.
        """
        format_name = canonical_format(format_name) if format_name else self.file_info.format_name
        bits = depth_for(self.file_info, format_name, depth)
        stored = self.stored_as(format_name, bits)
        file_info = replace(stored.file_info, format_name=format_name, bits=bits)
        return encode(stored.pixels, stored.alpha, file_info, quality)

    def save(
        self,
        target: str | os.PathLike[str] | WritableFile,
        *,
        format: str | None = None,  # noqa: A002  (as in Pillow)
        depth: int | None = None,
        quality: int | None = None,
        overwrite: bool = False,
    ) -> None:
        """Writes the photo to a path or an object store atomically, or to an open binary file such
        as an `io.BytesIO`.

        Args:
            target: a path, the URL of an object store, or a file opened for writing in binary mode.
            format: the format, such as "png" or "jpg"; by default, the format of the path's suffix
                or, for an open file, the format of the photo's file.
            depth: bits per channel; see `encode`.
            quality: 1..100, for lossy formats; see `encode`.
            overwrite: whether to replace an existing file.

        Raises:
            OutputError: the file exists and `overwrite` is False, or the file cannot be written.
            UnsupportedPhoto: the format cannot store this photo, or at this bit depth, or has no
                quality.
        """
        if isinstance(target, WritableFile):
            target.write(self.encode(format, depth=depth, quality=quality))
            return
        path = location(target)
        data = self.encode(format or format_name_of(path), depth=depth, quality=quality)
        write_atomically(path, data, overwrite=overwrite)

    def stored_as(self, format_name: str, bits: int) -> Photo:
        """Returns the photo with the dtype for a format and depth. The light changes only by
        rounding and clipping.

        Args:
            format_name: a key of `brewster.base.image_formats.FORMATS`, such as "png".
            bits: the bits of each channel: 8, 16 or 32 (floats).
        """
        was_linear, is_linear = (
            FORMATS[n].is_linear for n in (self.file_info.format_name, format_name)
        )
        dtype = np.dtype(
            np.float32 if is_linear or bits == 32 else np.uint8 if bits == 8 else np.uint16
        )
        changes_light = format_name != self.file_info.format_name and (was_linear or is_linear)
        if dtype == self.pixels.dtype and not changes_light:
            return self
        alpha = None if self.alpha is None else _rescaled(self.alpha, dtype)
        has_profile = self.file_info.icc is not None and not is_linear
        if has_profile or (dtype.kind == "u" and self.pixels.dtype.kind == "u"):
            return Photo(_rescaled(self.pixels, dtype), alpha, self.file_info)
        pixels = np.empty(self.pixels.shape, dtype)
        space = colour_space_of(None, None, dtype.kind == "f")
        for rows in self.strips():
            pixels[rows] = space.to_stored(self.linear_rows(rows.start, rows.stop), pixels[rows])
        return Photo(pixels, alpha, replace(self.file_info, icc=None, primaries=None, header=None))


def area_means(values: Float32, edges: NDArray[np.float64]) -> Float32:
    """Returns the means of values (n, ...) between edges (m + 1,), of which 0 is the start of the
    first value: (m, ...).
    """
    whole = np.minimum(edges.astype(int), len(values) - 1)
    parts = (edges - whole).astype(np.float32)
    factors = (1 / np.diff(edges)).astype(np.float32)
    rows = values.reshape(len(values), -1)
    means = np.empty((len(factors), rows.shape[1]), np.float32)
    # A loop: reduceat adds value by value along strides, which takes several times as long
    before = parts[0] * rows[whole[0]]
    for k, (start, end) in enumerate(pairwise(whole)):
        after = parts[k + 1] * rows[end]
        np.add.reduce(rows[start:end], axis=0, out=means[k])
        means[k] += after
        means[k] -= before
        means[k] *= factors[k]
        before = after
    return means.reshape(-1, *values.shape[1:])


def _rescaled(values: Stored, dtype: np.dtype[Any]) -> Stored:
    """Converts values to another dtype, scaled so that white stays white. The encoding is
    unchanged.
    """
    white = WHITE_LEVELS[values.dtype.name]
    new_white = WHITE_LEVELS[dtype.name]
    if dtype.kind == "f":
        return values.astype(dtype) / np.float32(white)
    if values.dtype.kind == "f":
        return np.rint(values.clip(0, 1) * np.float32(new_white)).astype(dtype)
    return ((values.astype(np.uint32) * new_white + white // 2) // white).astype(dtype)


def misleading_suffix(path: Location, data: bytes) -> Iterator[str]:
    """Yields a note if the suffix of a file is that of another format than its content."""
    named = format_of(path)
    content = format_of_content(data)
    pair = {row.name for row in (named, content) if row}
    if len(pair) == 2 and pair not in ({"raw", "tiff"}, {"heic", "avif"}) and named and content:
        yield (
            f"its content is {content.name.upper()}, not {named.name.upper()} as its suffix "
            f"{path.suffix} says"
        )


def _read_source(source: object) -> bytes:
    if isinstance(source, bytes | bytearray | memoryview):
        return bytes(source)
    if isinstance(source, str | os.PathLike):
        return read_image(location(source))
    data = source.read() if isinstance(source, BinaryFile) else None
    if isinstance(data, bytes):
        return data
    mode = " in text mode" if isinstance(data, str) else ""
    is_tensor = hasattr(source, "permute")
    advice = (
        "a tensor (C, H, W) as tensor.permute(1, 2, 0).cpu().numpy()"
        if is_tensor
        else "one of these"
    )
    raise TypeError(
        f"the source of a photo is of type {type(source).__name__}{mode}; expected a path, the "
        "bytes of a file, an open binary file, a numpy array, a PIL image or a Photo; pass "
        f"{advice}"
    )
