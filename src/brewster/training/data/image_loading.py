"""Reads folders of photos, HDR maps and aligned pairs into memory, small, for the streams in `mix`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brewster.benchmarks.pairing import PictureGroup, read_folders
from brewster.errors import PhotoError, RecipeError
from brewster.image_formats import SUFFIXES
from brewster.photo import Photo
from brewster.srgb import to_encoded

_MAPS = {suffix for suffix, image_format in SUFFIXES.items() if image_format.is_linear}
_PICTURES = SUFFIXES.keys() - _MAPS
_PHOTO_SIDE_PX = 640
_MAP_HEIGHT_PX = 512
_LARGEST_HALF = 65504.0
_WORD = re.compile(r"[^0-9A-Za-z]")


def read_photos(
    folders: Sequence[Path], exclude: Sequence[str] = (), only: Sequence[str] = ("*",)
) -> list[Tensor]:
    """Every photo of the folders, uint8 sRGB (H, W, 3), longest side at most 640 px, in order of name.

    Raises:
        RecipeError: a folder cannot be read, or there is no photo in any of them.
        PhotoError: a photo cannot be read.
    """
    return [_read_photo(path, _PHOTO_SIDE_PX) for path in _list(folders, _PICTURES, exclude, only)]


def source_weights(folders: Sequence[Path], exclude: Sequence[str] = ()) -> list[float]:
    """Relative frequencies of the photos that `read_photos` returns, so that no single source dominates.

    Photos whose names begin with the same word (letters and digits) are of one source; n of them together weigh
    sqrt(n).

    Raises:
        RecipeError: as `read_photos`.
    """
    sources = [_WORD.split(path.name)[0] for path in _list(folders, _PICTURES, exclude)]
    counts = Counter(sources)
    return [counts[source] ** -0.5 for source in sources]


def read_maps(
    folders: Sequence[Path], exclude: Sequence[str] = (), only: Sequence[str] = ("*",)
) -> list[Tensor]:
    """Every lat-long map of the folders, half precision (3, H, 2 H), at most 512 px high, linear light.

    Raises:
        RecipeError: a folder cannot be read, or there is no map in any of them.
        PhotoError: a map cannot be read.
    """
    return [_read_map(path) for path in _list(folders, _MAPS, exclude, only)]


def read_pairs(folders: Sequence[Path], at_most: int | None = None) -> list[tuple[Tensor, Tensor]]:
    """Aligned (photo, transmission) pairs of folders as `layouts.read_folders` joins them, in order of path.

    Of each folder `at_most` so many are read, evenly spaced.

    Raises:
        RecipeError: a folder cannot be read or is empty; a picture has no partner, or one of another size.
        PhotoError: a picture cannot be read.
    """
    return [_read_pair(trio) for folder in folders for trio in _evenly(_trios(folder), at_most)]


def _evenly(trios: list[PictureGroup], at_most: int | None) -> list[PictureGroup]:
    count = min(len(trios), at_most or len(trios))
    return [trios[number * len(trios) // count] for number in range(count)]


def _trios(folder: Path) -> list[PictureGroup]:
    try:
        found = read_folders(folder)
    except PhotoError as error:
        raise RecipeError(
            error.happened,
            "blended/ and transmission_layer/ beside each other",
            "name another folder in the recipe, or set BREWSTER_DATA to where the data lies",
        ) from error
    if found.refused:
        raise RecipeError(
            f"{folder}: {found.refused[0]} ({len(found.refused)} such)",
            "each photo needs one transmission of its name, and no transmission is left over",
            "add or remove files until the names match",
        )
    return sorted(found.trios, key=lambda trio: trio.photo)


def _read_pair(trio: PictureGroup) -> tuple[Tensor, Tensor]:
    photo, transmission = (
        torch.from_numpy(Photo.open(path).srgb_8bit().copy()) for path in (trio.photo, trio.transmission)
    )
    if photo.shape != transmission.shape:
        raise RecipeError(
            f"{trio.photo} and {trio.transmission} differ in size",
            "pairs must be aligned pixel by pixel",
            "crop one to the other",
        )
    return photo, transmission


def _read_map(path: Path) -> Tensor:
    linear = np.clip(_at_most(Photo.open(path), 2 * _MAP_HEIGHT_PX), 0, _LARGEST_HALF)
    return torch.from_numpy(linear.astype(np.float16)).permute(2, 0, 1).contiguous()


def _read_photo(path: Path, longest_px: int) -> Tensor:
    encoded = to_encoded(np.clip(_at_most(Photo.open(path), longest_px), 0, 1))
    return torch.from_numpy(np.rint(encoded * 255).astype(np.uint8))


def _at_most(photo: Photo, longest_px: int) -> NDArray[np.float32]:
    scale = min(1.0, longest_px / max(photo.size))
    width, height = (max(1, round(side * scale)) for side in photo.size)
    return photo.resized(width, height)


def _list(
    folders: Iterable[Path], suffixes: set[str], exclude: Sequence[str] = (), only: Sequence[str] = ("*",)
) -> list[Path]:
    found = sorted(
        path
        for folder in folders
        for path in _entries(folder)
        if path.suffix.lower() in suffixes and _matches(path, only) and not _matches(path, exclude)
    )
    if folders and not found:
        raise RecipeError(
            f"no pictures in {', '.join(map(str, folders))}",
            f"files ending in {', '.join(sorted(suffixes))}",
            "name another folder in the recipe, or set BREWSTER_DATA to where the data lies",
        )
    return found


def _matches(path: Path, patterns: Sequence[str]) -> bool:
    return any(fnmatch(path.name, pattern) for pattern in patterns)


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise RecipeError(
            f"{folder} cannot be read ({error.strerror})",
            "a folder with pictures",
            "name another folder in the recipe, or set BREWSTER_DATA to where the data lies",
        ) from error
