"""A local web server for files, with programmable faults."""

import contextlib
import socket
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread


class _Handler(BaseHTTPRequestHandler):
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
    """The bodies of a server by path, the requests it has received, and its next faults: "cut" or a status code."""

    def __init__(self, url):
        self.url, self.bodies, self.requests, self.faults = url, {}, [], []


def loopback_only(monkeypatch):
    """Allows connections to this machine only. Test files with a server use it instead of `_network_off`."""
    connect = socket.socket.connect

    def loopback(self, address):
        assert address[0] == "127.0.0.1", address
        return connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", loopback)


@contextlib.contextmanager
def on_loopback(handler, content):
    """Runs a server and yields `content(url)`. The handler reads it as `server.content`."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.content = content(f"http://127.0.0.1:{server.server_port}")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server.content
        server.shutdown()
        thread.join()


def served():
    """Runs a file server and yields its `Files`."""
    return on_loopback(_Handler, Files)


def unused_address():
    """Returns a URL of this machine on which no server listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{listener.getsockname()[1]}"
