"""The command `brewster serve`."""

import json
import re
import urllib.error
import urllib.request

import httpx
import pytest

from brewster.cli import serve as command
from brewster.cli.serve import serve
from cli_helpers import image_bytes
from file_server import loopback_only
from web_servers import form, serve_process


@pytest.fixture
def reachable(monkeypatch):
    """Allows connections to this machine, for the address that the server prints."""
    import socket  # noqa: PLC0415

    monkeypatch.undo()
    loopback_only(monkeypatch)
    return socket


def get(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_the_command_serves_requests_until_it_is_interrupted(reachable, model):
    with serve_process("--model", model, "--token", "auto") as link:
        url, token = re.fullmatch(r"(http://127\.0\.0\.1:\d+/)\?token=([\w-]{16,})", link).groups()
        assert get(f"{url}health")[0] == 401
        status, body = get(f"{url}models", Authorization=f"Bearer {token}")
        assert (status, [row["name"] for row in json.loads(body)]) == (200, ["pane", "compact"])
        assert get(f"{url}health", Authorization=f"Bearer {token}", Host="evil.com")[0] == 421
        assert get(link)[0] == 200


@pytest.mark.parametrize("options", [[], ["--verbose"]])
def test_the_message_of_a_library_is_only_in_the_log(reachable, model, tmp_path, options):
    half = image_bytes(600, 400)[:20_000]
    with (tmp_path / "log").open("w") as log, serve_process("--model", model, *options, stderr=log) as link:
        response = httpx.post(f"{link}separate", **form(half))
    assert response.json() == {
        "error": "the jpeg cannot be read completely; expected a complete file in a common variant of the format; "
        "copy the file again from its source, or convert it.",
        "kind": "UnreadablePhoto",
    }
    text = (tmp_path / "log").read_text()
    assert ("POST /separate failed" in text, "VipsJpeg" in text) == (bool(options), bool(options))


@pytest.fixture
def served_apps(monkeypatch, model):
    """Records the policy and arguments of `serve` instead of serving."""
    import brewster.web.application as web  # noqa: PLC0415

    calls = []
    monkeypatch.setattr(
        web, "serve", lambda app, **kwargs: calls.append((app.user_middleware[0].kwargs["policy"], kwargs))
    )
    return calls


def test_another_address_prints_a_warning_and_gets_a_token(run_without_model, served_apps):
    code, _, err = run_without_model("serve", "--host", "0.0.0.0")
    ((policy, kwargs),) = served_apps
    assert code == 0
    assert "warning: everybody who can reach 0.0.0.0" in err
    assert policy.any_address
    assert len(policy.token) >= 16
    assert kwargs["host"] == "0.0.0.0"


def test_a_loopback_address_needs_no_token(run_without_model, served_apps):
    code, _, err = run_without_model("serve", "--max-bytes", "1000")
    ((policy, kwargs),) = served_apps
    assert (code, policy.token, policy.max_bytes, kwargs["host"], kwargs["port"]) == (
        0,
        None,
        1000,
        "127.0.0.1",
        8417,
    )
    assert "warning" not in err


@pytest.mark.parametrize("token", ["short", "with space and more", "semi;colon;semi;colon", ""])
def test_a_short_token_or_one_with_forbidden_characters_is_a_wrong_argument(
    run_without_model, served_apps, token
):
    code, _, err = run_without_model("serve", "--token", token)
    assert code == 2
    assert "16 to 200 characters" in err
    assert not served_apps


def test_models_that_are_missing_or_share_a_name_are_refused_at_the_start(
    run_without_model, served_apps, model, tmp_path
):
    assert run_without_model("serve", "--model", "missing.onnx")[0] == 1
    twin = tmp_path / "compact.onnx"
    twin.write_bytes(model.read_bytes())
    code, _, err = run_without_model("serve", "--model", twin)
    assert code == 1
    assert "have the same name compact" in err
    assert not served_apps


def test_a_port_in_use_is_an_error_without_a_traceback(run_without_model, reachable):
    with reachable.create_server(("127.0.0.1", 0)) as taken:
        code, _, err = run_without_model("serve", "--port", taken.getsockname()[1])
    assert code == 1
    assert err.startswith("error: 127.0.0.1 port")


def test_the_page_opens_in_the_browser_only_if_requested(monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(command.webbrowser, "open", opened.append)
    command.print_link("http://127.0.0.1:1/", None, open_browser=False)
    command.print_link("http://127.0.0.1:1/", "token", open_browser=True)
    assert opened == ["http://127.0.0.1:1/?token=token"]
    assert capsys.readouterr().out.splitlines() == ["http://127.0.0.1:1/", "http://127.0.0.1:1/?token=token"]
    assert serve.name == "serve"
