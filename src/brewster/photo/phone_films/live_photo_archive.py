"""Reads the .livp files in which Apple's Photos and cloud services of China pass on a Live Photo: a
zip archive with a HEIC or JPEG and a MOV.

Sizes are checked before anything is decompressed: a small archive can expand to a huge file.
"""

import io
import lzma
import re
import zipfile
import zlib
from typing import BinaryIO, Final

from brewster.errors import UnreadablePhoto, UnsupportedPhoto

_MAX_ENTRIES: Final = 64
_MAX_DIRECTORY_BYTES: Final = 1 << 20
_MAX_MEMBER_BYTES: Final = 1 << 28
_END_RECORD: Final = b"PK\5\6"
_END_BYTES: Final = 22 + 0xFFFF
"""The last bytes of an archive, with the record of its end (APPNOTE 4.3.16) and a comment."""
_STILL_NAME: Final = re.compile(r"\.(heic|heif|jpe?g)$", re.IGNORECASE)
_FILM_NAME: Final = re.compile(r"\.(mov|mp4)$", re.IGNORECASE)
ZIP_ERRORS: Final = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError),
    *(KeyError, ValueError, OSError, EOFError, RuntimeError),
)


def still_bytes(data: bytes) -> bytes:
    """Returns the bytes of the still in an archive.

    Raises:
        UnreadablePhoto: the archive is damaged, encrypted or too large.
        UnsupportedPhoto: it has no still, or several.
    """
    file = io.BytesIO(data)
    names = _names(file, _STILL_NAME)
    if len(names) != 1:
        raise UnsupportedPhoto(
            f"the archive contains {len(names)} photos",
            "expected one HEIC or JPEG and its film, as in a .livp file",
            "unpack the archive, and pass the photos",
        )
    return member(file, names[0]).getvalue()


def film_names(file: BinaryIO) -> list[str]:
    """Returns the names of the films in an archive. Raises UnreadablePhoto if it is damaged."""
    return _names(file, _FILM_NAME)


def member(file: BinaryIO, name: str) -> io.BytesIO:
    """Returns a decompressed member of an archive. Raises UnreadablePhoto if the archive is damaged
    or encrypted, or the member is too large.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            size = archive.getinfo(name).file_size
            if size > _MAX_MEMBER_BYTES:
                raise _error(
                    f"{name} in the archive has {size} bytes",
                    f"expected at most {_MAX_MEMBER_BYTES}",
                )
            with archive.open(name) as stored:
                # without a number, zipfile expands all bytes, also those beyond the stated size
                return io.BytesIO(stored.read(size + 1))
    except ZIP_ERRORS as error:  # RuntimeError: the archive is encrypted
        raise _error("the archive cannot be read completely", "expected a .livp file") from error


def _names(file: BinaryIO, pattern: re.Pattern[str]) -> list[str]:
    _check_directory(file)
    try:
        with zipfile.ZipFile(file) as archive:
            return [name for name in archive.namelist() if pattern.search(name)]
    except ZIP_ERRORS as error:
        raise _error("the archive cannot be read completely", "expected a .livp file") from error


def _check_directory(file: BinaryIO) -> None:
    """Raises UnreadablePhoto if the directory of an archive is missing, or large, before it is
    read.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(max(size - _END_BYTES, 0))
    tail = file.read()
    at = tail.rfind(_END_RECORD)
    record = tail[at : at + 22] if at >= 0 else b""
    entries = int.from_bytes(record[10:12], "little")
    directory_bytes = int.from_bytes(record[12:16], "little")
    is_small = entries <= _MAX_ENTRIES and directory_bytes <= _MAX_DIRECTORY_BYTES
    if len(record) < 22 or not is_small:
        raise _error(
            f"the archive has {entries} files" if record else "the archive has no directory",
            f"expected a complete archive with 1 to {_MAX_ENTRIES} files",
        )


def _error(happened: str, expected: str) -> UnreadablePhoto:
    return UnreadablePhoto(happened, expected, "save the Live Photo again, as two files")
