"""Reads folders of photos, HDR maps and aligned pairs into memory, reduced if large, for the
streams in `mixtures`.
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brewster.base.files import folder_entries
from brewster.base.image_formats import SUFFIXES
from brewster.errors import PhotoError, RecipeError, error_prefix, read_errors
from brewster.evaluation.benchmarks.pairing import ImageGroup, read_folders
from brewster.photo import Photo
from brewster.photo.srgb import to_encoded

_MAPS = {suffix for suffix, image_format in SUFFIXES.items() if image_format.is_linear}
_PHOTOS = SUFFIXES.keys() - _MAPS
_PHOTO_SIDE_PX = 1024
_MAP_HEIGHT_PX = 512
_MAX_FLOAT16 = 65504.0
_WORD_END = re.compile(r"[^0-9A-Za-z]")
_FOLDER_CURE = "choose another folder in the recipe, or set BREWSTER_DATA to the folder of the data"


def read_photos(
    folders: Sequence[Path], exclude: Sequence[str] = (), only: Sequence[str] = ("*",)
) -> list[Tensor]:
    """Reads every photo of the folders: uint8 sRGB (H, W, 3), longest side at most 1,024 px, sorted
    by path.

    `exclude` and `only` are patterns of file names, as in `fnmatch`. Raises RecipeError if a folder
    cannot be read, or none of them contains a photo that matches; PhotoError if a photo cannot be
    read.
    """
    photos = []
    for path in _list_images(folders, _PHOTOS, exclude, only):
        encoded = to_encoded(np.clip(_downscaled(_open(path), _PHOTO_SIDE_PX), 0, 1))
        photos.append(torch.from_numpy(np.rint(encoded * 255).astype(np.uint8)))
    if folders and not photos:
        raise RecipeError(
            f"no photo in {', '.join(map(str, folders))} matches the patterns",
            f"expected names that match one of {[*only]} and none of {[*exclude]}",
            "correct exclude and held_out in the recipe",
        )
    return photos


def source_weights(folders: Sequence[Path], exclude: Sequence[str] = ()) -> list[float]:
    """Returns sampling weights for the photos of `read_photos`, so that no single source dominates.

    Photos whose names start with the same word are one source. Its n photos have the total weight
    n^(2/3).
    """
    sources = [_WORD_END.split(path.name)[0] for path in _list_images(folders, _PHOTOS, exclude)]
    counts = Counter(sources)
    return [counts[source] ** (-1 / 3) for source in sources]


def read_maps(
    folders: Sequence[Path], exclude: Sequence[str] = (), only: Sequence[str] = ("*",)
) -> list[Tensor]:
    """Reads every lat-long map of the folders, as `read_photos`: float16 (3, H, 2 H), at most 512
    px high, linear light. It is no error if none matches.
    """
    maps = []
    for path in _list_images(folders, _MAPS, exclude, only):
        linear = np.clip(_downscaled(_open(path), 2 * _MAP_HEIGHT_PX), 0, _MAX_FLOAT16)
        maps.append(torch.from_numpy(linear.astype(np.float16)).permute(2, 0, 1).contiguous())
    return maps


def read_pairs(
    folders: Sequence[Path], max_pairs: int | None = None
) -> list[tuple[Tensor, Tensor]]:
    """Reads aligned pairs (photo, transmission), uint8 sRGB (H, W, 3), sorted by path.

    `pairing.read_folders` matches the files by name. At most `max_pairs` pairs are read from each
    folder, evenly spaced. Raises RecipeError if a folder cannot be read or is empty, or a photo has
    no transmission of its size.
    """
    pairs = []
    for folder in folders:
        groups = image_groups(folder)
        count = min(len(groups), max_pairs or len(groups))
        for number in range(count):
            group = groups[number * len(groups) // count]
            photo, transmission = read_aligned(group.photo, group.transmission)
            pairs.append((photo, transmission))
    return pairs


def image_groups(folder: Path) -> list[ImageGroup]:
    """Returns the groups of a folder, sorted by the path of the photo. Raises RecipeError if the
    folder cannot be read or is empty, or a photo has no transmission with its name.
    """
    try:
        found = read_folders(folder)
    except PhotoError as error:
        raise RecipeError(
            error.happened,
            "expected a folder that contains blended/ and transmission_layer/",
            _FOLDER_CURE,
        ) from error
    if found.excluded:
        raise RecipeError(
            f"{folder}: {found.excluded[0]} (images without a partner: {len(found.excluded)})",
            "expected one transmission with the name of each photo, and no other files",
            "add or remove files until the names match",
        )
    return sorted(found.groups, key=lambda group: group.photo)


def read_aligned(*paths: Path) -> list[Tensor]:
    """Reads images of one size, uint8 sRGB (H, W, 3). Raises RecipeError if sizes differ,
    PhotoError.
    """
    images = [torch.from_numpy(_open(path).srgb_8bit().copy()) for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image.shape != images[0].shape:
            raise RecipeError(
                f"{paths[0]} and {path} differ in size",
                "expected images that are aligned pixel by pixel",
                "crop one to the size of the other",
            )
    return images


def _open(path: Path) -> Photo:
    with error_prefix(path):
        return Photo.open(path)


def _downscaled(photo: Photo, max_side_px: int) -> NDArray[np.float32]:
    scale = min(1.0, max_side_px / max(photo.size))
    width, height = (max(1, round(side * scale)) for side in photo.size)
    return photo.resized(width, height)


def _list_images(
    folders: Iterable[Path],
    suffixes: set[str],
    exclude: Sequence[str] = (),
    only: Sequence[str] = ("*",),
) -> list[Path]:
    paths: list[Path] = []
    for folder in folders:
        with read_errors(folder, RecipeError, "expected a folder with images", _FOLDER_CURE):
            paths += folder_entries(folder)
    images = sorted(path for path in paths if path.suffix.lower() in suffixes)
    if folders and not images:
        happened = f"no images in {', '.join(map(str, folders))}"
        raise RecipeError(
            happened, f"expected files ending in {', '.join(sorted(suffixes))}", _FOLDER_CURE
        )
    return [path for path in images if _matches(path, only) and not _matches(path, exclude)]


def _matches(path: Path, patterns: Sequence[str]) -> bool:
    return any(fnmatch(path.name, pattern) for pattern in patterns)
