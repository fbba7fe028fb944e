"""Fetches files over a line that may break: patiently, from http and https only, and checked against a sum.

    Line().fetch(Promise(url, size=244408911, algorithm="sha256", digest="7be5..."), Path("alexnet.pth"))

What was begun lies beside its target as `.part`, and the next call goes on from there.
"""

from __future__ import annotations

import functools
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse, InvalidURL
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar, cast, final
from urllib import request
from urllib.error import HTTPError

from brewster.errors import DownloadError, TargetError

_RETRYABLE_STATUS = (408, 425, 429, 500, 502, 503, 504)
_MAX_RETRY_AFTER_S = 120.0
_BLOCK_BYTES = 1 << 18
_HTTP_URL = "http:// or https://"

_T = TypeVar("_T")


class RemoteFile(NamedTuple):
    """A file as its server, or we, promise it; the digest is in lower-case hexadecimal digits."""

    url: str
    size: int
    algorithm: Literal["md5", "sha256"]
    digest: str


@final
class _RetryableError(Exception):
    """The line broke, or the server asks for patience: worth another attempt, after so many seconds."""

    def __init__(self, reason: object, wait_s: float = 0.0) -> None:
        super().__init__(str(reason) or type(reason).__name__)
        self.wait_s = wait_s


@final
@dataclass(frozen=True)
class Downloader:
    """How to ask: the pauses between attempts, how long silence is borne, and how to wait."""

    retry_delays_s: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    timeout_s: float = 30.0
    sleep: Callable[[float], object] = time.sleep

    def read(self, url: str) -> bytes:
        """All that an address answers.

        Raises:
            DownloadError: the address is none, the server refuses, or cannot be reached in all attempts.
        """

        def attempt() -> bytes:
            with self._open(url) as response:
                return _read(response)

        return self._with_retries(url, attempt)

    def fetch(self, remote: RemoteFile, target: Path) -> None:
        """Downloads a file, making its folder; the target has its name only when it is whole and right.

        Raises:
            DownloadError: the file cannot be had, or is not what was promised.
            TargetError: the folder cannot be written.
        """
        part = target.with_name(f"{target.name}.part")
        with target_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            self._with_retries(remote.url, lambda: self._fetch_rest(remote, part))
            if (digest := file_digest(part, remote.algorithm)) != remote.digest:
                part.unlink()
                happened = (
                    f"{remote.url} came with the {remote.algorithm.upper()} sum {digest}, and was dropped"
                )
                cure = "run again, to fetch all of it anew"
                raise DownloadError(happened, f"{remote.digest} was promised", cure)
            part.replace(target)

    def _with_retries(self, url: str, attempt: Callable[[], _T]) -> _T:
        delays = iter(self.retry_delays_s)
        while True:
            try:
                return attempt()
            except _RetryableError as error:
                if (delay := next(delays, None)) is None:
                    happened = f"{url} did not come in {len(self.retry_delays_s) + 1} attempts ({error})"
                    cure = "check the connection, or run again later: what came is kept"
                    raise DownloadError(
                        happened, "a server that answers, and a line that holds", cure
                    ) from error
                self.sleep(max(delay, error.wait_s))

    def _open(self, url: str, start: int = 0) -> HTTPResponse:
        """The answer, from this byte on if the server can do that."""
        headers = {"User-Agent": _user_agent()} | ({"Range": f"bytes={start}-"} if start else {})
        try:
            query = request.Request(url, headers=headers)  # noqa: S310  (the opener knows http and https only)
            response = _opener().open(query, timeout=self.timeout_s)
        except HTTPError as error:
            error.close()
            if error.code in _RETRYABLE_STATUS:
                retry_after = error.headers.get("Retry-After", "")
                raise _RetryableError(
                    error, min(float(retry_after), _MAX_RETRY_AFTER_S) if retry_after.isdecimal() else 0
                ) from error
            raise DownloadError(f"{url} was refused ({error})", "a file", "run again later") from error
        except (ValueError, InvalidURL) as error:
            raise DownloadError(f"{url!r} is no address ({error})", _HTTP_URL, "check the address") from error
        except (OSError, HTTPException) as error:
            raise _RetryableError(error) from error
        if response is None:
            raise DownloadError(f"{url!r} leads elsewhere", _HTTP_URL, "check the address")
        return cast("HTTPResponse", response)

    def _fetch_rest(self, remote: RemoteFile, part: Path) -> None:
        partial_bytes = part.stat().st_size if part.exists() else 0
        if partial_bytes == remote.size:
            return
        start = partial_bytes if partial_bytes < remote.size else 0
        with self._open(remote.url, start) as response:
            received = start if response.status == 206 else 0  # a server may ignore from where we asked
            with part.open("ab" if received else "wb") as file:
                while block := _read(response, min(_BLOCK_BYTES, remote.size - received)):
                    received += file.write(block)
                file.flush()
                os.fsync(file.fileno())
        if received < remote.size:
            raise _RetryableError(f"it ended after {received} of {remote.size} bytes")


def file_digest(path: Path, algorithm: str) -> str:
    """The sum of a file's bytes, in lower-case hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.new(algorithm, usedforsecurity=False)).hexdigest()


@contextmanager
def target_errors(path: Path) -> Iterator[None]:
    """Turns what a disk says about a file that is fetched into a TargetError."""
    try:
        yield
    except OSError as error:
        happened = f"{path} cannot be read or written ({error.strerror or error})"
        cure = "free some space or name another folder, and run again: it goes on from there"
        raise TargetError(happened, "a folder of yours on a disk with room", cure) from error


def _read(response: HTTPResponse, max_bytes: int | None = None) -> bytes:
    """All of it, or what has come of the next so many bytes: none of them is lost with the line."""
    try:
        return response.read() if max_bytes is None else response.read1(max_bytes)
    except (OSError, HTTPException) as error:
        raise _RetryableError(error) from error


@functools.cache
def _opener() -> request.OpenerDirector:
    """Opens http and https only, also where a server redirects to; for all else it has no answer."""
    opener = request.OpenerDirector()
    for handler in (
        request.ProxyHandler,
        request.HTTPHandler,
        request.HTTPSHandler,
        request.HTTPRedirectHandler,
        request.HTTPErrorProcessor,
        request.HTTPDefaultErrorHandler,
    ):
        opener.add_handler(handler())
    return opener


@functools.cache
def _user_agent() -> str:
    """Poly Haven asks that programs name themselves, and others may like it."""
    try:
        version = metadata.version("brewster")
    except metadata.PackageNotFoundError:
        version = "source"
    return f"brewster/{version} (+separates reflections in photographs; one download at a time)"
