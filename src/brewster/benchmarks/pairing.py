"""Which pictures in a folder belong together: by name, never by position, and nothing is guessed.

Benchmarks come in two forms. Repacked, a folder for each role with equal names in them: blended/a.png,
transmission_layer/a.png. Or as SIR2's authors gave them, a folder for each shot, with a letter for each role: ab/3/ab-3-m-32.png,
ab/3/ab-3-g-32.png. Either way, a name with one picture for each role is a `PictureGroup`, and every other is refused aloud.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from brewster.errors import PhotoError
from brewster.image_formats import SUFFIXES

ROLES: Final[dict[str, tuple[str, ...]]] = {
    "photo": ("blended", "blend", "input", "mixture", "mixed", "photo", "with_reflection", "i"),
    "transmission": ("transmission_layer", "transmission", "gt", "ground_truth", "without_reflection", "t"),
    "reflection": ("reflection_layer", "reflection", "r"),
}
"""What the folder of a role is called, in lower case; the first is the usual name."""

TREES: Final[dict[str, tuple[str, ...]]] = {
    "postcard": ("kind", "scene", "variant"),
    "solidobject": ("scene", "kind", "variant"),
    "wildscene": ("scene",),
}
"""SIR2's three sets, and what the folders on the way down to a shot mean."""

_KINDS: Final = ("focus", "thick")
_LETTERS: Final = {"m": "photo", "g": "transmission", "r": "reflection"}
_LETTER: Final = re.compile(r"(?<![^\W_])[mgr](?![^\W_])", re.IGNORECASE)
_JUNK: Final = ("thumbs.db", "desktop.ini", "__macosx")

Parts = Mapping[str, list[Path]]


@final
@dataclass(frozen=True)
class PictureGroup:
    """Pictures of one name: a photo, its truth, and perhaps what was mirrored; `scene` is "" where nobody tells."""

    name: str
    scene: str
    photo: Path
    transmission: Path
    reflection: Path | None


@final
@dataclass(frozen=True)
class FolderListing:
    """What a folder holds: trios in natural order, and lines about what was passed over and what was refused."""

    trios: tuple[PictureGroup, ...] = ()
    remarks: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()


def natural(name: str) -> tuple[list[str | int], str]:
    """Sorts names as people do: 2 before 10."""
    pieces = re.split(r"(\d+)", name)
    return [int(piece) if place % 2 else piece for place, piece in enumerate(pieces)], name


def entries(folder: Path) -> tuple[list[Path], list[Path]]:
    """The folders and the files in a folder, without hidden ones and what systems leave, in natural order.

    Raises:
        PhotoError: it cannot be read.
    """
    kinds: tuple[list[Path], list[Path]] = ([], [])
    try:
        for path in sorted(folder.iterdir(), key=lambda path: natural(path.name)):
            if path.name[0] != "." and path.name.lower() not in _JUNK:
                kinds[not path.is_dir()].append(path)
    except OSError as error:
        raise PhotoError(
            f"{folder} cannot be read ({error.strerror or error})",
            "a benchmark is a folder with pictures",
            "name the folder where your copy lies",
        ) from error
    return kinds


# --- a folder for each role


def find_roles(folder: Path) -> dict[str, Path]:
    """The folders of ROLES that lie in a folder, by role.

    Raises:
        PhotoError: it cannot be read, or has two folders for one role.
    """
    roles = {name: role for role, names in ROLES.items() for name in names}
    return _labelled(folder, lambda name: roles.get(re.sub(r"[\s-]+", "_", name.lower()), ""))


def find_split(folder: Path) -> Path:
    """The folder itself if pairs lie in it, else the one folder in it where they do: train, val or test.

    Raises:
        PhotoError: there are several, or a folder cannot be read.
    """
    if "photo" in find_roles(folder):
        return folder
    splits = [path for path in entries(folder)[0] if "photo" in find_roles(path)]
    if len(splits) > 1:
        raise PhotoError(
            f"{folder} has pairs in {listed([path.name for path in splits])}",
            "a benchmark is one of them",
            f"point at one, for example {splits[0]}",
        )
    return splits[0] if splits else folder


def read_folders(folder: Path) -> FolderListing:
    """Trios from a folder for each role, joined by their stems, whatever their suffixes.

    Raises:
        PhotoError: a folder is missing, empty or unreadable, or two could have one role.
    """
    roles = find_roles(folder)
    joined: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    strays: list[Path] = []
    for role in ROLES:
        pictures, others = _role_pictures(folder, role, roles)
        strays += others
        for picture in pictures:
            joined[unicodedata.normalize("NFC", picture.stem)][role].append(picture)
    pieces = [_join(folder, stem, "", joined[stem]) for stem in sorted(joined, key=natural)]
    return _together([*pieces, _passed_over(folder, [*strays, *entries(folder)[1]])])


def _role_pictures(folder: Path, role: str, roles: Mapping[str, Path]) -> tuple[list[Path], list[Path]]:
    if role not in roles:
        if role == "reflection":
            return [], []
        raise PhotoError(
            f"{folder} has no folder for the {role}",
            f"pairs lie in folders beside each other, this one called {listed(ROLES[role], ' or ')}",
            "rename yours, or name the folder above them",
        )
    pictures, others = _pictures(roles[role])
    if not pictures:
        raise PhotoError(
            f"no pictures in {roles[role]}", f"files ending in {', '.join(SUFFIXES)}", "name another folder"
        )
    return pictures, others


# --- SIR2's own trees


