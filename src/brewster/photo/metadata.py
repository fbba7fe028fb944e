"""Reads and writes metadata as bytes: JPEG tables, EXIF, PNG and WebP chunks.

libvips writes EXIF with libexif, which drops unknown tags, and libvips ignores EXIF in TIFF files. This module copies
the EXIF block of the source with all its tags; only the orientation and the thumbnail change. A block begins at its
TIFF header, without the "Exif\\0\\0" of JPEG."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator

from brewster.errors import UnsupportedPhoto

# --- JPEG (ITU-T T.81 annex B)

_EXIF_NAME = b"Exif\0\0"
_APP0, _APP1, _DQT, _SOS = 0xE0, 0xE1, 0xDB, 0xDA
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_MAX_SEGMENT_PAYLOAD = 65533  # bytes


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yields the marker, the position and the payload of each segment before the pixel data."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, size = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        yield marker, position, data[position + 4 : position + 2 + size]
        if marker == _SOS:
            return
        position += 2 + size


def jpeg_exif(data: bytes) -> bytes:
    """Returns the EXIF block of a JPEG, or no bytes if there is no block."""
    blocks = (payload for marker, _, payload in jpeg_segments(data) if marker == _APP1)
    return next((block[len(_EXIF_NAME) :] for block in blocks if block.startswith(_EXIF_NAME)), b"")


def jpeg_quantization_sums(data: bytes) -> dict[int, int]:
    """Returns the sum of each quantization table by its number (0: luma, 1: chroma). A table with a larger sum is coarser."""
    sums = {}
    for marker, _, payload in jpeg_segments(data):
        while marker == _DQT and payload:
            is_16bit, number = payload[0] >> 4, payload[0] & 15
            size = 128 if is_16bit else 64
            sums[number] = sum(struct.unpack(">64H" if is_16bit else ">64B", payload[1 : 1 + size]))
            payload = payload[1 + size :]  # noqa: PLW2901
    return sums


def jpeg_subsampling(data: bytes) -> str | None:
    """Returns the chroma subsampling, such as "4:4:4", "4:2:2" or "4:2:0", or None for a grey JPEG."""
    for marker, _, payload in jpeg_segments(data):
        if marker in _FRAMES and len(payload) >= 15:
            across, down = payload[7] >> 4, payload[7] & 15
            chroma_across, chroma_down = payload[10] >> 4, payload[10] & 15
            chroma = 4 * chroma_across // across
            return f"4:{chroma}:{0 if down > chroma_down else chroma}"
    return None


def with_jpeg_head(data: bytes, exif: bytes | None, dots_per_inch: tuple[float, float] | None) -> bytes:
    """Inserts a JFIF segment with the resolution, and an EXIF segment, into a JPEG without these segments. Raises
    UnsupportedPhoto if the EXIF block is larger than a segment, 64 KiB."""
    head = b""
    if dots_per_inch is not None:
        across, down = (min(max(round(dots), 1), 65535) for dots in dots_per_inch)
        head += _segment(_APP0, b"JFIF\0" + struct.pack(">HBHHBB", 0x0101, 1, across, down, 0, 0))
    if exif is not None:
        head += _segment(_APP1, _EXIF_NAME + exif)
    return b"".join((data[:2], head, data[2:]))


def _segment(marker: int, payload: bytes) -> bytes:
    if len(payload) > _MAX_SEGMENT_PAYLOAD:
        raise UnsupportedPhoto(
            f"the EXIF block has {len(payload)} bytes",
            f"expected at most {_MAX_SEGMENT_PAYLOAD} bytes for a JPEG",
            "write PNG, TIFF or WebP instead",
        )
    return struct.pack(">BBH", 0xFF, marker, len(payload) + 2) + payload


# --- PNG and WebP chunks


def png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yields the name and the content of each chunk of a PNG before its pixel data."""
    position = 8
    while position + 8 <= len(data) and data[position + 4 : position + 8] != b"IDAT":
        size = int.from_bytes(data[position : position + 4], "big")
        yield data[position + 4 : position + 8], data[position + 8 : position + 8 + size]
        position += 12 + size


def with_png_exif(data: bytes, exif: bytes) -> bytes:
    """Inserts an eXIf chunk into a PNG after its header chunk."""
    position = 8 + 12 + 13  # signature, and the header chunk: 12 bytes and 13 bytes of data
    chunk = b"eXIf" + exif
    sized = struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return b"".join((data[:position], sized, data[position:]))


