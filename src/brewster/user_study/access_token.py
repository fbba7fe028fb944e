"""The access token of a study, stored in its folder so that personal links stay valid when the server restarts."""

from __future__ import annotations

import os
import re
import secrets
from pathlib import Path
from typing import Final

from brewster.errors import BrewsterError, OutputError

_PATTERN: Final = re.compile(r"[A-Za-z0-9_-]{16,200}")


def load_or_create_token(folder: Path) -> str:
    """Read the token from the study folder, or create it in a file with permissions 0600. The token has 16 to 200
    URL-safe characters. Raises BrewsterError if the file exists but does not contain a valid token, and OutputError
    if the file cannot be read or written."""
    path = folder / "token"
    try:
        if not path.exists():
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(f"{secrets.token_urlsafe(16)}\n")
                file.flush()
                os.fsync(file.fileno())
        token = path.read_text("latin-1").strip()
    except OSError as error:
        raise OutputError(
            f"{path} cannot be read or written ({error.strerror or error})",
            "expected a file that can store the token of the study",
            "make the file readable and writable, or pass a token: --token TOKEN",
        ) from error
    if not _PATTERN.fullmatch(token):
        raise BrewsterError(
            f"{path} contains no valid token",
            "expected 16 to 200 characters of A-Z a-z 0-9 _ and -",
            "restore the file, or delete it to create a new token, which makes the links sent out earlier invalid",
        )
    return token
