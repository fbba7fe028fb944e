"""The table of image formats: one row holds all properties of a file format.

To add a format, add a row here. A format with a new `library` also needs a reader and a writer in
`brewster.photo`.
"""

import re
from dataclasses import dataclass
from pathlib import PurePath
from typing import Final, Literal, final

FormatName = Literal["jpeg", "png", "tiff", "webp", "avif", "heic", "exr", "hdr"]
"""The names of the formats in which a single layer can be written."""


@final
@dataclass(frozen=True, kw_only=True)
class ImageFormat:
    """A file format: how its files are recognised, what they can store, and which library reads and
    writes them.
    """

    name: str
    suffixes: tuple[str, ...]
    """File name suffixes in lower case. The first one is used for new files."""
    mime_type: str
    signature: bytes
    """A regular expression for the first bytes of a file. Most RAW files begin like TIFF: their
    tags tell.
    """
    library: Literal["libvips", "OpenEXR", "pillow-heif", "rawpy", "built-in"] = "libvips"
    vips_name: str = ""
    """The name of the format in the functions of libvips, if it is another one."""
    extra: str | None = None
    """The extra of brewster that installs the library, or None if the library is installed without
    an extra.
    """
    bit_depths: tuple[int, ...] = ()
    """The bit depths per channel that can be written. Empty for formats that are only read, and for
    OpenRaster.
    """
    replacement: str = "png"
    """The format of the layers of a photo, if the format of the photo is only read."""
    has_float32: bool = False
    """Whether 32-bit floats are stored without loss. In HDR, the channels share an exponent:
    precision is lost.
    """
    is_linear: bool = False
    """Whether the pixels are linear light by definition, without an ICC profile."""
    has_alpha: bool = True
    """Whether an alpha channel can be written."""
    keeps: tuple[str, ...] = ("icc", "exif", "xmp")
    """The metadata of a photo that its layers in this format have: names of fields of
    `brewster.photo.FileInfo`.
    """
    is_stored_rotated: bool = False
    """Whether the library returns pixels without applying the EXIF orientation."""

    @property
    def is_writable(self) -> bool:
        """Whether a single layer can be written in this format."""
        return bool(self.bit_depths)

    @property
    def written_as(self) -> str:
        """The name of the format in which the layers of a photo of this format are written."""
        return self.name if self.is_writable else self.replacement


