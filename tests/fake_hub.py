"""A Hugging Face hub on this machine: makes repositories, takes commits, or refuses."""

import base64
import json
from http.server import BaseHTTPRequestHandler

from file_server import on_loopback


class Hub:
    """What the hub holds, who may write to it, and which answer it gives in place of the right one."""

    def __init__(self, url):
        self.url, self.token, self.refusals, self.asked = url, "hf_right", {}, []
        self.speaks_html = False
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

    def answer(self, path, body):
        """Status and JSON for what the client asks."""
        refused = [status for place, status in self.refusals.items() if place in path]
        if refused:
            return refused[0], {"error": "no"}
        if path == "/api/repos/create":
            return self.create(json.loads(body))
        if path == "/api/validate-yaml":
            return 200, {}
        name, _, verb = path.removeprefix("/api/models/").partition("/main")[0].rpartition("/")
        if verb == "commit":
            return self.commit(name, [json.loads(line) for line in body.splitlines()])
        if verb == "preupload":
            files = [file["path"] for file in json.loads(body)["files"]]
            how = {"uploadMode": "regular", "shouldIgnore": False}
            return 200, {"files": [{"path": path, **how} for path in files]}
        name = f"{name}/{verb}"
        found = name in self.repos
        return (200, {"id": name, "private": self.private[name], "tags": []}) if found else (404, {})


class _Answers(BaseHTTPRequestHandler):
    def do_GET(self):
        hub, length = self.server.content, int(self.headers["Content-Length"] or 0)
        body, path = self.rfile.read(length), self.path.partition("?")[0]
        hub.asked.append(path)
        known = self.headers["Authorization"] == f"Bearer {hub.token}"
        status, told = hub.answer(path, body) if known else (401, {"error": "Invalid token"})
        data = b"<html>" if hub.speaks_html else json.dumps(told).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    do_POST = do_GET

    def log_message(self, *_):
        pass


def served():
    """A hub, until it is left."""
    return on_loopback(_Answers, Hub)
