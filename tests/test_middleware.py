"""The checks of host, origin, token and body size."""

import asyncio
import string

import httpx
import pytest
from fastapi import APIRouter, Request
from hypothesis import given
from hypothesis import strategies as st

from brewster.web.application import create_app
from brewster.web.middleware import AccessPolicy, is_loopback
from web_servers import client, request

TOKEN = "a-token-for-the-tests"


def app_with(policy):
    router = APIRouter()

    @router.post("/length")
    async def length(request: Request) -> int:
        return len(await request.body())

    return create_app(router, policy=policy)


@pytest.fixture
def app():
    return app_with(AccessPolicy(max_bytes=100))


@pytest.fixture
def app_with_token():
    return app_with(AccessPolicy(token=TOKEN))


def post(app, **what):
    return request(app, "POST", "/length", **what)


@pytest.mark.parametrize(
    "host", ["localhost", "localhost:8417", "127.0.0.1:9", "[::1]:8417", "LOCALHOST"]
)
def test_the_loopback_names_are_accepted(app, host):
    assert request(app, "GET", "/", headers={"host": host}).status_code == 200


FOREIGN_HOSTS = (
    "evil.com localhost.evil.com 127.0.0.1.evil.com 127.0.0.1:8417.evil.com evil.com@127.0.0.1 "
    "127.0.0.1#.evil.com 127.0.0.1?.evil.com 127.0.0.1/.evil.com 127.0.0.1: 127.0.0.1:123456 "
    "[::1].evil.com [ ::1"
)


@pytest.mark.parametrize("host", ["", *FOREIGN_HOSTS.split()])
def test_a_foreign_host_is_refused(app, host):
    for method in ("GET", "POST"):
        response = request(app, method, "/", headers={"host": host})
        assert response.status_code == 421
        assert "does not name this server" in response.json()["error"]


@given(name=st.text(string.ascii_lowercase + string.digits + ".-", min_size=1))
def test_only_the_listed_host_names_are_allowed(name):
    assert AccessPolicy().allows_host(name) == (name in {"localhost", "127.0.0.1"})


def test_a_network_server_accepts_its_address_and_no_foreign_name():
    policy = AccessPolicy.for_host("192.168.1.5")
    assert policy.allows_host("192.168.1.5:8417")
    assert not policy.allows_host("192.168.1.6:8417")
    everywhere = AccessPolicy.for_host("0.0.0.0")
    assert everywhere.allows_host("192.168.1.6:8417")
    assert not everywhere.allows_host("evil.com")


def test_only_loopback_counts_as_this_machine():
    hosts = (
        "127.0.0.1",
        "127.3.2.1",
        "::1",
        "localhost",
        "0.0.0.0",
        "::",
        "192.168.1.5",
        "example.org",
    )
    assert [is_loopback(host) for host in hosts] == [True] * 4 + [False] * 4
    assert [AccessPolicy.for_host(host).any_address for host in hosts] == 4 * [False] + 2 * [
        True
    ] + 2 * [False]


@pytest.mark.parametrize("headers", [
    {"origin": "http://evil.com"}, {"origin": "null"}, {"origin": "http://[::1"},
    {"origin": "http://localhost:9999"}, {"origin": "http://localhost"},
    {"sec-fetch-site": "cross-site"}, {"sec-fetch-site": "same-site"},
])  # fmt: skip
def test_a_post_from_another_site_is_refused(app, headers):
    response = post(app, headers=headers)
    assert response.status_code == 403
    assert "another site" in response.json()["error"]


@pytest.mark.parametrize(
    "headers", [{}, {"origin": "http://localhost:8417"}, {"sec-fetch-site": "same-origin"}]
)
def test_a_post_from_the_same_origin_or_without_origin_is_accepted(app, headers):
    assert post(app, content=b"abc", headers=headers).json() == 3


def test_no_response_has_cors_headers(app):
    origin = {"origin": "http://evil.com", "access-control-request-method": "POST"}
    for method in ("GET", "OPTIONS"):
        response = request(app, method, "/length", headers=origin)
        assert not [name for name in response.headers if name.startswith("access-control")]
        assert response.status_code == 405


def test_the_response_to_a_bug_has_security_headers_and_no_traceback():
    router = APIRouter()

    @router.get("/bug")
    def bug() -> None:
        raise ZeroDivisionError("secret")

    async def once():
        app = create_app(router, policy=AccessPolicy())
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as http:
            return await http.get("/bug")

    response = asyncio.run(once())
    assert response.status_code == 500
    assert "please report it" in response.json()["error"]
    assert "secret" not in response.text
    assert "default-src 'none'" in response.headers["content-security-policy"]


