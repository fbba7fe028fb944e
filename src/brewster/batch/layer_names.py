"""Names the layers of photos and films. No two photos have a layer with the same path."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from brewster.base import image_formats
from brewster.base.files import SeparationPaths, absolute
from brewster.base.remote_path import Location
from brewster.errors import OutputError
from brewster.options import Options

_SUFFIX_RANKS: Final = {suffix: rank for rank, suffix in enumerate(image_formats.SUFFIXES)}


def name_layers(
    images: Iterable[tuple[Location, Location]], options: Options
) -> list[tuple[Location, dict[str, Location]]]:
    """Returns the images with the paths of their layers, from pairs of an image and the folder of
    its layers, as `images_in` yields them. An image that occurs several times is included once.

    `a.jpg` gives `a.transmission.jpg`, and `a.png` gives `a.transmission.png`. If a layer of two
    images of a folder would have the same path, as their confidence, the image whose suffix comes
    first in `SUFFIXES` keeps it, and the other one uses its full name: `a.confidence.png` and
    `a.png.confidence.png`. Therefore `a.jpg` has the same names in all batches, whichever files are
    added to its folder. Only an image whose name has no image suffix comes before: its full name is
    its short name. Raises OutputError if layers of images of two folders would have the same path.
    """
    found: dict[str, SeparationPaths] = {}
    targets: dict[str, dict[str, Location]] = {}
    for image, folder in images:
        if (key := absolute(image)) not in found:
            found[key] = SeparationPaths(image, folder, _content_format(image))
            targets[key] = {}

    def naming_rank(key: str) -> tuple[int, int, str]:
        # Images without an image suffix are first, then short stems: `a.jpg` is the stem of
        # `a.jpg.png`.
        image = found[key].source
        rank = _SUFFIX_RANKS.get(image.suffix.lower())
        return (0, 0, image.name) if rank is None else (len(image.stem), rank, image.name)

    in_naming_order = sorted(found, key=naming_rank)
    for layer in options.layers:
        owners: dict[str, Location] = {}
        for key in in_naming_order:
            paths = found[key]
            suffix = options.suffix(layer, paths.suffix)
            target = paths.target(layer, suffix)
            owner = owners.get(_case_insensitive(target))
            if owner and owner.parent == paths.source.parent:
                target = paths.target(layer, suffix, has_full_name=True)
            owner = owners.setdefault(_case_insensitive(target), paths.source)
            if owner is not paths.source:
                raise OutputError(
                    f"{owner} and {paths.source} would both be written as {target}",
                    "expected a separate output name for each image",
                    "pass their parent folder, whose tree is mirrored, or use different output "
                    "folders",
                )
            targets[key][layer] = target
    return [(found[key].source, targets[key]) for key in found]


def _content_format(image: Location) -> image_formats.ImageFormat | None:
    """Only of local files without an image suffix: for a store, the requests would take hours."""
    if image_formats.format_of(image) or not isinstance(image, Path) or not os.path.isfile(image):  # noqa: PTH113
        return None
    try:
        with image.open("rb") as file:
            return image_formats.format_of_content(file.read(image_formats.HEAD_BYTES))
    except OSError:  # the separation opens the image later, and reports the error
        return None


def _case_insensitive(target: Location) -> str:
    """Returns the absolute path with a suffix in lower case: `a.transmission.JPG` and `.jpg` are
    one on Windows.
    """
    root, suffix = os.path.splitext(absolute(target))  # noqa: PTH122  (faster than pathlib for millions of paths)
    return root + suffix.lower()


def name_videos(
    films: Sequence[tuple[Location, Location]], options: Options
) -> list[tuple[Location, dict[str, Location]]]:
    """Returns the films with the paths of layers: `a.transmission.mp4`; with an `a.mov`,
    `a.mp4.transmission.mp4`.
    """
    stems = Counter((folder, film.stem) for film, folder in films)
    named = list[tuple[Location, dict[str, Location]]]()
    for film, folder in films:
        stem = film.stem if stems[folder, film.stem] == 1 else film.name
        suffix = film.suffix if film.suffix.lower() in image_formats.WRITABLE_VIDEOS else ".mp4"
        named.append(
            (film, {layer: folder / f"{stem}.{layer}{suffix}" for layer in options.layers})
        )
    return named
