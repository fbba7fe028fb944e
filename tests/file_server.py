"""A web server on this machine that gives files, or breaks off, refuses and lies when told to."""

import contextlib
import socket
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread


class _Answers(BaseHTTPRequestHandler):
    def do_GET(self):
        files = self.server.content
        files.requests.append((self.path, self.headers["Range"]))
        body, fault = files.bodies.get(self.path), files.faults.pop(0) if files.faults else None
        if body is None or isinstance(fault, int):
            return self.head(fault or 404)
        start = int((self.headers["Range"] or "bytes=0-")[6:-1])
        rest = body[start:]
        self.head(206 if start else 200, len(rest))
        self.wfile.write(rest[: len(rest) // 2] if fault == "cut" else rest)
        return None

    def head(self, code, length=0):
        self.send_response(code)
        self.send_header("Content-Length", str(length))
        self.end_headers()

    def log_message(self, *_):
        pass


class Files:
    """What the server gives by path, what was asked of it, and its next faults: "cut" or a status code."""

    def __init__(self, url):
        self.url, self.bodies, self.requests, self.faults = url, {}, [], []


def loopback_only(monkeypatch):
    """What a test file that serves files has as its `_network_off`: this machine may be reached, nothing else."""
    connect = socket.socket.connect

    def loopback(self, address):
        assert address[0] == "127.0.0.1", address
        return connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", loopback)


@contextlib.contextmanager
def on_loopback(answers, content):
    """A server whose handler finds `content(its address)`, which is given, until it is left."""
    with ThreadingHTTPServer(("127.0.0.1", 0), answers) as server:
        server.content = content(f"http://127.0.0.1:{server.server_port}")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server.content
        server.shutdown()
        thread.join()


def served():
    """A server of files, until it is left."""
    return on_loopback(_Answers, Files)


def unused_address():
    """An address on this machine where nobody listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{listener.getsockname()[1]}"
