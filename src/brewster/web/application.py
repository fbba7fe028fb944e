"""The FastAPI application of both pages: routers, access policy, page files, and errors as JSON.

    app = create_app(router, policy=AccessPolicy.for_host("127.0.0.1"))
    serve(app, host="127.0.0.1", port=8417)

All files of the pages are part of this package, so that the pages work offline. The server closes
idle connections, and shuts down without log messages. The idle time limit applies while the server
waits for the client to send a request or to receive a response.
"""

import asyncio
import ipaddress
import logging
import signal
import socket
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final, final

import uvicorn
from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

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
from brewster.web.middleware import SECURITY_HEADERS, AccessMiddleware, AccessPolicy, is_loopback
from brewster.web.request_schema import validation_message

_LOGGER: Final = logging.getLogger(__name__)
PAGE_FOLDER: Final = Path(__file__).parent / "page"
_ANY_ROUTED_ADDRESS: Final = ("192.0.2.1", 9)  # reserved for documentation, see RFC 5737
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
"""HTTP status by error class. Other BrewsterErrors are caused by the request and get the status
422.
"""

IDLE_CHECK_SECONDS: Final = 10.0
"""Interval of the idle check. A connection is closed at the second check if the client neither
completes the head of a request nor receives a byte between the checks.
"""
GRACE_SECONDS: Final = 2.0
"""The time for which running requests may continue after the shutdown begins."""
_BACKLOG: Final = 128
_SEND_BUFFER_BYTES: Final = 1 << 17
"""With a larger buffer of the kernel, the server cannot see whether a slow client still receives.
"""


def create_app(*routers: APIRouter, policy: AccessPolicy, index: str = "index.html") -> FastAPI:
    """Creates an application with these routes. `index` is the file in web/page/ that is served at
    `/`.
    """
    app = FastAPI(title="brewster", version=brewster.__version__, docs_url=None, redoc_url=None)
    app.add_middleware(AccessMiddleware, policy=policy)
    for error_class in (
        ClientDisconnect,
        HTTPException,
        RequestValidationError,
        BrewsterError,
        Exception,
    ):
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
    app.add_route(path, lambda _: page_response(name), include_in_schema=False)


def listen(host: str, port: int) -> socket.socket:
    """Opens a listening socket; port 0 chooses a free port. Raises OutputError if the address or
    the port cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise OutputError(
            f"{host} port {port} cannot be used ({error.strerror})",
            "expected an address of this machine and a free port",
            "choose another address with --host, or another port with --port",
        ) from error


def lan_address() -> str:
    """Returns the IPv4 address of this machine in its local network. Raises OutputError if it has
    none, or a public one.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(
                _ANY_ROUTED_ADDRESS
            )  # chooses the address of this machine, and sends no packet
            address = str(probe.getsockname()[0])
        except OSError:  # no route
            address = "127.0.0.1"
    if is_loopback(address) or not ipaddress.ip_address(address).is_private:
        raise OutputError(
            "this machine has no network"
            if is_loopback(address)
            else f"its address {address} is public",
            "expected an address in a private network, such as 192.168.1.5",
            "connect this machine and the phone to the same network, or choose an address with "
            "--host",
        )
    return address


def server_url(listening: socket.socket) -> str:
    """Returns the URL of a listening socket for a browser; a wildcard address becomes a loopback
    address.
    """
    host, port = listening.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  (nothing is bound here)
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(app: FastAPI, *, host: str, port: int, on_ready: Callable[[str], None] = print) -> None:
    """Serves the application until Ctrl-C or SIGTERM, and raises KeyboardInterrupt then. Call this
    in the main thread, because it handles signals. `on_ready` is called with the URL when the
    socket is open. Raises the errors of `listen`.
    """
    with listen(host, port) as listening:
        on_ready(server_url(listening))
        # uvicorn raises SIGTERM again after its shutdown, which kills the process if the signal is
        # not handled
        previous_handler = signal.signal(
            signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT)
        )
        try:
            create_server(app).run(sockets=[listening])
        finally:
            signal.signal(signal.SIGTERM, previous_handler)


