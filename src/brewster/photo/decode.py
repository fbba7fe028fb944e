"""Decodes the bytes of an image file to stored pixels and file metadata.

The first bytes determine the format; the file name is not used. The header is checked before any
pixel is decoded.
"""

import bisect
import io
import logging
import re
import zipfile
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.base.files import DEFAULT_MAX_PIXELS
from brewster.base.image_formats import FORMATS, ImageFormat, format_of_content, is_video_content
from brewster.errors import (
    PhotoError,
    UnreadablePhoto,
    UnsupportedPhoto,
    counted,
    empty_file_error,
    video_error,
)
from brewster.photo import metadata
from brewster.photo.blocks import tiff_tags, xmp
from brewster.photo.colour.description import profile_of
from brewster.photo.colour.spaces import colour_space_of, convert_cmyk, has_only_tables
from brewster.photo.file_info import Decoded, FileInfo, check_pixel_count, library_of, with_notes
from brewster.photo.formats import jpeg_scan, tiff_pixels
from brewster.photo.formats.hdr import read_exr, read_hdr
from brewster.photo.formats.raw import read_raw, read_raw_size
from brewster.photo.phone_films.live_photo_archive import ZIP_ERRORS, still_bytes

pyvips.cache_set_max(0)  # each image is read once, so the operation cache of libvips has no use
logging.getLogger("pyvips").addHandler(
    logging.NullHandler()
)  # warnings of libvips become brewster errors

_ANIMATED: Final = ("gif", "png", "webp", "avif")
"""The formats whose files with several images are animations."""

Stored = NDArray[Any]


def decode(data: bytes, max_pixels: int) -> Decoded:
    """Decodes the bytes of an image file. Raises PhotoError if the image cannot be read, is not
    supported, or is too large (see `Photo.open`), and MissingExtra if the reader of EXR, HEIC or
    RAW is not installed.
    """
    data, format_name = _detect_format(data, max_pixels)
    if format_name == "raw":
        return split_alpha(*read_raw(data, max_pixels))
    if format_name in _FLOAT_READERS:
        decoded = _FLOAT_READERS[format_name](data, max_pixels)
    elif format_name == "heic":
        decoded = _decode_heic(data, max_pixels)
    else:
        decoded = _decode_vips(data, format_name, max_pixels)
    if decoded.pixels.dtype.kind == "f" and not np.isfinite(decoded.pixels).all():
        count = int((~np.isfinite(decoded.pixels)).any(axis=2).sum())
        raise UnsupportedPhoto(
            f"{counted(count, 'pixel')} {'is' if count == 1 else 'are'} infinite or NaN",
            "expected finite values",
            "render the image again without such pixels",
        )
    return decoded


def read_size(data: bytes) -> tuple[int, int]:
    """Returns (width, height), as `Photo.open(data).size`, from the header only. Raises the errors
    of `Photo.open`.

    Damaged pixel data are not found. EXR and HDR files are read completely.

    Args:
        data: the bytes of the file; EXR and HDR files must be complete.
    """
    data, format_name = _detect_format(data, DEFAULT_MAX_PIXELS)
    if format_name == "raw":
        return read_raw_size(data, DEFAULT_MAX_PIXELS)
    if format_name in _FLOAT_READERS:
        return decode(data, DEFAULT_MAX_PIXELS).pixels.shape[1::-1]
    if format_name == "heic":
        heif = _open_heic(data, DEFAULT_MAX_PIXELS)
        _check_profile(_heic_profile(heif, data), is_float=False)
        return heif.size[0], heif.size[1]
    image, tags = _open_vips(data, format_name, DEFAULT_MAX_PIXELS)
    if image.interpretation != _CMYK:
        _check_profile(_profile(image, data, format_name, tags), is_float=image.format == "float")
    return _upright_size(image, _orientation(image, data, format_name))


