"""The token of a server in a file, so that links stay valid when the server is started again.

    token = load_or_create_token(state_folder() / "token")

Whoever can read the file can use the server, so that only its owner can read it.
"""

import os
import re
import secrets
from pathlib import Path
from typing import Final

import platformdirs

from brewster.errors import BrewsterError, OutputError

TOKEN: Final = re.compile(r"[A-Za-z0-9_-]{16,200}")
"""Tokens that can be part of a link and of a cookie, and are too long to be guessed."""


def state_folder() -> Path:
    """Returns the folder that the operating system defines for what programs of the user keep."""
    return platformdirs.user_state_path("brewster", appauthor=False)


def load_or_create_token(path: Path) -> str:
    """Reads the token from a file, or creates it in a file with permissions 0600. The token has 16
    to 200 URL-safe characters. Raises BrewsterError if the file exists but does not contain a valid
    token, and OutputError if the file cannot be read or written.
    """
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(f"{secrets.token_urlsafe(16)}\n")
                file.flush()
                os.fsync(file.fileno())
        token = path.read_text("latin-1").strip()
    except OSError as error:
        raise OutputError(
            f"{path} cannot be read or written ({error.strerror or error})",
            "expected a file that can store the token of the server",
            "make the file readable and writable, or pass a token: --token TOKEN",
        ) from error
    if not TOKEN.fullmatch(token):
        raise BrewsterError(
            f"{path} contains no valid token",
            "expected 16 to 200 characters of A-Z a-z 0-9 _ and -",
            "restore the file, or delete it to create a new token, which makes the links sent "
            "out earlier invalid",
        )
    return token
