"""Groups the pictures of a benchmark folder by name: photo, transmission and, if there is one, reflection.

Pictures are paired by name only, never by sorted position. Two layouts are supported:

- Pairs: one folder per role with equal file names: blended/a.png, transmission_layer/a.png.
- The original SIR2 tree: one folder per shot, with one letter per role: ab/3/ab-3-m-32.png, ab/3/ab-3-g-32.png.

A name with exactly one picture for each role becomes a `PictureGroup`. Every other name is refused with a reason.
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
"""role -> accepted folder names, in lower case. The first one is the usual name."""

SIR2_TREES: Final[dict[str, tuple[str, ...]]] = {
    "postcard": ("kind", "scene", "variant"),
    "solidobject": ("scene", "kind", "variant"),
    "wildscene": ("scene",),
}
"""SIR2's three subsets -> the meaning of each folder level from the subset's root to a shot."""

_KINDS: Final = ("focus", "thick")
_LETTERS: Final = {"m": "photo", "g": "transmission", "r": "reflection"}
_LETTER: Final = re.compile(r"(?<![^\W_])[mgr](?![^\W_])", re.IGNORECASE)
_SYSTEM_FILES: Final = ("thumbs.db", "desktop.ini", "__macosx")

_FilesByRole = Mapping[str, list[Path]]


@final
@dataclass(frozen=True)
class PictureGroup:
    """Pictures of one name: photo, transmission (ground truth) and, if there is one, reflection. `scene` is "" if unknown."""

    name: str
    scene: str
    photo: Path
    transmission: Path
    reflection: Path | None


@final
@dataclass(frozen=True)
class FolderListing:
    """The content of a folder: groups in natural order of their names.

    `remarks` are lines about ignored files, `excluded` lines about files without a unique partner.
    """

    groups: tuple[PictureGroup, ...] = ()
    remarks: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Sort key for natural order: 2 before 10."""
    pieces = re.split(r"(\d+)", name)
    return [int(piece) if i % 2 else piece for i, piece in enumerate(pieces)], name


def entries(folder: Path) -> tuple[list[Path], list[Path]]:
    """The folders and the files in a folder, each in natural order, without hidden files and files of the system.

    Raises:
        PhotoError: the folder cannot be read.
    """
    kinds: tuple[list[Path], list[Path]] = ([], [])
    try:
        for path in sorted(folder.iterdir(), key=lambda path: natural_key(path.name)):
            if path.name[0] != "." and path.name.lower() not in _SYSTEM_FILES:
                kinds[not path.is_dir()].append(path)
    except OSError as error:
        raise PhotoError(
            f"{folder} cannot be read ({error.strerror or error})",
            "a folder with pictures was expected",
            "give the path of your copy of the benchmark",
        ) from error
    return kinds


# --- a folder for each role


def find_roles(folder: Path) -> dict[str, Path]:
    """role -> subfolder that has one of the role's names (see ROLES).

    Raises:
        PhotoError: the folder cannot be read, or has two subfolders for one role.
    """
    roles = {name: role for role, names in ROLES.items() for name in names}
    return _find_labelled(folder, lambda name: roles.get(re.sub(r"[\s-]+", "_", name.lower()), ""))


def find_split(folder: Path) -> Path:
    """The folder itself if it contains pairs, else its only subfolder that does: train, val or test.

    Raises:
        PhotoError: several subfolders contain pairs, or a folder cannot be read.
    """
    if "photo" in find_roles(folder):
        return folder
    splits = [path for path in entries(folder)[0] if "photo" in find_roles(path)]
    if len(splits) > 1:
        raise PhotoError(
            f"{folder} has pairs in {join_names([path.name for path in splits])}",
            "one split was expected",
            f"give the path of one, for example {splits[0]}",
        )
    return splits[0] if splits else folder


def read_folders(folder: Path) -> FolderListing:
    """Groups from one folder per role, matched by file stem; suffixes may differ.

    Raises:
        PhotoError: a folder is missing, empty or unreadable, or two folders have one role.
    """
    roles = find_roles(folder)
    by_name: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    ignored: list[Path] = []
    for role in ROLES:
        pictures, others = _role_pictures(folder, role, roles)
        ignored += others
        for picture in pictures:
            by_name[unicodedata.normalize("NFC", picture.stem)][role].append(picture)
    pieces = [_make_group(folder, stem, "", by_name[stem]) for stem in sorted(by_name, key=natural_key)]
    return _merge([*pieces, _ignored_remark(folder, [*ignored, *entries(folder)[1]])])


def _role_pictures(folder: Path, role: str, roles: Mapping[str, Path]) -> tuple[list[Path], list[Path]]:
    if role not in roles:
        if role == "reflection":
            return [], []
        raise PhotoError(
            f"{folder} has no folder for the {role}",
            f"expected one folder per role, side by side, this one named {join_names(ROLES[role], ' or ')}",
            "rename your folder, or give the path of its parent folder",
        )
    pictures, others = _pictures(roles[role])
    if not pictures:
        raise PhotoError(
            f"no pictures in {roles[role]}",
            f"expected files ending in {', '.join(SUFFIXES)}",
            "give another folder",
        )
    return pictures, others


# --- the original SIR2 trees


def find_subsets(folder: Path) -> dict[str, Path]:
    """subset of SIR2 -> its folder. Only the beginning of the name is compared: "Postcard Dataset", "postcard".

    Raises:
        PhotoError: the folder cannot be read, or has two folders for one subset.
    """
    return _find_labelled(folder, _subset_of)