@dataclass(frozen=True)
class Header:
    """What the header of an image file states."""

    format_name: str
    """The name of the format of the file, or of the image in an archive: a key of `FORMATS`."""
    size: tuple[int, int]
    """Width and height of the upright image."""
    orientation: int
    """The EXIF orientation, 1..8, which is applied when the photo is opened."""
    file_info: FileInfo


def read_header(data: bytes) -> Header:
    """Returns what the header of an image file states, without decoding its pixels, except of EXR
    and HDR files. Raises the errors of `Photo.open`.
    """
    data, format_name = _detect_format(data, DEFAULT_MAX_PIXELS)
    if format_name == "raw":
        size = read_raw_size(data, DEFAULT_MAX_PIXELS)
        return Header(format_name, size, 1, FileInfo(FORMATS["raw"].written_as, bits=16))
    if format_name in _FLOAT_READERS:
        decoded = decode(data, DEFAULT_MAX_PIXELS)
        return Header(format_name, decoded.pixels.shape[1::-1], 1, decoded.file_info)
    if format_name == "heic":
        heif = _open_heic(data, DEFAULT_MAX_PIXELS)
        orientation = tiff_tags.orientation_of(heif.info.get("exif") or b"")
        return Header(format_name, heif.size, orientation, _heic_info(heif, data))
    image, tags = _open_vips(data, format_name, DEFAULT_MAX_PIXELS)
    orientation = _orientation(image, data, format_name)
    size = _upright_size(image, orientation)
    file_info = _file_info(image, data, format_name, tags, size)
    return Header(format_name, size, orientation, file_info)


def _check_profile(icc: bytes | None, *, is_float: bool) -> None:
    if is_float or not has_only_tables(icc):
        colour_space_of(icc, None, is_float=is_float)


_FLOAT_READERS = {"exr": read_exr, "hdr": read_hdr}


def _detect_format(data: bytes, max_pixels: int) -> tuple[bytes, str]:
    """Returns the data and the name of their format; of an OpenRaster file, those of its merged
    image; of a .livp file, those of its still.
    """
    image_format = known_format(data)
    if image_format.name == "livp":
        data = still_bytes(data)
        image_format = known_format(data)
    if image_format.name == "ora":
        return _merged_image(data, max_pixels), "png"
    is_raw_tiff = image_format.name == "tiff" and tiff_tags.is_raw(data)
    return data, "raw" if is_raw_tiff else image_format.name


def known_format(data: bytes) -> ImageFormat:
    """Returns the format of a file by its first `HEAD_BYTES` bytes. Raises PhotoError if they are
    of no image.
    """
    if not data:
        raise empty_file_error()
    if image_format := format_of_content(data):
        return image_format
    if is_video_content(data):
        raise video_error("the file")
    is_text = re.fullmatch(rb"[\t\n\r -~]+", data[:12])
    raise UnreadablePhoto(
        f"the file is {'text' if is_text else 'of another kind'}, which is no known image format",
        f"expected one of {', '.join(FORMATS)}",
        "convert the file, or check that its content matches its name",
    )


_FAIL_ON = {"tiff": "error"}  # libvips reports missing strips as errors, not as truncation
_EXTRA_SAMPLES = 338
_GREY = ("b-w", "grey16")
_CMYK = "cmyk"
_RGB = ("srgb", "rgb", "rgb16", "scrgb")
_DTYPES = {"uchar": np.uint8, "ushort": np.uint16, "float": np.float32}


