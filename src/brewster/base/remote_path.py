"""Files in object stores, such as s3://bucket/scans/a.jpg, through fsspec.

`location` returns such a file or a local path, and `read_image` reads both. fsspec loads the
package of the store (s3fs for S3, gcsfs for Google Cloud Storage), which has its own settings, such
as AWS_PROFILE or FSSPEC_S3_ENDPOINT_URL.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, TypeAlias, final

from brewster.base.image_formats import HEAD_BYTES, format_of, is_video, is_video_content
from brewster.errors import (
    BrewsterError,
    MissingExtra,
    OutputError,
    UnreadablePhoto,
    empty_file_error,
    video_error,
)

_RETRY = (
    "check the network and the credentials, and run the same command again: finished files are kept"
)


@final
class RemotePath(PurePosixPath):
    """The URL of a file or folder in an object store, with the methods of `pathlib.Path` that
    brewster needs. Empty parts, as in `s3://bucket/a//b.jpg`, are dropped.
    """

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    def read_bytes(self) -> bytes:
        """Returns the content of the file. Raises UnreadablePhoto if the file does not exist, or
        the store fails.
        """
        with self._reading() as store:
            return bytes(store.cat_file(str(self)))

    def check_readable(self) -> None:
        """Checks that the URL is that of a file with content, with one request that does not read
        the content. Raises UnreadablePhoto if the file does not exist, is empty or is a folder, or
        the store fails.
        """
        with self._reading() as store:
            info = store.info(str(self))
        if info["type"] == "directory":
            raise UnreadablePhoto(
                f"{self} cannot be read (it is a folder)", "expected an image file", "check the URL"
            )
        if info.get("size") == 0:
            raise empty_file_error()

    def walk_files(self) -> list[RemotePath]:
        """Returns all files below this folder, sorted. Raises UnreadablePhoto if the store
        fails.
        """
        with self._reading("listed") as store:
            found = store.find(str(self))
            root = store._strip_protocol(str(self))  # the prefix of all names that `find` returns
        return sorted(self / str(name)[len(root) :].lstrip("/") for name in found)

    @contextlib.contextmanager
    def _reading(self, action: str = "read") -> Iterator[Any]:
        """Yields the store. Translates its errors within this block into `UnreadablePhoto`."""
        store = _store(self)
        try:
            yield store
        except Exception as error:  # each store has its own errors
            if isinstance(error, FileNotFoundError) and action == "read":
                raise UnreadablePhoto(
                    f"{self} cannot be read (it does not exist)",
                    "expected an image file",
                    "check the URL",
                ) from error
            happened = f"{self} cannot be {action} ({_reason(error)})"
            raise UnreadablePhoto(happened, "expected a store that responds", _RETRY) from error

    def write_bytes(self, data: bytes, *, overwrite: bool = False) -> None:
        """Writes the file with one upload, which is atomic in S3, GCS and Azure. Raises
        FileExistsError if the file exists and `overwrite` is False, and OutputError if the store
        fails, or refuses the upload.
        """
        store = _store(self)
        try:
            store.pipe_file(str(self), data, mode="overwrite" if overwrite else "create")
        except FileExistsError as error:
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from error
        except Exception as error:
            happened = f"{self} was not written ({_reason(error)})"
            raise OutputError(
                happened, "expected a store that can be written to", _RETRY
            ) from error

    def exists(self) -> bool:
        """Whether the file exists. False if the store fails: reading or writing the file then
        raises the error.
        """
        store = _store(self)
        with contextlib.suppress(Exception):
            return bool(store.exists(str(self)))
        return False

    def unlink(self) -> None:
        """Deletes the file. Ignores errors, because only temporary files are deleted."""
        with contextlib.suppress(Exception):
            _store(self).rm_file(str(self))

    def iterdir(self) -> Iterator[RemotePath]:
        """Yields the files and folders in this folder. Yields nothing if the store fails."""
        store = _store(self)
        names = []
        with contextlib.suppress(Exception):
            names = store.ls(str(self), detail=False)
        yield from (self / PurePosixPath(name).name for name in names)


Location: TypeAlias = Path | RemotePath


def location(text: str | os.PathLike[str]) -> Location:
    """Returns the path for a path, a file:// URL, or the URL of an object store. Raises
    BrewsterError if the URL is a web address, names a file of another machine, or has an unknown
    protocol, and MissingExtra for the store.
    """
    if isinstance(text, RemotePath | Path) or not re.match(r"[A-Za-z][\w+.-]+://", os.fspath(text)):
        return text if isinstance(text, RemotePath) else Path(text)
    url = os.fspath(text)
    if url.startswith("file:"):
        return Path(path_of_file_url(url))
    if url.lower().startswith(("http://", "https://")):
        raise BrewsterError(
            f"{url} is a web address",
            "expected a file or folder on this machine, or the URL of an object store such as "
            "s3://bucket/folder",
            "download the photo, and pass the path of the file",
        )
    path = RemotePath(url)
    _store(path)  # raises the errors here once, instead of for every photo
    return path


def path_of_file_url(url: str) -> str:
    """Returns the local path of a file:// URL (RFC 8089). Its host is empty or localhost, or on
    Windows the name of a server. Raises BrewsterError if the URL names another machine, and this
    machine does not run Windows.
    """
    from urllib.request import url2pathname  # noqa: PLC0415  (slow)

    host, _, path = url.removeprefix("file://").partition("/")
    if host in ("", "localhost"):
        return url2pathname(f"/{path}")
    if sys.platform == "win32":
        return url2pathname(f"//{host}/{path}")
    raise BrewsterError(
        f"{url} is a file on the machine {host}",
        "expected a file on this machine: a path, or a URL such as file:///home/me/photo.jpg",
        "copy the file to this machine, or mount its folder and pass the path there",
    )


def read_image(path: Location) -> bytes:
    """Returns the bytes of an image file. Raises UnreadablePhoto if the file does not exist, is a
    folder, or cannot be read, and UnsupportedPhoto for a video, whose content may not fit into
    memory.
    """
    if isinstance(path, RemotePath):
        check_not_video(path)
        return path.read_bytes()
    with _opened(path) as file:
        check_not_video(path)
        head = file.read(HEAD_BYTES)
        if is_video_content(head):
            raise video_error(str(path))
        return head + file.read()


def is_video_file(path: Location) -> bool:
    """Returns whether a file is a video, by its suffix or by its content.

    Only a local file without the suffix of an image or a video is opened, because in a store the
    requests would take hours. False for a file that cannot be read: reading it later raises the
    error.
    """
    if is_video(path) or format_of(path) or isinstance(path, RemotePath):
        return is_video(path)
    try:
        if not os.path.isfile(path):  # noqa: PTH113  (a pipe would be read)
            return False
        with path.open("rb") as file:
            return is_video_content(file.read(HEAD_BYTES))
    except (OSError, ValueError):
        return False


def check_readable(path: Location) -> None:
    """Checks that a file, but not a pipe, exists and is not empty. Raises UnreadablePhoto if
    not.
    """
    if isinstance(path, RemotePath):
        path.check_readable()
        return
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):  # noqa: PTH110, PTH112, PTH113
        return
    with _opened(path) as file:
        if not file.read(1):
            raise empty_file_error()


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        is_folder = os.path.isdir(path)  # noqa: PTH112  (Path.is_dir raises without permission)
        reason = "it is a folder" if is_folder else error.strerror or str(error)
        raise UnreadablePhoto(
            f"{path} cannot be read ({reason})",
            "expected an image file",
            "check its name and permissions",
        ) from error


def check_not_video(path: Location) -> None:
    """Raises UnsupportedPhoto if a name has the suffix of a video. A damaged video has no other
    sign.
    """
    if is_video(path):
        raise video_error(str(path))


def _store(path: RemotePath) -> Any:  # noqa: ANN401  (fsspec has no types)
    """Returns the file system of a URL. Listings are not cached, because other nodes write files,
    too.
    """
    protocol = path.parts[0].rstrip(":")
    try:
        return importlib.import_module("fsspec").filesystem(protocol, use_listings_cache=False)
    except ImportError as error:
        if error.name == "fsspec":
            raise MissingExtra.for_extra(
                "cluster",
                "the package fsspec is not installed",
                f"expected it to be installed, because it reads {protocol}:// URLs",
            ) from error
        raise MissingExtra(
            f"{protocol}:// needs a package that is not installed ({error})",
            "expected the package of this store: s3fs for s3://, gcsfs for gs://, adlfs for az://",
            "install it with pip",
        ) from error
    except ValueError as error:
        raise BrewsterError(
            f"the protocol {protocol}:// is unknown",
            "expected the path of a file or folder, or a URL such as s3://bucket/folder",
            "correct the URL",
        ) from error


def _reason(error: Exception) -> str:
    first_line = str(error).partition("\n")[0]
    return first_line or type(error).__name__
