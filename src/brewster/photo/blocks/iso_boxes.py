"""Walks the boxes of ISO base media files (ISO/IEC 14496-12) and QuickTime movies: MP4, MOV, HEIC,
AVIF.

Only headers and small boxes are read, so the size of a file does not matter. A malformed box ends
the walk: a damaged file gives fewer boxes, never an error.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple, final

from brewster.base.image_formats import is_video_content

_MAX_BOXES: Final = 4096
"""The most boxes of one level that are walked: a film in fragments has two for each fragment."""
_MAX_CONTENT_BYTES: Final = 1 << 20
"""The most bytes of one box that are read."""
_TABLE_BYTES: Final = 4096
_MAX_TRACKS: Final = 64
_MAX_ITEMS: Final = 4096
_MAX_EXTENTS: Final = 64

_FILM_BOXES: Final = frozenset(
    (
        *(b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"uuid", b"meta", b"udta", b"pdin"),
        *(b"moof", b"mfra", b"sidx", b"ssix", b"styp", b"emsg", b"prft", b"pnot", b"PICT"),
    )
)
"""The boxes of a film at the top level. Any other, such as Samsung's `sefd`, is after its end."""


class Box(NamedTuple):
    """A box: its type, and where it and its content are in the file, in bytes."""

    kind: bytes
    start: int
    content: int
    end: int


@final
@dataclass(frozen=True)
class IsoFilm:
    """A film whose boxes could be walked, and what its headers state."""

    start: int
    """The position of its first byte in the file."""
    size: int
    """Bytes up to the end of its last box."""
    duration_s: float | None = None
    """The duration of its longest track; None: not stated, as in fragments."""
    frames: int | None = None
    """The number of frames of its first track of pictures; None: not stated, as in fragments."""
    content_identifier: str | None = None
    """The identifier that a Live Photo of Apple shares with its still."""
    still_time_s: float | None = None
    """When the still of a Live Photo of Apple was taken, in seconds of the film."""


def read_at(file: BinaryIO, start: int, size: int) -> bytes:
    """Returns at most `size` bytes from a position of a file."""
    if start < 0 or size <= 0:
        return b""
    file.seek(start)
    return file.read(size)


def boxes(file: BinaryIO, start: int, end: int, *, numbered: bool = False) -> Iterator[Box]:
    """Yields the boxes between two positions. A box that ends after `end` is yielded and ends the
    walk, and so does a header that is no box. The types in an `ilst` box are numbers (`numbered`).
    """
    for _ in range(_MAX_BOXES):
        header = read_at(file, start, min(16, end - start))
        if len(header) < 8:
            return
        size, kind = struct.unpack_from(">I4s", header)
        header_size = 8
        if size == 1 and len(header) == 16:
            (size,) = struct.unpack_from(">Q", header, 8)
            header_size = 16
        elif size == 0:  # to the end of the file
            size = end - start
        if size < header_size or not (numbered or _is_kind(kind)):
            return
        yield Box(kind, start, start + header_size, start + size)
        start += size
        if start > end:
            return


def _is_kind(kind: bytes) -> bool:
    """Whether these bytes may be the type of a box: printable, as © in those of QuickTime."""
    return all(0x20 <= byte < 0x7F or byte == 0xA9 for byte in kind)


def child(file: BinaryIO, parent: Box | None, *path: bytes) -> Box | None:
    """Returns the first box of these types below a box: `child(file, trak, b"mdia", b"hdlr")`."""
    for kind in path:
        if parent is None:
            return None
        inside = boxes(file, _first_child(file, parent), parent.end)
        parent = next((box for box in inside if box.kind == kind and box.end <= parent.end), None)
    return parent


def _first_child(file: BinaryIO, parent: Box) -> int:
    """Returns where the boxes in a box begin. A `meta` box has a version before them, except in
    QuickTime.
    """
    has_version = parent.kind == b"meta" and read_at(file, parent.content + 4, 4) != b"hdlr"
    return parent.content + 4 * has_version


def content(file: BinaryIO, box: Box | None, limit: int = _MAX_CONTENT_BYTES) -> bytes:
    """Returns the first `limit` bytes of the content of a box; none for None."""
    if box is None:
        return b""
    return read_at(file, box.content, min(box.end - box.content, limit))


# --- Films


