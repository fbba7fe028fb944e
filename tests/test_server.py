"""Clients that keep a server waiting, and servers that end, over a real socket."""

import asyncio
import errno
import socket
import time
from threading import Thread

import pytest
from fastapi import APIRouter, Response

from brewster.web import server
from brewster.web.application import application
from brewster.web.middleware import RequestLimits
from file_server import loopback_only
from front_door import picture
from glass_server import Stubborn, app_of, on_a_thread, served, spoken

PHOTO = picture(40, 30, "png")
FORM = b'--x\r\nContent-Disposition: form-data; name="photo"; filename="a.png"\r\n\r\n%b\r\n--x--\r\n' % PHOTO
GET = b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n"
POST = (
    b"POST /separate HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
    b"Content-Type: multipart/form-data; boundary=x\r\nContent-Length: %d\r\n\r\n%b" % (len(FORM), FORM)
)
LONG = 8_000_000


@pytest.fixture(autouse=True)
def _network_off(monkeypatch):
    loopback_only(monkeypatch)


@pytest.fixture
def impatient(monkeypatch):
    """A look at each connection ten times a second."""
    monkeypatch.setattr(server, "LOOK_SECONDS", 0.1)


@pytest.fixture
def long():
    """An application with a long answer."""
    router = APIRouter()
    router.get("/long")(lambda: Response(bytes(LONG)))
    return application(router, guard=RequestLimits())


def narrow(port, width=1 << 12):
    """A connection that has asked for the long answer and takes little at once."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, width)
    connection.settimeout(30)
    connection.connect(("127.0.0.1", port))
    connection.sendall(GET.replace(b"/health", b"/long"))
    return connection


def rest(connection):
    """All that comes until the connection ends."""
    got = bytearray()
    try:
        while more := connection.recv(1 << 16):
            got += more
    except ConnectionResetError:
        pass
    return bytes(got)


@pytest.mark.parametrize("start", [b"", b"G", GET[:-2]])
def test_a_client_that_does_not_finish_asking_is_given_up(impatient, start):
    with on_a_thread(app_of()) as port:
        assert spoken(port, start) == b""
        assert b"200 OK" in spoken(port, GET)


def test_half_a_request_after_a_whole_one_is_given_up_too(impatient):
    with (
        on_a_thread(app_of()) as port,
        socket.create_connection(("127.0.0.1", port), timeout=30) as connection,
    ):
        connection.sendall(GET)
        answer = b""
        while not answer.endswith(b"}"):
            answer += connection.recv(1 << 16)
        connection.sendall(GET[:20])
        assert rest(connection) == b""


def test_work_may_take_longer_than_a_client(impatient):
    backend = Stubborn()
    with on_a_thread(app_of(backend)) as port:
        answers = []
        asking = Thread(target=lambda: answers.append(spoken(port, POST)))
        asking.start()
        backend.started.wait()
        time.sleep(0.5)  # some looks
        backend.go.set()
        asking.join()
    assert b"200 OK" in answers[0]


def test_a_client_that_never_reads_is_given_up_and_a_slow_one_is_not(monkeypatch, long):
    monkeypatch.setattr(server, "LOOK_SECONDS", 0.4)
    with served(long) as (port, running):
        with narrow(port) as deaf:
            while not running.server_state.connections:
                time.sleep(0.01)
            for _ in range(1000):
                if not running.server_state.connections:
                    break
                time.sleep(0.01)
            assert not running.server_state.connections
            assert len(rest(deaf)) < LONG
        with narrow(port, 1 << 16) as slow:
            head = bytearray()
            for _ in range(60):  # longer than three looks
                head += slow.recv(1 << 16)
                time.sleep(0.02)
            assert len(head) < LONG
            assert len(head) + len(rest(slow)) > LONG


def test_a_server_that_ends_tells_what_is_under_way(monkeypatch, caplog):
    monkeypatch.setattr(server, "GRACE_SECONDS", 0.1)
    backend, answers = Stubborn(), []
    with served(app_of(backend)) as (port, running):
        asking = Thread(target=lambda: answers.append(spoken(port, POST)))
        asking.start()
        backend.started.wait()
        running.should_exit = True
        asking.join()
        backend.go.set()
    (answer,) = answers
    assert answer.startswith(b"HTTP/1.1 503")
    assert b"being stopped" in answer
    assert b"nosniff" in answer
    assert not caplog.records


def test_a_server_that_ends_amid_an_answer_says_nothing(monkeypatch, caplog, long):
    monkeypatch.setattr(server, "GRACE_SECONDS", 0.1)
    with served(long) as (port, running), narrow(port) as deaf:
        assert deaf.recv(100).startswith(b"HTTP/1.1 200")
        running.should_exit = True
        while running.server_state.connections:
            time.sleep(0.01)
    assert not caplog.records


def test_too_many_connections_are_not_reported_one_by_one_and_bugs_are(caplog):
    async def hear():
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(server._tell)
        full = OSError(errno.EMFILE, "Too many open files")
        loop.call_exception_handler({"message": "socket.accept() out of system resource", "exception": full})
        assert not caplog.records
        loop.call_exception_handler({"message": "a bug", "exception": KeyError()})

    asyncio.run(hear())
    assert [record.message.splitlines()[0] for record in caplog.records] == ["a bug"]
