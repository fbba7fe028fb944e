"""Separates one photo, by the film that its phone recorded around it if that helps.

    brewster.separate("IMG_1234.HEIC").transmission.save("clear.jpg")

A film that cannot be used never stops the photo: it is then separated alone, with a note.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Unpack

from brewster.options import (
    FILM_AUTO,
    BurstMethod,
    LoadOptions,
    Options,
    Quality,
    check_keywords,
)
from brewster.photo import Encoding, Photo, Source
from brewster.photo.file_info import with_notes
from brewster.photo.in_memory import BinaryFile
from brewster.photo.phone_films.motion_photo import PhotoFilm
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separation import Separation
from brewster.separation.separator import Separator
from brewster.separation.used_film import FoundFilm, find_used_film

if TYPE_CHECKING:
    from brewster.film.fitted_burst import FittedBurst

_FITTED: Final = 0.8
"""The completed fraction when the layers of the film are measured."""


def separate_photo(
    source: Source,
    separator: Separator,
    *,
    film: str = FILM_AUTO,
    method: BurstMethod = Options.method,
    swap: bool = Options.swap,
    encoding: Encoding | None = None,
    on_progress: ProgressCallback = lambda _fraction: None,
    **call: Any,  # noqa: ANN401  (those of `Options.call_options`)
) -> Separation:
    """Separates one photo, by its film if that helps.

    Args:
        source: a path, the bytes of a file, an open binary file, a PIL image, a `Photo`, or an
            array.
        separator: separates the photo alone.
        film: see `find_used_film`.
        method: see `separate_burst`.
        swap: whether the measured layers are exchanged.
        encoding: that of an array; see the call of a `Separator`.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.
        call: strength, quality, mask, hints, additive and max_pixels of the call of a `Separator`.

    Raises:
        BrewsterError: see the call of a `Separator`; or the given film cannot be used.
    """
    source = _as_bytes(source)
    found = FoundFilm() if call.get("strength") == 0 else find_used_film(source, film)
    if found.film is None:
        separation = separator(source, encoding=encoding, on_progress=on_progress, **call)
        return _with_notes(separation, *found.notes)
    max_pixels = call.get("max_pixels", Options.max_pixels)
    photo = Photo.open(source, encoding=encoding, max_pixels=max_pixels)
    fitted, notes = found.fitted(lambda used: _fitted(photo, used, separator, call, on_progress))
    if fitted:
        separation = fitted.chosen(method, swap=swap).separate(
            lambda done: on_progress(_FITTED + (1 - _FITTED) * done), **call
        )
    else:
        separation = separator(photo, on_progress=on_progress, **call)
    return _with_notes(separation, *notes)


def _as_bytes(source: Source) -> Source:
    """Reads an open binary file, because the photo and its film are read from it."""
    data = source.read() if isinstance(source, BinaryFile) else source
    return data if isinstance(data, bytes) else source


def _fitted(
    photo: Photo,
    film: PhotoFilm,
    separator: Separator,
    call: Mapping[str, Any],
    on_progress: ProgressCallback,
) -> FittedBurst:
    from brewster.film.photo_film import fit_photo_film  # noqa: PLC0415  (imports numba)

    own = {name: call[name] for name in ("hints", "max_pixels") if name in call}
    return fit_photo_film(
        photo,
        film,
        separator=separator,
        on_progress=lambda done: on_progress(_FITTED * done),
        **own,
    )


def _with_notes(separation: Separation, *notes: str) -> Separation:
    if not notes:
        return separation
    photo = separation.photo
    return replace(separation, photo=replace(photo, file_info=with_notes(photo.file_info, *notes)))


def separate(
    source: Source,
    *,
    model: str = Options.model,
    strength: float = Options.strength,
    quality: Quality = Options.quality,
    mask: Source | None = Options.mask,
    hints: Source | None = Options.hints,
    film: str = Options.film,
    additive: bool = Options.additive,
    encoding: Encoding | None = None,
    max_pixels: int = Options.max_pixels,
    **options: Unpack[LoadOptions],
) -> Separation:
    """Separates one photo. For several photos, use `Separator.load` once and call the separator for
    each, or `brewster.batch.separate_files`.

    Args:
        source: a path, the bytes of a file, an open binary file, a PIL image, a `Photo`, or an
            array.
        model: see `Separator.load`.
        strength: see `Separator.__call__`.
        quality: see `Separator.__call__`.
        mask: see `Separator.__call__`.
        hints: see `Separator.__call__`.
        film: "auto" uses the film that a phone recorded around the photo, if the file contains it
            or it is next to the file (Live Photo, Motion Photo), and the extra `burst` is
            installed; "no" does not; a path is the film to use.
        additive: see `Separator.__call__`.
        encoding: see `Separator.__call__`.
        max_pixels: see `Separator.__call__`.
        options: those of `Separator.load`.

    Raises:
        BrewsterError: an error of `Separator.load` or of a call of the `Separator`; or the film
            that was passed cannot be used.
        TypeError: there is no such option.
    """
    check_keywords(options, "load", "call")
    return separate_photo(
        source,
        Separator.load(model, **options),
        film=os.fspath(film),
        encoding=encoding,
        strength=strength,
        quality=quality,
        mask=mask,
        hints=hints,
        additive=additive,
        max_pixels=max_pixels,
    )
