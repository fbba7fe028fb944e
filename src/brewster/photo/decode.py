"""Bytes of a file to stored pixels: what kind it is, whether we take it, its pixels, and what else it says.

Each kind is recognised by its first bytes, never by its name. Everything that can be refused is refused from
the header, before a pixel is decoded.
"""

from __future__ import annotations

import bisect
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.errors import MissingExtra, PhotoError, UnreadablePhoto, UnsupportedPhoto
from brewster.files import DEFAULT_MAX_PIXELS
from brewster.photo import metadata
from brewster.photo.colour import colour_space_of
from brewster.photo.file_info import FileInfo
from brewster.photo.hdr_formats import read_exr, read_hdr, too_large
from brewster.photo.lut_profiles import has_only_tables

pyvips.cache_set_max(0)  # each picture is read once: libvips' cache of operations would only hold memory
logging.getLogger("pyvips").addHandler(logging.NullHandler())  # its warnings come as errors of ours

Stored = NDArray[Any]


@dataclass(frozen=True)
class Decoded:
    """Upright pixels (H, W, 1|3) and alpha (H, W) or None: uint8, uint16 or float32, as stored."""

    pixels: Stored
    alpha: Stored | None
    file_info: FileInfo


def decode(data: bytes, max_pixels: int) -> Decoded:
    """The picture in these bytes. Raises PhotoError's kinds, as Photo.open says."""
    container = _container(data)
    if container in ("exr", "hdr"):
        floats = (read_exr if container == "exr" else read_hdr)(data, max_pixels)
        decoded = Decoded(floats.pixels, floats.alpha, floats.file_info)
    elif container == "heic":
        decoded = _decode_heic(data, max_pixels)
    else:
        decoded = _decode_vips(data, container, max_pixels)
    if decoded.pixels.dtype.kind == "f" and not np.isfinite(decoded.pixels).all():
        count = int((~np.isfinite(decoded.pixels)).any(axis=2).sum())
        raise UnsupportedPhoto(
            f"{count} pixels are infinite or not a number", "light is finite", "repair them in the renderer"
        )
    return decoded


def read_size(data: bytes) -> tuple[int, int]:
    """Width and height of the upright picture in these bytes, as Photo.open(data).size, by the header alone.

    What Photo.open refuses by the header is refused here too; damage further on is not seen. Pictures of
    floats are read whole.
    """
    container = _container(data)
    if container in ("exr", "hdr"):
        height, width = decode(data, DEFAULT_MAX_PIXELS).pixels.shape[:2]
        return width, height
    if container == "heic":
        heif = _open_heic(data, DEFAULT_MAX_PIXELS)
        _check_profile(_heic_profile(heif, data), is_float=False)
        return heif.size[0], heif.size[1]
    image = _open_vips(data, container, DEFAULT_MAX_PIXELS)
    icc = image.get("icc-profile-data") if image.get_typeof("icc-profile-data") else None
    _check_profile(icc or _profile_of(data, container), is_float=image.format == "float")
    sides = int(image.width), int(image.height)
    return sides[::-1] if _orientation(image, container) in _TRANSPOSED else sides


def _check_profile(icc: bytes | None, *, is_float: bool) -> None:
    if is_float or not has_only_tables(icc):
        colour_space_of(icc, None, is_float=is_float)


_SIGNATURES = (
    (rb"\xff\xd8\xff", "jpeg"),
    (rb"\x89PNG\r\n\x1a\n", "png"),
    (rb"II[*+]\0|MM\0[*+]", "tiff"),
    (rb"RIFF....WEBP", "webp"),
    (rb"....ftyp(avif|avis)", "avif"),
    (rb"....ftyp(hei[cxms]|hev[cxms])", "heic"),
    (rb"GIF8[79]a", "gif"),
    (rb"v/1\x01", "exr"),
    (rb"#\?(RADIANCE|RGBE)", "hdr"),
)


