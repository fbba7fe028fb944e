"""The server on the wire: uvicorn that says little, waits for no client without end, and ends without noise.

    create_server(app).run(sockets=[listening])

A client has its turn when it asks and when it takes the answer; only then is it timed.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any, Final, final

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

IDLE_CHECK_SECONDS: Final = 10.0
"""Twice this long, at most, a client may neither finish the head of a request nor take a byte of its answer."""
GRACE_SECONDS: Final = 2.0
"""How long what is under way may go on when the server ends."""
_BACKLOG: Final = 128
_SEND_BUFFER_BYTES: Final = 1 << 17  # of an answer; more would hide for long that a slow client takes any


def create_server(app: FastAPI) -> uvicorn.Server:
    """A server of an application; when it ends, it waits two seconds for what is under way."""
    config = uvicorn.Config(
        app,
        http=TimeoutProtocol,
        ws="none",
        backlog=_BACKLOG,
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=int(GRACE_SECONDS) + 3,  # reached by what cannot even be cancelled
    )
    return QuietServer(config)


@final
class QuietServer(uvicorn.Server):
    """Cancels by itself what does not end in time: the guard then answers in a sentence, and nothing is logged."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begins the service."""
        for listening in sockets or []:  # connections inherit it
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        asyncio.get_running_loop().set_exception_handler(_handle_loop_error)
        await super().startup(sockets)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Ends the service."""
        grace_timer = asyncio.get_running_loop().call_later(GRACE_SECONDS, self._cancel)
        try:
            await super().shutdown(sockets)
        finally:
            grace_timer.cancel()

    def _cancel(self) -> None:
        for connection in list(self.server_state.connections):
            if isinstance(connection, TimeoutProtocol) and not connection.is_unanswered:
                connection.transport.abort()  # half an answer cannot become a sentence
        for task in list(self.server_state.tasks):
            task.cancel()


@final
class TimeoutProtocol(H11Protocol):
    """One connection, looked at now and then: one without a sign of life between two looks is ended."""

    _previous_state: tuple[object, int] | None = None
    _idle_timer: asyncio.TimerHandle | None = None

    @property
    def is_unanswered(self) -> bool:
        """Whether there is a request whose answer has not begun."""
        return self.cycle is not None and not self.cycle.response_started

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has come."""
        super().connection_made(transport)
        self._idle_timer = self.loop.call_later(IDLE_CHECK_SECONDS, self._check_idle)

    def connection_lost(self, exc: Exception | None) -> None:
        """It has gone."""
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
    """Too many connections just wait: asyncio would report each of them, each second, and once more at the end."""
    if not any(noise in context["message"] for noise in ("socket.accept()", "_start_serving")):
        loop.default_exception_handler(context)
