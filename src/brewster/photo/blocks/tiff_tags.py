"""Reads and writes EXIF blocks and the directories of TIFF and BigTIFF files (TIFF 6.0 section 2,
CIPA DC-008).

libvips writes EXIF with libexif, which drops unknown tags, and libvips ignores EXIF in TIFF files.
This module copies the EXIF block of the source with all its tags; only the orientation, the size
and the thumbnail change. A block begins at its TIFF header, without the "Exif\\0\\0" of JPEG.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from mmap import mmap
from typing import Final, NamedTuple

from brewster.errors import UnsupportedPhoto

Tags = dict[int, "tuple[int, int, bytes] | Tags"]
"""The tags of a directory by number. An entry is (type, count, little-endian value), or the
directory of a pointer.
"""

EXIF_NAME: Final = b"Exif\0\0"
ORIENTATION: Final = 274
_SUBFILE_TYPE = 254
_OLD_SUBFILE_TYPE = 255
_COMPRESSION = 259
_PHOTOMETRIC = 262
_SUB_DIRECTORIES = 330
EXIF_POINTER: Final = 34665
_INTEROPERABILITY_POINTER = 40965
_POINTER_TAGS = (EXIF_POINTER, 34853, _INTEROPERABILITY_POINTER)  # Exif, GPS, interoperability
_IMAGE_TAGS: Final = frozenset(
    (
        *(
            *range(254, 267),
            273,
            *range(277, 285),
            *range(288, 294),
            296,
            297,
            301,
            *range(317, 348),
            351,
        ),
        *(*range(512, 533), 700, 33421, 33422, 33723, 34377, 34675, 37724),
        *(*range(50706, 51200), *range(52525, 52600)),  # DNG
    )
)
"""The tags that describe how the pixels of this file are stored, and those that are written from
other fields of a `FileInfo`. All others are those of the camera or of its user, and are kept.
"""
_SIZE_TAGS: Final = {256: 0, 257: 1, 4097: 0, 4098: 1, 40962: 0, 40963: 1}
"""Tags with the width (0) or the height (1) of the image."""
_TYPE_BYTES = {
    **dict.fromkeys((1, 2, 6, 7, 129), 1),  # 129: UTF-8 (EXIF 3.0)
    **dict.fromkeys((3, 8), 2),
    **dict.fromkeys((4, 5, 9, 10, 11, 13), 4),
    **dict.fromkeys((12, 16, 17, 18), 8),
}
"""The bytes of a number of each type; of a rational, those of its numerator."""
_RATIONAL_TYPES = (5, 10)  # two numbers: numerator and denominator
_CLASSIC_TYPES = {16: 4, 17: 9, 18: 13}
"""The types of BigTIFF with 8 bytes, and the types with 4 bytes that replace them."""
COMPRESSION_NAMES: Final = {
    6: "old JPEG",
    34712: "JPEG 2000",
    33003: "JPEG 2000",
    33005: "JPEG 2000",
    34887: "LERC",
    34925: "LZMA",
    50001: "WebP",
    **dict.fromkeys((50002, 52546), "JPEG XL"),
}
"""The names of compressions that brewster may not read."""


class _Layout(NamedTuple):
    """How numbers are stored: by the formats of `struct`."""

    byte_order: str
    count_format: str
    offset_format: str


_LAYOUTS: Final = {
    b"II*\0": (_Layout("<", "H", "I"), 4),
    b"MM\0*": (_Layout(">", "H", "I"), 4),
    b"II+\0": (_Layout("<", "Q", "Q"), 8),
    b"MM\0+": (_Layout(">", "Q", "Q"), 8),
}
"""The layout by the first bytes of a file, and where the position of the first directory is."""


def read_directories(data: bytes | mmap) -> Iterator[Tags]:
    """Yields the directories of a TIFF, BigTIFF or EXIF block with their subdirectories; nothing
    for other data.
    """
    layout, start = _LAYOUTS.get(data[:4], (None, 0))
    if layout is None or len(data) < 2 * start:
        return
    (position,) = struct.unpack_from(layout.byte_order + layout.offset_format, data, start)
    visited = {0}
    while position not in visited:
        visited.add(position)
        tags, position = _directory(data, layout, position, _POINTER_TAGS)
        yield tags


def read_tags(data: bytes | mmap) -> Tags:
    """Returns the first directory of a TIFF or EXIF block with its subdirectories, or an empty dict
    for other data.
    """
    return next(read_directories(data), {})


def sub_directories(data: bytes, tags: Tags) -> list[Tags]:
    """Returns the directories to which the tag SubIFDs of a directory points."""
    layout, _ = _LAYOUTS[data[:4]]
    return [
        _directory(data, layout, at, _POINTER_TAGS)[0] for at in numbers(tags, _SUB_DIRECTORIES)
    ]


def _directory(
    data: bytes | mmap, layout: _Layout, position: int, pointers: tuple[int, ...]
) -> tuple[Tags, int]:
    """Returns the tags of a directory, and the position of the next one, or 0 if there is none."""
    order = layout.byte_order
    offset_bytes = struct.calcsize(layout.offset_format)
    first = position + struct.calcsize(layout.count_format)
    if first > len(data):
        return {}, 0
    (count,) = struct.unpack_from(order + layout.count_format, data, position)
    row_bytes = 4 + 2 * offset_bytes
    tags = Tags()
    end = first + row_bytes * min(count, 0xFFFF)
    for row in range(first, min(end, len(data) - row_bytes + 1), row_bytes):
        tag, kind, number, offset = struct.unpack_from(
            f"{order}HH2{layout.offset_format}", data, row
        )
        width = _TYPE_BYTES.get(kind, 0)
        size = width * number * (2 if kind in _RATIONAL_TYPES else 1)
        start = row + 4 + offset_bytes if size <= offset_bytes else offset
        if not width or start + size > len(data):
            continue
        value = data[start : start + size]
        if order == ">":
            value = b"".join(value[i : i + width][::-1] for i in range(0, size, width))
        if tag in pointers:
            at = int.from_bytes(value[:width], "little")
            others = tuple(p for p in pointers if p != tag)
            tags[tag], _ = _directory(data, layout, at, others)
        else:
            tags[tag] = (kind, number, value)
    has_next = end + offset_bytes <= len(data)
    return tags, struct.unpack_from(order + layout.offset_format, data, end)[0] if has_next else 0


def number_of(tags: Tags, tag: int, default: int) -> int:
    """Returns the first integer of a tag, or the default."""
    return next(iter(numbers(tags, tag)), default)


def numbers(tags: Tags, tag: int) -> list[int]:
    """Returns the integers of a tag, or an empty list if the tag is missing."""
    entry = tags.get(tag)
    if not isinstance(entry, tuple) or entry[0] not in (1, 3, 4, 13, 16, 18):
        return []
    width = _TYPE_BYTES[entry[0]]
    return [
        int.from_bytes(entry[2][i : i + width], "little") for i in range(0, len(entry[2]), width)
    ]


def rationals(tags: Tags, tag: int) -> list[float]:
    """Returns the numbers of a tag of integers or fractions, or an empty list if the tag is missing
    or invalid.
    """
    entry = tags.get(tag)
    if not isinstance(entry, tuple) or entry[0] not in _RATIONAL_TYPES:
        return [*map(float, numbers(tags, tag))]
    parts = struct.unpack(f"<{2 * entry[1]}{'I' if entry[0] == 5 else 'i'}", entry[2])
    return (
        [top / bottom for top, bottom in zip(parts[::2], parts[1::2], strict=True)]
        if all(parts[1::2])
        else []
    )


def value_of(tags: Tags, tag: int) -> bytes | None:
    """Returns the bytes of a tag, or None if the tag is missing."""
    entry = tags.get(tag)
    return entry[2] if isinstance(entry, tuple) else None


class Page(NamedTuple):
    """An image in full resolution."""

    options: Mapping[str, int]
    """The arguments of the libvips loader."""
    tags: Tags
    """The tags of its directory, and those of the camera in the first directory."""


def full_pages(data: bytes) -> list[Page]:
    """Returns the images of a TIFF in full resolution. Others are reduced: thumbnails (of scanners,
    before or after the image) and the levels of pyramids. A first directory with a thumbnail may
    have the full image in a subdirectory.
    """
    pages: list[Page] = []
    first: Tags = {}
    for number, tags in enumerate(read_directories(data)):
        first = first or tags
        camera = {
            tag: entry
            for tag, entry in first.items()
            if tag not in _IMAGE_TAGS or tag in (700, 33723, 34377)
        }
        if not _is_reduced(tags):
            pages.append(Page({"page": number}, camera | tags))
        elif number == 0:
            pages += [
                Page({"page": 0, "subifd": index}, camera | sub)
                for index, sub in enumerate(sub_directories(data, tags))
                if not _is_reduced(sub)
            ]
    return pages


def is_raw(data: bytes) -> bool:
    """Returns whether a TIFF is a RAW file. A DNG has the tag DNGVersion (50706). Other RAW files
    have the data of the sensor (a colour filter array, or linear RAW), or reduced images only.
    """
    tags = read_tags(data)
    images = (*read_directories(data), *sub_directories(data, tags)) if tags else ()
    has_sensor_data = any(number_of(image, _PHOTOMETRIC, 0) in (32803, 34892) for image in images)
    return bool(images) and (50706 in tags or has_sensor_data or not full_pages(data))


def compressions(data: bytes) -> set[int]:
    """Returns the compression codes of all images of a TIFF in full resolution; an empty set for
    other data.
    """
    return {number_of(page.tags, _COMPRESSION, 1) for page in full_pages(data)}


def default_crop(data: bytes) -> tuple[int, int, int, int] | None:
    """Returns the default crop of a DNG, (left, top, width, height) within its active area, or
    None.
    """
    for page in full_pages(data):
        origin = rationals(page.tags, 50719)
        size = rationals(page.tags, 50720)
        if len(origin) == len(size) == 2:
            left, top, width, height = map(round, (*origin, *size))
            return left, top, width, height
    return None


def _is_reduced(tags: Tags) -> bool:
    """EXIF thumbnails (JPEG, compression 6) have no tag for it."""
    is_marked = number_of(tags, _SUBFILE_TYPE, 0) & 1 or number_of(tags, _OLD_SUBFILE_TYPE, 1) == 2
    return bool(is_marked) or (number_of(tags, _COMPRESSION, 1) == 6 and 513 in tags)


_SAMPLE_KINDS = {
    1: "unsigned integers",
    2: "signed integers",
    3: "floats",
    5: "complex integers",
    6: "complex floats",
}
_SUPPORTED_SAMPLES = {(1, 1), (1, 2), (1, 4), (1, 8), (4, 8), (1, 16), (3, 16), (3, 32)}
"""The kinds and bits of samples; kind 4 is unspecified."""
_COLOUR_NAMES = {8: "CIELAB", 9: "ICCLAB", 10: "ITULAB", 32844: "LogL", 32845: "LogLuv"}


def check_pixels(tags: Tags) -> None:
    """Raises UnsupportedPhoto for pixels that libvips reads with an error, or with other values."""
    bits, kind, colours = (
        number_of(tags, *pair) for pair in ((258, 1), (339, 1), (_PHOTOMETRIC, 2))
    )
    if (kind, bits) in _SUPPORTED_SAMPLES and colours <= 6:
        return
    found = f"{bits}-bit {_SAMPLE_KINDS.get(kind, 'values of another kind')}"
    if colours > 6:
        found = f"{_COLOUR_NAMES.get(colours, f'other ({colours})')} colours"
    raise UnsupportedPhoto(
        f"the tiff has {found}",
        "expected grey, RGB or CMYK of 8- or 16-bit integers or 32-bit floats",
        "convert the image to one of these",
    )


def has_all_pixels(tags: Tags, size: int) -> bool:
    """Returns whether all strips or tiles of a TIFF are within a file of `size` bytes."""
    parts = (
        (numbers(tags, starts), numbers(tags, sizes)) for starts, sizes in ((273, 279), (324, 325))
    )
    return all(
        0 < start <= size - length for part in parts for start, length in zip(*part, strict=False)
    )


def orientation_of(exif: bytes) -> int:
    """Returns the orientation 1..8 of an EXIF block, or 1 if the block has no orientation."""
    orientation = number_of(read_tags(exif.removeprefix(EXIF_NAME)), ORIENTATION, 1)
    return orientation if 1 <= orientation <= 8 else 1


def _serialised_directory(tags: Tags, position: int) -> tuple[bytes, int]:
    """Returns the bytes of a directory at `position` in a little-endian file, and the position of
    its entries.
    """
    values = b""
    rows = b""
    for tag, entry in sorted(tags.items(), key=lambda item: item[0]):
        if isinstance(entry, dict):
            subdirectory, offset = _serialised_directory(entry, position + len(values))
            values = values + subdirectory
            entry = (4, 1, struct.pack("<I", offset))  # noqa: PLW2901
        kind, count, value = entry
        if kind in _CLASSIC_TYPES:
            kind = _CLASSIC_TYPES[kind]
            value = b"".join(value[i : i + 4] for i in range(0, len(value), 8))
        if len(value) > 4:
            value_or_offset = struct.pack("<I", position + len(values))
            values += value + bytes(len(value) % 2)
        else:
            value_or_offset = value.ljust(4, b"\0")
        rows += struct.pack("<HHI", tag, kind, count) + value_or_offset
    return values + struct.pack("<H", len(tags)) + rows + bytes(4), position + len(values)


def camera_tags(tags: Tags) -> Tags:
    """Returns the tags of a directory that do not describe how its pixels are stored."""
    return {
        tag: entry
        for tag, entry in tags.items()
        if tag not in (*_IMAGE_TAGS, ORIENTATION) and entry
    }


MAKER_NOTE: Final = 37500
_MOVABLE_NOTES: Final = re.compile(rb"Nikon\0\x02|OLYMPUS\0|OM SYSTEM\0|FUJIFILM|Apple iOS\0")
"""The maker notes whose positions count from their own start. In all others, such as those of
Canon, they count from the start of the file, and the byte order is that of the file.
"""


def has_fixed_maker_note(tags: Tags) -> bool:
    """Returns whether the maker note of a TIFF or EXIF block is readable only at its position."""
    exif = tags.get(EXIF_POINTER)
    note = value_of(exif if isinstance(exif, dict) else tags, MAKER_NOTE)
    return note is not None and not _MOVABLE_NOTES.match(note)


def without_fixed_maker_note(tags: Tags) -> Tags:
    """Returns the tags that can be written to another position."""
    exif = tags.get(EXIF_POINTER)
    if not has_fixed_maker_note(tags) or not isinstance(exif, dict):
        return tags
    return tags | {EXIF_POINTER: {tag: exif[tag] for tag in exif if tag != MAKER_NOTE}}


def tiff_exif(tags: Tags) -> bytes | None:
    """Returns an EXIF block with the camera tags of a TIFF, or None if there are no such tags."""
    camera = without_fixed_maker_note(camera_tags(tags))
    if not camera:
        return None
    body, first = _serialised_directory(camera | {ORIENTATION: (3, 1, b"\x01\0")}, 8)
    return b"II*\0" + struct.pack("<I", first) + body


def with_tags(data: bytes, added: Tags) -> bytes:
    """Adds tags to a little-endian TIFF of one page, in a new directory at the end of the file."""
    start = len(data) + len(data) % 2
    body, first = _serialised_directory(read_tags(data) | added, start)
    return b"".join((data[:4], struct.pack("<I", first), data[8:], bytes(len(data) % 2), body))


def first_directory(exif: bytes | bytearray, position: int | None = None) -> tuple[str, int, int]:
    """Returns the byte order of an EXIF block for `struct`, and the start and the end of the rows
    of its first directory, or of the directory at `position`. Without a directory, all values are
    empty or 0.
    """
    layout, start = _LAYOUTS.get(bytes(exif[:4]), (None, 0))
    if layout is None or start != 4 or len(exif) < 10:
        return "", 0, 0
    order = layout.byte_order
    if position is None:
        (position,) = struct.unpack_from(order + "I", exif, 4)
    (count,) = (
        struct.unpack_from(order + "H", exif, position) if position + 2 <= len(exif) else (0,)
    )
    return order, position + 2, position + 2 + 12 * count


def upright_exif(exif: bytes, size: tuple[int, int]) -> bytes:
    """Returns an EXIF block for the upright image of this (width, height): with orientation 1, with
    this size, and without the thumbnail. The result begins at the TIFF header. The thumbnail shows
    the input before rotation and separation, so the pointer to its directory is set to 0. All other
    bytes are unchanged.
    """
    block = bytearray(exif.removeprefix(EXIF_NAME))
    order, first_row, next_directory = first_directory(block)
    pending = [(first_row, next_directory)]
    for start, end in pending:
        for row in range(start, min(end, len(block) - 11), 12):
            tag, kind, _, value = struct.unpack_from(order + "HHII", block, row)
            if tag in (EXIF_POINTER, _INTEROPERABILITY_POINTER) and len(pending) < 3:
                pending.append(first_directory(block, value)[1:])
            elif tag == ORIENTATION or tag in _SIZE_TAGS:
                number = 1 if tag == ORIENTATION else size[_SIZE_TAGS[tag]]
                kind_format, values = (
                    ("I", (number,)) if kind == 4 else ("HH", (min(number, 0xFFFF), 0))
                )
                struct.pack_into(order + kind_format, block, row + 8, *values)
    if first_row and next_directory + 4 <= len(block):
        struct.pack_into(order + "I", block, next_directory, 0)
    return bytes(block)