def webp_chunks(data: bytes) -> dict[bytes, bytes]:
    """Returns the chunks of a WebP by name."""
    found, position = {}, 12
    while position + 8 <= len(data):
        size = int.from_bytes(data[position + 4 : position + 8], "little")
        found[data[position : position + 4]] = data[position + 8 : position + 8 + size]
        position += 8 + size + size % 2
    return found


def with_webp_exif(data: bytes, exif: bytes, size: tuple[int, int], has_alpha: bool) -> bytes:
    """Inserts an EXIF chunk into a WebP, in the extended layout (RFC 9649 2.7). `size` is (width, height)."""
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


def cicp(data: bytes) -> tuple[int, int, int] | None:
    """Returns the code points (CICP, ITU-T H.273) of primaries, transfer function and matrix of an AVIF, HEIC or PNG.
    Returns None for a file without code points."""
    if data.startswith(b"\x89PNG"):
        chunk = dict(png_chunks(data)).get(b"cICP", b"")
        return (chunk[0], chunk[1], chunk[2]) if len(chunk) >= 3 else None
    found = re.search(rb"colrnclx(.{6})", data[: 1 << 16], re.DOTALL)
    return struct.unpack(">3H", found[1]) if found else None


# --- AVIF items (ISO/IEC 14496-12 8.11)


def with_avif_exif(data: bytes, exif: bytes) -> bytes:
    """Replaces the Exif item of an AVIF that libvips has written. The new block is appended to the file, and the
    location of the item is set to this block."""
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
    version, size_fields, index_fields = data[table + 4], data[table + 8], data[table + 9]
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


# --- EXIF and TIFF directories (TIFF 6.0 section 2, CIPA DC-008)

Tags = dict[int, "tuple[int, int, bytes] | Tags"]
"""The tags of a directory by number. An entry is (type, count, little-endian value), or the directory for a pointer tag."""

_POINTER_TAGS = (34665, 34853, 40965)  # Exif, GPS, interoperability
_CAMERA_TAGS = (270, 271, 272, 305, 306, 315, 33432, 34665, 34853)
"""Camera, date, author, copyright, and the pointers to Exif and GPS."""
_ORIENTATION = 274
_BYTE_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_HEADER_BYTES = 8  # byte order, the number 42, and the position of the first directory
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 1, 7: 1, 8: 2, 9: 4, 10: 4, 11: 4, 12: 8, 13: 4}
_RATIONAL_TYPES = (5, 10)  # two numbers: numerator and denominator


def read_tags(data: bytes) -> Tags:
    """Returns the first directory of a TIFF or EXIF block with its subdirectories, or an empty dict for other data."""
    byte_order = _BYTE_ORDERS.get(data[:4])
    if byte_order is None or len(data) < _TIFF_HEADER_BYTES:
        return {}
    return _directory(data, byte_order, struct.unpack_from(byte_order + "I", data, 4)[0], _POINTER_TAGS)


def _directory(data: bytes, byte_order: str, position: int, pointers: tuple[int, ...]) -> Tags:
    if position + 2 > len(data):
        return {}
    (count,) = struct.unpack_from(byte_order + "H", data, position)
    tags: Tags = {}
    for row in range(position + 2, min(position + 2 + 12 * count, len(data) - 11), 12):
        tag, kind, number = struct.unpack_from(byte_order + "HHI", data, row)
        width = _TYPE_BYTES.get(kind, 0)
        size = width * number * (2 if kind in _RATIONAL_TYPES else 1)
        (offset,) = struct.unpack_from(byte_order + "I", data, row + 8)
        start = row + 8 if size <= 4 else offset
        if tag in pointers:
            tags[tag] = _directory(data, byte_order, offset, tuple(p for p in pointers if p != tag))
        elif width and start + size <= len(data):
            value = data[start : start + size]
            if byte_order == ">":
                value = b"".join(value[i : i + width][::-1] for i in range(0, size, width))
            tags[tag] = (kind, number, value)
    return tags


def number_of(tags: Tags, tag: int, default: int) -> int:
    """Returns the first integer of a tag, or the default."""
    return next(iter(numbers(tags, tag)), default)


def pixel_data_end(tags: Tags) -> int:
    """Returns the end position of the last strip or tile of a TIFF, or 0 if its tags contain no positions."""
    parts = ((numbers(tags, starts), numbers(tags, sizes)) for starts, sizes in ((273, 279), (324, 325)))
    return max((start + size for part in parts for start, size in zip(*part, strict=False)), default=0)


