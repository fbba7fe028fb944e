"""Reads how much of each frame a player hides: the clean aperture of MP4 and QuickTime (`clap`,
ISO/IEC 14496-12, 12.1.4), and PixelCrop of Matroska (RFC 9559, 5.1.4.1.28).

FFmpeg reads them, too, but PyAV offers neither the values nor the cropped frames.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, final

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
    whole = (0, file.seek(0, 2))
    for track in _boxes_at(file, whole, b"moov", b"trak"):
        if not any(
            _track_id(file, header) == track_id for header in _boxes_at(file, track, b"tkhd")
        ):
            continue
        for table in _boxes_at(file, track, b"mdia", b"minf", b"stbl", b"stsd"):
            for _, entry in _boxes(file, (table[0] + 8, table[1])):
                inner = (entry[0] + _SAMPLE_ENTRY_BYTES, entry[1])
                for aperture in _boxes_at(file, inner, b"clap"):
                    return _crop(_read(file, aperture), size)
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


def _crop(content: bytes, size: tuple[int, int]) -> Crop | None:
    """Returns the border around a clean aperture: its width, height and the offsets of its centre
    are fractions.
    """
    if len(content) < 32:
        return None
    numbers = struct.unpack(">8i", content[:32])
    if not all(denominator > 0 for denominator in numbers[1::2]):
        return None
    width, height, x, y = (a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True))
    left = round((size[0] - width) / 2 + x)
    top = round((size[1] - height) / 2 + y)
    return _checked(
        Crop(left, top, size[0] - round(width) - left, size[1] - round(height) - top), size
    )


def _checked(crop: Crop, size: tuple[int, int]) -> Crop | None:
    """Returns None if nothing is hidden, or if the values are impossible."""
    borders = (crop.left, crop.top, crop.right, crop.bottom)
    is_possible = (
        min(borders) >= 0 and crop.left + crop.right < size[0] and crop.top + crop.bottom < size[1]
    )
    return crop if is_possible and any(borders) else None


def _boxes_at(file: BinaryIO, span: Span, *path: bytes) -> Iterator[Span]:
    """Yields the content of the boxes at a path."""
    for kind, content in _boxes(file, span):
        if kind == path[0]:
            if len(path) == 1:
                yield content
            else:
                yield from _boxes_at(file, content, *path[1:])


def _boxes(file: BinaryIO, span: Span) -> Iterator[tuple[bytes, Span]]:
    """Yields the kind and the content of each box, up to a damaged one."""
    begin, end = span
    while begin + 8 <= end:
        file.seek(begin)
        length, kind = struct.unpack(">I4s", file.read(8).ljust(8, b"\0"))
        header = 8
        if length == 1:
            length = int.from_bytes(file.read(8), "big")
            header = 16
        elif length == 0:  # the last box
            length = end - begin
        if length < header or begin + length > end:
            return
        yield kind, (begin + header, begin + length)
        begin += length


def _track_id(file: BinaryIO, header: Span) -> int:
    content = _read(file, header)
    place = 20 if content[:1] == b"\1" else 12
    return int.from_bytes(content[place : place + 4], "big")


def _elements(file: BinaryIO, span: Span) -> Iterator[tuple[int, Span]]:
    """Yields the number and the content of each EBML element, up to a damaged one or the first
    cluster, which contains frames.
    """
    begin, end = span
    while begin < end:
        file.seek(begin)
        head = file.read(12)
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
    return int.from_bytes(_read(file, span), "big")


def _read(file: BinaryIO, span: Span) -> bytes:
    file.seek(span[0])
    return file.read(min(span[1] - span[0], 128))
