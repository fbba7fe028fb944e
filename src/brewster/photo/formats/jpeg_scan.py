"""Finds damage in the compressed pixels of a JPEG (ITU-T T.81).

libvips reads missing rows of a JPEG as grey without an error, because libjpeg only warns about
them, and it warns about many readable files, too. The Huffman codes of a scan soon make sense again
after damage, but shifted by some blocks: the only sign of it is that data are missing or left after
the last row, and these are not read by default.
"""

import re
from typing import NamedTuple

import pyvips

from brewster.photo.blocks.jpeg_segments import FRAMES, START_OF_SCAN, jpeg_segments

_HUFFMAN_TABLES = 0xC4
_AC = 0x10
"""The class of a table for the coefficients other than the first one of a block."""
_END_OF_BLOCK = 0
_PROGRESSIVE = (0xC2, 0xC6, 0xCA, 0xCE)
_END = b"\xff\xd9"
_ENTROPY_CODED_END = re.compile(rb"\xff[^\0\xff\xd0-\xd7]")
"""The next marker after the data of a scan, which have stuffed zeros and restart markers."""
_MARKER = re.compile(rb"\xff[^\0\xff]")
_BLOCK_PX = 8
_HARMLESS = re.compile(
    "unknown JFIF revision|Unknown Adobe color transform|bad ICC marker|Invalid SOS parameters"
    "|Inconsistent progression"
)
"""The warnings of libjpeg that name another variant of the format, not damage."""
_EXTRANEOUS = re.compile(r"(\d+) extraneous bytes before marker 0x(\w\w)")
_MAX_PADDING = 4096
"""The zeros that an encoder may write after the last scan, as an encoder with a buffer of fixed
size does. In bytes.
"""
_MAX_EXTRA = 2
"""Other bytes that an encoder may write after the last scan."""
_BUFFER_BYTES = 8
"""What libjpeg may have read of the bytes after the last scan."""
_HOLE = bytes(32)
"""More zeros than a scan contains, except one of flat areas."""


class Scans(NamedTuple):
    """The scans of the first image in a JPEG file."""

    frame: int
    """The position of the payload of the frame header, or 0."""
    start: int
    """The position of the data of the last scan, behind its header."""
    end: int
    """The position of the end marker, or the end of the file."""
    has_end_marker: bool
    is_single: bool
    """Whether libjpeg decodes while it reads: the image is not progressive, and has one scan."""
    has_all: bool
    """Whether a progressive image has all bits of its coefficients."""


def read_scans(data: bytes) -> Scans:
    """Returns the scans of the first image in a JPEG file."""
    frame = start = count = 0
    is_progressive = False
    coarse: dict[tuple[int, int], int] = {}
    position = 2
    has_end_marker = False
    while found := _MARKER.search(data, position):
        marker = data[found.end() - 1]
        position = found.end()
        if marker == _END[1]:
            has_end_marker = True
            break
        if marker in range(0xD0, 0xD9):  # a restart or start marker has no segment
            continue
        payload = position + 2
        position += int.from_bytes(data[position:payload], "big")
        if marker in FRAMES and not frame:
            frame = payload
            is_progressive = marker in _PROGRESSIVE
            components = data[payload + 6 : payload + 6 + 3 * data[payload + 5] : 3]
            coarse = {(name, k): 1 for name in components for k in range(64)}
        if marker == START_OF_SCAN:
            count += 1
            start = position
            names = data[payload + 1 : payload + 1 + 2 * data[payload] : 2]
            first, last, approximation = data[position - 3 : position]
            for name in names:
                for k in range(first, min(last, 63) + 1):
                    coarse[name, k] = approximation & 15
            following = _ENTROPY_CODED_END.search(data, position)
            position = following.start() if following else len(data)
    end = found.start() if has_end_marker and found else len(data)
    is_single = not is_progressive and count == 1
    has_all = not is_progressive or not any(coarse.values())
    return Scans(frame, start, end, has_end_marker, is_single, has_all)


