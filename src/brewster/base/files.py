"""Finds input images and writes results atomically, without overwriting other files.

for image, folder in images_in(Path("holiday"), output_folder=Path("clear")):
    write_atomically(SeparationPaths(image, folder).target("transmission", ".png"), data)
"""

import contextlib
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import sys
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from brewster.base.image_formats import FORMATS, ImageFormat, format_of
from brewster.base.remote_path import Location, RemotePath
from brewster.errors import DiskFull, OutputError

DEFAULT_MAX_PIXELS = 200_000_000
"""The default for the maximum number of pixels. Larger images are refused undecoded: a small file
can expand to a huge one.
"""

TEMPORARY_PREFIX = ".brewster-"
"""File name prefix of unfinished files."""

FOLDERS_OF_PROGRAMS = frozenset(
    ("@eaDir", "#recycle", "@Recycle", "$RECYCLE.BIN", ".thumbnails", ".Trashes", "lost+found")
)
"""Folders of thumbnails and of deleted files, which network drives and file managers create."""

OUTPUT_LAYERS = ("transmission", "reflection", "confidence", "layered")
LAYER_FORMATS = {"confidence": "png", "layered": "ora"}
"""The formats of the layers whose format does not depend on that of the photo."""
MASK_SUFFIX = ".mask"
"""The end of the stem of a mask: the page saves the mask of `a.jpg` as `a.mask.png`."""


@dataclass(frozen=True)
class SeparationPaths:
    """An image to separate, and the folder of its layers. Command line, Python and HTTP name layers
    with this class.
    """

    source: Location
    folder: Location
    content_format: ImageFormat | None = None
    """The format of the content of the image; None: unknown. It is needed only if the name has no
    image suffix.
    """

    @property
    def suffix(self) -> str:
        """The image suffix of the source. If it has none, the suffix of the format of its content,
        by default .png.
        """
        if format_of(self.source):
            return self.source.suffix
        return (self.content_format or FORMATS["png"]).suffixes[0]

    @property
    def stem(self) -> str:
        """The name of the source without its image suffix. Other suffixes belong to the name, as in
        `x.jpg_large`.
        """
        return self.source.stem if format_of(self.source) else self.source.name

    def target(self, layer: str, suffix: str, *, has_full_name: bool = False) -> Location:
        """Returns the path of a layer: `a.transmission.jpg` for `a.jpg`, or
        `a.jpg.transmission.jpg`.

        `suffix` is that of the layer, from `Options.suffix`.
        """
        return self.folder / f"{self.source.name if has_full_name else self.stem}.{layer}{suffix}"


def images_in(
    source: Location,
    output_folder: Location | None = None,
    *,
    skipped: list[Location] | None = None,
) -> Iterator[tuple[Location, Location]]:
    """Yields the images in a file or folder in a stable order, each with the folder of its layers.

    Layers are written next to their image, or below `output_folder`, which mirrors the tree of an
    input folder.

    In folders, hidden files, layers that brewster has written, and masks next to their image
    (`a.mask.png` next to `a.jpg`) are ignored. Folders that programs create for thumbnails or
    deleted files are skipped, and appended to `skipped`. All other files without the suffix of an
    image, such as videos, are appended to `skipped`, and so are pipes, sockets and devices. A
    folder that is reached through several links is visited once, so that link loops end. A file
    given by name is always included. If it is not an image, opening it raises the error.
    """
    for image in _image_files(source, [] if skipped is None else skipped):
        if output_folder is None or image == source:
            yield image, output_folder or image.parent
        else:
            yield image, output_folder.joinpath(*image.parent.relative_to(source).parts)


