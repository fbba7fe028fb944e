"""The application behind both front doors: routers, a guard, the files of the page, and errors as sentences.

    serve(create_app(router, guard=Guard.at("127.0.0.1")), host="127.0.0.1", port=8417)

Everything comes from this package: no remote asset, so that it works offline.
"""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Final

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

import brewster
from brewster.errors import (
    BrewsterError,
    DeviceError,
    DownloadError,
    MissingExtra,
    ModelError,
    PhotoTooLarge,
    TargetError,
    UnreadablePhoto,
    UnsupportedPhoto,
)
from brewster.web.middleware import SECURITY_HEADERS, LimitMiddleware, RequestLimits
from brewster.web.request_schema import validation_message
from brewster.web.server import create_server

PAGE: Final = Path(__file__).parent / "page"
_STATUS_CODES: Final[dict[type[BrewsterError], int]] = {
    PhotoTooLarge: 413,
    UnreadablePhoto: 422,
    UnsupportedPhoto: 415,
    MissingExtra: 501,
    DeviceError: 503,
    ModelError: 500,
    TargetError: 500,
    DownloadError: 502,
}
"""Of errors that are not named here, the asker is to blame: 422."""


def create_app(*routers: APIRouter, limits: RequestLimits, index: str = "index.html") -> FastAPI:
    """An application of these routers whose first page is the file `home` in web/page/, behind the guard."""
    app = FastAPI(title="brewster", version=brewster.__version__, docs_url=None, redoc_url=None)
    app.add_middleware(LimitMiddleware, limits=limits)
    for kind in (ClientDisconnect, HTTPException, RequestValidationError, BrewsterError, Exception):
        app.add_exception_handler(kind, _error_response)
    for router in routers:
        app.include_router(router)
    _add_page(app, "/", index)
    for file in sorted(PAGE.iterdir()):
        _add_page(app, f"/page/{file.name}", file.name)
    return app


def page_response(name: str) -> Response:
    """A file of web/page/, to be asked for again each time."""
    return FileResponse(PAGE / name, headers={"Cache-Control": "no-cache"})


def _add_page(app: FastAPI, path: str, name: str) -> None:
    app.get(path, include_in_schema=False)(lambda: page_response(name))


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens; port 0 takes a free one.

    Raises:
        TargetError: the address cannot be had.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise TargetError(
            f"{host} port {port} cannot be listened on ({error.strerror})",
            "an address of this machine and a free port",
            "choose others with --host and --port",
        ) from error


def server_url(listening: socket.socket) -> str:
    """The URL of a listening socket, as a browser takes it."""
    host, port = listening.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  (read, not bound)
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(
    app: FastAPI,
    *,
    host: str,
    port: int,
    on_ready: Callable[[str], None] = print,
) -> None:
    """Serves until it is interrupted; `on_ready` is told the URL when browsers may come. For a main thread only.

    Raises:
        KeyboardInterrupt: the usual end, by Ctrl-C or SIGTERM.
        TargetError: the address cannot be had.
    """
    with _sigterm_as_sigint(), listen(host, port) as listening:
        on_ready(server_url(listening))
        create_server(app).run(sockets=[listening])


@contextmanager
def _sigterm_as_sigint() -> Iterator[None]:
    """SIGTERM does what Ctrl-C does: uvicorn sends itself the signal once more when it has ended, to die of it."""
    previous_handler = signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


async def _error_response(request: Request, error: Exception) -> Response:
    """Every error as JSON, `{"error": sentence}`."""
    if isinstance(error, ClientDisconnect):
        return Response(status_code=499)  # nobody reads it
    if isinstance(error, HTTPException):
        return JSONResponse({"error": _http_error_message(request, error)}, error.status_code, error.headers)
    if isinstance(error, RequestValidationError):
        return JSONResponse({"error": validation_message(error.errors())}, 422)
    if isinstance(error, BrewsterError):
        return JSONResponse({"error": str(error)}, _STATUS_CODES.get(type(error), 422))
    body = {"error": f"brewster stumbled ({type(error).__name__}); please report it"}
    return JSONResponse(body, 500, SECURITY_HEADERS)  # this answer does not pass the guard


def _http_error_message(request: Request, error: HTTPException) -> str:
    if error.detail != HTTPStatus(error.status_code).phrase:
        return error.detail
    return f"there is no {request.method} {request.url.path} here; GET /openapi.json tells what there is"
