"""The FastAPI application of both pages: routers, access policy, page files, and errors as JSON.

    serve(create_app(router, policy=AccessPolicy.for_host("127.0.0.1")), host="127.0.0.1", port=8417)

All files of the pages are part of this package, so that the pages work offline.
"""

from __future__ import annotations

import logging
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
    OutputError,
    PhotoTooLarge,
    UnreadablePhoto,
    UnsupportedPhoto,
)
from brewster.web.middleware import SECURITY_HEADERS, AccessMiddleware, AccessPolicy
from brewster.web.request_schema import validation_message
from brewster.web.server import create_server

_LOGGER: Final = logging.getLogger(__name__)
PAGE_FOLDER: Final = Path(__file__).parent / "page"
_STATUS_CODES: Final[dict[type[BrewsterError], int]] = {
    PhotoTooLarge: 413,
    UnreadablePhoto: 422,
    UnsupportedPhoto: 415,
    MissingExtra: 501,
    DeviceError: 503,
    ModelError: 500,
    OutputError: 500,
    DownloadError: 502,
}
"""HTTP status by error class. Other BrewsterErrors are caused by the request and get the status 422."""


def create_app(*routers: APIRouter, policy: AccessPolicy, index: str = "index.html") -> FastAPI:
    """Creates an application.

    Args:
        routers: the routes of the API.
        policy: the access policy for every request.
        index: the file in web/page/ that is served at `/`.
    """
    app = FastAPI(title="brewster", version=brewster.__version__, docs_url=None, redoc_url=None)
    app.add_middleware(AccessMiddleware, policy=policy)
    for error_class in (ClientDisconnect, HTTPException, RequestValidationError, BrewsterError, Exception):
        app.add_exception_handler(error_class, _error_response)
    for router in routers:
        app.include_router(router)
    _add_page(app, "/", index)
    for file in sorted(PAGE_FOLDER.iterdir()):
        _add_page(app, f"/page/{file.name}", file.name)
    return app


def page_response(name: str) -> Response:
    """Returns the response with a file of web/page/. Browsers revalidate the file on each use."""
    return FileResponse(PAGE_FOLDER / name, headers={"Cache-Control": "no-cache"})


def _add_page(app: FastAPI, path: str, name: str) -> None:
    # Unlike FastAPI.get, this method of Starlette also adds HEAD.
    app.add_route(path, lambda _: page_response(name), include_in_schema=False)


def listen(host: str, port: int) -> socket.socket:
    """Opens a listening socket; port 0 chooses a free port.

    Raises:
        OutputError: the address or the port cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise OutputError(
            f"{host} port {port} cannot be used ({error.strerror})",
            "expected an address of this machine and a free port",
            "choose another address with --host, or another port with --port",
        ) from error


def server_url(listening: socket.socket) -> str:
    """Returns the URL of a listening socket for a browser; a wildcard address becomes a loopback address."""
    host, port = listening.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  (nothing is bound here)
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(
    app: FastAPI,
    *,
    host: str,
    port: int,
    on_ready: Callable[[str], None] = print,
) -> None:
    """Serves the application until it is interrupted. Call this in the main thread, because it handles signals.

    Args:
        app: the application.
        host: the address to bind to.
        port: the port; 0 chooses a free port.
        on_ready: called with the URL when the socket is open.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM has ended the server.
        OutputError: the address or the port cannot be used.
    """
    with _sigterm_as_sigint(), listen(host, port) as listening:
        on_ready(server_url(listening))
        create_server(app).run(sockets=[listening])


@contextmanager
def _sigterm_as_sigint() -> Iterator[None]:
    """Handles SIGTERM like Ctrl-C. uvicorn raises the signal again after its shutdown, which kills the process if SIGTERM is not handled."""
    previous_handler = signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


async def _error_response(request: Request, error: Exception) -> Response:
    """Returns an error as JSON, `{"error": message}`. For a BrewsterError, `kind` is the name of its class.

    The traceback of a BrewsterError is logged, because it has the messages of libraries, which the response does not have.
    """
    if isinstance(error, ClientDisconnect):
        return Response(status_code=499)  # the client has disconnected and does not read the response
    if isinstance(error, HTTPException):
        return JSONResponse({"error": _http_error_message(request, error)}, error.status_code, error.headers)
    if isinstance(error, RequestValidationError):
        return JSONResponse({"error": validation_message(error.errors())}, 422)
    if isinstance(error, BrewsterError):
        _LOGGER.info("%s %s failed", request.method, request.url.path, exc_info=error)
        body = {"error": str(error), "kind": type(error).__name__}
        return JSONResponse(body, _STATUS_CODES.get(type(error), 422))
    body = {
        "error": f"brewster has an internal error ({type(error).__name__}); expected no such error; please report it"
    }
    return JSONResponse(body, 500, SECURITY_HEADERS)  # Starlette sends this response outside AccessMiddleware


def _http_error_message(request: Request, error: HTTPException) -> str:
    if error.detail != HTTPStatus(error.status_code).phrase:
        return error.detail
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        allowed = (error.headers or {}).get("Allow", "another method")
        return f"{request.url.path} does not accept {request.method}; expected {allowed}; repeat the request with this method"
    return f"{request.method} {request.url.path} does not exist; expected an existing route; choose one from GET /openapi.json"