def film_at(file: BinaryIO, start: int, end: int, *, needs_type: bool = True) -> IsoFilm | None:
    """Returns the film that begins at a position and ends at `end` or before, or None.

    A film begins with `ftyp` and the brand of a film, and has a `moov` box with a track of pictures
    and an `mdat` box. A film that is cut off, so that a box ends after `end`, is no film. Bytes
    that are no box of a film end it.

    Args:
        file: the file.
        start: where the film is supposed to begin.
        end: where the film must end: the end of the file, or of the box that contains the film.
        needs_type: whether the film must begin with `ftyp`. A QuickTime movie need not.
    """
    head = read_at(file, start, min(64, max(end - start, 0)))
    if not is_video_content(head) or (needs_type and head[4:8] != b"ftyp"):
        return None
    movie = None
    has_data = False
    film_end = start
    for box in boxes(file, start, end):
        is_next_film = box.kind == b"ftyp" and box.start > start
        if is_next_film or box.kind not in _FILM_BOXES:
            break
        if box.end > end:
            return None
        movie = box if box.kind == b"moov" and movie is None else movie
        has_data |= box.kind == b"mdat"
        film_end = box.end
    return _described(file, movie, start, film_end) if movie and has_data else None


def missing_part(file: BinaryIO, end: int) -> str | None:
    """Returns what a film lacks that was cut off or never finished; None if nothing is known to be
    missing, also for a file of another format.

    Args:
        file: the film begins at its first byte.
        end: the number of its bytes.
    """
    found = set[bytes]()
    film_end = 0
    for box in boxes(file, 0, end):
        if box.kind not in _FILM_BOXES:
            break
        film_end = box.end
        if box.end <= end or box.kind == b"mdat":
            found.add(box.kind)
    if film_end == 0:
        return None
    parts = []
    if film_end > end:
        parts.append(f"it is cut off: at least {film_end - end:,} bytes are missing at its end")
    if b"moov" not in found:
        parts.append("it has no index of its frames (moov), without which none can be shown")
    elif found.isdisjoint((b"mdat", b"moof")):
        parts.append("it has no pictures (mdat)")
    return ", and ".join(parts) or None


def _described(file: BinaryIO, movie: Box, start: int, end: int) -> IsoFilm | None:
    """Returns the film with what its movie box states, or None if there is no track of pictures
    whose data are in the film.
    """
    inside = boxes(file, movie.content, movie.end)
    tracks = [box for box in inside if box.kind == b"trak" and box.end <= movie.end][:_MAX_TRACKS]
    pictures = [track for track in tracks if _handler(file, track) == b"vide"]
    if not any(_has_data(file, track, end - start) for track in pictures):
        return None
    scale = number_after_times(content(file, child(file, movie, b"mvhd")))
    durations = [_duration_s(file, track) for track in tracks]
    return IsoFilm(
        start,
        end - start,
        max(durations, default=0) or None,
        _sample_count(file, pictures[0]) or None,
        _content_identifier(file, movie),
        next(filter(None, (_still_time_s(file, track, scale) for track in tracks)), None),
    )


def _handler(file: BinaryIO, track: Box) -> bytes:
    return content(file, child(file, track, b"mdia", b"hdlr"))[8:12]


def _table(file: BinaryIO, track: Box, kind: bytes) -> bytes:
    """Returns the start of a table of samples, which is long for a long film."""
    return content(file, child(file, track, b"mdia", b"minf", b"stbl", kind), _TABLE_BYTES)


def _has_data(file: BinaryIO, track: Box, film_size: int) -> bool:
    """Whether the first data of a track are in the film. In fragments, the track has none."""
    short = _table(file, track, b"stco")
    width = 4 if short else 8
    table = short or _table(file, track, b"co64")
    if len(table) < 8 or not any(table[4:8]):
        return bool(table)
    return int.from_bytes(table[8 : 8 + width], "big") < film_size


def _sample_count(file: BinaryIO, track: Box) -> int:
    return int.from_bytes(_table(file, track, b"stsz")[8:12], "big")


def number_after_times(header: bytes) -> int:
    """Returns the number after the times of creation and modification, with which the headers of a
    movie and its tracks begin: the units of time in a second in an `mvhd` or `mdhd` box, 0 if they
    are not stated; the number of the track in a `tkhd` box.
    """
    start = 20 if header[:1] == b"\1" else 12
    return int.from_bytes(header[start : start + 4], "big")


def _duration_s(file: BinaryIO, track: Box) -> float:
    header = content(file, child(file, track, b"mdia", b"mdhd"))
    start, width = (24, 8) if header[:1] == b"\1" else (16, 4)
    duration = int.from_bytes(header[start : start + width], "big")
    scale = number_after_times(header)
    is_unknown = duration == (1 << 8 * width) - 1
    return 0.0 if is_unknown or not scale else duration / scale


