"""Reads folders of photos, HDR maps and aligned pairs into memory, small, for the streams in `mix`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brewster.errors import RecipeError
from brewster.files import SUFFIXES
from brewster.light import to_encoded
from brewster.photo import Photo

_MAPS = {suffix for suffix, container in SUFFIXES.items() if container in ("exr", "hdr")}
_PICTURES = SUFFIXES.keys() - _MAPS
_PHOTO_SIDE_PX = 640
_MAP_HEIGHT_PX = 512
_LARGEST_HALF = 65504.0


def read_photos(folders: Sequence[Path], exclude: Sequence[str] = ()) -> list[Tensor]:
    """Every photo of the folders, uint8 sRGB (H, W, 3), longest side at most 640 px, in order of name.

    Raises:
        RecipeError: a folder cannot be read, or there is no photo in any of them.
        PhotoError: a photo cannot be read.
    """
    return [_read_photo(path, _PHOTO_SIDE_PX) for path in _list(folders, _PICTURES, exclude)]


def read_maps(folders: Sequence[Path], exclude: Sequence[str] = ()) -> list[Tensor]:
    """Every lat-long map of the folders, half precision (3, H, 2 H), at most 512 px high, linear light.

    Raises:
        RecipeError: a folder cannot be read, or there is no map in any of them.
        PhotoError: a map cannot be read.
    """
    return [_read_map(path) for path in _list(folders, _MAPS, exclude)]


def read_pairs(folders: Sequence[Path]) -> list[tuple[Tensor, Tensor]]:
    """Aligned (photo, transmission) pairs of folders with `blended/` and `transmission*/`, joined by name.

    Raises:
        RecipeError: a folder cannot be read or is empty; a photo has no partner, or one of another size.
        PhotoError: a picture cannot be read.
    """
    return [_read_pair(path) for folder in folders for path in _list([folder / "blended"], _PICTURES)]


def _read_pair(blended: Path) -> tuple[Tensor, Tensor]:
    partners = [
        path
        for path in blended.parent.parent.glob(f"transmission*/{blended.stem}.*")
        if path.suffix.lower() in _PICTURES
    ]
    if len(partners) != 1:
        raise RecipeError(
            f"{blended} has {len(partners)} partners",
            "each blended picture needs one of the same name under transmission/",
            "add or remove files until the names match",
        )
    photo, transmission = (_read_photo(path, 10**6) for path in (blended, partners[0]))
    if photo.shape != transmission.shape:
        raise RecipeError(
            f"{blended} and {partners[0]} differ in size",
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
    return photo.small(width, height)


def _list(folders: Iterable[Path], suffixes: set[str], exclude: Sequence[str] = ()) -> list[Path]:
    found = sorted(
        path
        for folder in folders
        for path in _entries(folder)
        if path.suffix.lower() in suffixes and not any(fnmatch(path.name, pattern) for pattern in exclude)
    )
    if folders and not found:
        raise RecipeError(
            f"no pictures in {', '.join(map(str, folders))}",
            f"files ending in {', '.join(sorted(suffixes))}",
            "name another folder in the recipe, or set BREWSTER_DATA to where the data lies",
        )
    return found


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise RecipeError(
            f"{folder} cannot be read ({error.strerror})",
            "a folder with pictures",
            "name another folder in the recipe, or set BREWSTER_DATA to where the data lies",
        ) from error
