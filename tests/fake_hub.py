"""A local HTTP server with the part of the Hugging Face hub's API that uploads use."""

import base64
import json
from http.server import BaseHTTPRequestHandler

from file_server import on_loopback


class Hub:
    """The state of the hub: repositories, the valid token, and the paths of all requests."""

    def __init__(self, url):
        self.url, self.token, self.requests = url, "hf_right", []
        self.repos, self.private, self.messages = {}, {}, []

    def create(self, body):
        name = f"{body['organization']}/{body['name']}"
        if name in self.repos:
            return 409, {"error": "You already created this model repo", "url": f"{self.url}/{name}"}
        self.repos[name], self.private[name] = {}, body["visibility"] == "private"
        return 200, {"url": f"{self.url}/{name}"}

    def commit(self, name, lines):
        for line in lines:
            value = line["value"]
            if line["key"] == "header":
                self.messages.append(value["summary"])
            else:
                self.repos[name][value["path"]] = base64.b64decode(value["content"])
        return 200, {"commitUrl": f"{self.url}/{name}/commit/1", "commitOid": "1" * 40}

    def respond(self, path, body):
        """Returns the status and the JSON value of the response to a request."""
        if path == "/api/repos/create":
            return self.create(json.loads(body))
        if path == "/api/validate-yaml":
            return 200, {}
        name, _, verb = path.removeprefix("/api/models/").partition("/main")[0].rpartition("/")
        if verb == "commit":
            return self.commit(name, [json.loads(line) for line in body.splitlines()])
        if verb == "preupload":
            files = [file["path"] for file in json.loads(body)["files"]]
            options = {"uploadMode": "regular", "shouldIgnore": False}
            return 200, {"files": [{"path": path, **options} for path in files]}
        name = f"{name}/{verb}"
        exists = name in self.repos
        return (200, {"id": name, "private": self.private[name], "tags": []}) if exists else (404, {})


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        hub, length = self.server.content, int(self.headers["Content-Length"] or 0)
        body, path = self.rfile.read(length), self.path.partition("?")[0]
        hub.requests.append(path)
        is_authorised = self.headers["Authorization"] == f"Bearer {hub.token}"
        status, value = hub.respond(path, body) if is_authorised else (401, {"error": "Invalid token"})
        data = json.dumps(value).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    do_POST = do_GET

    def log_message(self, *_):
        pass


def served():
    """Returns a context manager that runs the hub in a thread."""
    return on_loopback(_Handler, Hub)
