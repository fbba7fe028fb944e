"""The token of a study, kept beside it: the personal links that carry it hold when the server starts again."""

from __future__ import annotations

import os
import re
import secrets
from pathlib import Path
from typing import Final

from brewster.errors import BrewsterError, TargetError

_PATTERN: Final = re.compile(r"[A-Za-z0-9_-]{16,200}")


def load_or_create_token(folder: Path) -> str:
    """The token in the folder of a study, made where there is none, in a file that only its owner may read.

    Raises:
        BrewsterError: what is there is none.
        TargetError: it cannot be read or written.
    """
    path = folder / "token"
    try:
        if not path.exists():
            _write(path, secrets.token_urlsafe(16))
        token = path.read_text("latin-1").strip()
    except OSError as error:
        raise TargetError(
            f"{path} cannot be used ({error.strerror or error})",
            "a token that is kept is read and written there",
            "mend that, or give the token itself: --token TOKEN",
        ) from error
    if not _PATTERN.fullmatch(token):
        raise BrewsterError(
            f"{path} holds no token",
            "16 letters or more, of A-Z a-z 0-9 _ and -",
            "remove it for a new one; links that were sent out hold only with the old one",
        )
    return token


def _write(path: Path, token: str) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(f"{token}\n")
        file.flush()
        os.fsync(file.fileno())
