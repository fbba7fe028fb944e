"""The command `brewster serve`."""

import ipaddress
import json
import re
import socket
import urllib.error
import urllib.request

import cv2
import httpx
import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.errors import OutputError
from brewster.web.application import lan_address
from brewster.web.model_cache import ModelCache
from cli_helpers import image_bytes
from page_helpers import canvas, upload
from web_servers import form, serve_process


def get(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


@pytest.mark.loopback
def test_the_command_serves_requests_until_it_is_interrupted(model):
    with serve_process("--model", model, "--token", "auto") as link:
        url, token = re.fullmatch(r"(http://127\.0\.0\.1:\d+/)\?token=([\w-]{16,})", link).groups()
        assert get(f"{url}health")[0] == 401
        status, body = get(f"{url}models", Authorization=f"Bearer {token}")
        assert (status, [row["name"] for row in json.loads(body)]) == (200, ["pane", "compact"])
        assert get(f"{url}health", Authorization=f"Bearer {token}", Host="evil.com")[0] == 421
        assert get(link)[0] == 200


@pytest.mark.loopback
def test_the_link_and_the_cookie_stay_valid_when_the_server_is_started_again(model, tmp_path):
    arguments = ("--model", model, "--token", "auto")
    environment = {"XDG_STATE_HOME": str(tmp_path)}
    tokens = []
    with httpx.Client() as browser:
        for _ in range(2):
            with serve_process(*arguments, environment=environment) as link:
                url, _, token = link.partition("?token=")
                tokens.append(token)
                if len(tokens) == 1:
                    assert browser.get(f"{url}health").status_code == 401
                    assert browser.get(link).status_code == 200
                assert browser.get(f"{url}health").status_code == 200
    assert tokens[0] == tokens[1]
    (path,) = tmp_path.rglob("token")
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_server_without_a_writable_folder_has_a_token_until_it_stops(
    run_without_model, served_apps, monkeypatch, tmp_path
):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    for _ in range(2):
        code, _, err = run_without_model("serve", "--token", "auto")
        assert code == 0
        assert "until the server stops" in err
    first, second = (policy.token for policy, _ in served_apps)
    assert first != second
    assert min(len(first), len(second)) >= 16


@pytest.mark.loopback
@pytest.mark.parametrize("options", [[], ["--verbose"]])
def test_the_message_of_a_library_is_only_in_the_log(model, tmp_path, options):
    half = image_bytes(600, 400, "webp")[:2000]
    with (
        (tmp_path / "log").open("w") as log,
        serve_process("--model", model, *options, stderr=log) as link,
    ):
        response = httpx.post(f"{link}separate", **form(half))
    assert response.json()["kind"] == "UnreadablePhoto"
    assert "Vips" not in response.text
    text = (tmp_path / "log").read_text()
    assert ("POST /separate failed" in text, "webp" in text) == (bool(options), bool(options))


@pytest.fixture
def served_apps(monkeypatch, model):
    """Records the policy and arguments of `serve` instead of serving."""
    import brewster.web.application as web  # noqa: PLC0415

    calls = []
    monkeypatch.setattr(
        web,
        "serve",
        lambda app, **kwargs: calls.append((app.user_middleware[0].kwargs["policy"], kwargs)),
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
    assert (code, policy.token, policy.max_bytes, "warning" in err) == (0, None, 1000, False)
    assert (kwargs["host"], kwargs["port"]) == ("127.0.0.1", 8417)


@pytest.mark.parametrize(("options", "device"), [((), "auto"), (("--device", "cpu"), "cpu")])
def test_the_models_of_a_server_run_on_the_device_that_is_asked_for(
    run_without_model, served_apps, monkeypatch, options, device
):
    devices = []
    load = Separator.load

    def recording(model, **options):
        devices.append(options["device"])
        return load(model, device="cpu")

    monkeypatch.setattr(Separator, "load", recording)
    assert run_without_model("serve", *options)[0] == 0
    assert devices == [device]


@pytest.mark.parametrize("token", ["short", "with space and more", "semi;colon;semi;colon", ""])
def test_a_short_token_or_one_with_wrong_characters_is_refused(
    run_without_model, served_apps, token
):
    code, _, err = run_without_model("serve", "--token", token)
    assert code == 2
    assert "16 to 200 characters" in err
    assert not served_apps


def test_models_that_are_missing_or_share_a_name_are_refused(
    run_without_model, served_apps, model, tmp_path
):
    assert run_without_model("serve", "--model", "missing.onnx")[0] == 1
    twin = tmp_path / "compact.onnx"
    twin.write_bytes(model.read_bytes())
    code, _, err = run_without_model("serve", "--model", twin)
    assert code == 1
    assert "have the same name compact" in err
    assert not served_apps


def test_a_lora_in_the_current_folder_has_the_name_of_the_folder(tmp_path, monkeypatch):
    (tmp_path / "glass").mkdir()
    monkeypatch.chdir(tmp_path / "glass")
    assert ModelCache(["."]).names[0] == "glass"


@pytest.fixture
def lan(monkeypatch, model, tmp_path):
    """A server for phones: its link, and the log with the QR code."""
    monkeypatch.undo()  # allow connections to the address of this machine in its network
    try:
        lan_address()
    except OutputError as error:
        pytest.skip(str(error))
    log = tmp_path / "log"
    with log.open("w") as stderr, serve_process("--lan", "--model", model, stderr=stderr) as link:
        yield link, log


def test_a_server_for_phones_admits_only_its_private_address_and_only_with_the_token(lan):
    link, log = lan
    host, port, token = re.fullmatch(r"http://([\d.]+):(\d+)/\?token=([\w-]{16,})", link).groups()
    address = ipaddress.ip_address(host)
    assert address.is_private
    assert not address.is_loopback
    url = f"http://{host}:{port}/health"
    bearer = {"Authorization": f"Bearer {token}"}
    assert get(url)[0] == 401
    assert get(url, Authorization="Bearer " + "x" * len(token))[0] == 401
    assert get(url, **bearer)[0] == 200
    for other in ("evil.com", "192.168.255.254", socket.gethostname()):
        assert get(url, Host=other, **bearer)[0] == 421
    with socket.socket() as loopback:  # the server is bound to one address
        assert loopback.connect_ex(("127.0.0.1", int(port))) != 0
    assert f"warning: everybody who can reach {host}" in log.read_text()


def test_a_phone_reads_the_link_from_the_qr_code(lan):
    link, log = lan
    assert get(link)[0] == 200  # the server has printed everything
    rows = [line for line in log.read_text().splitlines() if set(line) <= set(" ▀▄█") and line]
    halves = {
        " ": (0, 0),
        "▀": (1, 0),
        "▄": (0, 1),
        "█": (1, 1),
    }  # a module is light where a block is
    modules = [[halves[block][half] for block in row] for row in rows for half in (0, 1)]
    image = np.kron(np.array(modules, np.uint8) * 255, np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetectorAruco().detectAndDecode(image)[0] == link


def test_a_phone_opens_the_link_once_and_separates_a_photo(lan, new_page):
    link, _ = lan
    page = new_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page.goto(link)
    page.wait_for_selector("#model option", state="attached")
    assert page.evaluate("[isSecureContext, document.cookie, location.search]") == [False, "", ""]
    page.reload()  # without the token in the address
    photo = image_bytes(60, 40, "png")
    upload(page, ("window.png", photo))
    (cookie,) = page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    assert (canvas(page, "left") == Photo.open(photo).pixels).all()
    assert page.locator("li.done").count() == 1


@pytest.mark.parametrize(
    ("own", "message"),
    [(None, "no network"), ("127.0.0.1", "no network"), ("8.8.8.8", r"8\.8\.8\.8 is public")],
)
def test_a_machine_without_a_private_address_cannot_serve_phones(monkeypatch, own, message):
    class Network(socket.socket):
        def connect(self, address):
            if not own:
                raise OSError(101, "Network is unreachable")

        def getsockname(self):
            return own, 1

    monkeypatch.setattr(socket, "socket", Network)
    with pytest.raises(OutputError, match=message):
        lan_address()
