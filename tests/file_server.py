"""A local web server for files, with programmable faults."""

import contextlib
import socket
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread
from urllib.parse import urlsplit


class FileHandler(BaseHTTPRequestHandler):
    def do_GET(self):
        files = self.server.content
        path = urlsplit(self.path).path
        files.requests.append((path, self.headers["Range"]))
        files.agents.append(self.headers["User-Agent"])
        faults = files.faults.get(path)
        match faults.pop(0) if faults else None:
            case None:
                self.send(files.body(path))
            case "cut":
                self.send(files.body(path), is_cut=True)
            case "stall":
                self.send(files.body(path), is_cut=True)
                files.stop.wait(5)
            case "no range":
                self.send(files.body(path), ranged=False)
            case bytes(body):
                self.send(body, ranged=False)
            case str(location):
                self.head(302, Location=location)
            case code:
                self.head(code, **({"Retry-After": "7"} if code == 429 else {}))

    def send(self, body, *, ranged=True, is_cut=False):
        if body is None:
            self.head(404)
            return
        start = int((self.headers["Range"] or "bytes=0-")[6:-1]) if ranged else 0
        rest = body[start:]
        self.head(206 if start else 200, len(rest))
        self.wfile.write(rest[: len(rest) // 2] if is_cut else rest)

    def head(self, code, length=0, **headers):
        self.send_response(code)
        for name, value in ({"Content-Length": length} | headers).items():
            self.send_header(name, str(value))
        self.end_headers()

    def log_message(self, *_):
        pass


class Files:
    """The bodies of a server by path, the requests it has received, and its next faults by path.

    A fault is "cut", "stall", "no range", another body, a location, or a status code.
    """

    def __init__(self, url):
        self.url = url
        self.bodies = {}
        self.requests = []
        self.agents = []
        self.faults = {}
        self.stop = Event()

    def body(self, path):
        return self.bodies.get(path)


def loopback_only(monkeypatch):
    """Allows connections (`connect`) to this machine only. Tests with the marker `loopback` use
    it.
    """
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
        try:
            yield server.content
        finally:
            server.shutdown()
            thread.join()


def served():
    """Runs a file server and yields its `Files`."""
    return on_loopback(FileHandler, Files)


def unused_address():
    """Returns a URL of this machine on which no server listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{listener.getsockname()[1]}"
