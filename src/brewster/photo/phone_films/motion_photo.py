"""Finds the film of a photo: inside its file, or in a file next to it.

    for film in search_films(Path("PXL_2024.MP.jpg")).films:
        data = film.read()

`LAYOUTS` is the table of formats: a row for each place inside a photo where makers store the film.
Files next to a photo are found by their names (`_FILM_ENDINGS`).
A row only suggests positions, because metadata are often out of date or mean something else than
their names say. The film is where the boxes of an ISO base media file can be walked, see
`brewster.photo.blocks.iso_boxes`.

Sources: Android's Motion Photo format 1.0 and its predecessor MicroVideo, Apple's QuickTime File
Format, and files of the devices.
"""

import io
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final, final

from brewster.base.image_formats import HEAD_BYTES, format_of_content
from brewster.errors import UnreadablePhoto, read_errors
from brewster.photo.blocks.iso_boxes import Box, IsoFilm, boxes, film_at, read_at
from brewster.photo.phone_films import live_photo_archive
from brewster.photo.phone_films.motion_metadata import MotionMetadata, read_motion_metadata

_TAIL_BYTES: Final = 4096
_MAX_SCAN_BYTES: Final = 1 << 27
"""The most bytes that are searched for a film whose position no metadata state."""
_CHUNK_BYTES: Final = 1 << 20
_MAX_CANDIDATES: Final = 64
"""The most positions that a row of the table may suggest."""
_MAX_FILMS: Final = 8


@final
@dataclass(frozen=True)
class PhotoFilm:
    """The film of a photo: a part of a file, which is read only when it is needed."""

    layout: str
    """The name of a row of `LAYOUTS`, or "Apple Live Photo", "beside", "livp" or "given"."""
    path: Path | None
    """The file that contains the film; None: the photo was passed as bytes."""
    offset: int
    """The position of the first byte of the film in the file, or in the member of the archive."""
    size: int
    """The number of bytes of the film."""
    still_time_s: float | None = None
    """When the still was taken, in seconds of the film, as the metadata state; None: not stated.
    The frame at this time is not always the most similar one.
    """
    duration_s: float | None = None
    """The duration that the film states, or None."""
    frames: int | None = None
    """The number of frames that the film states, or None."""
    is_certain: bool = True
    """Whether the film is of this photo for certain. A film next to a photo may have the same name
    by accident: then compare the pictures.
    """
    note: str | None = None
    """What is unusual, for the user, or None."""
    member: str | None = None
    """The name of the film in the archive `path`, if the photo is a .livp file."""
    content: bytes | None = field(default=None, repr=False, compare=False)
    """The bytes of the file, if the photo was passed as bytes."""

    @classmethod
    def of_file(cls, path: Path) -> "PhotoFilm":
        """Returns the film that a person names. It is not opened.

        Raises UnreadablePhoto if there is no such file.
        """
        with _read_errors(path):
            return cls("given", path, 0, path.stat().st_size)

    @classmethod
    def of_bytes(cls, data: bytes) -> "PhotoFilm":
        """Returns the film that a client sends, the bytes of its file."""
        return cls("given", None, 0, len(data), content=data)

    def read(self) -> bytes:
        """Returns the bytes of the film. No other part of the file is read.

        Raises UnreadablePhoto if the file cannot be read, or has changed.
        """
        name = self.path or "the photo"
        source = self.path or self.content or b""
        with _read_errors(source), closing(_opened(source)) as file:
            film = live_photo_archive.member(file, self.member) if self.member else file
            data = read_at(film, self.offset, self.size)
        if len(data) < self.size:
            raise UnreadablePhoto(
                f"the film in {name} has {len(data)} bytes",
                f"expected {self.size} bytes, as when it was found",
                "wait until the file is complete, or copy it again",
            )
        return data


@final
@dataclass(frozen=True)
class FilmSearch:
    """The films of a photo, and what was found about films that cannot be used."""

    films: tuple[PhotoFilm, ...] = ()
    """The films, best first."""
    notes: tuple[str, ...] = ()


