"""Idle clients and the shutdown of the server, tested over a real socket."""

import asyncio
import errno
import socket
import time
from threading import Thread

import pytest
from fastapi import APIRouter, Response

from brewster.web import application as server
from brewster.web.application import create_app
from brewster.web.middleware import AccessPolicy
from cli_helpers import image_bytes
from web_servers import BlockingBackend, make_app, raw_exchange, running_server, served_port

pytestmark = pytest.mark.loopback

PHOTO = image_bytes(40, 30, "png")
FORM = b'--x\r\nContent-Disposition: form-data; name="photo"; filename="a.png"\r\n\r\n%b\r\n--x--\r\n' % PHOTO
GET = b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n"
POST = (
    b"POST /separate HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
    b"Content-Type: multipart/form-data; boundary=x\r\nContent-Length: %d\r\n\r\n%b" % (len(FORM), FORM)
)
LONG_BYTES = 8_000_000


@pytest.fixture
def frequent_checks(monkeypatch):
    """Sets the interval of the idle check to 0.1 s."""
    monkeypatch.setattr(server, "IDLE_CHECK_SECONDS", 0.1)


@pytest.fixture
def app_with_long_response():
    """An application with a long response."""
    router = APIRouter()
    router.get("/long")(lambda: Response(bytes(LONG_BYTES)))
    return create_app(router, policy=AccessPolicy())


def slow_client(port, buffer_bytes=1 << 12):
    """A connection that has requested the long response and has a small receive buffer."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
    connection.settimeout(30)
    connection.connect(("127.0.0.1", port))
    connection.sendall(GET.replace(b"/health", b"/long"))
    return connection


def read_to_end(connection):
    """All bytes until the connection is closed."""
    received = bytearray()
    try:
        while more := connection.recv(1 << 16):
            received += more
    except ConnectionResetError:
        pass
    return bytes(received)


@pytest.mark.parametrize("start", [b"", b"G", GET[:-2]])
def test_a_client_that_does_not_finish_its_request_is_closed(frequent_checks, start):
    with served_port(make_app()) as port:
        assert raw_exchange(port, start) == b""
        assert b"200 OK" in raw_exchange(port, GET)


def test_half_a_request_after_a_complete_one_is_closed(frequent_checks):
    with served_port(make_app()) as port:
        assert raw_exchange(port, GET + GET[:20]).count(b"200 OK") == 1


def test_work_may_take_longer_than_the_idle_limit(frequent_checks):
    backend = BlockingBackend()
    with served_port(make_app(backend)) as port:
        responses = []
        client = Thread(target=lambda: responses.append(raw_exchange(port, POST)))
        client.start()
        backend.started.wait()
        time.sleep(0.5)  # several idle checks
        backend.proceed.set()
        client.join()
    assert b"200 OK" in responses[0]


def test_a_client_that_never_reads_is_closed_and_a_slow_one_is_not(monkeypatch, app_with_long_response):
    monkeypatch.setattr(server, "IDLE_CHECK_SECONDS", 0.4)
    with running_server(app_with_long_response) as (port, running):
        with slow_client(port) as silent:
            while not running.server_state.connections:
                time.sleep(0.01)
            for _ in range(1000):
                if not running.server_state.connections:
                    break
                time.sleep(0.01)
            assert not running.server_state.connections
            assert len(read_to_end(silent)) < LONG_BYTES
        with slow_client(port, 1 << 16) as slow:
            head = bytearray()
            for _ in range(60):  # longer than three idle checks
                head += slow.recv(1 << 16)
                time.sleep(0.02)
            assert len(head) < LONG_BYTES
            assert len(head) + len(read_to_end(slow)) > LONG_BYTES


def test_a_server_that_stops_sends_an_error_for_running_requests(monkeypatch, caplog):
    monkeypatch.setattr(server, "GRACE_SECONDS", 0.1)
    backend, responses = BlockingBackend(), []
    with running_server(make_app(backend)) as (port, running):
        client = Thread(target=lambda: responses.append(raw_exchange(port, POST)))
        client.start()
        backend.started.wait()
        running.should_exit = True
        client.join()
        backend.proceed.set()
    (response,) = responses
    assert response.startswith(b"HTTP/1.1 503")
    assert b"being stopped" in response
    assert b"nosniff" in response
    assert not caplog.records


def test_too_many_connections_are_not_logged_and_bugs_are(caplog):
    async def report():
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(server._handle_loop_error)
        full = OSError(errno.EMFILE, "Too many open files")
        loop.call_exception_handler({"message": "socket.accept() out of system resource", "exception": full})
        assert not caplog.records
        loop.call_exception_handler({"message": "a bug", "exception": KeyError()})

    asyncio.run(report())
    assert [record.message.splitlines()[0] for record in caplog.records] == ["a bug"]
