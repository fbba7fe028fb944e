"""Reads how much of each frame a player hides: the clean aperture of MP4 and QuickTime (`clap`,
ISO/IEC 14496-12, 12.1.4), and PixelCrop of Matroska (RFC 9559, 5.1.4.1.28).

FFmpeg reads them, too, but PyAV offers neither the values nor the cropped frames.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, final

from brewster.photo.blocks.iso_boxes import Box, boxes, child, content, number_after_times, read_at

_TABLE_HEADER_BYTES: Final = 8
_SAMPLE_ENTRY_BYTES: Final = 78
"""The length of the fields of a visual sample entry, before its boxes."""
_SEGMENT: Final = 0x18538067
_CLUSTER: Final = 0x1F43B675
_TRACKS: Final = 0x1654AE6B
_TRACK_ENTRY: Final = 0xAE
_TRACK_TYPE: Final = 0x83
_IS_VIDEO: Final = 1
_VIDEO: Final = 0xE0
_PIXEL_CROP: Final = 0x54CC, 0x54BB, 0x54DD, 0x54AA
"""The elements for left, top, right and bottom."""

Span = tuple[int, int]
"""The first byte of the content of an element, and the byte after its last one."""


@final
@dataclass(frozen=True)
class Crop:
    """The hidden border of the stored frames, in pixels."""

    left: int
    top: int
    right: int
    bottom: int


def clean_aperture(file: BinaryIO, track_id: int, size: tuple[int, int]) -> Crop | None:
    """Returns the hidden border of a track of an MP4 or QuickTime file, or None.

    Args:
        file: the file, which can be sought.
        track_id: the number of the track in its header.
        size: width and height of the stored frames.
    """
    movie = next((box for box in boxes(file, 0, file.seek(0, 2)) if box.kind == b"moov"), None)
    inside = boxes(file, movie.content, movie.end) if movie else ()
    for track in (box for box in inside if box.kind == b"trak"):
        if number_after_times(content(file, child(file, track, b"tkhd"))) == track_id:
            table = child(file, track, b"mdia", b"minf", b"stbl", b"stsd")
            return _aperture(file, table, size) if table else None
    return None


def pixel_crop(file: BinaryIO, video_index: int, size: tuple[int, int]) -> Crop | None:
    """Returns the hidden border of a video track of a Matroska file, or None.

    Args:
        file: the file, which can be sought.
        video_index: counts the video tracks, from 0.
        size: width and height of the stored frames.
    """
    whole = (0, file.seek(0, 2))
    entries = [
        dict(_elements(file, entry))
        for identifier, segment in _elements(file, whole)
        if identifier == _SEGMENT
        for identifier, tracks in _elements(file, segment)
        if identifier == _TRACKS
        for identifier, entry in _elements(file, tracks)
        if identifier == _TRACK_ENTRY
    ]
    videos = [
        entry
        for entry in entries
        if _TRACK_TYPE in entry and _number(file, entry[_TRACK_TYPE]) == _IS_VIDEO
    ]
    if video_index >= len(videos) or _VIDEO not in videos[video_index]:
        return None
    video = dict(_elements(file, videos[video_index][_VIDEO]))
    borders = [_number(file, video[side]) if side in video else 0 for side in _PIXEL_CROP]
    return _checked(Crop(*borders), size)


def _aperture(file: BinaryIO, table: Box, size: tuple[int, int]) -> Crop | None:
    """Returns the border around the clean aperture in a table of sample descriptions. Its width,
    its height and the offsets of its centre are fractions.
    """
    entry = next(boxes(file, table.content + _TABLE_HEADER_BYTES, table.end), None)
    if entry is None:
        return None
    inside = boxes(file, entry.content + _SAMPLE_ENTRY_BYTES, entry.end)
    fractions = content(file, next((box for box in inside if box.kind == b"clap"), None))
    if len(fractions) < 32:
        return None
    numbers = struct.unpack_from(">8i", fractions)
    if not all(denominator > 0 for denominator in numbers[1::2]):
        return None
    width, height, x, y = (a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True))
    left = round((size[0] - width) / 2 + x)
    top = round((size[1] - height) / 2 + y)
    right = size[0] - round(width) - left
    bottom = size[1] - round(height) - top
    return _checked(Crop(left, top, right, bottom), size)


def _checked(crop: Crop, size: tuple[int, int]) -> Crop | None:
    """Returns None if nothing is hidden, or if the values are impossible."""
    borders = (crop.left, crop.top, crop.right, crop.bottom)
    is_possible = (
        min(borders) >= 0 and crop.left + crop.right < size[0] and crop.top + crop.bottom < size[1]
    )
    return crop if is_possible and any(borders) else None


def _elements(file: BinaryIO, span: Span) -> Iterator[tuple[int, Span]]:
    """Yields the number and the content of each EBML element, up to a damaged one or the first
    cluster, which contains frames.
    """
    begin, end = span
    while begin < end:
        head = read_at(file, begin, 12)
        identifier_bytes = _length_of_number(head[:1])
        length_bytes = _length_of_number(head[identifier_bytes : identifier_bytes + 1])
        header = identifier_bytes + length_bytes
        if not identifier_bytes or not length_bytes or len(head) < header:
            return
        identifier = int.from_bytes(head[:identifier_bytes], "big")
        # Without its marker, which is the first bit that is set
        unknown = (1 << 7 * length_bytes) - 1
        length = int.from_bytes(head[identifier_bytes:header], "big") & unknown
        content_end = end if length == unknown else begin + header + length
        if identifier == _CLUSTER:
            return
        yield identifier, (begin + header, min(content_end, end))
        begin = content_end


def _length_of_number(first: bytes) -> int:
    """Returns how many bytes a variable-length number of EBML has, or 0 for none."""
    return 9 - first[0].bit_length() if first and first[0] else 0


def _number(file: BinaryIO, span: Span) -> int:
    return int.from_bytes(read_at(file, span[0], min(span[1] - span[0], 8)), "big")