def search_films(photo: Path | bytes) -> FilmSearch:
    """Searches the file of a photo, and the files next to it, for films.

    A film that is certain comes before others, and one inside the photo before one next to it. Only
    headers are read, and for some photos the bytes after their header.

    Args:
        photo: the path of a photo, or the bytes of its file; only for a path, files next to it are
            searched.

    Raises:
        UnreadablePhoto: the file cannot be read, or is an archive that is damaged or too large.
    """
    with _read_errors(photo), closing(_opened(photo)) as file:
        still = _Still.read(file)
        if still.format_name == "livp":
            return FilmSearch(tuple(_films_of_archive(still, photo)))
        inside = [_photo_film(name, still, film, photo) for name, film in _films_inside(still)]
        search = _search_beside(still, photo) if isinstance(photo, Path) else FilmSearch()
    films = sorted([*inside, *search.films], key=lambda film: not film.is_certain)
    notes = search.notes
    if still.metadata.is_motion_photo and not films:
        notes += ("its metadata state a film (motion photo), but its file contains none",)
    elif still.metadata.content_identifier and not films and not notes:
        notes += ("it is a Live Photo, but the .MOV file with its film did not come with it",)
    return FilmSearch(tuple(films), notes)


def _opened(source: Path | bytes) -> BinaryIO:
    return source.open("rb") if isinstance(source, Path) else io.BytesIO(source)


def _read_errors(source: Path | bytes) -> AbstractContextManager[None]:
    name = source if isinstance(source, Path) else "the photo"
    return read_errors(name, UnreadablePhoto, "expected an image file", "copy the file again")


@final
@dataclass(frozen=True)
class _Still:
    """The file of a photo, with what its metadata state about a film."""

    file: BinaryIO
    size: int
    format_name: str
    """A key of `FORMATS`, or no text for an unknown format."""
    metadata: MotionMetadata

    @classmethod
    def read(cls, file: BinaryIO) -> "_Still":
        size = file.seek(0, io.SEEK_END)
        image_format = format_of_content(read_at(file, 0, HEAD_BYTES))
        name = image_format.name if image_format else ""
        return cls(file, size, name, read_motion_metadata(file, name))

    def image_boxes(self) -> list[Box]:
        """Returns the boxes of a HEIC or AVIF, up to a film after them."""
        found = list[Box]()
        for box in boxes(self.file, 0, self.size) if self.format_name in _ISO_FORMATS else ():
            if found and box.kind == b"ftyp":
                break
            found.append(box)
        return found

    def tail(self) -> bytes:
        """Returns the last bytes of the file."""
        return read_at(self.file, max(self.size - _TAIL_BYTES, 0), _TAIL_BYTES)


_ISO_FORMATS: Final = ("heic", "avif")
_Range = tuple[int, int]
"""Where a film may begin, and where it must end at the latest."""


def _photo_film(
    layout: str, still: _Still, film: IsoFilm, photo: Path | bytes, member: str | None = None
) -> PhotoFilm:
    stated = still.metadata.still_time_s
    return PhotoFilm(
        layout,
        photo if isinstance(photo, Path) else None,
        film.start,
        film.size,
        stated if film.still_time_s is None else film.still_time_s,
        film.duration_s,
        film.frames,
        member=member,
        content=None if isinstance(photo, Path) else photo,
    )


# --- Films inside the photo: each function suggests ranges


def _media_boxes(still: _Still) -> Iterator[_Range]:
    """The box `mpvd` of HEIC and AVIF (Motion Photo format 1.0, and Samsung before it). Up to One
    UI 5, Samsung's block `sefd` is at its end, after the film.
    """
    for box in still.image_boxes():
        if box.kind == b"mpvd":
            yield box.content, min(box.end, still.size)


_SEF_FILM: Final = 0x0A30
"""The type of the entry MotionPhoto_Data in Samsung's extended format (SEF)."""


def _samsung_entries(still: _Still) -> Iterator[_Range]:
    """The entry MotionPhoto_Data of the SEF block at the end. It contains the film, or "mpv2" with
    the position and the size of the film.
    """
    directory, entries = _samsung_directory(still)
    for kind, position in entries:
        if kind == _SEF_FILM:
            block = read_at(still.file, position, 64)
            start = 8 + int.from_bytes(block[4:8], "little")  # after the name
            if block[start : start + 3] == b"mpv":
                yield int.from_bytes(block[start + 4 : start + 8], "big"), still.size
            yield position + start, directory


