"""Reads and writes metadata as bytes: JPEG segments, PNG and WebP chunks, AVIF items, resources of
Photoshop.
"""

import contextlib
import re
import struct
import zlib
from collections.abc import Iterator
from mmap import mmap

from brewster.errors import UnsupportedPhoto
from brewster.photo.blocks.jpeg_segments import APP1, FRAMES, XMP_NAME, jpeg_segments
from brewster.photo.blocks.tiff_tags import (
    EXIF_NAME,
    Tags,
    camera_tags,
    read_tags,
    value_of,
    without_fixed_maker_note,
)
from brewster.photo.blocks.xmp import guid_of, split_xmp
from brewster.photo.file_info import FileInfo

# --- JPEG (ITU-T T.81 annex B)

_APP0 = 0xE0
_APP13 = 0xED
_DQT = 0xDB
_COM = 0xFE
_EXTENDED_XMP_NAME = b"http://ns.adobe.com/xmp/extension/\0"
_RESOURCES_NAME = b"Photoshop 3.0\0"
_MAX_SEGMENT_PAYLOAD = 65533  # bytes


def jpeg_exif(data: bytes) -> bytes:
    """Returns the EXIF block of a JPEG, or no bytes if there is no block."""
    return next(iter(_named_segments(data, APP1, EXIF_NAME)), b"")


def jpeg_comments(data: bytes) -> list[bytes]:
    """Returns the segments of the comments of a JPEG."""
    return [_segment(_COM, payload) for marker, _, payload in jpeg_segments(data) if marker == _COM]


def _named_segments(data: bytes | mmap, marker: int, name: bytes) -> list[bytes]:
    found = (payload for kind, _, payload in jpeg_segments(data) if kind == marker)
    return [payload[len(name) :] for payload in found if payload.startswith(name)]


def _jpeg_xmp(data: bytes | mmap) -> list[bytes]:
    """Returns the XMP packet of a JPEG, and the extended packet to which it refers if all of it is
    in the file.
    """
    packets = _named_segments(data, APP1, XMP_NAME)[:1]
    parts: dict[int, bytes] = {}
    size = 0
    for payload in _named_segments(data, APP1, _EXTENDED_XMP_NAME) if packets else ():
        if payload[:32] in packets[0]:  # the digest of the extended packet
            size, position = struct.unpack_from(">II", payload.ljust(40, b"\0"), 32)
            parts[position] = payload[40:]
    extended = b"".join(part for _, part in sorted(parts.items()))
    return [*packets, extended] if extended and len(extended) == size else packets


def jpeg_quantization_sums(data: bytes) -> dict[int, int]:
    """Returns the sum of each quantization table by its number (0: luma, 1: chroma). A larger sum
    is coarser.
    """
    sums = {}
    for marker, _, payload in jpeg_segments(data):
        while marker == _DQT and payload:
            is_16bit = payload[0] >> 4
            number = payload[0] & 15
            size = 128 if is_16bit else 64
            sums[number] = sum(struct.unpack(">64H" if is_16bit else ">64B", payload[1 : 1 + size]))
            payload = payload[1 + size :]  # noqa: PLW2901
    return sums


def jpeg_subsampling(data: bytes) -> str | None:
    """Returns the chroma subsampling, such as "4:4:4", "4:2:2" or "4:2:0", or None for a grey
    JPEG.
    """
    for marker, _, payload in jpeg_segments(data):
        if marker in FRAMES and len(payload) >= 15:
            across, down = payload[7] >> 4, payload[7] & 15
            chroma_across = payload[10] >> 4
            chroma_down = payload[10] & 15
            chroma = 4 * chroma_across // across
            return f"4:{chroma}:{0 if down > chroma_down else chroma}"
    return None


