"""A uvicorn server that closes idle connections and shuts down without log messages.

    create_server(app).run(sockets=[listening])

The idle time limit applies while the server waits for the client to send a request or to receive a response.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any, Final, final

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

IDLE_CHECK_SECONDS: Final = 10.0
"""Interval of the idle check. A connection is closed at the second check if the client neither completes the head of a
request nor receives a byte between the checks."""
GRACE_SECONDS: Final = 2.0
"""The time for which running requests may continue after the shutdown begins."""
_BACKLOG: Final = 128
_SEND_BUFFER_BYTES: Final = (
    1 << 17
)  # with a larger kernel buffer, the server cannot see whether a slow client still receives


def create_server(app: FastAPI) -> uvicorn.Server:
    """Creates a server for an application. At shutdown, the server waits up to GRACE_SECONDS for running requests."""
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

    It cancels requests that run longer than GRACE_SECONDS; AccessMiddleware then sends an error message for each of them.
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
                connection.transport.abort()  # a response has begun, so no error message can be sent
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
    """Ignores errors of accept(). With too many connections, asyncio logs one error per second for each connection."""
    if not any(ignored in context["message"] for ignored in ("socket.accept()", "_start_serving")):
        loop.default_exception_handler(context)