def _samsung_directory(still: _Still) -> tuple[int, list[tuple[int, int]]]:
    """Returns the position of the directory of the SEF block, and the type and the position of each
    entry; the size of the file and no entries if there is no block.
    """
    tail = still.tail()
    end = tail.rfind(b"SEFT")
    if end < 4:
        return still.size, []
    end += still.size - len(tail)
    size = int.from_bytes(read_at(still.file, end - 4, 4), "little")
    start = end - 4 - size
    table = read_at(still.file, start, min(size, _TAIL_BYTES))
    if table[:4] != b"SEFH":
        return still.size, []
    rows = [struct.unpack_from("<2xHI", table, row) for row in range(12, len(table) - 11, 12)]
    return start, [(kind, start - distance) for kind, distance in rows]


def _huawei_tail(still: _Still) -> Iterator[_Range]:
    """The last 60 bytes of Huawei and Honor, three fields of 20: a version, numbers, and LIVE_N. N
    counts the bytes of the film and those of the first field, which old files do not have.
    """
    tail = still.tail()[-64:]
    if found := re.search(rb"LIVE_(\d{1,12})", tail):
        end = still.size - len(tail) + found.start() + 20
        yield end - 40 - int(found[1]), still.size


def _micro_video(still: _Still) -> Iterator[_Range]:
    """MicroVideoOffset counts from the end of the file, with blocks that follow the film."""
    if still.metadata.micro_video_offset:
        yield still.size - still.metadata.micro_video_offset, still.size


def _container_items(still: _Still) -> Iterator[_Range]:
    """The item MotionPhoto of the Google container. The lengths of the last items count from the
    end, those of the first ones from the start. Some writers state the padding in the length.
    """
    items = still.metadata.items
    for number, item in enumerate(items):
        if item.is_film:
            yield still.size - sum(after.length for after in items[number:]), still.size
            before = items[:number]
            yield sum(each.length + each.padding for each in before), still.size


def _oppo_items(still: _Still) -> Iterator[_Range]:
    """As the Google container. VideoLength of OPPO and OnePlus is smaller than the film."""
    return _container_items(still) if still.metadata.has_oppo_properties else iter(())


def _after_the_image(still: _Still) -> Iterator[_Range]:
    """Films whose position nothing states: metadata are lost in messengers, or bytes were added
    later.

    A JPEG that states no film, and ends with an image, contains none: it is not searched.
    """
    if still.format_name in _ISO_FORMATS:
        start = max((box.end for box in still.image_boxes()), default=still.size)
    elif still.format_name == "jpeg" and (
        still.metadata.is_motion_photo or not _ends_with_an_image(still)
    ):
        start = still.metadata.pixels_start
    else:
        return
    for position in _positions(still.file, b"ftyp", start, still.size):
        yield position - 4, still.size


def _ends_with_an_image(still: _Still) -> bool:
    """Whether the end marker of a JPEG is at the end of the file, or before a block of Samsung."""
    end, entries = _samsung_directory(still)
    end = min([end, *(position for _, position in entries)])
    tail = read_at(still.file, max(end - _TAIL_BYTES, 0), min(end, _TAIL_BYTES))
    return tail.rstrip(b"\0").endswith(b"\xff\xd9")


def _positions(file: BinaryIO, word: bytes, start: int, end: int) -> Iterator[int]:
    """Yields the positions of a word in the first `_MAX_SCAN_BYTES` bytes of a range."""
    for chunk_start in range(start, min(end, start + _MAX_SCAN_BYTES), _CHUNK_BYTES):
        size = min(_CHUNK_BYTES + len(word) - 1, end - chunk_start)
        chunk = read_at(file, chunk_start, size)
        at = chunk.find(word)
        while at >= 0:
            yield chunk_start + at
            at = chunk.find(word, at + 1)


