"""Which pictures a folder holds, by dataset and name: `real/12.png` is the picture 12 of the dataset real."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from brewster.errors import BrewsterError
from brewster.files import SUFFIXES
from brewster.user_study.study import UNNAMED_DATASET

Key = tuple[str, str]
"""Dataset and stem."""

_MAX_LISTED: Final = 8
_TRANSMISSION: Final = ".transmission"


def find_pictures(folder: Path, datasets: Sequence[str] = ()) -> dict[Key, Path]:
    """The pictures of a folder in natural order: in its folders, or in itself where these hold none.

    Of the `datasets` only and in their order, if any are given. Outputs may be called like those of `brewster -o`:
    name.transmission.png, beside which name.reflection.png and name.confidence.png are passed over.

    Raises:
        BrewsterError: there is no picture, no such dataset, one name has several files, or pictures lie both in the
            folder and in its folders, and no `datasets` say which.
    """
    if not folder.is_dir():
        raise BrewsterError(f"{folder} is no folder", "one with pictures is needed", "name another")
    subfolders = {
        _normalised(subfolder.name): subfolder
        for subfolder in folder.iterdir()
        if subfolder.is_dir() and subfolder.name[0] != "."
    }
    subfolders = {name: subfolders[name] for name in sorted(subfolders, key=_natural_key)}
    stems_by_dataset = {
        name: stems for name, subfolder in subfolders.items() if (stems := _list_pictures(subfolder))
    }
    if missing := [name for name in datasets if name not in stems_by_dataset]:
        raise BrewsterError(
            f"{folder} has no dataset {missing[0]!r}",
            f"a folder with pictures in it; there {'is' if len(stems_by_dataset) == 1 else 'are'} {', '.join(stems_by_dataset) or 'none'}",
            "check the name",
        )
    if not datasets and (own := _list_pictures(folder)):
        _require_one_layout(folder, list(stems_by_dataset), list(own))
        stems_by_dataset = {UNNAMED_DATASET: own}
    found: defaultdict[Key, list[Path]] = defaultdict(list)
    for name in dict.fromkeys(datasets or stems_by_dataset):
        for path, stem in stems_by_dataset[name].items():
            found[name, stem].append(path)
    _require_unique_names(folder, found)
    return {key: paths[0] for key, paths in found.items()}


def shorten_list(items: Sequence[str]) -> str:
    """The first few of them, and how many more there are."""
    remaining = len(items) - _MAX_LISTED
    return "; ".join(items[:_MAX_LISTED]) + (f"; and {remaining} more" if remaining > 0 else "")


def _require_unique_names(folder: Path, found: dict[Key, list[Path]]) -> None:
    if not found:
        raise BrewsterError(
            f"{folder} holds no picture", "pictures, or folders of them", "name another folder"
        )
    duplicates = [" and ".join(sorted(map(str, paths))) for paths in found.values() if len(paths) > 1]
    if duplicates:
        raise BrewsterError(
            f"{shorten_list(duplicates)} share a name",
            "pictures are paired by name, whatever their format",
            "remove all but one of each",
        )


def _require_one_layout(folder: Path, subfolders: Sequence[str], own: Sequence[Path]) -> None:
    if subfolders:
        raise BrewsterError(
            f"{folder} holds pictures ({shorten_list([path.name for path in own])}) beside folders of them ({', '.join(subfolders)})",
            "pictures lie in a folder, or in its folders, one for each dataset",
            "move them into one of these folders, or name those that are meant: --dataset NAME",
        )


def _list_pictures(folder: Path) -> dict[Path, str]:
    """What each picture of a folder is called, in natural order; without the other layers of one that is there."""
    pictures = {
        path: _normalised(path.stem)
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    }
    separated = {
        stem.removesuffix(_TRANSMISSION) for stem in pictures.values() if stem.endswith(_TRANSMISSION)
    }
    other_layers = {f"{stem}{layer}" for stem in separated for layer in (".reflection", ".confidence")}
    stems = {
        path: stem.removesuffix(_TRANSMISSION) for path, stem in pictures.items() if stem not in other_layers
    }
    return dict(sorted(stems.items(), key=lambda pair: (_natural_key(pair[1]), pair[0])))


def _normalised(name: str) -> str:
    """A name in one spelling: some systems write an accented letter as two characters."""
    return unicodedata.normalize("NFC", name)


def _natural_key(name: str) -> list[tuple[int, str]]:
    """Sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