def _decode_vips(data: bytes, format_name: str, max_pixels: int) -> Decoded:
    data, notes = jpeg_scan.with_end_marker(data) if format_name == "jpeg" else (data, [])
    image, tags = _open_vips(data, format_name, max_pixels)
    orientation = _orientation(image, data, format_name)
    try:
        file_info = _file_info(image, data, format_name, tags, _upright_size(image, orientation))
        if image.interpretation == _CMYK:
            image, file_info = convert_cmyk(image, file_info)
        array = np.frombuffer(image.write_to_memory(), _DTYPES[image.format])
    except pyvips.Error as error:
        raise _library_error(format_name, error, tags) from error
    if _has_damaged_pixels(data, format_name, tags):
        raise _unreadable_error(format_name, "pixels are damaged")
    array = _full_scale(array.reshape(image.height, image.width, image.bands), file_info.bits)
    file_info = with_notes(file_info, *notes)
    decoded = split_alpha(apply_orientation(array, orientation), file_info)
    if tiff_tags.numbers(tags, _EXTRA_SAMPLES) == [0]:  # unspecified data
        file_info = replace(decoded.file_info, extra_channel=decoded.alpha)
        decoded = Decoded(decoded.pixels, None, file_info)
    is_premultiplied = format_name == "avif" and b"prem" in metadata.iso_box(data, b"iref")
    return _with_straight_alpha(decoded) if is_premultiplied else decoded


def _has_damaged_pixels(data: bytes, format_name: str, tags: tiff_tags.Tags) -> bool:
    """Returns whether libvips has read damaged pixels as grey, black or noise without an error."""
    if format_name == "jpeg":
        return jpeg_scan.is_damaged(data)
    return format_name == "tiff" and tiff_pixels.is_damaged(data, tags)


def _open_vips(
    data: bytes, format_name: str, max_pixels: int
) -> tuple[pyvips.Image, tiff_tags.Tags]:
    """Opens an image and checks its header. libvips decodes the pixels later. Returns the tags of a
    TIFF, too.
    """
    load = getattr(pyvips.Image, f"{FORMATS[format_name].vips_name or format_name}load_buffer")
    pages = tiff_tags.full_pages(data) if format_name == "tiff" else [tiff_tags.Page({}, {})]
    if len(pages) > 1:
        raise _frames_error(format_name)
    options, tags = pages[0] if pages else tiff_tags.Page({}, {})
    if format_name == "tiff":
        tiff_tags.check_pixels(tags)
    fail_on = _FAIL_ON.get(format_name, "truncated")
    try:
        image = load(data, access="sequential", fail_on=fail_on, **options)
        _check_supported(image, data, format_name, max_pixels)
    except pyvips.Error as error:
        raise _library_error(format_name, error, tags) from error
    if format_name == "tiff" and not tiff_tags.has_all_pixels(tags, len(data)):
        raise _unreadable_error(
            "tiff", "pixels are missing"
        )  # libvips reads missing tiles as black
    return image, tags


def _orientation(image: pyvips.Image, data: bytes, format_name: str) -> int:
    """Returns the EXIF orientation that must still be applied; 1 if libvips has applied it."""
    if format_name == "png":  # libvips reads no metadata after the pixels
        return tiff_tags.orientation_of(dict(metadata.png_chunks(data)).get(b"eXIf", b""))
    must_be_applied = FORMATS[format_name].is_stored_rotated and image.get_typeof("orientation")
    return int(image.get("orientation")) if must_be_applied else 1


def _upright_size(image: pyvips.Image, orientation: int) -> tuple[int, int]:
    sides = int(image.width), int(image.height)
    return sides[::-1] if orientation in _TRANSPOSED else sides


_UNSUPPORTED = re.compile(
    r"unsupported (?!marker)|not supported|not implemented|not configured", re.I
)


def _library_error(format_name: str, error: Exception, tags: tiff_tags.Tags) -> PhotoError:
    """Returns the error for a file that a library cannot read: it is damaged, or of a kind that is
    not supported.
    """
    reason = next((line for line in str(error).splitlines() if _UNSUPPORTED.search(line)), None)
    if not reason:
        return _unreadable_error(format_name)
    compression = tiff_tags.COMPRESSION_NAMES.get(tiff_tags.number_of(tags, 259, 1))
    kind = f"compressed with {compression}, which" if compression else "of a kind that"
    return UnsupportedPhoto(
        f"the {format_name} is {kind} brewster does not support "
        f"({reason.rpartition(': ')[2].strip()})",
        "expected a common variant of the format",
        "convert the image, for example to PNG",
    )


