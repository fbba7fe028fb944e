"""What the file of a photo or a video contains: format, size, colour profile, metadata, films."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from brewster.base.image_formats import HEAD_BYTES, is_video, is_video_content
from brewster.base.remote_path import check_readable, read_image
from brewster.errors import UnreadablePhoto
from brewster.photo.blocks.iso_boxes import film_at, missing_part
from brewster.photo.blocks.xmp import FILM
from brewster.photo.colour.spaces import icc_tags
from brewster.photo.decode import read_header
from brewster.photo.phone_films.motion_photo import PhotoFilm, search_films

VIDEO: Final = "video"
"""The format of a file with a film only."""


@final
@dataclass(frozen=True)
class FileContents:
    """What a file contains. The fields about the image have defaults for a video."""

    path: Path
    byte_count: int
    format_name: str
    """A key of `brewster.base.image_formats.FORMATS`, or "video". For an archive, that of its
    image.
    """
    size: tuple[int, int] | None = None
    """Width and height of the upright image, in pixels."""
    bits: int | None = None
    """Bits per channel."""
    orientation: int | None = None
    """The EXIF orientation, 1..8."""
    profile: str | None = None
    """The description in the ICC profile; None: no profile."""
    metadata: tuple[str, ...] = ()
    """The names of the blocks of metadata."""
    other_parts: tuple[str, ...] = ()
    """The names of other parts, such as a gain map, without films."""
    films: tuple[PhotoFilm, ...] = ()
    """The films of the photo, or the video itself."""
    notes: tuple[str, ...] = ()
    """What is unusual."""


def read_contents(path: Path) -> FileContents:
    """Reads what a file contains. Pixels are decoded only of EXR and HDR files, and films never.

    Raises the errors of `Photo.open`, and UnreadablePhoto for a file that is no image or video.
    """
    check_readable(path)
    with path.open("rb") as file:
        byte_count = file.seek(0, 2)
        file.seek(0)
        if is_video_content(file.read(HEAD_BYTES)):
            film = film_at(file, 0, byte_count, needs_type=False)
            facts = (film.still_time_s, film.duration_s, film.frames) if film else ()
            films = (PhotoFilm(VIDEO, path, 0, byte_count, *facts),)
            missing = missing_part(file, byte_count)
            notes = (missing,) if missing else ()
            return FileContents(path, byte_count, VIDEO, films=films, notes=notes)
    if is_video(path):
        raise UnreadablePhoto(
            f"{path} is named like a video, but does not begin like one",
            "expected a photo or a video",
            "copy or record it again, or give it the suffix of its content",
        )
    header = read_header(read_image(path))
    info = header.file_info
    blocks = {"EXIF": info.exif, "XMP": info.xmp, "IPTC": info.iptc}
    search = search_films(path)
    return FileContents(
        path,
        byte_count,
        header.format_name,
        header.size,
        info.bits,
        header.orientation,
        profile_name(info.icc) if info.icc else None,
        tuple(name for name, block in blocks.items() if block),
        tuple(part for part in info.other_parts if part != FILM),
        search.films,
        search.notes,
    )


def profile_name(icc: bytes) -> str:
    """Returns the description of an ICC profile (ICC.1:2022 9.2.41; of version 2, `desc`), or
    "unnamed".
    """
    try:
        value = icc_tags(icc).get(b"desc", b"")
    except struct.error:
        return "unnamed"
    if len(value) < 28:
        return "unnamed"
    if value[:4] == b"mluc":  # the first language
        length, position = struct.unpack_from(">II", value, 20)
        text = value[position : position + length].decode("utf-16-be", "replace")
    else:
        length = int.from_bytes(value[8:12], "big")
        text = value[12 : 12 + length].decode("ascii", "replace")
    return text.strip("\0 ") or "unnamed"
