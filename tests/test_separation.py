import asyncio
import io
import zipfile
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis.specs.openapi.checks import negative_data_rejection, positive_data_acceptance

import brewster
from brewster import Photo
from brewster.inference import Separator
from brewster.web.application import application
from brewster.web.job_queue import JobQueue
from brewster.web.middleware import RequestLimits
from brewster.web.model_cache import ModelCache
from brewster.web.separation import separation
from front_door import picture
from glass_server import Stubborn, app_of, ask, client, form, pane
from picture_files import exif_block, file_of, smooth

MIXTURE = Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg"
SMALL = picture(40, 30, "png")


@pytest.fixture
def app():
    return app_of()


def separate(app, photo=SMALL, name="window.png", **fields):
    return ask(app, "POST", "/separate", **form(photo, name, **fields))


def error_of(answer):
    assert set(answer.json()) == {"error"}
    return answer.json()["error"]


# --- answers


def test_the_shipped_model_answers_as_the_command_line_does(bare, tmp_path):
    app = application(
        separation(ModelCache(device="cpu"), JobQueue(), max_pixels=10**8), guard=RequestLimits()
    )
    answer = separate(app, MIXTURE.read_bytes(), MIXTURE.name, quality="draft", strength="0.7")
    bare(MIXTURE, "-o", tmp_path, "--quality", "draft", "--strength", "0.7", "--device", "cpu")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        made = {name: archive.read(name) for name in archive.namelist()}
    assert made == {path.name: path.read_bytes() for path in tmp_path.glob("*.jpg")}
    assert len(made) == 2
    (row,) = ask(app, "GET", "/models").json()
    assert answer.headers["brewster-sha256"] == row["sha256"]
    assert "where it fails" in row["card"].lower()


@pytest.mark.parametrize(
    ("fields", "kind", "name"),
    [
        ({"layers": "transmission"}, "image/png", "window.transmission.png"),
        ({"layers": "confidence", "format": "webp"}, "image/png", "window.confidence.png"),
        ({"layers": "reflection", "format": "webp"}, "image/webp", "window.reflection.webp"),
        ({"layers": "reflection", "additive": "true"}, "image/tiff", "window.reflection.tiff"),
        ({"layers": "reflection,transmission"}, "application/zip", "window.zip"),
    ],
)
def test_one_layer_is_a_picture_and_several_are_a_zip(app, fields, kind, name):
    answer = separate(app, **fields)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == kind
    assert f'filename="{name}"' in answer.headers["content-disposition"]
    if kind != "application/zip":
        expected = Separator(pane)(SMALL, additive="additive" in fields)
        layer = fields["layers"]
        assert answer.content == getattr(expected, layer).encode(kind.removeprefix("image/"))


def test_how_it_was_made_stands_in_the_headers(app):
    headers = separate(app).headers
    assert headers["brewster-model"] == "pane"
    assert headers["brewster-sha256"] == "0" * 64
    assert headers["brewster-device"] == "cpu"
    assert 0 <= float(headers["brewster-residual"]) < 0.01
    assert float(headers["brewster-seconds"]) > 0


def test_the_same_photo_gives_the_same_bytes(app):
    assert separate(app).content == separate(app).content


def test_a_photo_keeps_its_profile_and_its_camera(app):
    photo = file_of(smooth(), "jpeg", exif=exif_block(6), icc_profile=Photo.open(SMALL).file_info.icc)
    layer = Photo.open(separate(app, photo, "a.jpg", layers="transmission").content)
    assert layer.size == (48, 64)
    assert b"Sextant" in layer.file_info.exif


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.text())
def test_no_file_name_harms_the_answer(app, name):
    head = f'form-data; name="photo"; filename="{name}"'.replace("\r", "").replace("\n", "")
    data = b"--x\r\nContent-Disposition: %b\r\n\r\n%b\r\n--x--\r\n" % (head.encode(errors="replace"), SMALL)
    kind = {"content-type": "multipart/form-data; boundary=x"}
    answer = ask(app, "POST", "/separate", content=data, headers=kind)
    assert answer.status_code in (200, 400, 422)
    if answer.status_code == 200:
        (said,) = answer.headers.get_list("content-disposition")
        assert said.isprintable()
        given_name = unquote(said.partition("''")[2])
        assert given_name.endswith(".zip")
        assert not set(given_name) & set('/\\\r\n"')


@pytest.mark.parametrize(
    "name", ["../../a.png", "a\nb.png", "ä日本.png", "x" * 1000 + ".png", '".png', "%2e%2e%2f.png"]
)
def test_a_hostile_name_gives_a_harmless_one(app, name):
    answer = separate(app, name=name, layers="transmission")
    assert answer.status_code == 200
    assert Path(unquote(answer.headers["content-disposition"].partition("''")[2])).suffix == ".png"


# --- refusals, each with a status and a sentence


@pytest.mark.parametrize(
    ("photo", "status", "said"),
    [
        (b"", 422, "empty"),
        (b"hello", 422, "no known image format"),
        (SMALL[:60], 422, "cannot be read completely"),
        (file_of(np.zeros((40, 50, 4), np.uint8), "tiff"), 200, ""),
        (file_of(smooth(200, 300), "png"), 413, "pixels"),
    ],
)
def test_uploads_that_are_no_photos_are_refused(photo, status, said):
    answer = separate(app_of(max_pixels=5000), photo)
    assert answer.status_code == status
    if said:
        assert said in error_of(answer)


def test_a_kind_of_picture_that_is_not_taken_is_refused(app):
    from PIL import Image  # noqa: PLC0415

    data = io.BytesIO()
    Image.new("CMYK", (8, 8)).save(data, "jpeg")
    answer = separate(app, data.getvalue(), "a.jpg")
    assert answer.status_code == 415
    assert "CMYK" in error_of(answer)