def _unreadable_error(format_name: str, reason: str = "") -> PhotoError:
    """Returns the error for a damaged file. The message of a library is its cause, for tracebacks
    and logs.
    """
    return UnreadablePhoto(
        f"the {format_name} cannot be read completely{f' ({reason})' if reason else ''}",
        "expected a complete file in a common variant of the format",
        "copy the file again from its source, or convert it",
    )


def _check_supported(image: pyvips.Image, data: bytes, format_name: str, max_pixels: int) -> None:
    """Raises PhotoTooLarge or UnsupportedPhoto by the header of an image."""
    check_pixel_count(image.width, image.height, max_pixels)
    if _has_frames(image, data, format_name):
        raise _frames_error(format_name)
    interpretations = {1: _GREY, 2: _GREY, 3: _RGB, 4: (*_RGB, _CMYK)}.get(image.bands, ())
    if image.interpretation not in interpretations or image.format not in _DTYPES:
        raise UnsupportedPhoto(
            f"the {format_name} has {image.bands} channels of {image.format} "
            f"({image.interpretation})",
            "expected grey or RGB, with or without alpha, or CMYK, of 8 or 16 bits or 32-bit "
            "floats",
            "convert the image to one of these",
        )


def _frames_error(format_name: str) -> UnsupportedPhoto:
    if format_name in _ANIMATED:
        return UnsupportedPhoto(
            f"the {format_name} is an animation",
            "expected a single image",
            "separate it as a film of one window (brewster burst FILE, in Python "
            "brewster.separate_burst), or extract a frame first",
        )
    return UnsupportedPhoto(
        f"the {format_name} is an animation or has several pages",
        "expected a single image",
        "extract the frames first, for example with ffmpeg or vips",
    )


def _has_frames(image: pyvips.Image, data: bytes, format_name: str) -> bool:
    if format_name == "png":
        return b"acTL" in dict(
            metadata.png_chunks(data)
        )  # libvips reads the first frame without an error
    if format_name == "avif":
        return data[8:12] == b"avis"  # libvips counts thumbnails as pages
    has_pages = format_name != "tiff" and bool(image.get_typeof("n-pages"))
    return has_pages and image.get("n-pages") > 1


def _blob(image: pyvips.Image, name: str) -> bytes | None:
    return image.get(f"{name}-data") if image.get_typeof(f"{name}-data") else None


def _profile(
    image: pyvips.Image, data: bytes, format_name: str, tags: tiff_tags.Tags
) -> bytes | None:
    is_grey = image.interpretation in _GREY
    return profile_of(data, format_name, _blob(image, "icc-profile"), is_grey=is_grey, tags=tags)