def _container(data: bytes) -> str:
    if not data:
        raise UnreadablePhoto("the file is empty", "a picture has at least a header", "copy it again")
    if re.match(rb"....ftypmi[fa]", data, re.DOTALL):  # either kind: the decoder's settings tell
        return "heic" if b"hvcC" in data[: 1 << 16] else "avif"
    for start, container in _SIGNATURES:
        if re.match(start, data, re.DOTALL):
            return container
    raise UnreadablePhoto(
        f"the file starts with {data[:12]!r}, which is no picture brewster knows",
        "JPEG, PNG, TIFF, WebP, AVIF, HEIC, EXR, HDR and single GIF pictures are read",
        "convert it, or check that the file is what its name says",
    )


# --- libvips

_LOADERS: dict[str, Callable[..., Any]] = {
    "jpeg": pyvips.Image.jpegload_buffer,
    "png": pyvips.Image.pngload_buffer,
    "tiff": pyvips.Image.tiffload_buffer,
    "webp": pyvips.Image.webpload_buffer,
    "avif": pyvips.Image.heifload_buffer,
    "gif": pyvips.Image.gifload_buffer,
}
_STRICT = {"tiff": "error"}  # missing strips are no more than errors to libvips
_GREY = ("b-w", "grey16")
_RGB = ("srgb", "rgb", "rgb16", "scrgb")
_TYPES = {"uchar": np.uint8, "ushort": np.uint16, "float": np.float32}


def _decode_vips(data: bytes, container: str, max_pixels: int) -> Decoded:
    image = _open_vips(data, container, max_pixels)
    try:
        file_info = _file_info(image, data, container)
        array = np.frombuffer(image.write_to_memory(), _TYPES[image.format])
    except pyvips.Error as error:
        raise _unreadable(container, error) from error
    array = _full_scale(array.reshape(image.height, image.width, image.bands), file_info.bits)
    return split_alpha(apply_orientation(array, _orientation(image, container)), file_info)


def _open_vips(data: bytes, container: str, max_pixels: int) -> pyvips.Image:
    """The header; pixels come when they are asked for."""
    try:
        image = _LOADERS[container](data, access="sequential", fail_on=_STRICT.get(container, "truncated"))
        _check_supported(image, data, container, max_pixels)
    except pyvips.Error as error:
        raise _unreadable(container, error) from error
    return image


def _orientation(image: pyvips.Image, container: str) -> int:
    """How pixels are still to be turned: libvips has turned the others itself."""
    is_unapplied = container in ("jpeg", "png", "tiff", "webp") and image.get_typeof("orientation")
    return int(image.get("orientation")) if is_unapplied else 1


def _unreadable(container: str, error: Exception | str) -> PhotoError:
    lines = [line.strip() for line in str(error).splitlines()]
    message = " ".join(line for line in lines if line and not line.startswith(("unable to", "source:")))
    return UnreadablePhoto(
        f"the {container} cannot be read whole ({message[:200] or error})",
        "a whole file of a common kind is needed",
        "copy it again from where it came, or convert it",
    )


def _check_supported(image: pyvips.Image, data: bytes, container: str, max_pixels: int) -> None:
    """Everything we do not take, told from the header alone."""
    if image.width * image.height > max_pixels:
        raise too_large(image.width, image.height, max_pixels)
    if _has_frames(image, data, container):
        raise UnsupportedPhoto(
            f"the {container} is an animation or has several pages",
            "brewster takes one picture at a time",
            "extract the frames first, for example with ffmpeg or vips",
        )
    if image.interpretation == "cmyk":
        raise UnsupportedPhoto(
            f"the {container} is CMYK, colours for print",
            "brewster needs RGB or grey",
            "convert it to sRGB first",
        )
    meanings = {1: _GREY, 2: _GREY, 3: _RGB, 4: _RGB}.get(image.bands, ())
    if image.interpretation not in meanings or image.format not in _TYPES:
        raise UnsupportedPhoto(
            f"the {container} has {image.bands} channels of {image.format} ({image.interpretation})",
            "brewster takes grey or RGB, with or without alpha, of 8 or 16 bits or 32-bit floats",
            "convert it to one of these",
        )
    if container == "tiff":
        _check_tiff(metadata.read_tags(data), len(data))


