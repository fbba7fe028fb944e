"""Find the pictures in a folder by dataset and name: `real/12.png` is picture 12 of the dataset real."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from brewster.errors import BrewsterError
from brewster.files import is_image_file, natural_key, normalised
from brewster.image_formats import SUFFIXES
from brewster.user_study.study import UNNAMED_DATASET

Key = tuple[str, str]
"""The dataset of a picture, and its file name without the suffix (the stem)."""

_MAX_LISTED: Final = 8
_TRANSMISSION: Final = ".transmission"


def find_pictures(folder: Path, datasets: Sequence[str] = ()) -> dict[Key, Path]:
    """Find pictures in the subfolders, one for each dataset, or in the folder itself if no subfolder has pictures.

    Outputs may be named as `brewster -o` names them: `name.transmission.png` counts as `name`, and the files
    `name.reflection.png` and `name.confidence.png` of the same photo are ignored. The keys are (dataset, stem), in
    natural order (2 before 10). With `datasets`, only these are used, in this order. Raises BrewsterError if the folder
    contains no picture, a dataset is missing, two files have the same name, or pictures are both in the folder and in
    its subfolders, and `datasets` is empty."""
    if not folder.is_dir():
        raise BrewsterError(f"{folder} is not a folder", "expected a folder with pictures", "check the path")
    subfolders = {
        normalised(path.name): path for path in folder.iterdir() if path.is_dir() and path.name[0] != "."
    }
    stems_by_dataset = {
        name: stems
        for name in sorted(subfolders, key=natural_key)
        if (stems := _list_pictures(subfolders[name]))
    }
    if missing := [name for name in datasets if name not in stems_by_dataset]:
        raise BrewsterError(
            f"{folder} has no dataset {missing[0]!r}",
            f"expected the name of a subfolder with pictures ({', '.join(stems_by_dataset) or 'there are none'})",
            "check the name",
        )
    if not datasets and (top_level := _list_pictures(folder)):
        if stems_by_dataset:
            names = shorten_list([path.name for path in top_level])
            raise BrewsterError(
                f"{folder} contains pictures ({names}) and subfolders with pictures ({', '.join(stems_by_dataset)})",
                "expected pictures either in the folder or in subfolders, one for each dataset",
                "move the pictures into a subfolder, or choose subfolders: --dataset NAME",
            )
        stems_by_dataset = {UNNAMED_DATASET: top_level}
    found: defaultdict[Key, list[Path]] = defaultdict(list)
    for name in dict.fromkeys(datasets or stems_by_dataset):
        for path, stem in stems_by_dataset[name].items():
            found[name, stem].append(path)
    if not found:
        happened = f"{folder} contains no picture"
        raise BrewsterError(happened, "expected pictures, or subfolders with pictures", "check the path")
    if duplicates := [" and ".join(sorted(map(str, paths))) for paths in found.values() if len(paths) > 1]:
        raise BrewsterError(
            f"{shorten_list(duplicates)} have the same name",
            "expected different names without the suffix, because pictures are paired by name",
            "keep one file of each name",
        )
    return {key: paths[0] for key, paths in found.items()}


def select_pictures(pictures: Mapping[Key, Path], names: Sequence[str], folder: Path) -> dict[Key, Path]:
    """The pictures with these names, in the order of `pictures`; all of them if `names` is empty. A name is
    "dataset/stem", or "stem" if there are no datasets; a suffix is allowed. Raises BrewsterError if a name has no
    picture."""
    by_name = {"/".join(filter(None, key)): key for key in pictures}
    stems = {
        name: name.rpartition(".")[0] if f".{name.rpartition('.')[2]}".lower() in SUFFIXES else name
        for name in map(normalised, names)
    }
    keys = {name: by_name.get(name, by_name.get(stem)) for name, stem in stems.items()}
    if missing := [name for name, key in keys.items() if key is None]:
        raise BrewsterError(
            f"{folder} has no picture for these names of the list: {shorten_list(missing)}",
            f"expected names such as {', '.join(list(by_name)[:3])}",
            "correct the list",
        )
    return {key: path for key, path in pictures.items() if not names or key in keys.values()}


def shorten_list(items: Sequence[str]) -> str:
    """Join the first items with semicolons, and add the number of the others."""
    remaining = len(items) - _MAX_LISTED
    return "; ".join(items[:_MAX_LISTED]) + (f"; and {remaining} more" if remaining > 0 else "")


def _list_pictures(folder: Path) -> dict[Path, str]:
    """The stems of the pictures in a folder, by path in natural order, without other layers of a photo with a
    transmission."""
    pictures = {path: normalised(path.stem) for path in folder.iterdir() if is_image_file(path)}
    separated = [
        stem.removesuffix(_TRANSMISSION) for stem in pictures.values() if stem.endswith(_TRANSMISSION)
    ]
    others = {f"{stem}{layer}" for stem in separated for layer in (".reflection", ".confidence")}
    stems = {path: stem.removesuffix(_TRANSMISSION) for path, stem in pictures.items() if stem not in others}
    return dict(sorted(stems.items(), key=lambda pair: (natural_key(pair[1]), pair[0])))