def _file_info(
    image: pyvips.Image, data: bytes, format_name: str, tags: tiff_tags.Tags, size: tuple[int, int]
) -> FileInfo:
    bits = {"float": 32, "uchar": 8}.get(image.format, 16)
    has_resolution = (image.xres, image.yres) != (1.0, 1.0)
    file_info = FileInfo(
        format_name=FORMATS[format_name].written_as,
        bits=image.get("bits-per-sample") if format_name == "avif" else bits,
        icc=_profile(image, data, format_name, tags),
        resolution_px_per_mm=(image.xres, image.yres) if has_resolution else None,
    )
    exif = _blob(image, "exif")
    packets = [packet for packet in (_blob(image, "xmp"),) if packet]
    match format_name:
        case "jpeg":
            subsampling = metadata.jpeg_subsampling(data)
            file_info = replace(
                file_info,
                subsampling=subsampling,
                jpeg_quality=_jpeg_quality(data, bands=3 if subsampling else 1),
                iptc=metadata.jpeg_image_resources(data),
                texts=tuple(metadata.jpeg_comments(data)),
            )
            packets = metadata.read_xmp(data)
        case "png":
            file_info = replace(file_info, texts=tuple(metadata.png_texts(data)))
            exif = dict(metadata.png_chunks(data)).get(b"eXIf")
            packets = metadata.read_xmp(data)
        case "tiff":
            compression = _COMPRESSIONS.get(tiff_tags.number_of(tags, 259, 1), "deflate")
            resources = metadata.tiff_image_resources(tags)
            packet = tiff_tags.value_of(tags, 700)
            file_info = replace(file_info, compression=compression, iptc=resources)
            exif = tiff_tags.tiff_exif(tags)
            if tiff_tags.has_fixed_maker_note(tags):
                file_info = with_notes(file_info, "its maker note is not kept")
            packets = [packet] if packet else []
        case "webp":
            file_info = replace(file_info, lossless=b"VP8L" in metadata.webp_chunks(data))
        case "avif":
            codes = metadata.cicp(
                data
            )  # only a lossless AVIF stores RGB: matrix code 0, the identity
            file_info = replace(file_info, lossless=codes is not None and codes[2] == 0)
            pages = image.get("n-pages") if image.get_typeof("n-pages") else 1
            # libvips counts thumbnails as pages
            thumbnails = metadata.iso_box(data, b"iref").count(b"thmb")
            file_info = with_notes(file_info, *_others(pages - 1 - thumbnails))
    return _with_exif_and_xmp(file_info, data, exif, packets, size)


def _with_exif_and_xmp(
    file_info: FileInfo,
    data: bytes,
    exif: bytes | None,
    packets: list[bytes],
    size: tuple[int, int],
) -> FileInfo:
    """Returns the metadata with EXIF and XMP of the upright image, (width, height), and a note on
    what is lost.
    """
    packet, lost = xmp.layer_xmp(packets, size)
    if file_info.format_name in ("jpeg", "heic", "avif"):
        lost += [name for mark, name in _LOST_PARTS.items() if mark in data]
        lost += [xmp.GAIN_MAP] if b"tmap" in metadata.iso_box(data, b"iinf") else []
    parts = tuple(dict.fromkeys(lost))
    exif = tiff_tags.upright_exif(exif, size) if exif else None
    file_info = replace(file_info, exif=exif, xmp=packet, other_parts=parts)
    notes = (_FILM_NOTE if name == xmp.FILM else f"its {name} is not kept" for name in parts)
    return with_notes(file_info, *notes)


_FILM_NOTE: Final = "the layers are still pictures: its film stays in the original photo only"
_LOST_PARTS = {
    b"urn:iso:std:iso:ts:21496:-1": xmp.GAIN_MAP,
    b"urn:com:apple:photo:2020:aux:hdrgainmap": xmp.GAIN_MAP,
    b"ns.adobe.com/hdr-gain-map/": xmp.GAIN_MAP,
    b"MotionPhoto_Data": xmp.FILM,
}
"""Bytes of files with other parts than the image, and the names of these parts."""


def _jpeg_quality(data: bytes, bands: int) -> int:
    """Returns the lowest libvips quality whose quantization of luma and chroma is at least as fine
    as in the file.
    """
    source = metadata.jpeg_quantization_sums(data)
    square = pyvips.Image.black(8, 8, bands=bands)

    def is_fine(quality: int) -> bool:
        candidate = metadata.jpeg_quantization_sums(square.jpegsave_buffer(Q=quality))
        return all(
            sum_ <= source.get(number, source.get(0, 0)) for number, sum_ in candidate.items()
        )

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


