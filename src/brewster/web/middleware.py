"""ASGI middleware that checks host, origin, token, body size and upload time of every request.

    app.add_middleware(AccessMiddleware, policy=AccessPolicy.for_host("127.0.0.1"))

A page of another site must not use a local server through the browser of the user. The middleware
therefore refuses a request with a foreign Host header (DNS rebinding) and a POST request from a
foreign origin. It sends no CORS headers.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final
from urllib.parse import parse_qs, quote, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
_SAFE_METHODS: Final = ("GET", "OPTIONS")
_DRAIN_SECONDS: Final = 10.0
_COOKIE_SECONDS: Final = 90 * 86400  # so that the page opens without its link after a restart
_MAX_LENGTH_DIGITS: Final = (
    18  # of the header Content-Length, because int() refuses very long numbers
)
SECURITY_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "media-src blob:; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every response."""
_HOST: Final = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\[\]:@/?#\s]+)(:[0-9]{1,5})?")
_REDIRECT_PAGE: Final = (
    '<!doctype html><title>brewster</title><p>The token is valid. <a href="{0}">Continue</a>.</p>'
)

_LINK_PAGE: Final = Path(__file__).with_name("page") / "link.html"
_LINK_PAGE_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors "
    "'none'"
}


@final
@dataclass(frozen=True)
class AccessPolicy:
    """Which requests a server accepts: their hosts, their token, and the size and duration of their
    bodies.
    """

    hosts: frozenset[str] = LOOPBACK
    """Host names and addresses that a Host header may contain."""
    any_address: bool = False
    """Whether the Host header may contain any IP address. This is safe, because DNS rebinding needs
    a host name.
    """
    token: str | None = None
    """The token that every request needs: in `Authorization: Bearer`, or in the cookie that a GET
    with `?token=` sets.
    """
    max_bytes: int = 100_000_000
    """The maximum size of a request body."""
    body_seconds: float = 120
    """The time limit for receiving a request body."""

    @property
    def cookie_name(self) -> str:
        """The name of the cookie. It depends on the token, because servers with different ports on
        one host share cookies.
        """
        return f"brewster-{hashlib.sha256((self.token or '').encode()).hexdigest()[:8]}"

    @classmethod
    def for_host(
        cls, host: str, *, token: str | None = None, max_bytes: int = 100_000_000
    ) -> AccessPolicy:
        """Returns the policy of a server that is bound to an address.

        A Host header may contain this address, the host name of the machine, or a loopback address.
        With a wildcard address, it may contain any IP address.
        """
        if is_loopback(host):
            return cls(LOOPBACK | {host}, token=token, max_bytes=max_bytes)
        names = {host.lower(), socket.gethostname().lower()}
        is_wildcard = host in ("0.0.0.0", "::")  # noqa: S104  (nothing is bound here)
        return cls(LOOPBACK | names, is_wildcard, token, max_bytes)

    def allows_host(self, host: str) -> bool:
        """Whether a Host header, with or without a port, names this server."""
        match = _HOST.fullmatch(host)
        name = match[1].strip("[]").lower() if match else ""
        return name in self.hosts or (self.any_address and _is_ip_address(name))

    def accepts_token(self, token: str | None) -> bool:
        """Whether the token is correct, or the server needs none. The comparison takes constant
        time.
        """
        if self.token is None or token is None:
            return self.token is None
        return secrets.compare_digest(token.encode(), self.token.encode())


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server bound to this address."""
    return host in LOOPBACK or (_is_ip_address(host) and ipaddress.ip_address(host).is_loopback)


@final
class AccessMiddleware:
    """Pure ASGI middleware: passes a request to `app`, or refuses it with a status and `{"error":
    message}`.
    """

    def __init__(self, app: ASGIApp, *, policy: AccessPolicy) -> None:
        self.app = app
        self.policy = policy

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        if scope["method"] == "HEAD":
            scope = {**scope, "method": "GET"}  # the server (uvicorn) leaves the body out
        exchange = _Exchange(self.policy, receive, send)
        try:
            response = self._own_response(scope, Headers(scope=scope)) or self.app
            await response(scope, exchange.receive, exchange.send)
        except HTTPException as error:  # the application has no handler for this error
            await _error_response(error.status_code, error.detail)(
                scope, exchange.receive, exchange.send
            )
        except asyncio.CancelledError:  # only the shutdown of the server cancels a request
            if not exchange.has_started:
                await _error_response(
                    503,
                    "the server is being stopped; expected a running server; start it again and "
                    "repeat the request",
                )(scope, exchange.receive, exchange.forward)

    def _own_response(self, scope: Scope, headers: Headers) -> Response | None:
        """Returns a page about the token, or None for a request to the application. Raises
        HTTPException if the request is refused.
        """
        policy = self.policy
        method = scope["method"]
        if not policy.allows_host(headers.get("host", "")):
            raise HTTPException(
                421,
                "the Host header does not name this server; expected its name or address; "
                "use the address that the server printed",
            )
        if method not in _SAFE_METHODS and not _is_same_origin(headers):
            raise HTTPException(
                403,
                "the request comes from another site; expected a request of the page of this "
                "server; open the address that the server printed and repeat the request there",
            )
        query_token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [None])[0]
        if policy.token and query_token and method == "GET" and policy.accepts_token(query_token):
            return _redirect_with_cookie(scope["path"], policy)
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        cookie = cookie_parser(headers.get("cookie", "")).get(policy.cookie_name)
        if not policy.accepts_token(bearer.strip() if scheme.lower() == "bearer" else cookie):
            if method == "GET" and "text/html" in headers.get("accept", ""):
                return HTMLResponse(_LINK_PAGE.read_text(), 401, _LINK_PAGE_HEADERS)
            raise HTTPException(
                401,
                "the token is missing or wrong; expected the token of this server; "
                "open the link that the server printed, or send the token as a Bearer token",
            )
        length = headers.get("content-length", "0")
        if (
            not length.isdecimal()
            or len(length) > _MAX_LENGTH_DIGITS
            or int(length) > policy.max_bytes
        ):
            raise _too_long(policy)
        return None


@final
class _Exchange:
    """One request and its response. Limits the size and the time of the body, and adds
    SECURITY_HEADERS to the response.
    """

    def __init__(self, policy: AccessPolicy, receive: Receive, send: Send) -> None:
        self._policy = policy
        self._receive = receive
        self._send = send
        self._bytes = 0
        self._is_complete = False
        self._is_draining = False
        self.has_started = False
        self._deadline = asyncio.get_running_loop().time() + policy.body_seconds

    async def receive(self) -> Message:
        """Receives the next part of the body, or the message that the client has disconnected after
        the end of the body. Raises HTTPException 413 if the body is too large, and 408 if it takes
        too long.
        """
        if self._is_complete:
            return await self._receive()
        try:
            async with asyncio.timeout_at(self._deadline):
                message = await self._receive()
        except TimeoutError as error:
            self._is_complete = True  # do not wait for the rest
            raise HTTPException(
                408,
                f"the upload took longer than {self._policy.body_seconds:g} seconds; expected all "
                "of it within this time; send it again, or send a smaller file",
            ) from error
        self._bytes += len(message.get("body", b""))
        self._is_complete = not message.get("more_body", False)
        if self._bytes > self._policy.max_bytes and not self._is_draining:
            raise _too_long(self._policy)
        return message

    async def send(self, message: Message) -> None:
        """Sends a message. The last message is delayed until the whole body is received.

        A response that ends earlier closes the connection during the upload, and the client does
        not read the response.
        """
        is_end = message["type"] == "http.response.body" and not message.get("more_body", False)
        if not is_end or self._is_complete:
            await self.forward(message)
            return
        await self._send({**message, "more_body": True})
        self._is_draining = True
        self._deadline = asyncio.get_running_loop().time() + _DRAIN_SECONDS
        with contextlib.suppress(HTTPException):
            while not self._is_complete:
                await self.receive()
        await self._send({"type": "http.response.body", "body": b""})

    async def forward(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.has_started = True
            headers = MutableHeaders(scope=message)
            for name, value in SECURITY_HEADERS.items():
                headers.setdefault(name, value)
        await self._send(message)


def _error_response(status: int, message: str) -> Response:
    return JSONResponse({"error": message}, status)


def _too_long(policy: AccessPolicy) -> HTTPException:
    limit = f"{policy.max_bytes / 1e6:g} MB"
    return HTTPException(
        413, f"the upload is too large; expected at most {limit}; send a smaller file"
    )


def _redirect_with_cookie(path: str, policy: AccessPolicy) -> Response:
    """No HTTP redirect: the cookie is sent only if the navigation starts on a page of this
    server.
    """
    address = "/" + quote(path.lstrip("/"))
    response = HTMLResponse(
        _REDIRECT_PAGE.format(address), headers={"Refresh": f"0; url={address}"}
    )
    response.set_cookie(
        policy.cookie_name,
        policy.token or "",
        max_age=_COOKIE_SECONDS,
        httponly=True,
        samesite="strict",
    )
    return response


def _is_same_origin(headers: Headers) -> bool:
    """Whether a POST comes from a page of this server, or from a client that is not a browser and
    sends no origin.
    """
    origin = headers.get("origin")
    if origin is None:
        return headers.get("sec-fetch-site", "none") in ("same-origin", "none")
    try:
        return urlsplit(origin).netloc == headers["host"]
    except ValueError:  # for example "[" without "]"
        return False


def _is_ip_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False