def _content_identifier(file: BinaryIO, movie: Box) -> str | None:
    """Returns the value of com.apple.quicktime.content.identifier (QuickTime File Format, metadata
    atoms): `keys` names the values, and `ilst` has them by their number. FFmpeg writes the box into
    `udta`.
    """
    meta = child(file, movie, b"meta") or child(file, movie, b"udta", b"meta")
    names = content(file, child(file, meta, b"keys"))
    position = 8
    number = 0
    while position + 8 <= len(names):
        size = int.from_bytes(names[position : position + 4], "big")
        number += 1
        if names[position + 8 : position + size] == b"com.apple.quicktime.content.identifier":
            values = child(file, meta, b"ilst")
            inside = boxes(file, values.content, values.end, numbered=True) if values else ()
            kind = number.to_bytes(4, "big")
            value = next((box for box in inside if box.kind == kind), None)
            text = content(file, child(file, value, b"data"))[8:]
            return text.decode("utf-8", "replace").strip("\0 ") or None
        position += max(size, 8)
    return None


def _still_time_s(file: BinaryIO, track: Box, movie_scale: int) -> float | None:
    """Returns the time of the only sample of the track with the key still-image-time of Apple: its
    edit list begins with an empty edit of this duration.
    """
    if _handler(file, track) != b"meta" or not movie_scale:
        return None
    if b"com.apple.quicktime.still-image-time" not in _table(file, track, b"stsd"):
        return None
    edits = content(file, child(file, track, b"edts", b"elst"))
    width = 8 if edits[:1] == b"\1" else 4
    is_empty = edits[8 + width : 8 + 2 * width] == b"\xff" * width
    return int.from_bytes(edits[8 : 8 + width], "big") / movie_scale if is_empty else 0.0


# --- Items of HEIC and AVIF


def item_contents(file: BinaryIO, end: int) -> dict[str, bytes]:
    """Returns the contents of the items "Exif" and "XMP" of a HEIC or AVIF, those that it has. EXIF
    begins at its TIFF header.
    """
    meta = next((box for box in boxes(file, 0, end) if box.kind == b"meta"), None)
    kinds = _item_kinds(file, child(file, meta, b"iinf"))
    places = _item_places(content(file, child(file, meta, b"iloc")))
    data = child(file, meta, b"idat")
    found = dict[str, bytes]()
    for item, kind in kinds.items():
        is_in_meta, extents = places.get(item, (False, []))
        base = data.content if is_in_meta and data else 0
        size_limit = _MAX_CONTENT_BYTES // max(len(extents), 1)
        parts = [read_at(file, base + at, min(size, size_limit)) for at, size in extents]
        found.setdefault(kind, b"".join(parts))
    if "Exif" in found:  # ISO/IEC 23008-12 annex A: the position of the TIFF header is first
        found["Exif"] = found["Exif"][4 + int.from_bytes(found["Exif"][:4], "big") :]
    return found


def _item_kinds(file: BinaryIO, table: Box | None) -> dict[int, str]:
    """Returns the numbers of the items with EXIF and XMP, from an `iinf` box."""
    if table is None:
        return {}
    version = read_at(file, table.content, 1)
    first = table.content + (6 if version == b"\0" else 8)
    kinds = {}
    for box in boxes(file, first, table.end):
        entry = read_at(file, box.content, min(box.end - box.content, 256))
        width = 4 if entry[:1] == b"\3" else 2
        item = int.from_bytes(entry[4 : 4 + width], "big")
        kind = entry[6 + width : 10 + width]
        if kind == b"Exif":
            kinds[item] = "Exif"
        elif kind == b"mime" and b"application/rdf+xml" in entry:
            kinds[item] = "XMP"
    return kinds


def _item_places(table: bytes) -> dict[int, tuple[bool, list[tuple[int, int]]]]:
    """Returns for each item of an `iloc` box whether its data are in the `idat` box, and the
    position and the size of its parts.
    """
    version = table[0] if table else 3
    if version > 2 or len(table) < 8:
        return {}
    widths = table[4] >> 4, table[4] & 15, table[5] >> 4, table[5] & 15 if version else 0
    item_width = 4 if version == 2 else 2
    position = 6

    def number(width: int) -> int:
        nonlocal position
        position += width
        return int.from_bytes(table[position - width : position], "big")

    offset_width, length_width, base_width, index_width = widths
    places = dict[int, tuple[bool, list[tuple[int, int]]]]()
    for _ in range(min(number(item_width), _MAX_ITEMS)):
        item = number(item_width)
        method = number(2) & 15 if version else 0
        number(2)  # the file of the data
        base = number(base_width)
        extents = []
        count = number(2)
        if count > _MAX_EXTENTS or position > len(table):
            return places
        for _ in range(count):
            number(index_width)
            extents.append((base + number(offset_width), number(length_width)))
        places[item] = (method == 1, extents)
    return places
