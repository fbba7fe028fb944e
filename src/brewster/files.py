"""Find pictures and write results safely: which files, under which names, never half, never over another.

for job in find([Path("holiday")], into=Path("clear")):
    write_atomically(job.target("transmission"), data, source=job.source)
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from brewster.errors import TargetError

SUFFIXES = {
    ".jpg": "jpeg",
    ".jpeg": "jpeg",
    ".jpe": "jpeg",
    ".jfif": "jpeg",
    ".png": "png",
    ".tif": "tiff",
    ".tiff": "tiff",
    ".webp": "webp",
    ".avif": "avif",
    ".heic": "heic",
    ".heif": "heic",
    ".exr": "exr",
    ".hdr": "hdr",
    ".gif": "gif",
}
"""What a file name promises to be: lower-case suffix -> container."""

DEFAULT_MAX_PIXELS = 200_000_000
"""Larger pictures are refused before they are decoded: a small file can hold an enormous one."""

TEMPORARY_PREFIX = ".brewster-"
"""What the names of files begin with that are not whole yet."""

LAYERS = ("transmission", "reflection", "confidence")
_PNG_LAYERS = ("confidence",)  # a grey map, not a photograph: no container of the source would suit it better


@dataclass(frozen=True)
class SeparationPaths:
    """One picture to separate, and where its layers go: `folder/name.layer.suffix`."""

    source: Path
    folder: Path
    name: str

    def target(self, layer: str, suffix: str | None = None) -> Path:
        """The file for a layer: the source's suffix unless one is given; PNG where that cannot be written."""
        source_suffix = self.source.suffix
        writable = SUFFIXES.get(source_suffix.lower(), "gif") != "gif" and layer not in _PNG_LAYERS
        return self.folder / f"{self.name}.{layer}{suffix or (source_suffix if writable else '.png')}"


def find(sources: Iterable[Path], output_folder: Path | None = None) -> list[SeparationPaths]:
    """Every picture in the files and folders given, each once, in a stable order.

    Layers go beside their picture, or under `into`, where the tree below a folder is mirrored. They are
    called by the picture's stem, or by its full name where a neighbour could want the same: `a.jpg` gives
    `a`; with `a.png` beside it, `a.jpg` and `a.png`. That depends on the pictures in the folder only, not on
    what was asked for or done.

    In folders, hidden files, files that are no pictures by name, and brewster's own results are passed over;
    a real folder is visited once, so link loops end. A file given by name is always taken: opening it will
    say what is wrong.

    Raises TargetError when two pictures would be written under one name.
    """
    jobs: dict[str, SeparationPaths] = {}
    counts: dict[Path, Counter[str]] = {}
    for source in sources:
        for picture in _image_files(source):
            parent = picture.parent
            if parent not in counts:
                counts[parent] = _name_counts(parent)
            subfolder = Path() if picture == source else parent.relative_to(source)
            folder = parent if output_folder is None else output_folder / subfolder
            job = SeparationPaths(picture, folder, _layer_name(picture, counts[parent]))
            jobs.setdefault(_absolute(picture), job)
    _check_unique_targets(jobs.values())
    return list(jobs.values())


def write_atomically(path: Path, data: bytes, *, overwrite: bool = False, source: Path | None = None) -> None:
    """Write a file whole or not at all, making its folder where needed.

    The bytes go to a hidden file in the same folder, reach the disk, and only then take the name, so that
    neither a full disk nor Ctrl-C leaves half a picture. Raises TargetError if the target exists and
    `overwrite` is off, is the `source`, or cannot be written.
    """
    _check_not_source(path, source)
    try:
        with _temporary(path) as part:
            path.parent.mkdir(parents=True, exist_ok=True)
            _check_writable(path, overwrite)
            _write_synced(part, data)
            _publish(part, path, overwrite)
    except OSError as error:
        raise _target_error(path, error) from error


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A hidden path beside a file or folder that takes its name once it is whole and on the disk.

    It replaces a file; a folder that another process has put there meanwhile stays.

    Raises:
        TargetError: it cannot be written; the disk may be full.
    """
    try:
        with _temporary(path) as part:
            path.parent.mkdir(parents=True, exist_ok=True)
            yield part
            _sync(part)
            _replace(path, part)
            _sync(path.parent)
    except OSError as error:
        raise TargetError(
            f"{path} was not written ({error.strerror or error})",
            "it needs its place on the disk",
            "mend that (free some space, or name another folder) and run again: what is finished is kept",
        ) from error


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A hidden path beside a place, where nothing is left afterwards."""
    part = temporary_path(path)
    try:
        try:
            yield part
        finally:
            discard(part)
    except KeyboardInterrupt:  # it may have come between the name's taking and the part's removal
        discard(part)
        raise


def temporary_path(path: Path) -> Path:
    """A new hidden name in the folder of a place, for what is not whole yet or not wanted any more."""
    return path.parent / f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}.part"