@final
@dataclass(frozen=True)
class Layout:
    """A place inside a photo where makers store the film."""

    name: str
    find: Callable[[_Still], Iterator[_Range]]
    """Suggests where the film may begin."""
    is_search: bool = False
    """Whether bytes of the image are searched, so that the row is used only after all others."""


LAYOUTS: Final = (
    Layout("Samsung mpvd", _media_boxes),
    Layout("Samsung SEF", _samsung_entries),
    Layout("Huawei LIVE", _huawei_tail),
    Layout("OPPO", _oppo_items),
    Layout("Google Motion Photo", _container_items),
    Layout("MicroVideo", _micro_video),
    Layout("after the image", _after_the_image, is_search=True),
)
"""All layouts inside a photo, in the order in which they are tried."""


def _films_inside(still: _Still) -> Iterator[tuple[str, IsoFilm]]:
    """Yields the films inside a photo with the names of their layouts, those that follow directly
    after one another, too.
    """
    ends = dict[int, int]()
    for layout in LAYOUTS:
        if layout.is_search and ends:
            return
        for start, end in islice(layout.find(still), _MAX_CANDIDATES):
            position = start
            while position > 0 and not _is_inside(position, ends) and len(ends) < _MAX_FILMS:
                film = film_at(still.file, position, end)
                if film is None:
                    break
                yield layout.name, film
                position = film.start + film.size
                ends[film.start] = position


def _is_inside(position: int, films: dict[int, int]) -> bool:
    return any(start <= position < end for start, end in films.items())


# --- Films next to the photo


_FILM_SUFFIXES: Final = (".mov", ".mp4", ".m4v", ".mp", ".mv")
_FILM_ENDINGS: Final = (
    *(suffix for lower in _FILM_SUFFIXES for suffix in (lower, lower.upper())),
    *("_HEVC.MOV", "_HEVC.mov", ""),
)
"""What follows the stem of a photo in the name of its film. Takeout writes `X.MP` for `X.MP.jpg`,
and films without a suffix."""


def _neighbours(photo: Path) -> Iterator[Path]:
    """Yields the files next to a photo whose names are those of its film, each file once."""
    seen = {_identity(photo)}
    for ending in _FILM_ENDINGS:
        path = photo.with_name(photo.stem + ending)
        identity = _identity(path)
        if identity and identity not in seen:
            seen.add(identity)
            yield path


def _identity(path: Path) -> tuple[int, int] | None:
    """Returns what identifies a file, because systems may ignore the case of names; None if the
    path is no file.
    """
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return (status.st_dev, status.st_ino) if path.is_file() else None


def _search_beside(still: _Still, photo: Path) -> FilmSearch:
    films = []
    notes = []
    for path in _neighbours(photo):
        try:
            with path.open("rb") as file:
                film = film_at(file, 0, file.seek(0, io.SEEK_END), needs_type=False)
        except OSError as error:
            notes.append(f"{path.name} next to it cannot be read ({error.strerror})")
            continue
        if film is None:
            if path.suffix:
                notes.append(f"{path.name} next to it is no complete film")
            continue
        identifiers = {film.content_identifier, still.metadata.content_identifier}
        if len(identifiers) == 2 and None not in identifiers:
            notes.append(f"{path.name} next to it is the film of another photo")
            continue
        films.append(_film_beside(still, film, path))
    return FilmSearch(tuple(films), tuple(notes))


def _film_beside(still: _Still, film: IsoFilm, path: Path) -> PhotoFilm:
    is_same = film.content_identifier == still.metadata.content_identifier
    if is_same and film.content_identifier:
        return _photo_film("Apple Live Photo", still, film, path)
    has_stated_size = path.stat().st_size in {item.length for item in still.metadata.items}
    found = _photo_film("beside", still, film, path)
    note = None if has_stated_size else "only its name shows that it belongs to the photo"
    return replace(found, is_certain=has_stated_size, note=note)


# --- Archives


def _films_of_archive(still: _Still, photo: Path | bytes) -> Iterator[PhotoFilm]:
    for name in live_photo_archive.film_names(still.file):
        data = live_photo_archive.member(still.file, name)
        size = data.seek(0, io.SEEK_END)
        if film := film_at(data, 0, size, needs_type=False):
            yield _photo_film("livp", still, film, photo, name)
