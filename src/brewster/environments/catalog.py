"""Catalogs of environment maps and pictures for random scenes: from folders of files; by default, those of brewster."""

from __future__ import annotations

import csv
import functools
import hashlib
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path

from brewster.environments.assets import (
    BUILTIN_MAPS,
    BUILTIN_PHOTOS,
    check_map,
    read_bytes,
)
from brewster.errors import BrewsterError, RecipeError, error_prefix
from brewster.files import folder_entries, is_unicode
from brewster.image_formats import format_of
from brewster.photo import Photo, read_size
from brewster.scene.sampler import Asset, Catalog
from brewster.scene.world import AssetSource


@functools.cache
def builtin_catalog() -> Catalog:
    """Returns the maps and photos that are part of brewster."""
    return read_catalog([], [])[0]


def read_catalog(
    maps: Sequence[Path], pictures: Sequence[Path], exclude: Sequence[str] = ()
) -> tuple[Catalog, list[BrewsterError]]:
    """Lists the maps and pictures in folders, by default the built-in ones, without those in `exclude`.

    Maps are decoded and validated; of pictures, only the headers are read. A `manifest.csv` with the columns
    file and category contains the categories of maps. Returns the catalog, and an error for each file that
    cannot be used. Raises RecipeError if a folder or its manifest cannot be read, or no file can be used.
    """
    found_maps, refused_maps = _read_folders(maps or [BUILTIN_MAPS], exclude, are_maps=True)
    found, refused = _read_folders(pictures or [BUILTIN_PHOTOS], exclude, are_maps=False)
    return Catalog(maps=found_maps, pictures=found), refused_maps + refused


def _read_folders(
    folders: Sequence[Path], exclude: Sequence[str], *, are_maps: bool
) -> tuple[tuple[Asset, ...], list[BrewsterError]]:
    found, refused = dict[str, Asset](), list[BrewsterError]()
    for folder in folders:
        categories = _read_categories(folder)
        for path in _list_files(folder, are_maps):
            if path.name in found or any(fnmatch(path.name, pattern) for pattern in exclude):
                continue
            try:
                found[path.name] = _read_asset(path, categories.get(path.name, ""), are_maps)
            except BrewsterError as error:
                refused.append(error)
    if not found:
        raise RecipeError(
            f"no {'maps' if are_maps else 'photos'} in {', '.join(map(str, folders))}",
            "expected lat-long .hdr or .exr files" if are_maps else "expected image files",
            str(refused[0]) if refused else "choose another folder",
        )
    return tuple(found[name] for name in sorted(found)), refused


def _read_asset(path: Path, category: str, is_map: bool) -> Asset:
    if not is_unicode(path.name):
        raise RecipeError(
            f"the name of {str(path)!r} is not text", "expected a name in UTF-8", "rename the file"
        )
    data = read_bytes(path)
    with error_prefix(path):
        pixels = check_map(Photo.open(data).linear(), str(path)) if is_map else None
        width, height = read_size(data) if pixels is None else pixels.shape[1::-1]
    source = AssetSource(file=path.name, sha256=hashlib.sha256(data).hexdigest())
    return Asset(source=source, width=width, height=height, category=category)


def _list_files(folder: Path, are_maps: bool) -> Iterator[Path]:
    try:
        entries = folder_entries(folder)
    except OSError as error:
        raise RecipeError(
            f"{folder} cannot be read ({error.strerror})",
            "expected a folder of files",
            "choose another folder",
        ) from error
    for path in entries:
        image_format = format_of(path)
        if image_format and not path.name.startswith(".") and image_format.is_linear == are_maps:
            yield path


def _read_categories(folder: Path) -> dict[str, str]:
    try:
        if folder / "manifest.csv" not in folder_entries(folder):
            return {}
        with (folder / "manifest.csv").open(newline="", encoding="utf-8-sig") as file:
            return {row["file"]: row.get("category") or "" for row in csv.DictReader(file) if row.get("file")}
    except OSError:
        return {}
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecipeError(
            f"{folder / 'manifest.csv'} cannot be read ({error})",
            "expected a table with the columns file and category, in UTF-8",
            "save the table in UTF-8, or remove it",
        ) from error