def discard(path: Path) -> None:
    """Removes a file, or a folder with all in it, as far as that can be done."""
    with contextlib.suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _replace(path: Path, part: Path) -> None:
    try:
        part.replace(path)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise


def _sync(path: Path) -> None:
    is_folder = path.is_dir()
    if is_folder and sys.platform == "win32":  # a folder cannot be opened there
        return
    file = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR)  # Windows syncs what it may write
    try:
        os.fsync(file)
    finally:
        os.close(file)


def _image_files(source: Path) -> Iterator[Path]:
    if _is_folder(source):
        yield from walk(source, _is_input)
    else:
        yield source


def walk(folder: Path, is_included: Callable[[Path], bool]) -> Iterator[Path]:
    """The files in a folder and below that are wanted, in a stable order, hidden folders passed over.

    Links are followed, and a real folder is visited once, so that loops end. A folder that cannot be looked into is
    given itself.
    """
    return _walk(folder, is_included, set())


def _walk(folder: Path, is_included: Callable[[Path], bool], seen: set[tuple[int, int]]) -> Iterator[Path]:
    try:
        entries = sorted(folder.iterdir())
        status = folder.stat()
    except OSError:
        yield folder  # opening it will say why, and the rest of the batch goes on
        return
    if (status.st_dev, status.st_ino) in seen:
        return
    seen.add((status.st_dev, status.st_ino))
    for entry in entries:
        if _is_folder(entry):
            if not entry.name.startswith("."):
                yield from _walk(entry, is_included, seen)
        elif is_included(entry):
            yield entry


def _absolute(path: Path) -> str:
    """A path in one spelling, links as they are: two links to one file are two pictures."""
    return os.path.abspath(path)  # noqa: PTH100


def _is_folder(path: Path) -> bool:
    return os.path.isdir(path)  # noqa: PTH112  (Path.is_dir raises where we may not look)


def _name_counts(folder: Path) -> Counter[str]:
    """How often the pictures of a folder claim a name: each once by its stem and once in full."""
    try:
        pictures = [path for path in folder.iterdir() if _is_input(path)]
    except OSError:
        return Counter()
    return Counter(name for path in pictures for name in (path.stem, path.name))


def _layer_name(picture: Path, counts: Counter[str]) -> str:
    others = counts[picture.stem] - _is_input(picture)
    return picture.name if others > 0 else picture.stem


def _is_input(path: Path) -> bool:
    """Whether a file found in a folder is a picture by name, not hidden, and not one of our own results."""
    is_result = Path(path.stem).suffix.lstrip(".") in LAYERS
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and not is_result


def _check_unique_targets(jobs: Iterable[SeparationPaths]) -> None:
    owners: dict[str, SeparationPaths] = {}
    for job in jobs:
        name = job.folder / job.name
        other = owners.setdefault(_absolute(name), job)
        if other is not job:
            raise TargetError(
                f"{other.source} and {job.source} would both be written as {name}.*",
                "every picture needs a name of its own",
                "give the folder above them, whose tree is mirrored, or run them into different folders",
            )


def _check_not_source(path: Path, source: Path | None) -> None:
    with contextlib.suppress(OSError):  # a source or target that is not there is not the same file
        if source is not None and path.samefile(source):
            raise TargetError(
                f"{path} is the picture itself", "sources are never touched", "choose another name"
            )


def _check_writable(path: Path, overwrite: bool) -> None:
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if path.exists() and not overwrite:
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def _write_synced(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _publish(part: Path, path: Path, overwrite: bool) -> None:
    if overwrite:
        part.replace(path)
        return
    try:
        os.link(part, path)  # unlike a rename, a link never replaces what somebody else wrote meanwhile
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK):
            raise
        part.replace(path)  # a file system without links (FAT): _refuse_taken has looked just before


_REMEDIES = {
    errno.EEXIST: (
        "nothing is overwritten unasked",
        "pass --overwrite (in Python overwrite=True) or choose another place",
    ),
    errno.EISDIR: ("the target must be a file", "name a file in it, or use -o for a folder"),
    errno.ENOSPC: ("the whole file must fit on the disk", "free some space and run again"),
    errno.EDQUOT: ("the whole file must fit in the quota", "free some space and run again"),
    errno.EACCES: ("the place must be writable", "choose another place with -o, or change its permissions"),
    errno.EPERM: ("the place must be writable", "choose another place with -o, or change its permissions"),
    errno.EROFS: ("the place must be writable", "choose another place with -o"),
    errno.ENAMETOOLONG: ("the name must be shorter", "rename the picture"),
}
_DEFAULT_REMEDY = ("the file must be writable", "choose another place with -o")


def _target_error(path: Path, error: OSError) -> TargetError:
    expected, cure = _REMEDIES.get(error.errno or 0, _DEFAULT_REMEDY)
    return TargetError(f"{path} was not written ({error.strerror or error})", expected, cure)


def cache_folder() -> Path:
    """Where downloads are kept: brewster's part of the user's cache folder, as each operating system has it."""
    return platformdirs.user_cache_path("brewster", appauthor=False)