def with_jpeg_head(
    data: bytes, file_info: FileInfo, dots_per_inch: tuple[float, float] | None
) -> bytes:
    """Inserts segments with the resolution (JFIF), EXIF, XMP, image resources and comments into a
    JPEG without them. Raises UnsupportedPhoto if the EXIF block is larger than a segment, 64 KiB.
    """
    head = []
    if dots_per_inch is not None:
        across, down = (min(max(round(dots), 1), 65535) for dots in dots_per_inch)
        head.append(
            _segment(_APP0, b"JFIF\0" + struct.pack(">HBHHBB", 0x0101, 1, across, down, 0, 0))
        )
    if file_info.exif is not None:
        head.append(_segment(APP1, EXIF_NAME + file_info.exif))
    main, extended = split_xmp(file_info.xmp or b"", _MAX_SEGMENT_PAYLOAD - len(XMP_NAME))
    if main:
        head.append(_segment(APP1, XMP_NAME + main))
    name = _EXTENDED_XMP_NAME + guid_of(extended).encode()
    for position, part in _parts(extended, _MAX_SEGMENT_PAYLOAD - len(name) - 8):
        head.append(_segment(APP1, name + struct.pack(">II", len(extended), position) + part))
    resources = _parts(file_info.iptc or b"", _MAX_SEGMENT_PAYLOAD - len(_RESOURCES_NAME))
    head += [_segment(_APP13, _RESOURCES_NAME + part) for _, part in resources]
    head += [text for text in file_info.texts if text.startswith(bytes((0xFF, _COM)))]
    return b"".join((data[:2], *head, data[2:]))


def _parts(data: bytes, size: int) -> list[tuple[int, bytes]]:
    return [(position, data[position : position + size]) for position in range(0, len(data), size)]


def _segment(marker: int, payload: bytes) -> bytes:
    if len(payload) > _MAX_SEGMENT_PAYLOAD:
        raise UnsupportedPhoto(
            f"the EXIF block has {len(payload)} bytes",
            f"expected at most {_MAX_SEGMENT_PAYLOAD} bytes for a JPEG",
            "write PNG, TIFF or WebP instead",
        )
    return struct.pack(">BBH", 0xFF, marker, len(payload) + 2) + payload


# --- Image resources of Photoshop (Adobe Photoshop File Formats Specification)

_IPTC = 1028  # the IPTC block
_THUMBNAILS = (1033, 1036)  # they show the input


def jpeg_image_resources(data: bytes) -> bytes | None:
    """Returns the image resources of a JPEG, without thumbnails."""
    return _serialise_resources(
        _resources(b"".join(_named_segments(data, _APP13, _RESOURCES_NAME)))
    )


def tiff_image_resources(tags: Tags) -> bytes | None:
    """Returns the image resources of a TIFF, without thumbnails. The IPTC block is that of its own
    tag, if any.
    """
    resources = _resources(value_of(tags, 34377) or b"")
    if iptc := value_of(tags, 33723):
        if (
            iptc[:1] != b"\x1c" and iptc[3:4] == b"\x1c"
        ):  # written as integers in the other byte order
            iptc = b"".join(iptc[i : i + 4][::-1] for i in range(0, len(iptc), 4))
        resources[_IPTC] = bytes(2), iptc[: _iptc_size(iptc)]
    return _serialise_resources(resources)


def _iptc_size(iptc: bytes) -> int:
    """Returns the size without the padding to integers. A data set has the marker 1C, two numbers
    and its size.
    """
    position = 0
    while iptc[position : position + 1] == b"\x1c" and position + 5 <= len(iptc):
        position += 5 + int.from_bytes(iptc[position + 3 : position + 5], "big")
    return position if 0 < position <= len(iptc) else len(iptc)


def tiff_tags_of(file_info: FileInfo) -> Tags:
    """Returns the tags of a TIFF for EXIF, XMP, the image resources and IPTC."""
    resources = _resources(file_info.iptc or b"")
    _, iptc = resources.pop(_IPTC, (b"", b""))
    blocks = {
        700: (1, file_info.xmp),
        33723: (7, iptc),
        34377: (1, _serialise_resources(resources)),
    }
    tags = camera_tags(read_tags(file_info.exif)) if file_info.exif else {}
    tags = without_fixed_maker_note(tags)
    return tags | {tag: (kind, len(block), block) for tag, (kind, block) in blocks.items() if block}


