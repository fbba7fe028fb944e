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
from brewster.study.study import ONE

Key = tuple[str, str]
"""Dataset and stem."""

_SHOWN: Final = 8


def find_pictures(folder: Path, datasets: Sequence[str] = ()) -> dict[Key, Path]:
    """The pictures of a folder in natural order: in its folders, or in itself where these hold none.

    Of the `datasets` only and in their order, if any are given. Outputs may be called like those of `brewster -o`: name.transmission.png.

    Raises:
        BrewsterError: there is no picture, no such dataset, or one name has several files.
    """
    if not folder.is_dir():
        raise BrewsterError(f"{folder} is no folder", "one with pictures is needed", "name another")
    rooms = {_plain(room.name): room for room in folder.iterdir() if room.is_dir() and room.name[0] != "."}
    parts = {name: room for name, room in rooms.items() if any(_stem(path) for path in room.iterdir())}
    if missing := [name for name in datasets if name not in parts]:
        raise BrewsterError(
            f"{folder} has no dataset {missing[0]!r}",
            f"a folder with pictures in it; there {'is' if len(parts) == 1 else 'are'} {', '.join(parts) or 'none'}",
            "check the name",
        )
    if not parts:
        parts = {ONE: folder}
    found: defaultdict[Key, list[Path]] = defaultdict(list)
    for name in dict.fromkeys(datasets or sorted(parts, key=_natural)):
        for path in sorted(parts[name].iterdir(), key=lambda path: _natural(_stem(path))):
            if stem := _stem(path):
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


def _stem(path: Path) -> str:
    """What a picture is called; "" for what is no picture, or another layer."""
    if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or not path.is_file():
        return ""
    stem = _plain(path.stem)
    return "" if stem.endswith((".reflection", ".confidence")) else stem.removesuffix(".transmission")


def _plain(name: str) -> str:
    """A name in one spelling: some systems write an accented letter as two characters."""
    return unicodedata.normalize("NFC", name)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
