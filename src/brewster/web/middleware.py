"""Who may ask, and how much: the checks before every request, whatever application stands behind them.

    app.add_middleware(Guarded, guard=Guard.at("127.0.0.1"))

A page from elsewhere must not reach a server on this machine through its reader's browser: a foreign Host (DNS
rebinding) is refused, and so is a post from a foreign page. There is no CORS at all.
"""

from __future__ import annotations

import asyncio
import hashlib
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass
from typing import Final, final
from urllib.parse import parse_qs, quote, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
_SAFE_METHODS: Final = ("GET", "HEAD", "OPTIONS")
_DRAIN_SECONDS: Final = 10.0
_MAX_LENGTH_DIGITS: Final = 18  # of a length in bytes; Python reads no endless ones
SECURITY_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""What every answer says to a browser."""
_HOST: Final = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\[\]:@/?#\s]+)(:[0-9]{1,5})?")
_REDIRECT_PAGE: Final = (
    '<!doctype html><title>brewster</title><p>The token fits. <a href="{0}">Go on</a>.</p>'
)


@final
@dataclass(frozen=True)
class RequestLimits:
    """What is let in."""

    hosts: frozenset[str] = LOOPBACK
    """Names and addresses that a request may call this server by."""
    any_address: bool = False
    """Whether every bare address will do as well: DNS cannot bend one, as it bends a name."""
    token: str | None = None
    """What a request must bring: in `Authorization: Bearer`, once as `?token=`, or in the cookie that this gives."""
    max_bytes: int = 100_000_000
    """The longest body."""
    body_seconds: float = 120
    """How long a body may take to arrive."""

    @property
    def cookie_name(self) -> str:
        """What the cookie is called: servers of one host share their cookies, whatever their ports."""
        return f"brewster-{hashlib.sha256((self.token or '').encode()).hexdigest()[:8]}"

    @classmethod
    def for_host(cls, host: str, *, token: str | None = None, max_bytes: int = 100_000_000) -> RequestLimits:
        """The guard of a server bound to an address: it is called by that, by its own name, or by loopback."""
        if is_loopback(host):
            return cls(LOOPBACK | {host}, token=token, max_bytes=max_bytes)
        names = {host.lower(), socket.gethostname().lower()}
        is_wildcard = host in ("0.0.0.0", "::")  # noqa: S104  (compared, not bound)
        return cls(LOOPBACK | names, is_wildcard, token, max_bytes)

    def allows_host(self, host: str) -> bool:
        """Whether a Host header, port and all, is one of ours."""
        match = _HOST.fullmatch(host)
        name = match[1].strip("[]").lower() if match else ""
        return name in self.hosts or (self.any_address and _is_ip_address(name))

    def accepts_token(self, token: str | None) -> bool:
        """Whether a token, or none, is enough."""
        if self.token is None or token is None:
            return self.token is None
        return secrets.compare_digest(token.encode(), self.token.encode())


def is_loopback(host: str) -> bool:
    """Whether an address to bind to can be reached from this machine only."""
    return host in LOOPBACK or (_is_ip_address(host) and ipaddress.ip_address(host).is_loopback)


@final
class LimitMiddleware:
    """Pure ASGI: lets a request through to `app`, or answers it itself with a status and `{"error": sentence}`."""

    def __init__(self, app: ASGIApp, *, limits: RequestLimits) -> None:
        self.app, self.limits = app, limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        exchange = _Exchange(self.limits, receive, send)
        try:
            response = self._refusal(scope, Headers(scope=scope)) or self.app
            await response(scope, exchange.receive, exchange.send)
        except HTTPException as error:  # of an application that does not answer them itself
            await _error_response(error.status_code, error.detail)(scope, exchange.receive, exchange.send)
        except asyncio.CancelledError:  # nobody cancels a request but a server that ends
            if not exchange.has_started:
                await _error_response(503, "the server is being stopped; start it again, then try again")(
                    scope, exchange.receive, exchange.forward
                )

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """What is said to a request that goes no further; None lets it through."""
        limits, method = self.limits, scope["method"]
        if not limits.allows_host(headers.get("host", "")):
            return _error_response(
                421, "this server was called by a name that is not its own; use the address it printed"
            )
        if method not in _SAFE_METHODS and not _is_same_origin(headers):
            return _error_response(
                403, "the request comes from another site; only this server's own page may send here"
            )
        query_token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [None])[0]
        if limits.token and query_token and method == "GET" and limits.accepts_token(query_token):
            return _redirect_with_cookie(scope["path"], limits)
        if not limits.accepts_token(_request_token(headers, limits.cookie_name)):
            return _error_response(
                401, "a token is needed; open the link that the server printed, or send it as a Bearer"
            )
        length = headers.get("content-length", "0")
        if not length.isdecimal() or len(length) > _MAX_LENGTH_DIGITS or int(length) > limits.max_bytes:
            raise _body_too_long(limits)
        return None


@final
class _Exchange:
    """One request and its answer: counts and times the body, and adds the headers that every answer has."""

    def __init__(self, limits: RequestLimits, receive: Receive, send: Send) -> None:
        self._limits, self._receive, self._send = limits, receive, send
        self._bytes, self._is_complete, self._is_draining = 0, False, False
        self.has_started = False
        self._deadline = asyncio.get_running_loop().time() + limits.body_seconds

    async def receive(self) -> Message:
        """The next piece of the body; afterwards the end of the connection.

        Raises:
            HTTPException: 413, 408: the body is too long, or takes too long.
        """
        if self._is_complete:
            return await self._receive()
        try:
            async with asyncio.timeout_at(self._deadline):
                message = await self._receive()
        except TimeoutError as error:
            self._is_complete = True  # no more of it is waited for
            raise HTTPException(
                408, f"the upload took longer than {self._limits.body_seconds:g} seconds; send it again"
            ) from error
        self._bytes += len(message.get("body", b""))
        self._is_complete = not message.get("more_body", False)
        if self._bytes > self._limits.max_bytes and not self._is_draining:
            raise _body_too_long(self._limits)
        return message

    async def send(self, message: Message) -> None:
        """Passes the answer on. Its end waits for the rest of the body: a client that is cut off reads no answer."""
        is_end = message["type"] == "http.response.body" and not message.get("more_body", False)
        if not is_end or self._is_complete:
            await self.forward(message)
            return
        await self._send({**message, "more_body": True})
        await self._drain()
        await self._send({"type": "http.response.body", "body": b""})

    async def forward(self, message: Message) -> None:
        """Passes the answer on and waits for nothing."""
        if message["type"] == "http.response.start":
            self.has_started = True
            headers = MutableHeaders(scope=message)
            for name, value in SECURITY_HEADERS.items():
                headers.setdefault(name, value)
        await self._send(message)

    async def _drain(self) -> None:
        self._is_draining = True
        self._deadline = asyncio.get_running_loop().time() + _DRAIN_SECONDS
        try:
            while not self._is_complete:
                await self.receive()
        except HTTPException:
            return


def _error_response(status: int, sentence: str) -> Response:
    return JSONResponse({"error": sentence}, status)


def _body_too_long(limits: RequestLimits) -> HTTPException:
    limit = f"{limits.max_bytes / 1e6:g} MB"
    return HTTPException(413, f"the upload is longer than {limit}; send a smaller one")


def _redirect_with_cookie(path: str, limits: RequestLimits) -> Response:
    """Gives the cookie and goes on without the token in the address.

    This is a page and no redirect: browsers bring a strict cookie only where this server's own page sent them.
    """
    target = "/" + quote(path.lstrip("/"))
    response = HTMLResponse(_REDIRECT_PAGE.format(target), headers={"Refresh": f"0; url={target}"})
    response.set_cookie(limits.cookie_name, limits.token or "", httponly=True, samesite="strict")
    return response


def _request_token(headers: Headers, cookie: str) -> str | None:
    """The token in the header or the cookie."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return token.strip()
    return cookie_parser(headers.get("cookie", "")).get(cookie)


def _is_same_origin(headers: Headers) -> bool:
    """Browsers say where a post comes from. Where nothing is said there is no browser, hence no page behind it."""
    origin = headers.get("origin")
    if origin is not None:
        return _netloc(origin) == headers["host"]
    return headers.get("sec-fetch-site", "none") in ("same-origin", "none")


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:  # such as [ without ]
        return None


def _is_ip_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
