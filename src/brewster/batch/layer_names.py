"""Chooses the paths of the layers of a batch, so that no two photos have a layer with the same path.

The names of a photo that is separated alone depend only on this photo. The other files in its folder do not change them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from brewster.errors import OutputError
from brewster.files import SeparationPaths, absolute
from brewster.image_formats import SUFFIXES
from brewster.remote_path import Location

_SUFFIX_RANKS: Final = {suffix: rank for rank, suffix in enumerate(SUFFIXES)}


def name_layers(
    images: Iterable[tuple[Location, Location]],
    layers: Sequence[str],
    suffix: Callable[[str, Location], str | None] = lambda _layer, _image: None,
) -> list[tuple[Location, dict[str, Location]]]:
    """Returns the images with the paths of their layers. An image that occurs several times is included once.

    The name of a layer begins with the stem of the image: `a.jpg` gives `a.transmission.jpg`, and `a.png` gives
    `a.transmission.png`. If a layer of two images of a folder would have the same path, as the confidence of these images, the
    image whose suffix comes first in `SUFFIXES` keeps it, and the other one uses its full name: `a.confidence.png` and
    `a.png.confidence.png`. Therefore `a.jpg` has the same names in all batches, whichever files are added to its folder.

    Args:
        images: pairs of an image and the folder of its layers, as `images_in` yields them.
        layers: the names of the layers.
        suffix: returns the suffix of a layer of an image; None is the default of `SeparationPaths.target`.

    Raises:
        OutputError: a layer of two images of different folders would have the same path.
    """
    found: dict[str, SeparationPaths] = {}
    for image, folder in images:
        found.setdefault(absolute(image), SeparationPaths(image, folder))
    targets: dict[str, dict[str, Location]] = {key: {} for key in found}
    in_naming_order = sorted(found, key=lambda key: _naming_rank(found[key].source))
    for layer in layers:
        owners: dict[str, Location] = {}
        for key in in_naming_order:
            paths, suffix_or_none = found[key], suffix(layer, found[key].source)
            target = paths.target(layer, suffix_or_none)
            owner = owners.get(_case_insensitive(target))
            if owner and owner.parent == paths.source.parent:
                target = paths.target(layer, suffix_or_none, has_full_name=True)
            owner = owners.setdefault(_case_insensitive(target), paths.source)
            if owner is not paths.source:
                raise OutputError(
                    f"{owner} and {paths.source} would both be written as {target}",
                    "expected a separate output name for each image",
                    "pass their parent folder, whose tree is mirrored, or use different output folders",
                )
            targets[key][layer] = target
    return [(found[key].source, targets[key]) for key in found]


def _naming_rank(image: Location) -> tuple[int, int, str]:
    """Returns the key by which `name_layers` sorts the images: the first ones keep their short names.

    Images with short stems are first, because the full name of `a.jpg` is the stem of `a.jpg.png`.
    """
    suffix = image.suffix.lower()
    return len(image.stem), _SUFFIX_RANKS.get(suffix, len(_SUFFIX_RANKS)), image.name


def _case_insensitive(target: Location) -> str:
    """Returns the absolute path with a suffix in lower case: `a.transmission.JPG` and `.jpg` are one file on Windows."""
    root, suffix = os.path.splitext(absolute(target))  # noqa: PTH122  (faster than pathlib for millions of paths)
    return root + suffix.lower()
