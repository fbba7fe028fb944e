"""Loads the environment maps and pictures of scenes, files by name and sha256, and lists them in
catalogs.
"""

import csv
import functools
import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brewster.base.cache import ByteLimitedCache
from brewster.base.files import folder_entries, is_unicode
from brewster.base.image_formats import format_of
from brewster.errors import BrewsterError, RecipeError, UnsupportedPhoto, error_prefix, read_errors
from brewster.photo import Photo, read_size
from brewster.photo.srgb import REC709_LUMINANCE
from brewster.render.scene.sampler import Asset, Catalog
from brewster.render.scene.world import AssetSource, EnvironmentMap, Plane

Float32 = NDArray[np.float32]

BUILTIN_MAPS = Path(__file__).with_name("maps")
BUILTIN_PHOTOS = Path(__file__).with_name("photos")
"""CC0 maps and photos that are part of brewster. The `manifest.csv` of each folder has their
origins and licences.
"""

_MAX_CACHE_BYTES = 300_000_000
_MAX_CLIPPED_FRACTION = 0.002
_LUMINANCE = np.array(REC709_LUMINANCE, np.float32)


class Assets:
    """Loads sources from the first folder that contains the exact file, or else from the built-in
    maps and photos.

    The most recently used sources are cached.
    """

    def __init__(self, folders: Sequence[Path] = ()) -> None:
        self._folders = (*folders, BUILTIN_MAPS, BUILTIN_PHOTOS)
        self._cache = ByteLimitedCache[Float32](_MAX_CACHE_BYTES)

    def map_radiance(self, environment: EnvironmentMap) -> Float32:
        """Returns the radiance of a lat-long map, (H, 2 H, 3), scaled to the mean luminance in the
        scene.

        Raises RecipeError if the file is missing, or has another sha256 than in the scene;
        PhotoError if the file cannot be decoded, or cannot light a scene (see `check_map`).
        """
        light = self._cached("map", environment.source, self._read_map)
        return light * np.float32(environment.luminance)

    def plane_radiance(self, plane: Plane) -> Float32:
        """Returns the radiance of a picture, (H, W, 3), with brighter highlights (see
        `Plane.highlight_boost`).

        The file is decoded with its colour profile; without a profile as sRGB (integers) or linear
        Rec.709 (floats).
        """
        picture = self._cached(
            "picture", plane.source, lambda source: self._open(source).linear().clip(0, 1)
        )
        highlight = ((picture.max(axis=2, keepdims=True) - 0.8) / 0.2).clip(0, 1)
        mean = (picture @ _LUMINANCE).mean() + np.float32(1e-4)
        boost: Float32 = 1 + np.float32(plane.highlight_boost) * highlight**2
        light: Float32 = picture * boost * (np.float32(plane.luminance) / mean)
        return light

    def _cached(
        self, kind: str, source: AssetSource, read: Callable[[AssetSource], Float32]
    ) -> Float32:
        return self._cache.get_or_create((kind, source.file, source.sha256), lambda: read(source))

    def _read_map(self, source: AssetSource) -> Float32:
        light: Float32 = np.maximum(
            check_map(self._open(source).linear(), source.file), np.float32(0)
        )
        light /= _mean_luminance(light)
        return light

    def _open(self, source: AssetSource) -> Photo:
        with error_prefix(source.file):
            return Photo.open(self._bytes(source))

    def _bytes(self, source: AssetSource) -> bytes:
        paths = [path for folder in self._folders if (path := folder / source.file).is_file()]
        for path in paths:
            data = read_bytes(path)
            if not source.sha256 or hashlib.sha256(data).hexdigest() == source.sha256:
                return data
        if paths:
            raise RecipeError(
                f"{paths[0]} is not the file that was chosen when the scene was sampled",
                f"expected the sha256 {source.sha256}",
                "choose the folder of the original file",
            )
        searched = ", ".join(map(str, self._folders))
        raise RecipeError(
            f"{source.file} was not found in {searched}",
            "expected the file that was chosen when the scene was sampled",
            "choose its folder with --maps or --photos",
        )


