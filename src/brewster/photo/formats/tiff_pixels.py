"""Finds damage in the compressed strips and tiles of a TIFF (TIFF 6.0, sections 9, 13 and 22).

libtiff stops as soon as the rows of a strip or tile are filled. It compares no checksum, and does
not notice data that are too long. Here, all of the data are decompressed, and only their size
counts.
"""

import zlib
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brewster.photo.blocks.tiff_tags import Tags, number_of, numbers, value_of
from brewster.photo.formats import jpeg_scan


class _Part(NamedTuple):
    """A strip or a tile."""

    data: bytes
    sizes: tuple[int, int]
    """Its size in bytes without compression: that of its rows in the image, and that of all its
    rows. Some programs fill up the last strip.
    """


def is_damaged(data: bytes, tags: Tags) -> bool:
    """Returns whether a strip or tile of a TIFF is damaged, as far as its compression shows it."""
    compression = number_of(tags, 259, 1)
    if number_of(tags, 266, 1) != 1:  # the bits are in reversed order, which is very rare
        return False
    if compression == 7:
        tables = value_of(tags, 347) or b""
        streams = (
            tables[:-2] + part.data[2:] if tables else part.data for part in _parts(data, tags)
        )
        return any(map(jpeg_scan.is_damaged, streams))
    size_of = _SIZES.get(compression)
    if size_of is None or number_of(tags, 262, 2) == 6:  # subsampled YCbCr has other sizes
        return False
    fits = list[bool]()
    for part in _parts(data, tags):
        size = size_of(part.data)
        if size is None:
            return True
        fits.append(size in part.sizes)
    # If no part has the expected size, this is the way in which a program writes its files
    return not all(fits) and (any(fits) or len(fits) == 1)


def _parts(data: bytes, tags: Tags) -> Iterator[_Part]:
    width, height = number_of(tags, 256, 0), number_of(tags, 257, 0)
    is_tiled = 324 in tags
    starts = numbers(tags, 324 if is_tiled else 273)
    lengths = numbers(tags, 325 if is_tiled else 279)
    is_planar = number_of(tags, 284, 1) == 2
    bits = number_of(tags, 258, 1) * (1 if is_planar else number_of(tags, 277, 1))
    columns = number_of(tags, 322, width) if is_tiled else width
    rows = number_of(tags, 323 if is_tiled else 278, height)
    rows = rows if is_tiled else max(1, min(rows, height))
    row_bytes = -(-columns * bits // 8)
    count = -(-height // rows)
    for index, (start, length) in enumerate(zip(starts, lengths, strict=False)):
        left = rows if is_tiled else min(rows, height - rows * (index % count))
        yield _Part(data[start : start + length], (row_bytes * left, row_bytes * rows))


def _deflate_size(data: bytes) -> int | None:
    """Returns the size of a zlib stream, -1 if it has no end, and None if it is damaged."""
    stream = zlib.decompressobj()
    try:
        size = len(stream.decompress(data))
    except zlib.error:
        return None
    return size if stream.eof else -1


def _packbits_size(data: bytes) -> int | None:
    size = position = 0
    while position < len(data):
        head = data[position]
        size += head + 1 if head < 128 else 257 - head if head > 128 else 0
        position += head + 2 if head < 128 else 2 if head > 128 else 1
    return size


# --- LZW (section 13)

_CLEAR: Final = 256
_END: Final = 257
_FIRST_ENTRY: Final = 258
_WIDTHS: Final = np.repeat(np.array((9, 10, 11, 12)), (254, 512, 1024, 2306))
"""The bits of the codes after a clear code. The table has one entry less than there are codes, and
a code has one more bit as soon as the table has 511, 1023 and 2047 entries.
"""
_STARTS: Final = np.concatenate([[0], np.cumsum(_WIDTHS)])


def _lzw_size(data: bytes) -> int | None:
    """Returns the size of LZW data up to the end code, or None if they contain an invalid code."""
    if data[:1] == b"\0" and data[1:2] and data[1] & 1:  # the bit order before TIFF 6.0
        return -1
    padded = np.frombuffer(data + bytes(3), np.uint8)
    bit_count = 8 * len(data)
    position = size = 0
    while True:
        count = int(np.searchsorted(_STARTS, bit_count - position, side="right")) - 1
        starts = position + _STARTS[:count]
        first = starts >> 3
        window = padded[first].astype(np.int64) << 16
        window |= padded[first + 1].astype(np.int64) << 8
        window |= padded[first + 2]
        widths = _WIDTHS[:count]
        codes = window >> (24 - (starts & 7) - widths) & ((1 << widths) - 1)
        special = np.flatnonzero((codes == _CLEAR) | (codes == _END))
        stop = int(special[0]) if special.size else count
        added = _total_length(codes[:stop])
        if added is None or stop == len(_WIDTHS):
            return None
        size += added
        if stop == count or codes[stop] == _END:
            return size
        position += int(_STARTS[stop + 1])


def _total_length(codes: NDArray[np.int64]) -> int | None:
    """Returns how many bytes the codes after a clear code represent, or None if one of them is not
    in the table.

    The n-th code adds entry n - 1, the bytes of the code before it and one byte more. The length of
    an entry is therefore that of a path through the codes, which is measured in doubling steps.
    """
    count = len(codes)
    parents = np.where(codes < _CLEAR, count, codes - _FIRST_ENTRY)
    if (parents[codes >= _CLEAR] >= np.flatnonzero(codes >= _CLEAR)).any():
        return None
    parents = np.append(parents, count)
    lengths = np.append(np.ones(count, np.int64), 0)
    while (parents != count).any():
        lengths += lengths[parents]
        parents = parents[parents]
    return int(lengths.sum())


_SIZES: Final[dict[int, Callable[[bytes], int | None]]] = {
    5: _lzw_size,
    8: _deflate_size,
    32946: _deflate_size,
    32773: _packbits_size,
}
