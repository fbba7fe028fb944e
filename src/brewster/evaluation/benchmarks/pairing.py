"""Groups the images of a benchmark folder by file name, not by position: photo, transmission and
perhaps reflection.

- Pairs: one folder per role with equal file names: blended/a.png, transmission_layer/a.png.
- The original folders of SIR2: one folder per shot. A letter in the file name denotes the role:
  ab/3/ab-3-m-32.png, ab/3/ab-3-g-32.png.

A name with one photo, one transmission and at most one reflection becomes an `ImageGroup`; others
are excluded, with a reason. All functions that take a folder raise PhotoError if it cannot be read.
"""

import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final

from brewster.base.files import folder_entries, natural_key
from brewster.base.image_formats import SUFFIXES
from brewster.errors import PhotoError, read_errors

ROLES: Final[dict[str, tuple[str, ...]]] = {
    "photo": ("blended", "blend", "input", "mixture", "mixed", "photo", "with_reflection", "i"),
    "transmission": (
        "transmission_layer",
        "transmission",
        "gt",
        "ground_truth",
        "without_reflection",
        "t",
    ),
    "reflection": ("reflection_layer", "reflection", "r"),
}
"""The accepted folder names of each role, in lower case. The transmission is the ground truth of
the photo.
"""

SIR2_TREES: Final[dict[str, tuple[str, ...]]] = {
    "postcard": ("kind", "scene", "variant"),
    "solidobject": ("scene", "kind", "variant"),
    "wildscene": ("scene",),
}
"""For each subset of SIR2, the meaning of each folder level, from the folder of the subset to the
folder of a shot.
"""

_SPLIT_PREFIX: Final = re.compile(r"^(?:train|val|test)_\d+_", re.IGNORECASE)
"""The start of the folder names of OpenRR-5k, such as val_300_blended: a split and its number of
images.
"""

_KINDS: Final = ("focus", "thick")
"""The two series of SIR2's controlled scenes: the focus of the camera varies, or the thickness of
the glass.
"""

_ROLE_LETTERS: Final = {"m": "photo", "g": "transmission", "r": "reflection"}
_ROLE_LETTER: Final = re.compile(r"(?<![^\W_])[mgr](?![^\W_])", re.IGNORECASE)
"""The letter m, g or r as a separate word. The character "_" also separates words."""

_SYSTEM_FILES: Final = ("thumbs.db", "desktop.ini", "__macosx")

_FilesByRole = Mapping[str, list[Path]]


@final
@dataclass(frozen=True)
class ImageGroup:
    """The files with one name: photo, transmission (ground truth), reflection or None. `scene` is
    "" if it is unknown.
    """

    name: str
    scene: str
    photo: Path
    transmission: Path
    reflection: Path | None = None


@final
@dataclass
class FolderListing:
    """The content of a folder. The groups are in natural order of their names (2 before 10).
    `remarks` lists the ignored files. `excluded` lists the images without a unique partner, with
    the reason.
    """

    root: Path
    """The folder. Remarks and reasons name the files relative to it."""
    groups: list[ImageGroup] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    excluded: list[str] = field(default_factory=list)

    def add(self, name: str, scene: str, files: _FilesByRole) -> None:
        """Adds a group, or the reason why its files are excluded."""
        ambiguous = next((role for role, paths in files.items() if len(paths) > 1), None)
        missing = next((role for role in ("photo", "transmission") if not files.get(role)), None)
        if ambiguous:
            names = self._names(files[ambiguous])
            self.excluded.append(f"{names} are ambiguous: expected one {ambiguous} with this name")
        elif missing:
            paths = [path for paths in files.values() for path in paths]
            have = "has" if len(paths) == 1 else "have"
            self.excluded.append(
                f"{self._names(paths)} {have} no partner: there is no {missing} with this name"
            )
        else:
            paths = [files[role][0] for role in ROLES if files.get(role)]
            self.groups.append(ImageGroup(name, scene, *paths))

    def ignore(self, paths: Sequence[Path]) -> None:
        """Adds a remark on files that belong to no group."""
        if paths:
            self.remarks.append(f"ignored {self._names(paths)}")

    def exclude_duplicates(self) -> None:
        """Excludes all groups whose name is not unique. For example, the folders Focus and focus
        give equal names.
        """
        counts = Counter(group.name for group in self.groups)
        self.excluded += [
            f"{self._names([group.photo])} is ambiguous: another photo has the same name, "
            f"{group.name}"
            for group in self.groups
            if counts[group.name] > 1
        ]
        self.groups = [group for group in self.groups if counts[group.name] == 1]

    def _names(self, paths: Sequence[Path]) -> str:
        return join_names([path.relative_to(self.root).as_posix() for path in paths])