def read_tree(folder: Path, subset: str) -> FolderListing:
    """Groups from one folder per shot, matched by file name without the letter of the role.

    Raises:
        PhotoError: a folder cannot be read, or the tree contains no shot.
    """
    found = _refuse_duplicates(folder, _merge(_read_branches(folder, folder, SIR2_TREES[subset], {})))
    if not found.groups and not found.excluded:
        raise PhotoError(
            f"{folder} is not a {subset} set",
            f"expected photos in {'/'.join(f'<{level}>' for level in SIR2_TREES[subset])}/*m*.*, or in {ROLES['photo'][0]}/",
            "give the path of your copy",
        )
    return found


def _subset_of(name: str) -> str:
    letters = re.sub(r"[^a-z]", "", name.lower())
    return next((subset for subset in SIR2_TREES if letters.startswith(subset)), "")


def _read_branches(
    root: Path, folder: Path, levels: Sequence[str], labels: Mapping[str, str]
) -> Iterator[FolderListing]:
    if not levels:
        yield _read_shot(root, folder, labels)
        return
    folders, files = entries(folder)
    kinds = [path for path in folders if levels[0] != "kind" or path.name.lower() in _KINDS]
    for path in kinds:
        step = path.name.capitalize() if levels[0] == "kind" else path.name
        yield from _read_branches(root, path, levels[1:], {**labels, levels[0]: step})
    yield _ignored_remark(root, [*files, *(path for path in folders if path not in kinds)])


def _read_shot(root: Path, folder: Path, labels: Mapping[str, str]) -> FolderListing:
    by_name: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    pictures, others = _pictures(folder)
    for picture in pictures:
        letters = _LETTER.findall(picture.stem)
        if len(letters) == 1:
            by_name[_without_letter(picture.stem)][_LETTERS[letters[0].lower()]].append(picture)
        else:
            others.append(picture)
    shot = "-".join(labels[level] for level in ("scene", "kind", "variant") if level in labels)
    names = {rest: shot if len(by_name) == 1 else f"{shot}-{rest}".rstrip("-") for rest in by_name}
    pieces = [_make_group(root, names[rest], labels["scene"], by_name[rest]) for rest in by_name]
    return _merge([*pieces, _ignored_remark(root, others)])


def _without_letter(stem: str) -> str:
    return "-".join(piece for piece in re.split(r"[-_ ]+", _LETTER.sub("", stem)) if piece)


def _refuse_duplicates(root: Path, found: FolderListing) -> FolderListing:
    """Refuses all groups that share a name. Folders whose names differ only in case can cause this."""
    counts = Counter(group.name for group in found.groups)
    duplicates = tuple(
        f"{_relative(root, group.photo)} is ambiguous: another photo has the name {group.name} too"
        for group in found.groups
        if counts[group.name] > 1
    )
    unique = tuple(group for group in found.groups if counts[group.name] == 1)
    return FolderListing(unique, found.remarks, (*found.excluded, *duplicates))


# --- both layouts


def _make_group(root: Path, name: str, scene: str, parts: _FilesByRole) -> FolderListing:
    """A listing with one group, or with the reason why there is none."""
    problem = _problem(root, parts)
    if problem:
        return FolderListing(excluded=(problem,))
    reflection = parts["reflection"][0] if parts.get("reflection") else None
    return FolderListing(
        (PictureGroup(name, scene, parts["photo"][0], parts["transmission"][0], reflection),)
    )


def _problem(root: Path, parts: _FilesByRole) -> str:
    for role, paths in parts.items():
        if len(paths) > 1:
            named = join_names([_relative(root, path) for path in paths])
            return f"{named} are ambiguous: expected one {role} of that name"
    for role in ("photo", "transmission"):
        if not parts.get(role):
            named = join_names([_relative(root, path) for paths in parts.values() for path in paths])
            return f"{named} has no partner: there is no {role} of that name"
    return ""


def _pictures(folder: Path) -> tuple[list[Path], list[Path]]:
    """The pictures of a folder in natural order, and all other entries."""
    folders, files = entries(folder)
    pictures = [path for path in files if path.suffix.lower() in SUFFIXES]
    return pictures, [*folders, *(path for path in files if path.suffix.lower() not in SUFFIXES)]


def _find_labelled(folder: Path, label: Callable[[str], str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in entries(folder)[0]:
        role = label(path.name)
        if role and found.setdefault(role, path) != path:
            raise PhotoError(
                f"{folder} has two folders for {role}, {found[role].name} and {path.name}",
                "expected one of each",
                "move or rename one of them",
            )
    return {role: path for role, path in found.items() if role}


def _ignored_remark(root: Path, others: Iterable[Path]) -> FolderListing:
    named = [_relative(root, path) for path in others]
    return FolderListing(remarks=(f"ignored {join_names(named)}",) if named else ())


def _merge(pieces: Iterable[FolderListing]) -> FolderListing:
    listings = list(pieces)
    return FolderListing(
        tuple(
            sorted(
                (group for piece in listings for group in piece.groups),
                key=lambda group: natural_key(group.name),
            )
        ),
        tuple(line for piece in listings for line in piece.remarks),
        tuple(line for piece in listings for line in piece.excluded),
    )


def _relative(root: Path, path: Path) -> str:
    return path.relative_to(root).as_posix()


def join_names(names: Sequence[str], last: str = " and ") -> str:
    """Names as text: "a, b and c". Of ten names or more, the first five and the number of the others."""
    shown = [*names] if len(names) < 10 else [*names[:5], f"{len(names) - 5} more"]
    return last.join(([", ".join(shown[:-1])] if len(shown) > 1 else []) + shown[-1:])