def read_bytes(path: Path) -> bytes:
    """Returns the bytes of a file. Raises RecipeError if the file cannot be read."""
    with read_errors(
        path, RecipeError, "expected an image file", "remove the file from the folder"
    ):
        return path.read_bytes()


def check_map(texels: Float32, name: str) -> Float32:
    """Returns the map, if it can light a scene. Raises UnsupportedPhoto if the map is not 2:1, has
    values that are not finite, is black, or is clipped like an 8-bit image.
    """
    height, width = texels.shape[:2]
    if width != 2 * height:
        raise UnsupportedPhoto(
            f"{name} is {width} x {height}",
            "expected a lat-long map, twice as wide as high",
            "convert the image to a lat-long map",
        )
    brightest = texels.max()
    if not np.isfinite(texels).all() or brightest <= 0:
        raise UnsupportedPhoto(
            f"{name} is black, or has values that are not finite",
            "expected finite radiance in every texel, and radiance above 0 in at least one texel",
            "repair the map, or remove it",
        )
    if (texels.max(axis=2) >= brightest).mean() > _MAX_CLIPPED_FRACTION:
        raise UnsupportedPhoto(
            f"{name} is clipped: many texels have the maximum value",
            "expected the full dynamic range of the light",
            "use the image as a picture, or use the unclipped original",
        )
    return texels


def _mean_luminance(texels: Float32) -> np.float32:
    """Returns the mean luminance over the sphere. Lamps have little weight: values are clipped at
    ten means.
    """
    height = texels.shape[0]
    solid_angle = np.sin((np.arange(height) + 0.5) / height * np.pi)[:, None]
    luminance = texels @ _LUMINANCE
    weights = np.broadcast_to(solid_angle / solid_angle.sum() / luminance.shape[1], luminance.shape)
    limit = 10 * (luminance * weights).sum()
    return np.float32((np.minimum(luminance, limit) * weights).sum())


# --- catalogs of the content of random scenes: from folders of files; by default, those of brewster


@functools.cache
def builtin_catalog() -> Catalog:
    """Returns the maps and photos that are part of brewster."""
    return read_catalog([], [])[0]


def read_catalog(
    maps: Sequence[Path], pictures: Sequence[Path]
) -> tuple[Catalog, list[BrewsterError]]:
    """Lists the maps and pictures in folders, by default the built-in ones.

    Maps are decoded and validated; of pictures, only the headers are read. A `manifest.csv` with
    the columns file and category contains the categories of maps. Returns the catalog, and an error
    for each file that cannot be used. Raises RecipeError if a folder or its manifest cannot be
    read, or no file can be used.
    """
    found_maps, refused_maps = _read_folders(maps or [BUILTIN_MAPS], are_maps=True)
    found, refused = _read_folders(pictures or [BUILTIN_PHOTOS], are_maps=False)
    return Catalog(maps=found_maps, pictures=found), refused_maps + refused


def _read_folders(
    folders: Sequence[Path], *, are_maps: bool
) -> tuple[tuple[Asset, ...], list[BrewsterError]]:
    found = dict[str, Asset]()
    refused = list[BrewsterError]()
    for folder in folders:
        categories = _read_categories(folder)
        for path in _list_files(folder, are_maps):
            if path.name in found:
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
    with read_errors(folder, RecipeError, "expected a folder of files", "choose another folder"):
        entries = folder_entries(folder)
    for path in entries:
        image_format = format_of(path)
        if image_format and not path.name.startswith(".") and image_format.is_linear == are_maps:
            yield path


def _read_categories(folder: Path) -> dict[str, str]:
    path = folder / "manifest.csv"
    expected = "expected a table with the columns file and category, in UTF-8"
    cure = "save the table in UTF-8, or remove it"
    with read_errors(path, RecipeError, expected, cure, (csv.Error,)), suppress(OSError):
        if path in folder_entries(folder):
            with path.open(newline="", encoding="utf-8-sig") as file:
                return {
                    r["file"]: r.get("category") or ""
                    for r in csv.DictReader(file)
                    if r.get("file")
                }
    return {}
