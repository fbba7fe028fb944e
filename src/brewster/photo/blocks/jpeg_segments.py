"""Walks the segments of a JPEG before its compressed pixels (ITU-T T.81 annex B)."""

from collections.abc import Iterator
from mmap import mmap
from typing import BinaryIO, Final, NamedTuple

from brewster.photo.blocks.iso_boxes import read_at

APP1: Final = 0xE1
"""The marker of EXIF and XMP."""
START_OF_SCAN: Final = 0xDA
FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""The markers of frame headers."""
XMP_NAME: Final = b"http://ns.adobe.com/xap/1.0/\0"
"""What a segment with an XMP packet begins with."""
_FILL: Final = 0xFF
_MAX_SEGMENTS: Final = 4096
"""The most segments that are walked, of a damaged file."""


class JpegSegment(NamedTuple):
    """A segment, with its marker."""

    marker: int
    start: int
    """The position of its marker in the file."""
    payload: bytes
    """What follows its size."""


def jpeg_segments(source: bytes | mmap | BinaryIO) -> Iterator[JpegSegment]:
    """Yields the segments of a JPEG up to the header of its first scan.

    Args:
        source: the content of the file, or the file, of which only the segments are read.
    """

    def read(start: int, size: int) -> bytes:
        if isinstance(source, bytes | mmap):
            return source[start : start + max(size, 0)]
        return read_at(source, start, size)

    position = 2
    for _ in range(_MAX_SEGMENTS):
        header = read(position, 4)
        if len(header) < 4 or header[0] != _FILL:
            return
        marker = header[1]
        if marker == _FILL:
            position += 1
            continue
        size = int.from_bytes(header[2:], "big")
        yield JpegSegment(marker, position, read(position + 4, size - 2))
        if marker == START_OF_SCAN:
            return
        position += 2 + size
