"""Web servers for tests: applications without a network, in a thread, or in a separate process."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
from threading import Event, Thread

import httpx

from brewster.separation import Separator
from brewster.web.application import create_app, create_server, listen
from brewster.web.job_queue import JobQueue
from brewster.web.middleware import AccessPolicy
from brewster.web.model_cache import ModelRow
from brewster.web.separation import separation_router
from other_processes import started


def pane(tile):
    return tile * 0.8, tile * 0.2


class FakeModelCache:
    """A ModelCache with one backend."""

    names = ("pane",)

    def __init__(self, backend=pane):
        self._separator = Separator(backend, name="pane", sha256="0" * 64)

    def rows(self):
        return [ModelRow(name="pane", licence="none", sha256=None, card=None)]

    def separator(self, name):
        assert name == "pane"
        return self._separator


class BlockingBackend:
    """A backend that blocks until `proceed` is set, and counts its tiles."""

    def __init__(self):
        self.tiles = 0
        self.started = Event()
        self.proceed = Event()

    def __call__(self, tile):
        self.tiles += 1
        self.started.set()
        assert self.proceed.wait(30)
        return pane(tile)


def make_app(backend=pane, *, job_queue=None, max_pixels=10**8, policy=None, preparation=None):
    return create_app(
        separation_router(
            FakeModelCache(backend),
            job_queue or JobQueue(),
            max_pixels=max_pixels,
            preparation=preparation,
        ),
        policy=policy or AccessPolicy(),
    )


@contextlib.asynccontextmanager
async def client(app, **kwargs):
    """An HTTP client of an application, without a network. At its end, the application stops."""
    transport = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost:8417", **kwargs) as http,
    ):
        yield http


def request(app, method, path, **kwargs):
    """Sends one request; returns the response."""

    async def once():
        async with client(app) as http:
            return await http.request(method, path, **kwargs)

    return asyncio.run(once())


def form(photo, name="window.png", **fields):
    """The arguments of httpx for a form with a photo."""
    return {"files": {"photo": (name, photo)}, "data": fields}


@contextlib.contextmanager
def served_port(app):
    """Runs an application in a thread; yields its port."""
    with running_server(app) as (port, _):
        yield port


@contextlib.contextmanager
def running_server(app):
    """Runs an application in a thread; yields its port and the server."""
    with listen("127.0.0.1", 0) as listening:
        running = create_server(app)
        thread = Thread(target=running.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield listening.getsockname()[1], running
        finally:
            running.should_exit = True
            thread.join()


def raw_exchange(port, *pieces):
    """Sends these bytes and returns all bytes of the server until it closes the connection."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for piece in pieces:
            connection.sendall(piece)
        response = b""
        while more := connection.recv(1 << 16):
            response += more
    return response


@contextlib.contextmanager
def serve_process(*args, stderr=None, environment=None):
    """Runs `brewster serve` in a process. Yields its first line of output, a link; checks the exit
    code at the end. `environment`: variables in addition to those of this process.
    """
    command = [
        sys.executable,
        "-m",
        "brewster",
        "serve",
        "--port",
        "0",
        "--device",
        "cpu",
        *map(str, args),
    ]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})}
    with started(
        command, stdout=subprocess.PIPE, stderr=stderr, text=True, env=environment
    ) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()
    assert process.returncode == 0
