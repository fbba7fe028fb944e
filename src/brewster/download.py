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

_BUSY = (408, 425, 429, 500, 502, 503, 504)
_LONGEST_WAIT_S = 120.0
_BLOCK = 1 << 18
_WEB = "http:// or https://"

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

    def __init__(self, why: object, wait_s: float = 0.0) -> None:
        super().__init__(str(why) or type(why).__name__)
        self.wait_s = wait_s


@final
@dataclass(frozen=True)
class Downloader:
    """How to ask: the pauses between attempts, how long silence is borne, and how to wait."""

    pauses_s: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
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

        return self._patiently(url, attempt)

    def fetch(self, promise: RemoteFile, target: Path) -> None:
        """Downloads a file, making its folder; the target has its name only when it is whole and right.

        Raises:
            DownloadError: the file cannot be had, or is not what was promised.
            TargetError: the folder cannot be written.
        """
        part = target.with_name(f"{target.name}.part")
        with explained(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            self._patiently(promise.url, lambda: self._fetch_rest(promise, part))
            if (came := digest_of(part, promise.algorithm)) != promise.digest:
                part.unlink()
                happened = (
                    f"{promise.url} came with the {promise.algorithm.upper()} sum {came}, and was dropped"
                )
                cure = "run again, to fetch all of it anew"
                raise DownloadError(happened, f"{promise.digest} was promised", cure)
            part.replace(target)

    def _patiently(self, url: str, attempt: Callable[[], _T]) -> _T:
        pauses = iter(self.pauses_s)
        while True:
            try:
                return attempt()
            except _RetryableError as lost:
                if (pause := next(pauses, None)) is None:
                    happened = f"{url} did not come in {len(self.pauses_s) + 1} attempts ({lost})"
                    cure = "check the connection, or run again later: what came is kept"
                    raise DownloadError(
                        happened, "a server that answers, and a line that holds", cure
                    ) from lost
                self.sleep(max(pause, lost.wait_s))

    def _open(self, url: str, start: int = 0) -> HTTPResponse:
        """The answer, from this byte on if the server can do that."""
        headers = {"User-Agent": _agent()} | ({"Range": f"bytes={start}-"} if start else {})
        try:
            asked = request.Request(url, headers=headers)  # noqa: S310  (the opener knows http and https only)
            answer = _opener().open(asked, timeout=self.timeout_s)
        except HTTPError as error:
            error.close()
            if error.code in _BUSY:
                wait = error.headers.get("Retry-After", "")
                raise _RetryableError(
                    error, min(float(wait), _LONGEST_WAIT_S) if wait.isdecimal() else 0
                ) from error
            raise DownloadError(f"{url} was refused ({error})", "a file", "run again later") from error
        except (ValueError, InvalidURL) as error:
            raise DownloadError(f"{url!r} is no address ({error})", _WEB, "check the address") from error
        except (OSError, HTTPException) as error:
            raise _RetryableError(error) from error
        if answer is None:
            raise DownloadError(f"{url!r} leads elsewhere", _WEB, "check the address")
        return cast("HTTPResponse", answer)

    def _fetch_rest(self, promise: RemoteFile, part: Path) -> None:
        came = part.stat().st_size if part.exists() else 0
        if came == promise.size:
            return
        start = came if came < promise.size else 0
        with self._open(promise.url, start) as response:
            there = start if response.status == 206 else 0  # a server may ignore from where we asked
            with part.open("ab" if there else "wb") as file:
                while block := _read(response, min(_BLOCK, promise.size - there)):
                    there += file.write(block)
                file.flush()
                os.fsync(file.fileno())
        if there < promise.size:
            raise _RetryableError(f"it ended after {there} of {promise.size} bytes")


def digest_of(path: Path, algorithm: str) -> str:
    """The sum of a file's bytes, in lower-case hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.new(algorithm, usedforsecurity=False)).hexdigest()


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turns what a disk says about a file that is fetched into a TargetError."""
    try:
        yield
    except OSError as error:
        happened = f"{path} cannot be read or written ({error.strerror or error})"
        cure = "free some space or name another folder, and run again: it goes on from there"
        raise TargetError(happened, "a folder of yours on a disk with room", cure) from error


def _read(response: HTTPResponse, most: int | None = None) -> bytes:
    """All of it, or what has come of the next so many bytes: none of them is lost with the line."""
    try:
        return response.read() if most is None else response.read1(most)
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
def _agent() -> str:
    """Poly Haven asks that programs name themselves, and others may like it."""
    try:
        version = metadata.version("brewster")
    except metadata.PackageNotFoundError:
        version = "source"
    return f"brewster/{version} (+separates reflections in photographs; one download at a time)"