def write_atomically(path: Location, data: bytes, *, overwrite: bool = False) -> None:
    """Writes a file atomically, as `atomic_path` does; in an object store, with one upload. Raises
    OutputError if the file exists and `overwrite` is False, or it cannot be written.
    """
    if isinstance(path, RemotePath):
        try:
            path.write_bytes(data, overwrite=overwrite)
        except OSError as error:
            raise _output_error(path, error) from error
        return
    with atomic_path(path, overwrite=overwrite) as part:
        if path.is_dir():
            raise _os_error(errno.EISDIR)
        if path.exists() and not (overwrite and os.access(path, os.W_OK)):
            raise _os_error(errno.EACCES if overwrite else errno.EEXIST)
        part.write_bytes(data)


def check_output_folder(folder: Location) -> None:
    """Checks that the output folder of a batch can be created and written to, to find errors before
    the first photo.

    The permissions of a folder do not show all errors. Therefore a hidden folder is created in the
    output folder, or in its nearest parent that exists, and is deleted at once; in an object store,
    an empty file. Raises OutputError if the folder cannot be created, or cannot be written to.
    """
    if isinstance(folder, RemotePath):
        probe = folder / f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}"
        write_atomically(probe, b"")
        probe.unlink()
        return
    try:
        for existing in (folder, *folder.parents):
            with contextlib.suppress(FileNotFoundError):
                existing.lstat()
                break
        if not existing.is_dir():
            raise _os_error(errno.ENOTDIR)
        with _temporary(existing / folder.name) as part:
            part.mkdir()
    except OSError as error:
        raise _output_error(folder, error) from error


@contextlib.contextmanager
def atomic_path(path: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yields a hidden path for a new file or folder, in a folder that is created where needed. At
    the end of the block, the file or folder is flushed to the disk and renamed to `path`, so that a
    full disk or Ctrl-C leaves no part of it.

    An existing file is replaced, unless `overwrite` is False. If another process has created the
    folder in the meantime, that folder stays. Raises OutputError if it cannot be written, for
    example because the disk is full.
    """
    try:
        with _temporary(path) as part:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except (
                FileExistsError
            ) as error:  # another cure: --overwrite replaces no file by a folder
                raise _os_error(errno.ENOTDIR) from error
            yield part
            _sync(part)
            _publish(part, path, overwrite)
            with contextlib.suppress(OSError):  # some file systems cannot flush a folder
                _sync(path.parent)
    except OSError as error:
        raise _output_error(path, error) from error


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yields a hidden path in the folder of `path`. A file or folder that still has this path at
    the end is deleted.
    """
    part = temporary_path(path)
    try:
        try:
            yield part
        finally:
            discard(part)
    except KeyboardInterrupt:  # the interrupt may have stopped `discard`
        discard(part)
        raise


def temporary_path(path: Path) -> Path:
    """Returns a new hidden path in the folder of `path`, for a file that is written or deleted."""
    return path.parent / f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}.part"


def discard(path: Path) -> None:
    """Deletes a file, or a folder with its content. Ignores errors."""
    with contextlib.suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _sync(path: Path) -> None:
    is_folder = path.is_dir()
    if is_folder and sys.platform == "win32":  # Windows cannot open a folder
        return
    # Windows syncs only files opened for writing
    file = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def _image_files(source: Location, skipped: list[Location]) -> Iterator[Location]:
    def is_included(path: Location) -> bool:
        if (format_of(path) is None or _is_special(path)) and not path.name.startswith("."):
            skipped.append(path)
        return _is_input(path)

    if isinstance(source, RemotePath):
        found = [source] if format_of(source) else source.walk_files()
        folders = {path: path.relative_to(source).parts for path in found}
        visible = (
            path
            for path, parts in folders.items()
            if not any(part.startswith(".") or part in FOLDERS_OF_PROGRAMS for part in parts)
        )
        yield from _without_masks(path for path in visible if path == source or is_included(path))
    elif _is_folder(source):
        yield from _without_masks(walk(source, is_included, skipped=skipped))
    else:
        yield source