def _merged_image(data: bytes, max_pixels: int) -> bytes:
    """Returns the PNG of the merged image in an OpenRaster file (baseline 0.0.6)."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if archive.getinfo("mergedimage.png").file_size > (1 << 20) + 16 * max_pixels:
                raise _unreadable_error("ora", "the merged image is too large")
            return archive.read("mergedimage.png")
    except ZIP_ERRORS as error:  # RuntimeError: the file is encrypted
        raise _unreadable_error("ora") from error


_HEIC_ERRORS = (ValueError, RuntimeError, OSError, SyntaxError, EOFError)


def _open_heic(data: bytes, max_pixels: int) -> Any:  # noqa: ANN401  (pillow-heif has no types)
    """Opens a HEIC file and checks its header. pillow-heif decodes the pixels later."""
    pillow_heif = library_of("heic")
    try:
        heif = pillow_heif.open_heif(data, convert_hdr_to_8bit=False)
        if not len(heif):
            raise _unreadable_error("heic", "no image in the file can be decoded")
        check_pixel_count(heif.size[0], heif.size[1], max_pixels)
    except _HEIC_ERRORS as error:
        raise _library_error("heic", error, {}) from error
    return heif


def _others(count: int) -> list[str]:
    """Returns a note on the other images of a HEIC or AVIF file."""
    return [
        f"{counted(count, 'other image')} of the file {'is' if count == 1 else 'are'} not read"
    ][: count > 0]


def _heic_profile(heif: Any, data: bytes) -> bytes | None:  # noqa: ANN401
    return profile_of(data, "heic", heif.info.get("icc_profile"), is_grey=False, tags={})


def _decode_heic(data: bytes, max_pixels: int) -> Decoded:
    heif = _open_heic(data, max_pixels)
    try:
        array = np.array(heif)
    except _HEIC_ERRORS as error:
        raise _library_error("heic", error, {}) from error
    file_info = _heic_info(heif, data)
    file_info = with_notes(file_info, *_others(len(heif) - 1))
    decoded = split_alpha(
        _full_scale(array.reshape(*array.shape[:2], -1), file_info.bits), file_info
    )
    return _with_straight_alpha(decoded) if "a" in heif.mode else decoded


def _heic_info(heif: Any, data: bytes) -> FileInfo:  # noqa: ANN401
    packet = heif.info.get("xmp")
    file_info = FileInfo("heic", heif.info.get("bit_depth", 8), icc=_heic_profile(heif, data))
    packets = [packet] if packet else []
    return _with_exif_and_xmp(file_info, data, heif.info.get("exif"), packets, heif.size)


_TRANSPOSED = (5, 6, 7, 8)


def _full_scale(array: Stored, bits: int) -> Stored:
    """Copies the upper bits of 10- and 12-bit values to the lower ones, so that white is 65535."""
    return array | array >> bits if bits in (10, 12) else array


def _with_straight_alpha(image: Decoded) -> Decoded:
    """Divides colours by alpha. The colours of transparent pixels stay."""
    if image.alpha is None:
        return image
    white = np.iinfo(image.pixels.dtype).max
    divisor = np.where(image.alpha > 0, image.alpha, white)[..., None].astype(np.float64)
    straight = np.rint(np.minimum(image.pixels * (white / divisor), white)).astype(
        image.pixels.dtype
    )
    return replace(image, pixels=straight)


def apply_orientation(array: Stored, orientation: int) -> Stored:
    """Rotates and flips an array (H, W, C) as the EXIF orientation 1..8 requires (CIPA DC-008, tag
    274).
    """
    if orientation in _TRANSPOSED:
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return array


def split_alpha(array: Stored, file_info: FileInfo) -> Decoded:
    """Splits an array (H, W, 1..4) into contiguous colour channels (H, W, 1|3), and alpha (H, W) or
    None.
    """
    has_alpha = array.shape[2] in (2, 4)
    colour_channels = array.shape[2] - has_alpha
    alpha = np.ascontiguousarray(array[..., colour_channels]) if has_alpha else None
    return Decoded(np.ascontiguousarray(array[..., :colour_channels]), alpha, file_info)