def list_folder(folder: Path) -> tuple[list[Path], list[Path]]:
    """Returns the folders and the files in a folder, in natural order, without hidden files and
    system files.
    """
    kinds: tuple[list[Path], list[Path]] = ([], [])
    cure = "give the path of your copy of the benchmark"
    with read_errors(folder, PhotoError, "expected a folder with images", cure):
        for path in sorted(folder_entries(folder), key=lambda path: natural_key(path.name)):
            if path.name[0] != "." and path.name.lower() not in _SYSTEM_FILES:
                kinds[not path.is_dir()].append(path)
    return kinds


def find_roles(folder: Path) -> dict[str, Path]:
    """Returns the subfolder of each role. ROLES has their names. Raises PhotoError if there are two
    for one role.
    """
    return _find_subfolders(folder, _role_of)


def find_numbered_splits(folder: Path) -> dict[str, dict[str, Path]]:
    """Returns the subfolders by split and role, for names such as val_300_blended, whose split is
    "val_300".
    """
    splits: dict[str, dict[str, Path]] = defaultdict(dict)
    for path in list_folder(folder)[0]:
        prefix = _SPLIT_PREFIX.match(path.name)
        if prefix and (role := _role_of(path.name[prefix.end() :])):
            splits[prefix[0].rstrip("_").lower()][role] = path
    return dict(splits)


def _role_of(name: str) -> str:
    """Returns the role of a folder of this name, or "" if it has none."""
    normalised = re.sub(r"[\s-]+", "_", name.lower())
    return next((role for role, names in ROLES.items() if normalised in names), "")


def find_split(folder: Path) -> Path:
    """Returns the folder itself if it contains pairs, else its only subfolder with pairs, such as
    test. Raises PhotoError if several contain pairs.
    """
    if "photo" in find_roles(folder):
        return folder
    splits = [path for path in list_folder(folder)[0] if "photo" in find_roles(path)]
    if len(splits) > 1:
        raise PhotoError(
            f"{folder} has pairs in the subfolders {join_names([path.name for path in splits])}",
            "expected one subfolder with pairs",
            f"give the path of one subfolder, for example {splits[0]}",
        )
    return splits[0] if splits else folder


def read_folders(folder: Path, roles: Mapping[str, Path] | None = None) -> FolderListing:
    """Returns the groups of a folder with one subfolder per role. The file stems must be equal;
    suffixes may differ. `roles` has the subfolder of each role; by default, it is the result of
    `find_roles`. Raises PhotoError if a folder is missing or empty, or two folders have the same
    role.
    """
    roles = find_roles(folder) if roles is None else roles
    by_name: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    ignored: list[Path] = []
    for role in ROLES:
        if role not in roles:
            if role == "reflection":  # it is optional
                continue
            raise PhotoError(
                f"{folder} has no subfolder for the {role}",
                f"expected a subfolder with the name {join_names(ROLES[role], ' or ')}",
                "rename the subfolder, or give the path of its parent folder",
            )
        images, others = image_files(roles[role])
        if not images:
            expected = f"expected files ending in {', '.join(SUFFIXES)}"
            raise PhotoError(f"{roles[role]} contains no images", expected, "choose another folder")
        ignored += others
        for image in images:
            by_name[unicodedata.normalize("NFC", image.stem)][role].append(image)
    listing = FolderListing(folder)
    for stem in sorted(by_name, key=natural_key):
        listing.add(stem, "", by_name[stem])
    listing.ignore([*ignored, *list_folder(folder)[1]])
    return listing