async def _error_response(request: Request, error: Exception) -> Response:
    """Returns an error as JSON, `{"error": message}`. For a BrewsterError, `kind` is the name of
    its class.

    The traceback of a BrewsterError is logged, because it has the messages of libraries, which the
    response does not have.
    """
    if isinstance(error, ClientDisconnect):
        return Response(
            status_code=499
        )  # the client has disconnected and does not read the response
    if isinstance(error, HTTPException):
        message = error.detail
        path = request.url.path
        allowed = (error.headers or {}).get("Allow")
        if message == HTTPStatus.METHOD_NOT_ALLOWED.phrase:
            message = (
                f"{path} does not accept {request.method}; expected {allowed}; repeat the "
                "request with this method"
            )
        elif message == HTTPStatus(error.status_code).phrase:
            message = (
                f"{request.method} {path} does not exist; expected an existing route; "
                "choose one from GET /openapi.json"
            )
        return JSONResponse({"error": message}, error.status_code, error.headers)
    if isinstance(error, RequestValidationError):
        return JSONResponse({"error": validation_message(error.errors())}, 422)
    if isinstance(error, BrewsterError):
        _LOGGER.info("%s %s failed", request.method, request.url.path, exc_info=error)
        body = {"error": str(error), "kind": type(error).__name__}
        return JSONResponse(body, _STATUS_CODES.get(type(error), 422))
    message = (
        f"brewster has an internal error ({type(error).__name__}); expected no such error; "
        "please report it"
    )
    # Starlette sends this response outside AccessMiddleware
    return JSONResponse({"error": message}, 500, SECURITY_HEADERS)


def create_server(app: FastAPI) -> uvicorn.Server:
    """Creates a server for an application. At shutdown, the server waits up to GRACE_SECONDS for
    running requests.
    """
    config = uvicorn.Config(
        app,
        http=TimeoutProtocol,
        ws="none",
        backlog=_BACKLOG,
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=int(GRACE_SECONDS) + 3,  # only for tasks that ignore cancellation
    )
    return QuietServer(config)


@final
class QuietServer(uvicorn.Server):
    """A uvicorn server that logs nothing at shutdown.

    It cancels requests that run longer than GRACE_SECONDS; AccessMiddleware then sends an error
    message for each of them.
    """

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts serving."""
        for listening in sockets or []:  # connections inherit the option
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        asyncio.get_running_loop().set_exception_handler(_handle_loop_error)
        await super().startup(sockets)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stops serving, and cancels requests that run longer than GRACE_SECONDS."""
        grace_timer = asyncio.get_running_loop().call_later(GRACE_SECONDS, self._cancel)
        try:
            await super().shutdown(sockets)
        finally:
            grace_timer.cancel()

    def _cancel(self) -> None:
        for connection in list(self.server_state.connections):
            if isinstance(connection, TimeoutProtocol) and not connection.is_unanswered:
                # A response has begun, so no error message can be sent
                connection.transport.abort()
        for task in list(self.server_state.tasks):
            task.cancel()


@final
class TimeoutProtocol(H11Protocol):
    """A connection that is closed if its state does not change between two idle checks."""

    _previous_state: tuple[object, int] | None = None
    _idle_timer: asyncio.TimerHandle | None = None

    @property
    def is_unanswered(self) -> bool:
        """Whether there is a request whose response has not begun."""
        return self.cycle is not None and not self.cycle.response_started

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Starts the idle check."""
        super().connection_made(transport)
        self._idle_timer = self.loop.call_later(IDLE_CHECK_SECONDS, self._check_idle)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops the idle check."""
        super().connection_lost(exc)
        if self._idle_timer:
            self._idle_timer.cancel()

    def _check_idle(self) -> None:
        unsent_bytes = self.transport.get_write_buffer_size()
        is_responding = self.cycle is not None and not self.cycle.response_complete
        state = self.cycle, unsent_bytes
        if state == self._previous_state and (unsent_bytes or not is_responding):
            self.transport.abort()
            return
        self._previous_state = state
        self._idle_timer = self.loop.call_later(IDLE_CHECK_SECONDS, self._check_idle)


def _handle_loop_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Ignores errors of accept(). With too many connections, asyncio logs one error per second for
    each connection.
    """
    if not any(ignored in context["message"] for ignored in ("socket.accept()", "_start_serving")):
        loop.default_exception_handler(context)
