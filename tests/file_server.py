"""A local web server for files, with programmable faults."""

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
    """The files of the server by path, its received requests, and its next faults: "cut" or a status code."""

    def __init__(self, url):
        self.url, self.bodies, self.requests, self.faults = url, {}, [], []


def loopback_only(monkeypatch):
    """Replaces `_network_off` in test files with a server: only this machine may be reached."""
    connect = socket.socket.connect

    def loopback(self, address):
        assert address[0] == "127.0.0.1", address
        return connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", loopback)


@contextlib.contextmanager
def on_loopback(answers, content):
    """Runs a server; yields `content(url)`, which its handler finds as `server.content`."""
    with ThreadingHTTPServer(("127.0.0.1", 0), answers) as server:
        server.content = content(f"http://127.0.0.1:{server.server_port}")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server.content
        server.shutdown()
        thread.join()


def served():
    """Runs a server of files; yields its `Files`."""
    return on_loopback(_Answers, Files)


def unused_address():
    """A URL of this machine on which no server listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{listener.getsockname()[1]}"