_ROWS: Final = (
    ImageFormat(
        name="jpeg",
        suffixes=(".jpg", ".jpeg", ".jpe", ".jfif"),
        mime_type="image/jpeg",
        signature=rb"\xff\xd8\xff",
        bit_depths=(8,),
        has_alpha=False,
        keeps=("icc", "exif", "xmp", "iptc", "texts"),
        is_stored_rotated=True,
    ),
    ImageFormat(
        name="png",
        suffixes=(".png",),
        mime_type="image/png",
        signature=rb"\x89PNG\r\n\x1a\n",
        bit_depths=(8, 16),
        keeps=("icc", "exif", "xmp", "texts"),
        is_stored_rotated=True,
    ),
    ImageFormat(
        name="raw",
        suffixes=(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"),
        mime_type="image/x-dcraw",
        signature=rb"II\*\0....CR|....ftypcrx "
        rb"|FUJIFILMCCD-RAW|II(RO|RS|U\0)|MMOR",
        library="rawpy",
        extra="raw",
        replacement="tiff",
    ),
    ImageFormat(
        name="tiff",
        suffixes=(".tiff", ".tif"),
        mime_type="image/tiff",
        signature=rb"II[*+]\0|MM\0[*+]",
        bit_depths=(8, 16, 32),
        keeps=("icc", "exif", "xmp", "iptc"),
        has_float32=True,
        is_stored_rotated=True,
    ),
    ImageFormat(
        name="webp",
        suffixes=(".webp",),
        mime_type="image/webp",
        signature=rb"RIFF....WEBP",
        bit_depths=(8,),
        is_stored_rotated=True,
    ),
    ImageFormat(
        name="avif",
        suffixes=(".avif",),
        mime_type="image/avif",
        signature=rb"....ftyp(avif|avis)",
        vips_name="heif",
        bit_depths=(8, 10, 12),
    ),
    # an extra of its own, because of the patents on HEVC
    ImageFormat(
        name="heic",
        suffixes=(".heic", ".heif"),
        mime_type="image/heic",
        signature=rb"....ftyp(hei[cxms]|hev[cxms])",
        library="pillow-heif",
        extra="heic",
        bit_depths=(8, 10),
    ),
    ImageFormat(
        name="exr",
        suffixes=(".exr",),
        mime_type="image/x-exr",
        signature=rb"v/1\x01",
        library="OpenEXR",
        extra="exr",
        bit_depths=(16, 32),
        keeps=(),
        has_float32=True,
        is_linear=True,
    ),
    ImageFormat(
        name="hdr",
        suffixes=(".hdr",),
        mime_type="image/vnd.radiance",
        signature=rb"#\?(RADIANCE|RGBE)",
        library="built-in",
        bit_depths=(32,),
        keeps=(),
        is_linear=True,
        has_alpha=False,
    ),
    ImageFormat(
        name="ora",
        suffixes=(".ora",),
        mime_type="image/openraster",
        signature=rb"PK\x03\x04.{26}mimetypeimage/openraster",
        library="built-in",
    ),
    # an archive with a HEIC or JPEG, and its film
    ImageFormat(
        name="livp",
        suffixes=(".livp",),
        mime_type="application/zip",
        signature=rb"PK\x03\x04.{26}[^\0]{1,255}?\.(?i:heic|heif|jpe?g|mov)",
        library="built-in",
        replacement="jpeg",
    ),
    ImageFormat(name="gif", suffixes=(".gif",), mime_type="image/gif", signature=rb"GIF8[79]a"),
)

FORMATS: Final = {row.name: row for row in _ROWS}
"""All formats by name, in the order in which their signatures are tried."""

WRITABLE: Final = {name: row for name, row in FORMATS.items() if row.is_writable}
"""The formats in which a single layer can be written, by name."""

SUFFIXES: Final = {suffix: row for row in _ROWS for suffix in row.suffixes}
"""All formats by file name suffix, in lower case."""

VIDEO_SUFFIXES: Final = frozenset(
    (
        *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mts", ".m2ts"),
        *(".mpg", ".mpeg", ".3gp", ".3g2", ".wmv", ".flv"),
    )
)
"""File name suffixes of videos, in lower case. They are not photos: a video is separated as a
burst.
"""

WRITABLE_VIDEOS: Final = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""The suffixes of the videos that brewster writes, and the names of their formats in FFmpeg."""

_STILL_BRANDS: Final = (
    rb"hei[cmxs]|hev[cmxs]|mi[af]\w|msf1|avi[fs]|avc[is]|crx |jpeg|jp2 |jpx |jpm |j2ki|j2is|jxl "
    rb"|M4A |M4B |M4P |MA1.|aax "
)
"""The brands of ISO base media files with images or only sound. All other brands are films: new
ones appear each year.
"""
_VIDEO_SIGNATURE: Final = (
    rb"....(ftyp(?!"
    + _STILL_BRANDS
    + rb")[ -~]{4}|moov|mdat|wide|(free|skip|pnot).{0,4096}?(moov|mdat))"
    rb"|RIFF....AVI |\x1aE\xdf\xa3|\0\0\x01[\xba\xb3]|FLV\x01|0&\xb2u\x8ef\xcf\x11"
    rb"|OggS.{0,4096}?(\x80theora|OVP80|BBCD|fishead)"
    rb"|G(.{187}G){3}|.{4}G(.{191}G){3}"
)
"""A regular expression for the first bytes of a video: MP4 or QuickTime, AVI, Matroska or WebM,
MPEG program stream, FLV, WMV, Ogg with pictures, MPEG transport stream (packets of 188 bytes, or of
192 bytes on Blu-ray discs and in camcorders).
"""


def canonical_format(text: str) -> str:
    """Returns the name of a format for one of its suffixes: `JPG` and `.jpg` give `jpeg`. Other
    text is unchanged.
    """
    image_format = SUFFIXES.get(f".{text.lower().removeprefix('.')}")
    return image_format.name if image_format else text


HEAD_BYTES: Final = 1 << 16
"""The number of bytes at the beginning of a file that `format_of_content` reads."""


def format_of(path: PurePath) -> ImageFormat | None:
    """Returns the format for the suffix of a file name, or None if the suffix is unknown."""
    return SUFFIXES.get(path.suffix.lower())


def format_of_content(data: bytes) -> ImageFormat | None:
    """Returns the format of a file by its first `HEAD_BYTES` bytes, or None if it is unknown.

    For a RAW file that begins like a TIFF file, the result is tiff, which is also the format of its
    layers.
    """
    # AVIF and HEIC files use these brands. Only HEIC files have a decoder configuration hvcC.
    if re.match(rb"....ftypmi[fa]", data, re.DOTALL):
        return FORMATS["heic" if b"hvcC" in data[:HEAD_BYTES] else "avif"]
    return next((row for row in _ROWS if re.match(row.signature, data, re.DOTALL)), None)


def is_video(path: PurePath) -> bool:
    """Returns whether a file name has the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def is_video_content(data: bytes) -> bool:
    """Returns whether the first bytes of a file are those of a video, whatever its name.

    `data` should have `HEAD_BYTES` bytes, or all bytes of a shorter file.
    """
    is_video_signature = re.match(_VIDEO_SIGNATURE, data[:HEAD_BYTES], re.DOTALL) is not None
    return is_video_signature and format_of_content(data) is None


def is_animation(head: bytes) -> bool:
    """Returns whether a file is an animated PNG (acTL), WebP (flags of VP8X) or AVIF (brand avis).

    Args:
        head: the first 64 KB of the file. The profile of a PNG may come before its animation.
    """
    if head.startswith(b"\x89PNG"):
        return b"acTL" in head.partition(b"IDAT")[0]
    if head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X":
        return len(head) > 20 and bool(head[20] & 2)
    length = int.from_bytes(head[:4], "big")
    return head[4:8] == b"ftyp" and b"avis" in head[8:length]