def test_every_response_has_security_headers(app):
    for response in (
        request(app, "GET", "/"),
        request(app, "GET", "/", headers={"host": "evil.com"}),
        request(app, "GET", "/none"),
    ):
        policy = response.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert response.headers["x-content-type-options"] == "nosniff"
        assert response.headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"authorization": "Bearer wrong"},
        {"authorization": TOKEN},
        {"authorization": f"Basic {TOKEN}"},
        {"cookie": f"{AccessPolicy(token=TOKEN).cookie_name}=wrong"},
        {"authorization": "Bearer \xe9"},
    ],
)
def test_requests_without_the_token_are_refused(app_with_token, headers):
    for method, path in (("GET", "/"), ("GET", "/openapi.json"), ("POST", "/length")):
        raw = {name: value.encode("latin-1") for name, value in headers.items()}
        response = request(app_with_token, method, path, headers=raw)
        assert response.status_code == 401
        assert "token" in response.json()["error"]
    assert request(app_with_token, "GET", "/?token=wrong").status_code == 401


def test_a_browser_without_the_token_gets_a_page_and_a_program_gets_json(app_with_token):
    for accept, kind in (("text/html,*/*;q=0.8", "text/html"), ("*/*", "application/json")):
        response = request(app_with_token, "GET", "/", headers={"accept": accept})
        assert response.status_code == 401
        assert response.headers["content-type"].startswith(kind)
        assert "default-src 'none'" in response.headers["content-security-policy"]
    assert post(app_with_token, headers={"accept": "text/html"}).json()["error"]


def test_a_bearer_token_is_accepted(app_with_token):
    assert post(app_with_token, headers={"authorization": f"Bearer {TOKEN}"}).json() == 0


def test_a_link_with_the_token_sets_a_cookie_and_redirects():
    async def visit():
        async with client(app_with(AccessPolicy(token=TOKEN))) as browser:
            redirect = await browser.get(f"/page/index.html?token={TOKEN}")
            return redirect, await browser.get("/"), await browser.post("/length", content=b"abc")

    redirect, home, posted = asyncio.run(visit())
    assert {"HttpOnly", "SameSite=strict"} <= set(redirect.headers["set-cookie"].split("; "))
    assert redirect.headers["refresh"] == "0; url=/page/index.html"
    assert home.status_code == 200
    assert "set-cookie" not in home.headers
    assert posted.json() == 3


@pytest.mark.parametrize(
    "path", ["//evil.com/", "/%0d%0aSet-Cookie:x=y", "/%22%3E%3Cscript%3E", "/\\evil.com"]
)
def test_the_redirect_stays_on_this_server(app_with_token, path):
    response = request(
        app_with_token, "GET", httpx.URL(f"http://localhost:8417{path}", params={"token": TOKEN})
    )
    target = response.headers["refresh"].removeprefix("0; url=")
    assert target.startswith("/")
    assert not target.startswith("//")
    assert not set(target) & set('\r\n"<>\\')
    assert len(response.headers.get_list("set-cookie")) == 1


def chunks(count, size=30):
    async def generate():
        for _ in range(count):
            yield b"x" * size

    return generate()


def test_a_body_up_to_the_limit_is_accepted(app):
    assert post(app, content=b"x" * 100).json() == 100
    assert post(app, content=chunks(3)).json() == 90


@pytest.mark.parametrize("content", [lambda: b"x" * 101, lambda: chunks(4), lambda: chunks(1000)])
def test_a_larger_body_is_refused_with_and_without_content_length(app, content):
    assert post(app, content=content()).status_code == 413


@pytest.mark.parametrize("length", ["-1", "1e3", "\u00b2", "9" * 20, "9" * 5000])
def test_an_invalid_content_length_is_refused(app, length):
    headers = {"content-length": length.encode()}
    assert post(app, content=b"x", headers=headers).status_code == 413


def test_a_body_that_takes_too_long_is_refused():
    never_set = asyncio.Event

    async def slow():
        yield b"x"
        await never_set().wait()

    response = post(app_with(AccessPolicy(body_seconds=0.01)), content=slow())
    assert response.status_code == 408
    assert "longer than 0.01 seconds" in response.json()["error"]