def test_wrong_values_are_refused_before_any_work():
    def never(tile):
        raise AssertionError

    answer = separate(app_of(never), strength="7")
    assert answer.status_code == 422
    assert "strength is '7'" in error_of(answer)


def test_paths_that_are_not_there_and_other_methods_are_refused(app):
    assert ask(app, "GET", "/nothing").status_code == 404
    assert ask(app, "GET", "/page/../separation.py").status_code == 404
    assert ask(app, "GET", "/page/%2e%2e/separation.py").status_code == 404
    assert ask(app, "GET", "/separate").status_code == 405


def test_a_bug_is_told_without_its_traceback():
    def broken(tile):
        raise ZeroDivisionError("secret")

    async def once():
        import httpx  # noqa: PLC0415

        transport = httpx.ASGITransport(app_of(broken), raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as asking:
            return await asking.post("/separate", **form(SMALL))

    answer = asyncio.run(once())
    assert answer.status_code == 500
    assert "please report it" in error_of(answer)
    assert "secret" not in answer.text


# --- the desk


def test_a_client_that_goes_away_stops_the_work():
    backend, desk = Stubborn(), JobQueue()

    async def leave():
        async with client(app_of(backend, desk=desk)) as asking:
            task = asyncio.create_task(asking.post("/separate", **form(SMALL, quality="best")))
            await asyncio.to_thread(backend.started.wait)
            task.cancel()
            await asyncio.wait([task])
        backend.go.set()
        while desk.jobs:
            await asyncio.sleep(0.001)

    asyncio.run(leave())
    assert backend.tiles == 1
    backend_in_peace = Stubborn()
    backend_in_peace.go.set()
    assert separate(app_of(backend_in_peace), quality="best").status_code == 200
    assert backend_in_peace.tiles > 1


def test_a_full_server_says_when_to_come_back_and_goes_on():
    backend, desk = Stubborn(), JobQueue(queue=1)

    async def crowd():
        async with client(app_of(backend, desk=desk)) as asking:
            first = [asyncio.create_task(asking.post("/separate", **form(SMALL))) for _ in range(2)]
            await asyncio.to_thread(backend.started.wait)
            while desk.jobs < 2:
                await asyncio.sleep(0.001)
            health = (await asking.get("/health")).json()
            late = await asking.post("/separate", **form(SMALL))
            backend.go.set()
            return health, late, await asyncio.gather(*first)

    health, late, first = asyncio.run(crowd())
    assert (health["status"], health["jobs"], health["places"]) == ("ok", 2, 2)
    assert late.status_code == 503
    assert late.headers["retry-after"].isdecimal()
    assert "try again" in error_of(late)
    assert [answer.status_code for answer in first] == [200, 200]


def test_work_beyond_the_time_limit_is_given_up():
    backend = Stubborn()

    async def wait():
        async with client(app_of(backend, desk=JobQueue(seconds=0.01))) as asking:
            answer = await asking.post("/separate", **form(SMALL))
            backend.go.set()
            return answer

    answer = asyncio.run(wait())
    assert answer.status_code == 504
    assert "draft" in error_of(answer)


def test_progress_is_told_while_there_is_any():
    backend = Stubborn()

    async def watch():
        async with client(app_of(backend)) as asking:
            task = asyncio.create_task(asking.post("/separate?job=my-own-job", **form(SMALL)))
            await asyncio.to_thread(backend.started.wait)
            during = await asking.get("/progress/my-own-job")
            again = await asking.post("/separate?job=my-own-job", **form(SMALL))
            backend.go.set()
            await task
            return during, again, await asking.get("/progress/my-own-job")

    during, again, after = asyncio.run(watch())
    assert during.json() == {"state": "working", "ahead": 0, "share": 0.0}
    assert again.status_code == 409
    assert after.status_code == 404
    assert "job" in error_of(after)


def test_a_job_needs_a_name_that_is_one(app):
    answer = ask(app, "POST", "/separate?job=../x", **form(SMALL))
    assert answer.status_code == 422
    assert "job" in error_of(answer)


# --- what is written about it


def test_openapi_describes_every_field_and_every_refusal(app):
    api = ask(app, "GET", "/openapi.json").json()
    assert set(api["paths"]) == {"/separate", "/progress/{job}", "/models", "/health"}
    post = api["paths"]["/separate"]["post"]
    assert {"413", "415", "422", "503", "504"} <= set(post["responses"])
    assert post["requestBody"]["content"]["multipart/form-data"]["schema"]["required"] == ["photo"]
    assert api["info"]["version"] == brewster.__version__


def test_no_documentation_page_fetches_assets_from_elsewhere(app):
    assert ask(app, "GET", "/docs").status_code == ask(app, "GET", "/redoc").status_code == 404


TRIED = app_of(guard=RequestLimits(hosts=frozenset({"testserver"})))  # as schemathesis calls it
SCHEMA = schemathesis.openapi.from_asgi("/openapi.json", TRIED)


UNFIT = [  # no schema tells which options go together, and in a form all is text: 0 is as good a no as false
    positive_data_acceptance,
    negative_data_rejection,
]


@SCHEMA.parametrize()
@settings(max_examples=12, suppress_health_check=list(HealthCheck))
def test_the_server_keeps_what_openapi_promises(case):
    photo = case.body.get("photo") if isinstance(case.body, dict) else None
    if isinstance(photo, str | bytes):  # chance makes no picture
        case.body["photo"] = SMALL
    case.call_and_validate(excluded_checks=UNFIT)