def _check_tiff(tags: metadata.Tags, size: int) -> None:
    if metadata.pixel_data_end(tags) > size:  # libvips reads missing tiles as black
        raise _unreadable("tiff", "pixels are missing")
    if _is_raw(tags):
        raise UnsupportedPhoto(
            "the file is a camera's raw picture", "a developed picture is needed", "develop it first"
        )


def _has_frames(image: pyvips.Image, data: bytes, container: str) -> bool:
    if container == "png":
        return b"acTL" in metadata.png_chunks(data)  # libvips would take the first frame in silence
    if container == "avif":
        return data[8:12] == b"avis"  # an avif may hold thumbnails, which count as pages
    return bool(image.get_typeof("n-pages")) and image.get("n-pages") > 1


def _is_raw(tags: metadata.Tags) -> bool:
    """A DNG by its version tag; others because their first picture is a reduced one (NewSubfileType)."""
    return 50706 in tags or metadata.number_of(tags, 254, 0) & 1 == 1


def _file_info(image: pyvips.Image, data: bytes, container: str) -> FileInfo:
    names = ("icc-profile-data", "exif-data", "xmp-data", "iptc-data")
    icc, exif, xmp, iptc = (image.get(name) if image.get_typeof(name) else None for name in names)
    bits = {"float": 32, "uchar": 8}.get(image.format, 16)
    has_resolution = (image.xres, image.yres) != (1.0, 1.0)
    file_info = FileInfo(
        container="png" if container == "gif" else container,
        bits=image.get("bits-per-sample") if container == "avif" else bits,
        icc=icc or _profile_of(data, container),
        exif=metadata.upright_exif(exif) if exif else None,
        xmp=metadata.upright_xmp(xmp) if xmp else None,
        iptc=iptc,
        resolution=(image.xres, image.yres) if has_resolution else None,
    )
    return replace(file_info, **_EXTRA_INFO[container](data)) if container in _EXTRA_INFO else file_info


def _profile_of(data: bytes, container: str) -> bytes | None:
    """A profile for colours stated by number (ITU-T H.273) instead: sRGB needs none, Display P3 has one."""
    codes = metadata.cicp(data) if container in ("avif", "heic", "png") else None
    primaries, transfer = codes[:2] if codes else (1, 13)
    if transfer in (16, 18) or primaries not in (1, 2, 5, 6, 12):
        raise UnsupportedPhoto(
            f"the {container} has the colours of HDR video (primaries {primaries}, transfer {transfer})",
            "brewster takes sRGB, Display P3, or colours with an ICC profile",
            "export it in one of these",
        )
    return bytes(pyvips.Image.profile_load("p3")) if primaries == 12 else None


def _jpeg_info(data: bytes) -> dict[str, Any]:
    subsampling = metadata.jpeg_subsampling(data)
    return {"subsampling": subsampling, "jpeg_quality": _jpeg_quality(data, bands=3 if subsampling else 1)}


def _jpeg_quality(data: bytes, bands: int) -> int:
    """The least quality at which libvips quantises no coarser than the file, for luma and for chroma."""
    source = metadata.jpeg_quantisation_sums(data)
    square = pyvips.Image.black(8, 8, bands=bands)

    def is_fine(quality: int) -> bool:
        candidate = metadata.jpeg_quantisation_sums(square.jpegsave_buffer(Q=quality))
        return all(sum_ <= source.get(number, source.get(0, 0)) for number, sum_ in candidate.items())

    return min(bisect.bisect_left(range(1, 101), True, key=is_fine) + 1, 100)


