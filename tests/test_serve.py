import json
import re
import urllib.error
import urllib.request

import pytest

from brewster.cli import serve as command
from brewster.cli.serve import serve
from file_server import loopback_only
from glass_server import as_a_user


@pytest.fixture
def reachable(monkeypatch):
    """This machine may be reached, by the address that the server prints."""
    import socket  # noqa: PLC0415

    monkeypatch.undo()
    loopback_only(monkeypatch)
    return socket


def get(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_a_user_starts_it_asks_it_and_stops_it(reachable, model):
    with as_a_user("--model", model, "--token", "auto") as link:
        url, token = re.fullmatch(r"(http://127\.0\.0\.1:\d+/)\?token=([\w-]{16,})", link).groups()
        assert get(f"{url}health")[0] == 401
        status, body = get(f"{url}models", Authorization=f"Bearer {token}")
        assert (status, [row["name"] for row in json.loads(body)]) == (200, ["pane", "compact"])
        assert get(f"{url}health", Authorization=f"Bearer {token}", Host="evil.com")[0] == 421
        assert get(link)[0] == 200


@pytest.fixture
def served(monkeypatch, model):
    """What would have been served: the guard and the address."""
    import brewster.web.application as web  # noqa: PLC0415

    calls = []
    monkeypatch.setattr(
        web, "serve", lambda app, **how: calls.append((app.user_middleware[0].kwargs["guard"], how))
    )
    return calls


def test_another_address_is_warned_of_and_gets_a_token(bare, served):
    code, _, err = bare("serve", "--host", "0.0.0.0")
    ((guard, how),) = served
    assert code == 0
    assert "warning: everybody who can reach 0.0.0.0" in err
    assert guard.any_address
    assert len(guard.token) >= 16
    assert how["host"] == "0.0.0.0"


def test_this_machine_alone_needs_no_token(bare, served):
    code, _, err = bare("serve", "--max-bytes", "1000")
    ((guard, how),) = served
    assert (code, guard.token, guard.max_bytes, how["host"], how["port"]) == (
        0,
        None,
        1000,
        "127.0.0.1",
        8417,
    )
    assert "warning" not in err


@pytest.mark.parametrize("token", ["short", "with space and more", "semi;colon;semi;colon", ""])
def test_a_token_that_can_be_guessed_or_breaks_a_link_is_a_wrong_usage(bare, served, token):
    code, _, err = bare("serve", "--token", token)
    assert code == 2
    assert "16 to 200 characters" in err
    assert not served


def test_models_that_are_missing_or_share_a_name_are_refused_at_the_start(bare, served, model, tmp_path):
    assert bare("serve", "--model", "missing.onnx")[0] == 1
    twin = tmp_path / "compact.onnx"
    twin.write_bytes(model.read_bytes())
    code, _, err = bare("serve", "--model", twin)
    assert code == 1
    assert "both called compact" in err
    assert not served


def test_a_port_that_is_taken_is_an_error_and_no_traceback(bare, reachable):
    with reachable.create_server(("127.0.0.1", 0)) as taken:
        code, _, err = bare("serve", "--port", taken.getsockname()[1])
    assert code == 1
    assert err.startswith("error: 127.0.0.1 port")


def test_the_page_opens_in_the_browser_only_when_asked(monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(command.webbrowser, "open", opened.append)
    command.print_link("http://127.0.0.1:1/", None, opens=False)
    command.print_link("http://127.0.0.1:1/", "token", opens=True)
    assert opened == ["http://127.0.0.1:1/?token=token"]
    assert capsys.readouterr().out.splitlines() == ["http://127.0.0.1:1/", "http://127.0.0.1:1/?token=token"]
    assert serve.name == "serve"