def _resources(block: bytes) -> dict[int, tuple[bytes, bytes]]:
    found = {}
    position = 0
    while block[position : position + 4] == b"8BIM" and position + 12 <= len(block):
        name_end = position + 6 + (block[position + 6] + 2) // 2 * 2
        start = name_end + 4
        size = int.from_bytes(block[name_end:start], "big")
        number = int.from_bytes(block[position + 4 : position + 6], "big")
        found[number] = block[position + 6 : name_end], block[start : start + size]
        position = start + size + size % 2
    return found


def _serialise_resources(resources: dict[int, tuple[bytes, bytes]]) -> bytes | None:
    rows = [
        b"8BIM%b%b%b%b"
        % (number.to_bytes(2, "big"), name, len(content).to_bytes(4, "big"), content)
        + bytes(len(content) % 2)
        for number, (name, content) in resources.items()
        if number not in _THUMBNAILS
    ]
    return b"".join(rows) or None


_TEXT_CHUNKS = (b"tEXt", b"zTXt", b"iTXt")
_PNG_XMP_NAME = b"XML:com.adobe.xmp\0"


def png_chunks(data: bytes | mmap) -> Iterator[tuple[bytes, bytes]]:
    """Yields the name and the content of each chunk of a PNG except its pixel data."""
    position = 8
    while position + 8 <= len(data):
        size = int.from_bytes(data[position : position + 4], "big")
        name = data[position + 4 : position + 8]
        if name != b"IDAT":
            yield name, data[position + 8 : position + 8 + size]
        position += 12 + size


def png_texts(data: bytes) -> list[bytes]:
    """Returns the chunks with texts of a PNG, except XMP."""
    texts = ((name, content) for name, content in png_chunks(data) if name in _TEXT_CHUNKS)
    return [
        _chunk(name, content) for name, content in texts if not content.startswith(_PNG_XMP_NAME)
    ]


def _png_xmp(data: bytes | mmap) -> list[bytes]:
    """The XMP specification, part 3, requires uncompressed text (iTXt); libvips writes compressed
    text (zTXt).
    """
    for name, content in png_chunks(data):
        if name in _TEXT_CHUNKS and content.startswith(_PNG_XMP_NAME):
            text = content[len(_PNG_XMP_NAME) :]
            is_compressed = name == b"zTXt" or text[:1] == b"\1"
            text = {b"tEXt": text, b"zTXt": text[1:]}.get(name) or text[2:].split(b"\0", 2)[-1]
            with contextlib.suppress(zlib.error):
                return [zlib.decompress(text) if is_compressed else text]
    return []


def with_png_chunks(data: bytes, file_info: FileInfo) -> bytes:
    """Inserts chunks with EXIF, XMP and texts into a PNG after its header chunk."""
    position = 8 + 12 + 13  # signature, and the header chunk: 12 bytes and 13 bytes of data
    exif = [_chunk(b"eXIf", file_info.exif)] if file_info.exif else []
    xmp = [_chunk(b"iTXt", _PNG_XMP_NAME + bytes(4) + file_info.xmp)] if file_info.xmp else []
    texts = [text for text in file_info.texts if text[4:8] in _TEXT_CHUNKS]
    return b"".join((data[:position], *exif, *xmp, *texts, data[position:]))


def _chunk(name: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
    )


def webp_chunks(data: bytes | mmap) -> dict[bytes, bytes]:
    """Returns the chunks of a WebP by name."""
    found = {}
    position = 12
    while position + 8 <= len(data):
        size = int.from_bytes(data[position + 4 : position + 8], "little")
        found[data[position : position + 4]] = data[position + 8 : position + 8 + size]
        position += 8 + size + size % 2
    return found