def find_subsets(folder: Path) -> dict[str, Path]:
    """The folders of TREES that lie in a folder; only the first letters count: "Postcard Dataset", "postcard".

    Raises:
        PhotoError: it cannot be read, or has two folders for one set.
    """
    return _labelled(folder, _subset_of)


def read_tree(folder: Path, subset: str) -> FolderListing:
    """Trios from a folder for each shot, joined by their names without the role's letter.

    Raises:
        PhotoError: a folder cannot be read, or there is no shot in this tree.
    """
    found = _unique(folder, _together(_read_branches(folder, folder, TREES[subset], {})))
    if not found.trios and not found.refused:
        raise PhotoError(
            f"{folder} is no {subset} set",
            f"photos in {'/'.join(f'<{level}>' for level in TREES[subset])}/*m*.*, or in {ROLES['photo'][0]}/",
            "name the folder where your copy lies",
        )
    return found


def _subset_of(name: str) -> str:
    letters = re.sub(r"[^a-z]", "", name.lower())
    return next((subset for subset in TREES if letters.startswith(subset)), "")


def _read_branches(
    root: Path, folder: Path, levels: Sequence[str], way: Mapping[str, str]
) -> Iterator[FolderListing]:
    if not levels:
        yield _read_shot(root, folder, way)
        return
    folders, files = entries(folder)
    kinds = [path for path in folders if levels[0] != "kind" or path.name.lower() in _KINDS]
    for path in kinds:
        step = path.name.capitalize() if levels[0] == "kind" else path.name
        yield from _read_branches(root, path, levels[1:], {**way, levels[0]: step})
    yield _passed_over(root, [*files, *(path for path in folders if path not in kinds)])


def _read_shot(root: Path, folder: Path, way: Mapping[str, str]) -> FolderListing:
    joined: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    pictures, strays = _pictures(folder)
    for picture in pictures:
        letters = _LETTER.findall(picture.stem)
        if len(letters) == 1:
            joined[_without_letter(picture.stem)][_LETTERS[letters[0].lower()]].append(picture)
        else:
            strays.append(picture)
    shot = "-".join(way[level] for level in ("scene", "kind", "variant") if level in way)
    names = {rest: shot if len(joined) == 1 else f"{shot}-{rest}".rstrip("-") for rest in joined}
    pieces = [_join(root, names[rest], way["scene"], joined[rest]) for rest in joined]
    return _together([*pieces, _passed_over(root, strays)])


def _without_letter(stem: str) -> str:
    return "-".join(piece for piece in re.split(r"[-_ ]+", _LETTER.sub("", stem)) if piece)


def _unique(root: Path, found: FolderListing) -> FolderListing:
    """Folders that differ in case only can give two shots one name: then neither is taken."""
    counts = Counter(trio.name for trio in found.trios)
    twins = tuple(
        f"{_below(root, trio.photo)} is ambiguous: another photo would be called {trio.name} too"
        for trio in found.trios
        if counts[trio.name] > 1
    )
    kept = tuple(trio for trio in found.trios if counts[trio.name] == 1)
    return FolderListing(kept, found.remarks, (*found.refused, *twins))


# --- both


def _join(root: Path, name: str, scene: str, parts: Parts) -> FolderListing:
    """One trio, or the reason why there is none."""
    trouble = _trouble(root, parts)
    if trouble:
        return FolderListing(refused=(trouble,))
    reflection = parts["reflection"][0] if parts.get("reflection") else None
    return FolderListing(
        (PictureGroup(name, scene, parts["photo"][0], parts["transmission"][0], reflection),)
    )


def _trouble(root: Path, parts: Parts) -> str:
    for role, paths in parts.items():
        if len(paths) > 1:
            named = listed([_below(root, path) for path in paths])
            return f"{named} are ambiguous: there must be one {role} of that name"
    for role in ("photo", "transmission"):
        if not parts.get(role):
            named = listed([_below(root, path) for paths in parts.values() for path in paths])
            return f"{named} has no partner: there is no {role} of that name"
    return ""


def _pictures(folder: Path) -> tuple[list[Path], list[Path]]:
    """The pictures by name, and whatever else is there."""
    folders, files = entries(folder)
    pictures = [path for path in files if path.suffix.lower() in SUFFIXES]
    return pictures, [*folders, *(path for path in files if path.suffix.lower() not in SUFFIXES)]


def _labelled(folder: Path, label: Callable[[str], str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in entries(folder)[0]:
        role = label(path.name)
        if role and found.setdefault(role, path) != path:
            raise PhotoError(
                f"{folder} has two folders for {role}, {found[role].name} and {path.name}",
                "one of each is wanted, and brewster does not choose",
                "move one of them away",
            )
    return {role: path for role, path in found.items() if role}


def _passed_over(root: Path, strays: Iterable[Path]) -> FolderListing:
    named = [_below(root, path) for path in strays]
    return FolderListing(remarks=(f"passed over {listed(named)}",) if named else ())


def _together(pieces: Iterable[FolderListing]) -> FolderListing:
    every = list(pieces)
    return FolderListing(
        tuple(sorted((trio for piece in every for trio in piece.trios), key=lambda trio: natural(trio.name))),
        tuple(line for piece in every for line in piece.remarks),
        tuple(line for piece in every for line in piece.refused),
    )


def _below(root: Path, path: Path) -> str:
    return path.relative_to(root).as_posix()


def listed(names: Sequence[str], last: str = " and ") -> str:
    """Names in a sentence: "a, b and c", and where they are many, the first of them and how many more."""
    shown = [*names] if len(names) < 10 else [*names[:5], f"{len(names) - 5} more"]
    return last.join(([", ".join(shown[:-1])] if len(shown) > 1 else []) + shown[-1:])