def with_end_marker(data: bytes) -> tuple[bytes, list[str]]:
    """Returns a JPEG with an end marker, and notes on what is missing in the file. libjpeg then
    reports a scan that is not complete, and does not report an end marker that is missing.
    """
    scans = read_scans(data)
    if not scans.start:
        return data, []
    if scans.has_end_marker:
        is_coarse = not scans.has_all
        return data, ["its last scans are missing, so fine detail is coarse"] if is_coarse else []
    # A download that was not finished can have zeros at its end
    if not scans.has_all or data.endswith(_HOLE):
        return data, []
    return data + _END, ["its end marker is missing, and all of its pixels are there"]


def is_damaged(data: bytes) -> bool:
    """Returns whether the pixels of a JPEG are damaged, as far as its scans show it."""
    scans = read_scans(data)
    if not scans.frame:
        return False
    warning = _warning(data, scans)
    if count := _bytes_left(warning):
        padding = data[scans.end - count : scans.end]
        if count > _MAX_EXTRA and (any(padding) or count > _MAX_PADDING):
            return True
        scans = scans._replace(end=scans.end - count)
        warning = _warning(data, scans)
        if _bytes_left(warning) <= _BUFFER_BYTES:
            warning = ""
    return not _is_harmless(warning, data) or _has_hole(data, scans)


def _bytes_left(warning: str) -> int:
    """Returns the number of bytes before the end marker that libjpeg does not read."""
    found = _EXTRANEOUS.search(warning)
    return int(found[1]) if found and int(found[2], 16) == _END[1] else 0


def _is_harmless(warning: str, data: bytes) -> bool:
    """Returns whether libjpeg gives no warning, or one about a file whose pixels are complete."""
    if found := _EXTRANEOUS.search(warning):
        marker = int(found[2], 16)
        has_gap = all(number != START_OF_SCAN for number, _, _ in jpeg_segments(data))
        return has_gap or marker in FRAMES or marker > START_OF_SCAN
    return not warning or _HARMLESS.search(warning) is not None


def _warning(data: bytes, scans: Scans) -> str:
    """Returns the first warning of libjpeg if it reads all scans of a JPEG, or an empty text.

    It reads a single scan only up to the last row, and libvips does not see the warnings about the
    last rows. Therefore a component without a scan is added here: libjpeg then looks for its scan
    up to the end marker before it returns the first row. This takes half of the time of
    `Photo.open`, because only some rows are computed.
    """
    data = data[: scans.end] + _END
    if scans.is_single:
        frame = scans.frame
        count = data[frame + 5]
        end = frame + 6 + 3 * count
        used = data[frame + 6 : end : 3]
        added = 2 if count == 1 else 1  # libvips reads no image of two components
        names = [name for name in range(256) if name not in used][:added]
        rows = b"".join(bytes((name, 0x11, data[frame + 8])) for name in names)
        size = int.from_bytes(data[frame - 2 : frame], "big") + len(rows)
        head = data[: frame - 2] + size.to_bytes(2, "big") + data[frame : frame + 5]
        data = b"".join((head, bytes((count + added,)), data[frame + 6 : end], rows, data[end:]))
    try:
        image = pyvips.Image.jpegload_buffer(data, access="sequential", fail_on="warning")
        image.crop(0, 0, image.width, min(_BLOCK_PX, image.height)).write_to_memory()
    except pyvips.Error as error:
        return str(error)
    return ""


def _has_hole(data: bytes, scans: Scans) -> bool:
    """Returns whether a single scan contains zeros that would be a block of 63 equal coefficients.

    The first symbol of a table has the code of zeros only. If it is the end of a block, as it can
    be in images with flat areas, zeros are flat blocks.
    """
    if not scans.is_single or data.find(_HOLE, scans.start, scans.end) < 0:
        return False
    components = data[scans.start - 3 - 2 * data[scans.frame + 5] : scans.start - 3]
    first_symbols = dict[int, int]()
    for marker, _, payload in jpeg_segments(data):
        while marker == _HUFFMAN_TABLES and len(payload) > 17:
            first_symbols[payload[0]] = payload[17]
            payload = payload[17 + sum(payload[1:17]) :]  # noqa: PLW2901
    table = _AC | components[1] & 15
    return first_symbols.get(table, _END_OF_BLOCK) != _END_OF_BLOCK
