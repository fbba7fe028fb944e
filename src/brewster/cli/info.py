"""`brewster info`: prints what a photo or a video contains."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from brewster.cli.batch_plan import local_path
from brewster.cli.parameters import json_lines
from brewster.cli.terminal import one_line, print_error, print_out
from brewster.errors import BrewsterError, error_prefix

if TYPE_CHECKING:
    from brewster.photo.contents import FileContents
    from brewster.photo.phone_films.motion_photo import PhotoFilm


@click.command
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@json_lines("file")
@click.pass_context
def info(context: click.Context, *, files: Sequence[str], as_json: bool) -> None:
    """Print what photos and videos contain: format, size, profile, metadata, and the film.

    The film of a photo is inside its file, as in motion photos of Android phones, or next to it, as
    in Live Photos of iPhones. The exit code is 1 if a file cannot be read.
    """
    from brewster.photo.contents import read_contents  # noqa: PLC0415  (imports pyvips)

    exit_code = 0
    for name in files:
        try:
            with error_prefix(name):
                contents = read_contents(Path(local_path(name)))
        except BrewsterError as error:
            print_error(error)
            exit_code = 1
            continue
        if as_json:
            print_out(json.dumps(_as_json(contents)))
        else:
            print_out("\n".join([one_line(name), *_lines(contents)]))
    context.exit(exit_code)


def _lines(contents: FileContents) -> Iterator[str]:
    rows = {
        "format": ", ".join(_format(contents)),
        "profile": contents.profile,
        "orientation": None if contents.orientation in (None, 1) else str(contents.orientation),
        "metadata": ", ".join(contents.metadata),
        "other parts": ", ".join(contents.other_parts),
    }
    for name, text in rows.items():
        if text:
            yield f"  {name:12} {one_line(text)}"
    for film in contents.films:
        yield f"  {'film':12} {one_line(', '.join(_film(film)))}"
    for note in contents.notes:
        yield f"  {'note':12} {one_line(note)}"


def _format(contents: FileContents) -> Iterator[str]:
    yield contents.format_name
    if contents.size:
        yield f"{contents.size[0]} x {contents.size[1]} pixels"
        yield f"{contents.bits} bits per channel"
    yield f"{contents.byte_count:,} bytes"


def _film(film: PhotoFilm) -> Iterator[str]:
    yield film.layout
    yield film.member or (film.path.name if film.path else "")
    yield f"{film.size:,} bytes from byte {film.offset:,}"
    if film.duration_s is not None:
        yield f"{film.duration_s:.2f} s"
    if film.frames is not None:
        yield f"{film.frames} frames"
    if film.still_time_s is not None:
        yield f"photo at {film.still_time_s:.2f} s"
    if film.note:
        yield film.note


def _as_json(contents: FileContents) -> dict[str, Any]:
    width, height = contents.size or (None, None)
    return {
        "path": str(contents.path),
        "bytes": contents.byte_count,
        "format": contents.format_name,
        "width": width,
        "height": height,
        "bits": contents.bits,
        "orientation": contents.orientation,
        "profile": contents.profile,
        "metadata": contents.metadata,
        "other_parts": contents.other_parts,
        "films": [_film_as_json(film) for film in contents.films],
        "notes": contents.notes,
    }


def _film_as_json(film: PhotoFilm) -> dict[str, Any]:
    return {
        "layout": film.layout,
        "path": str(film.path),
        "member": film.member,
        "offset": film.offset,
        "bytes": film.size,
        "seconds": film.duration_s,
        "frames": film.frames,
        "still_time_s": film.still_time_s,
        "is_certain": film.is_certain,
        "note": film.note,
    }
