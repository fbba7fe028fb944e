"""Which pictures a folder holds, by dataset and name: `real/12.png` is the picture 12 of the dataset real."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from brewster.errors import BrewsterError
from brewster.image_formats import SUFFIXES
from brewster.user_study.study import ONE

Key = tuple[str, str]
"""Dataset and stem."""

_SHOWN: Final = 8
_CLEAR: Final = ".transmission"


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
    rooms = {_plain(room.name): room for room in folder.iterdir() if room.is_dir() and room.name[0] != "."}
    rooms = {name: rooms[name] for name in sorted(rooms, key=_natural)}
    parts = {name: stems for name, room in rooms.items() if (stems := _stems(room))}
    if missing := [name for name in datasets if name not in parts]:
        raise BrewsterError(
            f"{folder} has no dataset {missing[0]!r}",
            f"a folder with pictures in it; there {'is' if len(parts) == 1 else 'are'} {', '.join(parts) or 'none'}",
            "check the name",
        )
    if not datasets and (own := _stems(folder)):
        _refuse_both(folder, list(parts), list(own))
        parts = {ONE: own}
    found: defaultdict[Key, list[Path]] = defaultdict(list)
    for name in dict.fromkeys(datasets or parts):
        for path, stem in parts[name].items():
            found[name, stem].append(path)
    _refuse(folder, found)
    return {key: paths[0] for key, paths in found.items()}


def listed(words: Sequence[str]) -> str:
    """The first few of them, and how many more there are."""
    more = len(words) - _SHOWN
    return "; ".join(words[:_SHOWN]) + (f"; and {more} more" if more > 0 else "")


def _refuse(folder: Path, found: dict[Key, list[Path]]) -> None:
    if not found:
        raise BrewsterError(
            f"{folder} holds no picture", "pictures, or folders of them", "name another folder"
        )
    doubles = [" and ".join(sorted(map(str, paths))) for paths in found.values() if len(paths) > 1]
    if doubles:
        raise BrewsterError(
            f"{listed(doubles)} share a name",
            "pictures are paired by name, whatever their format",
            "remove all but one of each",
        )


def _refuse_both(folder: Path, rooms: Sequence[str], own: Sequence[Path]) -> None:
    if rooms:
        raise BrewsterError(
            f"{folder} holds pictures ({listed([path.name for path in own])}) beside folders of them ({', '.join(rooms)})",
            "pictures lie in a folder, or in its folders, one for each dataset",
            "move them into one of these folders, or name those that are meant: --dataset NAME",
        )


def _stems(folder: Path) -> dict[Path, str]:
    """What each picture of a folder is called, in natural order; without the other layers of one that is there."""
    pictures = {
        path: _plain(path.stem)
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    }
    clear = {stem.removesuffix(_CLEAR) for stem in pictures.values() if stem.endswith(_CLEAR)}
    others = {f"{stem}{layer}" for stem in clear for layer in (".reflection", ".confidence")}
    stems = {path: stem.removesuffix(_CLEAR) for path, stem in pictures.items() if stem not in others}
    return dict(sorted(stems.items(), key=lambda pair: (_natural(pair[1]), pair[0])))


def _plain(name: str) -> str:
    """A name in one spelling: some systems write an accented letter as two characters."""
    return unicodedata.normalize("NFC", name)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