def numbers(tags: Tags, tag: int) -> list[int]:
    """Returns the integers of a tag, or an empty list if the tag is missing."""
    entry = tags.get(tag)
    if not isinstance(entry, tuple) or entry[0] not in (1, 3, 4):
        return []
    width = _TYPE_BYTES[entry[0]]
    return [int.from_bytes(entry[2][i : i + width], "little") for i in range(0, len(entry[2]), width)]


def orientation_of(exif: bytes) -> int:
    """Returns the orientation 1..8 of an EXIF block, or 1 if the block has no orientation."""
    orientation = number_of(read_tags(exif.removeprefix(_EXIF_NAME)), _ORIENTATION, 1)
    return orientation if 1 <= orientation <= 8 else 1


def _serialize_directory(tags: Tags, position: int) -> tuple[bytes, int]:
    """Returns the bytes of a directory at `position` in a little-endian file, and the position of its entries."""
    values, rows = b"", b""
    for tag, entry in sorted(tags.items(), key=lambda item: item[0]):
        if isinstance(entry, dict):
            subdirectory, offset = _serialize_directory(entry, position + len(values))
            values, entry = values + subdirectory, (4, 1, struct.pack("<I", offset))  # noqa: PLW2901
        kind, count, value = entry
        if len(value) > 4:
            value_or_offset = struct.pack("<I", position + len(values))
            values += value + bytes(len(value) % 2)
        else:
            value_or_offset = value.ljust(4, b"\0")
        rows += struct.pack("<HHI", tag, kind, count) + value_or_offset
    return values + struct.pack("<H", len(tags)) + rows + bytes(4), position + len(values)


def tiff_exif(tags: Tags) -> bytes | None:
    """Returns an EXIF block with the camera tags of a TIFF, or None if there are no such tags."""
    camera: Tags = {tag: entry for tag, entry in tags.items() if tag in _CAMERA_TAGS}
    if not camera:
        return None
    camera[_ORIENTATION] = (3, 1, b"\x01\0")
    body, first = _serialize_directory(camera, 8)
    return b"II*\0" + struct.pack("<I", first) + body


def with_tiff_exif(data: bytes, exif: bytes) -> bytes:
    """Adds the camera tags of an EXIF block to a little-endian TIFF of one page, in a new directory at the end of the file."""
    tags = read_tags(data)
    tags.update((tag, entry) for tag, entry in read_tags(exif).items() if tag in _CAMERA_TAGS)
    start = len(data) + len(data) % 2
    body, first = _serialize_directory(tags, start)
    return b"".join((data[:4], struct.pack("<I", first), data[8:], bytes(len(data) % 2), body))


def first_directory(exif: bytes) -> tuple[str, int, int]:
    """Returns the byte order of an EXIF block for `struct`, and the start and the end of the rows of its first
    directory. Without a directory, all values are empty or 0."""
    byte_order = _BYTE_ORDERS.get(exif[:4])
    if byte_order is None or len(exif) < 10:
        return "", 0, 0
    (position,) = struct.unpack_from(byte_order + "I", exif, 4)
    (count,) = struct.unpack_from(byte_order + "H", exif, position) if position + 2 <= len(exif) else (0,)
    return byte_order, position + 2, position + 2 + 12 * count


def upright_exif(exif: bytes) -> bytes:
    """Returns an EXIF block with orientation 1 and without the thumbnail. The result begins at the TIFF header. The
    thumbnail shows the input before rotation and separation, so the pointer to its directory is set to 0. All other
    bytes are unchanged."""
    exif = exif.removeprefix(_EXIF_NAME)
    block = bytearray(exif)
    byte_order, first_row, next_directory = first_directory(exif)
    for row in range(first_row, min(next_directory, len(block) - 11), 12):
        tag, kind = struct.unpack_from(byte_order + "HH", block, row)
        if tag == _ORIENTATION:
            kind_format, values = ("I", (1,)) if kind == 4 else ("HH", (1, 0))
            struct.pack_into(byte_order + kind_format, block, row + 8, *values)
    if first_row and next_directory + 4 <= len(block):
        struct.pack_into(byte_order + "I", block, next_directory, 0)
    return bytes(block)


def upright_xmp(xmp: bytes) -> bytes:
    """Returns an XMP block with tiff:Orientation set to 1. All other bytes are unchanged."""
    return re.sub(rb"""(tiff:Orientation(?:=["']|>))[1-8]""", rb"\g<1>1", xmp)