def find_subsets(folder: Path) -> dict[str, Path]:
    """Returns the subfolder of each subset of SIR2. Only the start of the name is compared:
    "Postcard Dataset" is "postcard". Raises PhotoError if there are two subfolders for one subset.
    """

    def subset_of(name: str) -> str:
        letters = re.sub(r"[^a-z]", "", name.lower())
        return next((subset for subset in SIR2_TREES if letters.startswith(subset)), "")

    return _find_subfolders(folder, subset_of)


def read_tree(folder: Path, subset: str) -> FolderListing:
    """Returns the groups of a subset of SIR2. Its folders have one subfolder per shot. Files of a
    shot are grouped if their names, without the letter of the role, are equal. Raises PhotoError if
    there is no shot.
    """
    listing = FolderListing(folder)
    _read_branches(listing, folder, SIR2_TREES[subset], {})
    listing.groups.sort(key=lambda group: natural_key(group.name))
    listing.exclude_duplicates()
    if not listing.groups and not listing.excluded:
        raise PhotoError(
            f"{folder} contains no shot of SIR2 {subset}",
            f"expected photos in {'/'.join(f'<{level}>' for level in SIR2_TREES[subset])}/*m*.*, "
            f"or in {ROLES['photo'][0]}/",
            "give the path of the subset in your copy of SIR2",
        )
    return listing


def _read_branches(
    listing: FolderListing, folder: Path, levels: Sequence[str], labels: Mapping[str, str]
) -> None:
    """Adds the shots below `folder`, whose `levels` are to come, and whose `labels` are the names
    of those above.
    """
    if not levels:
        _read_shot(listing, folder, labels)
        return
    folders, files = list_folder(folder)
    branches = [path for path in folders if levels[0] != "kind" or path.name.lower() in _KINDS]
    for path in branches:
        label = path.name.capitalize() if levels[0] == "kind" else path.name
        _read_branches(listing, path, levels[1:], {**labels, levels[0]: label})
    listing.ignore([*files, *(path for path in folders if path not in branches)])


def _read_shot(listing: FolderListing, folder: Path, labels: Mapping[str, str]) -> None:
    by_name: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    images, others = image_files(folder)
    for image in images:
        letters = _ROLE_LETTER.findall(image.stem)
        if len(letters) == 1:
            words = re.split(r"[-_ ]+", _ROLE_LETTER.sub("", image.stem))
            by_name["-".join(filter(None, words))][_ROLE_LETTERS[letters[0].lower()]].append(image)
        else:
            others.append(image)
    shot = "-".join(labels[level] for level in ("scene", "kind", "variant") if level in labels)
    for stem, files in by_name.items():
        name = shot if len(by_name) == 1 else f"{shot}-{stem}".rstrip("-")
        listing.add(name, labels["scene"], files)
    listing.ignore(others)


def image_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Returns the image files in a folder, in natural order, and all other files and folders in
    it.
    """
    folders, files = list_folder(folder)
    images = [path for path in files if path.suffix.lower() in SUFFIXES]
    return images, [*folders, *(path for path in files if path.suffix.lower() not in SUFFIXES)]


def _find_subfolders(folder: Path, key_of: Callable[[str], str]) -> dict[str, Path]:
    """Returns the subfolder of each key. `key_of` returns the key of a subfolder's name, or "" if
    there is no key.
    """
    found: dict[str, Path] = {}
    for path in list_folder(folder)[0]:
        key = key_of(path.name)
        if key and found.setdefault(key, path) != path:
            happened = f"{folder} has two subfolders for {key}, {found[key].name} and {path.name}"
            raise PhotoError(
                happened, f"expected one subfolder for {key}", "move or rename one of the two"
            )
    return found


def join_names(names: Sequence[str], last: str = " and ") -> str:
    """Returns the names as text: "a, b and c". Of ten names or more, only the first five and the
    number of the rest.
    """
    shown = [*names] if len(names) < 10 else [*names[:5], f"{len(names) - 5} more"]
    return last.join(([", ".join(shown[:-1])] if len(shown) > 1 else []) + shown[-1:])
