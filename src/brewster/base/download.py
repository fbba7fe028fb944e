"""Downloads files from http and https, with retries and a checksum. The next call resumes a partial
one, `.part`.
"""

import functools
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse, InvalidURL
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar, final
from urllib import request
from urllib.error import HTTPError

import brewster
from brewster.base.files import file_digest
from brewster.errors import DownloadError, OutputError

_RETRYABLE_STATUS = (408, 425, 429, 500, 502, 503, 504)
_MAX_RETRY_AFTER_S = 120.0
_USER_AGENT = "brewster/{} (+separates reflections in photographs; one download at a time)"
"""Poly Haven requires that programs identify themselves."""
_BLOCK_BYTES = 1 << 18
_EXPECTED_URL = "expected a URL that starts with http:// or https://"

_T = TypeVar("_T")


class RemoteFile(NamedTuple):
    """A file to download: its URL, its size in bytes, and its expected digest in lower-case
    hexadecimal, or "".
    """

    url: str
    size: int
    algorithm: Literal["md5", "sha256"]
    digest: str


@final
class _RetryableError(Exception):
    """A temporary failure, such as a lost connection or a busy server. `wait_s` is the wait before
    the next attempt.
    """

    def __init__(self, reason: object, wait_s: float = 0.0) -> None:
        super().__init__(str(reason) or type(reason).__name__)
        self.wait_s = wait_s


@final
@dataclass(frozen=True)
class Downloader:
    """Downloads over http and https: one attempt, and one after each of the delays.

    `timeout_s` is the longest time without received data. Tests replace `sleep`, which gets the
    delay. `on_bytes` is called with the number of received bytes of a file.
    """

    retry_delays_s: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    timeout_s: float = 30.0
    sleep: Callable[[float], object] = time.sleep
    on_bytes: Callable[[int], object] = lambda _received: None

    def read(self, url: str) -> bytes:
        """Requests a URL and returns the body of the response. Raises DownloadError if the server
        refuses it, or all attempts fail."""

        def attempt() -> bytes:
            with self._response(url) as response:
                return _read(response)

        return self._with_retries(url, attempt)

    def size(self, url: str) -> int:
        """Returns the size of a file in bytes. Raises DownloadError as `read`, and if the server
        does not state it.
        """

        def attempt() -> str:
            with self._response(url) as response:
                return response.headers.get("Content-Length", "")

        stated = self._with_retries(url, attempt)
        if not stated.isdecimal():
            happened = f"the server does not state the size of {url}"
            raise DownloadError(
                happened, "expected a file", "download the file with another program"
            )
        return int(stated)

    def fetch(self, remote: RemoteFile, target: Path) -> None:
        """Downloads a file to the path `target` and creates its folder.

        The file gets the name `target` only after its digest is verified. Raises DownloadError as
        `read` and for another digest, OutputError if the folder cannot be written.
        """
        part = target.with_name(f"{target.name}.part")
        with output_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            self._with_retries(remote.url, lambda: self._fetch_rest(remote, part))
            if remote.digest and (digest := file_digest(part, remote.algorithm)) != remote.digest:
                part.unlink()
                happened = (
                    f"the file from {remote.url} has the {remote.algorithm} digest "
                    f"{digest} and was deleted"
                )
                cure = "run again to download the whole file"
                raise DownloadError(happened, f"expected the digest {remote.digest}", cure)
            part.replace(target)

    def _with_retries(self, url: str, attempt: Callable[[], _T]) -> _T:
        for delay in (*self.retry_delays_s, None):
            try:
                return attempt()
            except _RetryableError as error:
                if delay is None:
                    raise DownloadError(
                        f"{url} could not be downloaded in {len(self.retry_delays_s) + 1} "
                        f"attempts ({error})",
                        "expected a server that responds and a stable connection",
                        "check the connection, or run again later to resume the download",
                    ) from error
                self.sleep(max(delay, error.wait_s))
        raise AssertionError("the last attempt returns or raises")

    @contextmanager
    def _response(self, url: str, start: int = 0) -> Iterator[HTTPResponse]:
        """Yields the open response, which starts at byte `start` if the server supports range
        requests.
        """
        headers = {"User-Agent": _USER_AGENT.format(brewster.__version__)}
        headers |= {"Range": f"bytes={start}-"} if start else {}
        try:
            query = request.Request(url, headers=headers)  # noqa: S310  (the opener supports http and https only)
            response = _opener().open(query, timeout=self.timeout_s)
        except HTTPError as error:
            error.close()
            if error.code in _RETRYABLE_STATUS:
                wait = error.headers.get("Retry-After", "")
                wait_s = min(float(wait), _MAX_RETRY_AFTER_S) if wait.isdecimal() else 0
                raise _RetryableError(error, wait_s) from error
            happened = f"the server refused the request for {url} ({error})"
            raise DownloadError(happened, "expected a file", "run again later") from error
        except (ValueError, InvalidURL) as error:
            happened = f"{url!r} is not a valid URL ({error})"
            raise DownloadError(happened, _EXPECTED_URL, "check the URL") from error
        except (OSError, HTTPException) as error:
            raise _RetryableError(error) from error
        if response is None:
            happened = (
                f"{url!r} or a URL that it redirects to has another scheme than http or https"
            )
            raise DownloadError(happened, _EXPECTED_URL, "check the URL")
        with response:
            yield response

    def _fetch_rest(self, remote: RemoteFile, part: Path) -> None:
        partial_bytes = part.stat().st_size if part.exists() else 0
        if partial_bytes == remote.size:
            return
        start = partial_bytes if partial_bytes < remote.size else 0
        with self._response(remote.url, start) as response:
            received = start if response.status == 206 else 0  # 206: the server honours the range
            with part.open("ab" if received else "wb") as file:
                while block := _read(response, min(_BLOCK_BYTES, remote.size - received)):
                    received += file.write(block)
                    self.on_bytes(received)
                file.flush()
                os.fsync(file.fileno())
        if received < remote.size:
            raise _RetryableError(f"the response ended after {received} of {remote.size} bytes")


@contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """Converts an OSError in the block to an OutputError about the downloaded file `path`."""
    try:
        yield
    except OSError as error:
        happened = f"{path} cannot be read or written ({error.strerror or error})"
        cure = "free some space or choose another folder, and run again to resume the download"
        raise OutputError(
            happened, "expected a writable folder on a disk with free space", cure
        ) from error


def _read(response: HTTPResponse, max_bytes: int | None = None) -> bytes:
    try:  # read1 returns what is already received, so that no byte is lost if the connection breaks
        return response.read() if max_bytes is None else response.read1(max_bytes)
    except (OSError, HTTPException) as error:
        raise _RetryableError(error) from error


@functools.cache
def _opener() -> request.OpenerDirector:
    """Returns an opener for http and https that follows redirects. For other schemes, its `open`
    returns None.
    """
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