def walk(
    folder: Path,
    is_included: Callable[[Path], bool],
    visited: set[tuple[int, int]] | None = None,
    skipped: list[Location] | None = None,
) -> Iterator[Path]:
    """Yields the files below a folder for which `is_included` is True, in a stable order, without
    hidden folders, pipes, sockets, devices. Folders of programs are appended to `skipped`.

    Links are followed. Each folder is visited once, so that link loops end: `visited` contains the
    device and the number of those that were visited before. If a folder cannot be read, its path is
    yielded.
    """
    visited = set() if visited is None else visited
    try:
        entries = sorted(folder.iterdir())
        status = folder.stat()
    except OSError:
        # Opening this path raises the error for this path only, and the rest of the batch continues
        yield folder
        return
    if (status.st_dev, status.st_ino) in visited:
        return
    visited.add((status.st_dev, status.st_ino))
    for entry in entries:
        if _is_folder(entry):
            if entry.name in FOLDERS_OF_PROGRAMS:
                if skipped is not None:
                    skipped.append(entry)
            elif not entry.name.startswith("."):
                yield from walk(entry, is_included, visited, skipped)
        elif is_included(entry) and not _is_special(entry):
            yield entry


def folder_entries(folder: Path) -> list[Path]:
    """Returns the folders and the regular files in a folder, sorted. Pipes, sockets and devices are
    left out, because reading one can wait forever; broken links are included, because opening them
    raises the error. Raises OSError.
    """
    return sorted(entry for entry in folder.iterdir() if not _is_special(entry))


def _is_special(path: Location) -> bool:
    """Whether a path is that of a pipe, a socket or a device."""
    try:
        mode = path.stat().st_mode if isinstance(path, Path) else stat.S_IFREG
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def absolute(path: Location) -> str:
    """Returns the absolute path or the URL. Links are not resolved: two links to one file are two
    images.
    """
    return str(path) if isinstance(path, RemotePath) else os.path.abspath(path)  # noqa: PTH100


def _is_folder(path: Path) -> bool:
    return os.path.isdir(path)  # noqa: PTH112  (Path.is_dir raises without permission)


def _without_masks(images: Iterable[Location]) -> Iterator[Location]:
    """Yields the images of folders, but not the mask `a.mask.png` if the folder has an image with
    the stem `a`.
    """
    stems: dict[Location, set[str]] = {}
    for image in images:
        photo_stem = image.stem.removesuffix(MASK_SUFFIX)
        folder = image.parent
        if photo_stem != image.stem:
            if folder not in stems:
                stems[folder] = {path.stem for path in folder.iterdir() if _is_input(path)}
            if photo_stem in stems[folder]:
                continue
        yield image


def _is_input(path: Location) -> bool:
    """Returns whether a file has an image suffix, is not hidden, and is not a layer that brewster
    has written.
    """
    is_result = Path(path.stem).suffix.lstrip(".") in OUTPUT_LAYERS
    return format_of(path) is not None and not path.name.startswith(".") and not is_result


def is_same_file(path: Location, other: Location) -> bool:
    """Whether both paths lead to the same existing file, through links or hard links, too."""
    try:
        return (
            path.samefile(other)
            if isinstance(path, Path) and isinstance(other, Path)
            else path == other
        )
    except OSError:  # one of the files does not exist
        return False


