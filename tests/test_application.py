"""The application, idle clients and the shutdown of the server, tested over a real socket."""

import asyncio
import errno
import signal
import socket
import subprocess
import sys
import time
from threading import Thread
from threading import enumerate as enumerate_threads

import pytest
from fastapi import APIRouter, Response

from brewster.errors import OutputError
from brewster.web import application as server
from brewster.web.application import create_app, listen, server_url
from brewster.web.job_queue import JobQueue
from brewster.web.middleware import AccessPolicy
from cli_helpers import image_bytes
from other_processes import started
from web_servers import BlockingBackend, make_app, raw_exchange, running_server, served_port

pytestmark = pytest.mark.loopback

HEAD = (
    "POST /separate HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
    "Content-Type: multipart/form-data; boundary=x\r\n"
)
PLAIN = b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
END = b"\r\n\r\n"
PHOTO = image_bytes(40, 30, "png")
FORM = (
    b'--x\r\nContent-Disposition: form-data; name="photo"; filename="a.png"\r\n\r\n%b\r\n--x--\r\n'
    % PHOTO
)
TWO_PHOTOS = FORM.removesuffix(b"--\r\n") + FORM.removeprefix(b"--x")


def head(*more):
    return "".join([HEAD, *(f"{line}\r\n" for line in more), "\r\n"]).encode()


def post_request(body=FORM, path="/separate"):
    start = head(f"Content-Length: {len(body)}")
    return start.replace(b"/separate", path.encode()), body


def status(response):
    return int(response.split(b" ", 2)[1]) if response else None


def chunk(data):
    return b"%x\r\n%b\r\n" % (len(data), data)


@pytest.mark.parametrize(
    "path", [b"/health", b"/models", b"/openapi.json", b"/", b"/page/style.css"]
)
def test_head_returns_the_headers_of_get_without_a_body(path):
    def response_to(method):
        head, _, body = raw_exchange(port, PLAIN.replace(b"GET /", method + b" " + path)).partition(
            END
        )
        return (
            status(head),
            {line for line in head.splitlines() if not line.startswith(b"date:")},
            body,
        )

    with served_port(make_app()) as port:
        code, headers, body = response_to(b"GET")
        assert code == 200
        assert body
        assert not any(line.lower().startswith(b"server:") for line in headers)
        assert response_to(b"HEAD") == (code, headers, b"")


def test_an_upload_that_is_too_large_gets_a_complete_response():
    """A client that sends everything before it reads must receive the response, not a broken
    connection.
    """
    with served_port(make_app(policy=AccessPolicy(max_bytes=10_000))) as port:
        body = bytes(3_000_000)
        assert status(raw_exchange(port, head(f"Content-Length: {len(body)}"), body)) == 413
        chunked = [chunk(bytes(100_000)) for _ in range(30)]
        assert (
            status(raw_exchange(port, head("Transfer-Encoding: chunked"), *chunked, chunk(b"")))
            == 413
        )
        assert status(raw_exchange(port, *post_request())) == 200


def test_an_interrupted_upload_releases_its_place():
    job_queue = JobQueue(max_waiting=0)
    with served_port(make_app(job_queue=job_queue)) as port:
        for end in (0, 30, 90, len(FORM) - 3):
            with socket.create_connection(("127.0.0.1", port)) as connection:
                connection.sendall(head(f"Content-Length: {len(FORM)}") + FORM[:end])
        # the server has not yet released the place of the last upload
        while status(response := raw_exchange(port, *post_request())) == 503:
            assert b"Retry-After" in response or b"retry-after" in response
        assert status(response) == 200
    assert job_queue.job_count == 0


def test_a_broken_connection_stops_the_work():
    backend = BlockingBackend()
    job_queue = JobQueue()
    with served_port(make_app(backend, job_queue=job_queue)) as port:
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(b"".join(post_request()))
            backend.started.wait()
            (job,) = job_queue._jobs.values()
        job.cancelled.wait()
        backend.proceed.set()
    assert backend.tiles == 1


SERVING = """
from fastapi import APIRouter
from brewster.web.application import create_app, serve
from brewster.web.middleware import AccessPolicy
app = create_app(APIRouter(), policy=AccessPolicy())
try:
    serve(app, host="127.0.0.1", port=0, on_ready=lambda url: print(url, flush=True))
except KeyboardInterrupt:
    print("interrupted")
finally:
    print("closed")
"""


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_serve_returns_to_its_caller_after_a_signal(signal_number):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with started([sys.executable, "-c", SERVING], **pipes) as process:
        url = process.stdout.readline()
        # the server responds only after it has installed its signal handlers
        raw_exchange(int(url.split(":")[2].strip("/\n")), PLAIN)
        process.send_signal(signal_number)
        out, err = process.communicate()
    assert url.startswith("http://127.0.0.1:")
    assert (process.returncode, out.split(), err) == (0, ["interrupted", "closed"], "")


def test_a_port_in_use_is_an_error():
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert server_url(taken) == f"http://127.0.0.1:{port}/"
        with pytest.raises(OutputError, match=f"port {port} cannot be used"):
            listen("127.0.0.1", port)


GET = b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n"
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
        assert raw_exchange(port, GET + start).count(b"200 OK") == 1
        assert b"200 OK" in raw_exchange(port, GET)


def test_work_may_take_longer_than_the_idle_limit(frequent_checks):
    backend = BlockingBackend()
    with served_port(make_app(backend)) as port:
        responses = []
        client = Thread(target=lambda: responses.append(raw_exchange(port, *post_request())))
        client.start()
        backend.started.wait()
        time.sleep(0.5)  # several idle checks
        backend.proceed.set()
        client.join()
    assert b"200 OK" in responses[0]


def test_a_client_that_never_reads_is_closed_and_a_slow_one_is_not(
    monkeypatch, app_with_long_response
):
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
    backend = BlockingBackend()
    responses = []
    with running_server(make_app(backend)) as (port, running):
        client = Thread(target=lambda: responses.append(raw_exchange(port, *post_request())))
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


def test_no_thread_of_a_job_remains_after_the_server_has_stopped():
    before = set(enumerate_threads())
    app = make_app()
    for _ in range(2):  # also after it was started again
        with served_port(app) as port:
            assert status(raw_exchange(port, *post_request())) == 200
            assert status(raw_exchange(port, *post_request(TWO_PHOTOS, "/related"))) == 200
        left = set(enumerate_threads()) - before
        for thread in left:
            thread.join(30)
            assert not thread.is_alive(), thread.name


def test_too_many_connections_are_not_logged_and_bugs_are(caplog):
    async def report():
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(server._handle_loop_error)
        full = OSError(errno.EMFILE, "Too many open files")
        loop.call_exception_handler(
            {"message": "socket.accept() out of system resource", "exception": full}
        )
        assert not caplog.records
        loop.call_exception_handler({"message": "a bug", "exception": KeyError()})

    asyncio.run(report())
    assert [record.message.splitlines()[0] for record in caplog.records] == ["a bug"]
