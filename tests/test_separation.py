"""The HTTP API that separates photos: responses, errors, the job queue, and the OpenAPI
document.
"""

import asyncio
import io
import re
import zipfile
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import pyvips
import schemathesis
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from schemathesis.specs.openapi.checks import negative_data_rejection, positive_data_acceptance

from brewster.batch import plan_files
from brewster.separation import Separator
from brewster.web.application import create_app
from brewster.web.job_queue import JobQueue
from brewster.web.middleware import AccessPolicy
from brewster.web.model_cache import ModelCache
from brewster.web.separation import separation_router
from cli_helpers import image_bytes
from picture_files import file_of, smooth
from web_servers import BlockingBackend, client, form, make_app, pane, request

MIXTURE = Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg"
SMALL = image_bytes(40, 30, "png")


@pytest.fixture
def app():
    return make_app()


def separate(app, photo=SMALL, name="window.png", **fields):
    return request(app, "POST", "/separate", **form(photo, name, **fields))


def error_of(response):
    assert {"error"} <= set(response.json()) <= {"error", "kind"}
    return response.json()["error"]


def test_the_server_returns_the_bytes_of_the_command_line(run_without_model, tmp_path):
    app = create_app(
        separation_router(ModelCache(device="cpu"), JobQueue(), max_pixels=10**8),
        policy=AccessPolicy(),
    )
    response = separate(app, MIXTURE.read_bytes(), MIXTURE.name, quality="draft", strength="0.7")
    run_without_model(
        MIXTURE, "-o", tmp_path, "--quality", "draft", "--strength", "0.7", "--device", "cpu"
    )
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name) for name in archive.namelist()}
    assert files == {path.name: path.read_bytes() for path in tmp_path.glob("*.jpg")}
    assert len(files) == 2
    (row,) = request(app, "GET", "/models").json()
    assert response.headers["brewster-sha256"] == row["sha256"]
    assert "where it fails" in row["card"].lower()


@pytest.mark.parametrize(("fields", "kind", "name"), [
    ({"layers": "transmission"}, "image/png", "window.transmission.png"),
    ({"layers": "confidence", "format": "webp"}, "image/png", "window.confidence.png"),
    ({"layers": "reflection", "format": "webp"}, "image/webp", "window.reflection.webp"),
    ({"layers": "reflection", "additive": "true"}, "image/tiff", "window.reflection.tiff"),
    ({"layers": "reflection,transmission"}, "application/zip", "window.zip"),
])  # fmt: skip
def test_one_layer_is_an_image_and_several_are_a_zip(app, fields, kind, name):
    response = separate(app, **fields)
    assert response.status_code == 200
    assert response.headers["content-type"] == kind
    assert f'filename="{name}"' in response.headers["content-disposition"]
    if kind != "application/zip":
        expected = Separator(pane, name="pane", sha256="0" * 64)(
            SMALL, additive="additive" in fields
        )
        layer = fields["layers"]
        assert response.content == getattr(expected, layer).encode(kind.removeprefix("image/"))


def test_the_headers_describe_the_separation(app):
    headers = separate(app).headers
    assert headers["brewster-model"] == "pane"
    assert headers["brewster-sha256"] == "0" * 64
    assert headers["brewster-device"] == "cpu"
    assert 0 <= float(headers["brewster-residual"]) < 0.01
    assert float(headers["brewster-seconds"]) > 0


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.text())
@example("../../a.png")
@example("%2e%2e%2f.png")
@example("x" * 1000 + ".png")
def test_no_file_name_breaks_the_response(app, name):
    head = f'form-data; name="photo"; filename="{name}"'.replace("\r", "").replace("\n", "")
    data = b"--x\r\nContent-Disposition: %b\r\n\r\n%b\r\n--x--\r\n" % (
        head.encode(errors="replace"),
        SMALL,
    )
    kind = {"content-type": "multipart/form-data; boundary=x"}
    response = request(app, "POST", "/separate", content=data, headers=kind)
    assert response.status_code in (200, 400, 422)
    if response.status_code == 200:
        (disposition,) = response.headers.get_list("content-disposition")
        assert disposition.isprintable()
        file_name = unquote(disposition.partition("UTF-8''")[2])
        assert file_name.endswith(".zip")
        assert not set(file_name) & set('/\\\r\n"')