def file_digest(path: Path, algorithm: str) -> str:
    """Returns the digest of a file's bytes in lower-case hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(
            file, lambda: hashlib.new(algorithm, usedforsecurity=False)
        ).hexdigest()


def is_unicode(name: str) -> bool:
    """Whether a file name is text. Other bytes become surrogates (PEP 383), which neither JSON nor
    TOML can contain.
    """
    return not re.search("[\ud800-\udfff]", name)


def exists(path: Location) -> bool:
    """Whether a file, a folder or a link exists at the path."""
    return path.exists() if isinstance(path, RemotePath) else os.path.lexists(path)


_NO_HARD_LINKS = {
    errno.EPERM,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.ENOSYS,
    errno.EMLINK,
    errno.EINVAL,  # on Windows, FAT and exFAT
}


def _publish(part: Path, path: Path, overwrite: bool) -> None:
    try:
        if overwrite:
            part.replace(path)
        else:  # unlike a rename, a link never replaces a file that another process has just written
            os.link(part, path)
    except OSError as error:
        is_folder_there = error.errno in (errno.ENOTEMPTY, errno.EEXIST) and part.is_dir()
        if not overwrite and error.errno in _NO_HARD_LINKS:  # FAT, for example
            part.replace(path)
        elif not is_folder_there:
            raise


def _os_error(code: int) -> OSError:
    return OSError(code, os.strerror(code))


_REMEDIES = {
    errno.EEXIST: (
        "expected a path that does not exist, because files are not overwritten",
        "pass --overwrite (in Python overwrite=True) or choose another name or folder",
    ),
    errno.EISDIR: (
        "expected a file, not a folder",
        "choose a file in this folder",
    ),
    errno.ENOTDIR: (
        "expected a folder, but a part of this path is a file",
        "choose another folder",
    ),
    errno.ENOSPC: ("expected enough free space on the disk", "free some space and run again"),
    errno.EDQUOT: ("expected enough space in the disk quota", "free some space and run again"),
    errno.EACCES: (
        "expected a writable folder",
        "choose another folder, or change its permissions",
    ),
    errno.EPERM: (
        "expected a writable folder",
        "choose another folder, or change its permissions",
    ),
    errno.EROFS: ("expected a writable folder", "choose another folder"),
    errno.ENAMETOOLONG: ("expected a shorter name", "rename the image"),
}
_MAX_WINDOWS_PATH = 260
_DEFAULT_REMEDY = ("expected a writable file", "choose another folder")


def _output_error(path: Location, error: OSError) -> OutputError:
    expected, cure = _REMEDIES.get(error.errno or 0, _DEFAULT_REMEDY)
    if (
        sys.platform == "win32"
        and len(absolute(path)) >= _MAX_WINDOWS_PATH
        and error.errno == errno.ENOENT
    ):
        limit = f"{_MAX_WINDOWS_PATH} characters, the limit of Windows by default"
        expected = f"expected a path of fewer than {limit}"
        cure = "choose a shorter folder, or enable long paths in the settings of Windows"
    kind = DiskFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else OutputError
    return kind(f"{path} was not written ({error.strerror or error})", expected, cure)


@contextlib.contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Creates a folder, and holds its lock within this block. If the process is killed, the
    operating system releases the lock. Raises OutputError if another process holds it, or the
    folder cannot be written.
    """
    import filelock  # noqa: PLC0415  (few commands need it)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = filelock.FileLock(folder / ".lock", blocking=False, fallback_to_soft=False).acquire()
    except filelock.Timeout as error:
        raise OutputError(
            f"another run is writing to {folder}",
            "expected no other run, because only one run at a time can write there",
            "wait until the other run has ended, or choose another folder",
        ) from error
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written to, or has no locks ({error.strerror})",
            "expected a writable folder on a file system with locks",
            "choose another folder",
        ) from error
    with held:
        yield


def cache_folder() -> Path:
    """Returns the folder for downloads. It is in the cache folder that the operating system defines
    for the user.
    """
    return platformdirs.user_cache_path("brewster", appauthor=False)


def is_image_file(path: Path) -> bool:
    """Whether the path is that of a file that has an image suffix and is not hidden."""
    return format_of(path) is not None and not path.name.startswith(".") and path.is_file()


def normalised(name: str) -> str:
    """Returns a name in Unicode form NFC; some file systems store an accented letter as two code
    points.
    """
    return unicodedata.normalize("NFC", name)


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Returns the sort key for natural order: 2 before 10."""
    pieces = re.split(r"(\d+)", name)
    return [int(piece) if i % 2 else piece for i, piece in enumerate(pieces)], name


def free_disk_bytes(folder: Path) -> int:
    """Returns the free bytes of the disk of a folder. If it does not exist, its nearest parent is
    used.
    """
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free
