"""Chooses the film by which a photo is separated, and tells why a film was not used."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar, final

from brewster.errors import BrewsterError, MissingExtra, PhotoError, install_command
from brewster.options import FILM_AUTO, FILM_NO
from brewster.photo.phone_films.motion_photo import PhotoFilm, search_films

_Fitted = TypeVar("_Fitted")

MAX_FILM_S: Final = 10.0
"""Phones record up to 3 s around a still. A longer film next to a photo has another purpose."""


@final
@dataclass(frozen=True)
class FoundFilm:
    """The film of a photo, and notes for its user."""

    film: PhotoFilm | None = None
    notes: tuple[str, ...] = ()
    is_named: bool = False
    """Whether a person named this film, so that it is an error if it cannot be used."""

    def fitted(self, fit: Callable[[PhotoFilm], _Fitted]) -> tuple[_Fitted | None, tuple[str, ...]]:
        """Returns what `fit` makes of the film, or None if there is none that can be used, and the
        notes for the user. A film that nobody named never stops the separation of its photo.

        Args:
            fit: measures the layers of the photo by the film.

        Raises:
            MissingExtra: a package for films is missing, and the film was named.
            PhotoError: the film cannot be used, and was named.
        """
        if self.film is None:
            return None, self.notes
        try:
            return fit(self.film), self.notes
        except (MissingExtra, PhotoError) as error:
            if self.is_named:
                raise
            return None, (*self.notes, _unused_note(self.film, error))


def find_used_film(source: object, choice: str) -> FoundFilm:
    """Returns the film by which a photo is separated.

    Args:
        source: a path, or the bytes of a file. Other sources have no film.
        choice: "auto": the film in the file of the photo or next to it, if there is one; "no":
            none; or the path of a film.

    Raises:
        UnreadablePhoto: the given film does not exist.
    """
    if choice not in (FILM_AUTO, FILM_NO):
        return FoundFilm(PhotoFilm.of_file(Path(choice)), is_named=True)
    if choice == FILM_NO or not isinstance(source, str | Path | bytes) or not _is_file(source):
        return FoundFilm()
    search = search_films(Path(source) if isinstance(source, str) else source)
    films = [film for film in search.films if (film.duration_s or 0) <= MAX_FILM_S]
    notes = [*search.notes]
    if search.films and not films:
        long = search.films[0]
        notes.append(
            f"a film of {long.duration_s:.0f} s next to it was not used, because the film of a "
            f"photo has at most {MAX_FILM_S:.0f} s (--film FILE uses it)"
        )
    return FoundFilm(films[0] if films else None, tuple(notes))


def _is_file(source: str | Path | bytes) -> bool:
    return isinstance(source, bytes) or os.path.isfile(source)  # noqa: PTH113


def _unused_note(film: PhotoFilm, error: BrewsterError) -> str:
    """Returns a note about a film that was found, but not used."""
    length = f" of {film.duration_s:.1f} s" if film.duration_s else ""
    if isinstance(error, MissingExtra):
        return (
            f"the photo contains a film{length}, by which it could be separated better: run in the "
            f"repository of brewster: {install_command('burst')}"
        )
    return f"the film{length} of the photo was not used: {error}"