@pytest.mark.parametrize("name", [
    "x.jpg_large",
    "IMG 1 u\N{COMBINING DIAERESIS}.JPG",  # the form of file names on macOS
    "100%41 it's;a=b.png",
])  # fmt: skip
def test_layers_have_the_file_names_of_the_command_line(app, tmp_path, name):
    photo = image_bytes(40, 30, "jpeg")
    (tmp_path / name).write_bytes(photo)
    (task,) = plan_files(tmp_path / name)
    (single,) = separate(app, photo, name, layers="transmission").headers.get_list(
        "content-disposition"
    )
    assert unquote(single.partition("UTF-8''")[2]) == task.outputs["transmission"].name
    # RFC 6266: an ASCII name in quotes, and the complete name with the characters of RFC 5987
    pattern = r'attachment; filename="[ -!#-\[\]-~]+"; filename\*=UTF-8\'\'([\w.~-]|%[0-9A-F]{2})+'
    assert re.fullmatch(pattern, single, re.ASCII)
    with zipfile.ZipFile(io.BytesIO(separate(app, photo, name).content)) as archive:
        assert archive.namelist() == [path.name for path in task.outputs.values()]


@pytest.mark.parametrize(("photo", "status", "message"), [
    (b"", 422, "empty"), (b"hello", 422, "no known image format"),
    (SMALL[:60], 422, "cannot be read completely"),
    (file_of(np.zeros((40, 50, 4), np.uint8), "tiff"), 200, ""),
    (file_of(smooth(200, 300), "png"), 413, "pixels"),
    (pyvips.Image.black(8, 8, bands=5).tiffsave_buffer(), 415, "5 channels"),
])  # fmt: skip
def test_uploads_that_cannot_be_decoded_are_refused(photo, status, message):
    response = separate(make_app(max_pixels=5000), photo)
    assert response.status_code == status
    if message:
        assert message in error_of(response)


def test_wrong_values_are_refused_before_any_work():
    def fail_if_called(tile):
        raise AssertionError

    response = separate(make_app(fail_if_called), strength="7")
    assert response.status_code == 422
    assert "strength is '7'" in error_of(response)


def test_unknown_paths_and_methods_are_refused(app):
    for path in (
        "/nothing",
        "/page/../separation.py",
        "/page/%2e%2e/separation.py",
        "/docs",
        "/redoc",
    ):
        assert request(app, "GET", path).status_code == 404
    response = request(app, "GET", "/separate")
    assert (response.status_code, response.headers["allow"]) == (405, "POST")


def test_progress_is_available_while_the_job_runs():
    backend = BlockingBackend()

    async def watch():
        async with client(make_app(backend)) as http:
            task = asyncio.create_task(http.post("/separate?job=my-own-job", **form(SMALL)))
            await asyncio.to_thread(backend.started.wait)
            during = await http.get("/progress/my-own-job")
            again = await http.post("/separate?job=my-own-job", **form(SMALL))
            backend.proceed.set()
            await task
            return during, again, await http.get("/progress/my-own-job")

    during, again, after = asyncio.run(watch())
    assert during.json() == {
        "state": "working",
        "ahead": 0,
        "share": 0.0,
        "levels": 0,
        "is_measuring": False,
        "preparing": None,
    }
    assert again.status_code == 409
    assert after.status_code == 404
    assert "job" in error_of(after)


SCHEMA_APP = make_app(policy=AccessPolicy(hosts=frozenset({"testserver"})))
"""An application with the host name that schemathesis uses."""
SCHEMA = schemathesis.openapi.from_asgi("/openapi.json", SCHEMA_APP)


# The schema cannot express which options contradict each other, and in a form 0 is valid for false
EXCLUDED_CHECKS = [
    positive_data_acceptance,
    negative_data_rejection,
]


@SCHEMA.parametrize()
@settings(max_examples=12, suppress_health_check=list(HealthCheck))
def test_the_server_conforms_to_its_openapi_document(case):
    photo = case.body.get("photo") if isinstance(case.body, dict) else None
    if isinstance(photo, str | bytes):  # random bytes are not an image
        case.body["photo"] = SMALL
    case.call_and_validate(excluded_checks=EXCLUDED_CHECKS)