_COMPRESSIONS = {
    1: "none",
    5: "lzw",
    7: "jpeg",
    8: "deflate",
    32946: "deflate",
    32773: "packbits",
    50000: "zstd",
}


def _tiff_info(data: bytes) -> dict[str, Any]:
    tags = metadata.read_tags(data)
    compression = _COMPRESSIONS.get(metadata.number_of(tags, 259, 1), "deflate")
    return {"compression": compression, "exif": metadata.tiff_exif(tags)}


def _webp_info(data: bytes) -> dict[str, Any]:
    return {"lossless": b"VP8L" in metadata.webp_chunks(data)}


def _avif_info(data: bytes) -> dict[str, Any]:
    """Only a lossless AVIF stores RGB as it is: matrix 0, the identity."""
    codes = metadata.cicp(data)
    return {"lossless": codes is not None and codes[2] == 0}


_EXTRA_INFO = {"jpeg": _jpeg_info, "tiff": _tiff_info, "webp": _webp_info, "avif": _avif_info}


# --- HEIC

_HEIC_ERRORS = (ValueError, RuntimeError, OSError, SyntaxError, EOFError)


def _open_heic(data: bytes, max_pixels: int) -> Any:  # noqa: ANN401  (pillow-heif has no types)
    """The header; pixels come when they are asked for."""
    try:
        import pillow_heif  # noqa: PLC0415  (an extra, for the patents on HEVC)
    except ImportError as error:
        raise MissingExtra(
            "HEIC needs the pillow-heif package", "it is not installed", "run: pip install 'brewster[heic]'"
        ) from error
    try:
        heif = pillow_heif.open_heif(data, convert_hdr_to_8bit=False)
        if not len(heif):
            raise ValueError("no image in it can be decoded")
        if heif.size[0] * heif.size[1] > max_pixels:
            raise too_large(heif.size[0], heif.size[1], max_pixels)
    except _HEIC_ERRORS as error:
        raise _unreadable("heic", error) from error
    return heif


def _heic_profile(heif: Any, data: bytes) -> bytes | None:  # noqa: ANN401
    return heif.info.get("icc_profile") or _profile_of(data, "heic")


def _decode_heic(data: bytes, max_pixels: int) -> Decoded:
    heif = _open_heic(data, max_pixels)
    try:
        array = np.array(heif)
    except _HEIC_ERRORS as error:
        raise _unreadable("heic", error) from error
    exif, xmp = heif.info.get("exif"), heif.info.get("xmp")
    file_info = FileInfo(
        container="heic",
        bits=heif.info.get("bit_depth", 8),
        icc=_heic_profile(heif, data),
        exif=metadata.upright_exif(exif) if exif else None,
        xmp=metadata.upright_xmp(xmp) if xmp else None,
    )
    return split_alpha(_full_scale(array.reshape(*array.shape[:2], -1), file_info.bits), file_info)


# --- arrays

_TRANSPOSED = (5, 6, 7, 8)


def _full_scale(array: Stored, bits: int) -> Stored:
    """10 and 12 bits, which arrive in the upper part of 16, repeated below, so that white is 65535."""
    return array | array >> bits if bits in (10, 12) else array


def apply_orientation(array: Stored, orientation: int) -> Stored:
    """The array (H, W, C) turned as EXIF orientation 1..8 says (CIPA DC-008, tag 274)."""
    if orientation in _TRANSPOSED:
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return array


def split_alpha(array: Stored, file_info: FileInfo) -> Decoded:
    """Colour and alpha apart, each whole in memory."""
    has_alpha = array.shape[2] in (2, 4)
    colours = array.shape[2] - has_alpha
    alpha = np.ascontiguousarray(array[..., colours]) if has_alpha else None
    return Decoded(np.ascontiguousarray(array[..., :colours]), alpha, file_info)