def with_webp_exif(data: bytes, exif: bytes, size: tuple[int, int], has_alpha: bool) -> bytes:
    """Inserts an EXIF chunk into a WebP, in the extended layout (RFC 9649 2.7). `size` is (width,
    height).
    """
    chunks = webp_chunks(data)
    flags = chunks.pop(b"VP8X", bytes(4))[0] | 0x08 | 0x10 * has_alpha
    canvas = b"".join((side - 1).to_bytes(3, "little") for side in size)
    xmp = chunks.pop(b"XMP ", None)
    ordered = {b"VP8X": bytes((flags, 0, 0, 0)) + canvas, **chunks, b"EXIF": exif}
    if xmp is not None:
        ordered[b"XMP "] = xmp
    padded = ((name, len(chunk), chunk + bytes(len(chunk) % 2)) for name, chunk in ordered.items())
    body = b"".join(name + struct.pack("<I", size) + chunk for name, size, chunk in padded)
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body


def read_xmp(data: bytes | mmap) -> list[bytes]:
    """Returns the XMP packet of a JPEG, PNG, WebP or TIFF of one page, if any, and the extended one
    of a JPEG.
    """
    if data[:2] == b"\xff\xd8":
        return _jpeg_xmp(data)
    if data[:4] == b"\x89PNG":
        return _png_xmp(data)
    packet = (
        webp_chunks(data).get(b"XMP ") if data[:4] == b"RIFF" else value_of(read_tags(data), 700)
    )
    return [packet] if packet else []


def cicp(data: bytes) -> tuple[int, int, int, bool] | None:
    """Returns the code points (CICP, ITU-T H.273) of primaries, transfer function and matrix of an
    AVIF, HEIC or PNG, and whether the values use the full range. Returns None for a file without
    code points.
    """
    if data.startswith(b"\x89PNG"):
        chunk = dict(png_chunks(data)).get(b"cICP", b"")
        return (chunk[0], chunk[1], chunk[2], chunk[3] == 1) if len(chunk) >= 4 else None
    head = data[: 1 << 16] if data[4:8] == b"ftyp" else b""
    found = re.search(rb"colrnclx(.{6})(.)", head, re.DOTALL)
    return (*struct.unpack(">3H", found[1]), found[2][0] >= 128) if found else None


# --- Boxes of AVIF and HEIC (ISO/IEC 14496-12)


def iso_box(data: bytes, name: bytes) -> bytes:
    """Returns the content of the first ISO box with this name in the first MiB, or no bytes."""
    at = data.find(name, 4, 1 << 20)
    return data[at + 4 : at - 4 + int.from_bytes(data[at - 4 : at], "big")] if at > 0 else b""


def with_avif_exif(data: bytes, exif: bytes) -> bytes:
    """Replaces the Exif item of an AVIF that libvips has written. The new block is appended to the
    file, and the location of the item is set to this block.
    """
    item = re.search(rb"infe\x02...(..)..Exif", data, re.DOTALL)
    row = _item_location(data, item[1]) if item else None
    if row is None:
        return data
    payload = bytes(4) + exif
    location = struct.pack(">IHII", 0, 1, len(data) + 8, len(payload))
    box = struct.pack(">I", len(payload) + 8) + b"mdat" + payload
    return b"".join((data[:row], location, data[row + len(location) :], box))


def _item_location(data: bytes, item: bytes) -> int | None:
    """Returns the position of a location in an iloc box, or None if the layout is not libheif's."""
    table = data.find(b"iloc")
    version = data[table + 4]
    size_fields = data[table + 8]
    index_fields = data[table + 9]
    if table < 0 or version > 1 or (size_fields, index_fields) != (0x44, 0x40):
        return None
    position = table + 12
    for _ in range(int.from_bytes(data[table + 10 : table + 12], "big")):
        row = position + 4 + 2 * (version == 1)
        count = int.from_bytes(data[row + 4 : row + 6], "big")
        if data[position : position + 2] == item:
            return row if count == 1 else None
        position = row + 6 + 8 * count
    return None
