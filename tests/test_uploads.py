"""Files that are sent once: their key in place of files, their memory, and what is answered when
they are no longer kept.
"""

import asyncio
import base64
import gc
import io
import tempfile
import tracemalloc
import zipfile

import numpy as np
import pytest

import brewster.web.separation as routes
from brewster import Photo
from brewster.web.film_preparation import FilmPreparation
from brewster.web.uploads import Upload
from cli_helpers import image_bytes
from video_files import film_of, write_video
from web_servers import BlockingBackend, client, make_app, request

PHOTOS = [image_bytes(60, 40, "png", seed) for seed in range(3)]


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film of 8 frames of 96 x 64 pixels, too small to show a motion."""
    picture = Photo.open(image_bytes(160, 130, "png")).pixels
    path = tmp_path_factory.mktemp("film") / "window.mp4"
    return write_video(path, film_of(picture, 8, step=2, size=(96, 64))).read_bytes()


def as_files(photos, film=None):
    files = [("photo", (f"{number}.png", photo)) for number, photo in enumerate(photos, 1)]
    return [*files, ("film", ("1.mov", film))] if film else files


def post(app, path, files=(), **fields):
    parts = [*files, *((name, (None, value)) for name, value in fields.items())]
    return request(app, "POST", path, files=parts)


def key_of(app, files):
    response = request(app, "POST", "/photos", files=files)
    assert response.status_code == 200, response.text
    return response.json()["key"]


@pytest.mark.parametrize("fields", [{}, {"strength": "0.4", "layers": "transmission"}], ids=str)
@pytest.mark.parametrize("photos", [PHOTOS[:1], PHOTOS], ids=["photo", "burst"])
def test_a_key_gives_what_the_files_give(photos, fields):
    app = make_app()
    key = key_of(app, as_files(photos))
    for path in ("/separate", "/preview"):
        sent = post(app, path, as_files(photos), **fields)
        named = post(app, path, photo=key, **fields)
        assert named.status_code == sent.status_code == 200, named.text
        assert named.content == sent.content
        names = [answer.headers.get("Content-Disposition") for answer in (named, sent)]
        assert names[0] == names[1]


def test_the_reference_is_chosen_with_the_request_that_uses_the_burst():
    app = make_app()
    key = key_of(app, as_files(PHOTOS))
    for number in "13":
        response = post(app, "/separate", photo=key, reference=number, layers="transmission")
        assert f'"{number}.transmission.png"' in response.headers["Content-Disposition"]
    assert post(app, "/separate", photo=key, reference="4").status_code == 422


def test_a_film_and_the_film_of_a_photo_are_used_by_their_key(film):
    app = make_app()
    answer = request(app, "POST", "/photos", files=[("photo", ("window.mp4", film))]).json()
    assert answer["is_film"]
    response = post(app, "/separate", photo=answer["key"], layers="transmission")
    assert Photo.open(response.content).size == (96, 64)
    assert "Brewster-Burst" in response.headers
    key = key_of(app, as_files([image_bytes(96, 64, "png")], film))
    assert post(app, "/separate", photo=key).headers["Brewster-Film"] == "given"
    assert "Brewster-Film" not in post(app, "/separate", photo=key, film="no").headers


def test_tiles_of_an_upload_are_decoded_again_when_they_are_needed(film):
    app = make_app()
    for files, size in (
        (as_files(PHOTOS[:1]), (60, 40)),
        ([("photo", ("window.mp4", film))], (96, 64)),
    ):
        tile = request(app, "GET", f"/tile/{key_of(app, files)}/0/0/0")
        assert Photo.open(tile.content).size == size


def test_the_tiles_of_a_burst_show_the_photo_that_is_separated():
    app = make_app()
    tile = request(app, "GET", f"/tile/{key_of(app, as_files(PHOTOS))}/0/0/0")
    assert (Photo.open(tile.content).pixels == Photo.open(PHOTOS[1]).pixels).all()


@pytest.mark.parametrize("path", ["/separate", "/preview", "/photo"])
def test_a_key_that_is_not_kept_is_told_apart_from_an_invalid_form(path):
    app = make_app()
    response = post(app, path, photo="0" * 64)
    assert response.status_code == 404
    assert "send the photo again" in response.json()["error"]
    for text in ("no key", "0" * 63):
        response = post(app, path, photo=text)
        assert response.status_code == 422
        assert "key" in response.json()["error"]


def test_the_uploads_that_were_not_used_for_longest_are_dropped_first(monkeypatch):
    monkeypatch.setattr(routes, "_MAX_UPLOAD_BYTES", int(2.5 * len(PHOTOS[0])))
    app = make_app()
    first, second = (key_of(app, as_files([photo])) for photo in PHOTOS[:2])
    assert post(app, "/separate", photo=first).status_code == 200
    third = key_of(app, as_files([PHOTOS[2]]))
    kept = [post(app, "/separate", photo=key).status_code for key in (first, second, third)]
    assert kept == [200, 404, 200]


def test_the_key_names_the_files_with_their_names_and_their_order():
    def key(*files, film=None):
        names, contents = zip(*files, strict=True)
        return Upload(names, contents, film).key

    a, b = ("a.png", b"a"), ("b.png", b"b")
    uploads = [(a,), (b,), (a, b), (b, a), (("b.png", b"a"),), (("a.pn", b"ga"),)]
    keys = [*(key(*files) for files in uploads), key(a, film=b"b"), key(a, film=b"")]
    assert len(set(keys)) == len(keys)
    assert key(a, b) == key(a, b)


def test_the_film_of_a_photo_counts_as_memory():
    assert Upload(("a.png", "b.png"), (b"12", b"345")).nbytes == 5
    assert Upload(("a.png",), (b"12",), b"3456").nbytes == 6


@pytest.mark.parametrize("size", [0, 4, 40, 0.6, 0.9])
def test_a_film_that_cannot_be_decoded_is_refused_and_not_kept(film, size, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    cut = film[: int(size * len(film)) if size < 1 else size]
    app = make_app()
    response = request(app, "POST", "/photos", files=[("photo", ("window.mp4", cut))])
    assert response.status_code == 422
    assert response.json()["kind"] == "UnreadablePhoto"
    assert post(app, "/separate", photo=Upload(("window.mp4",), (cut,)).key).status_code == 404
    assert list(tmp_path.iterdir()) == []
    assert key_of(app, [("photo", ("window.mp4", film))])


def test_a_film_that_was_refused_leaves_no_memory(film):
    app = make_app()
    first_box = film[: int.from_bytes(film[:4], "big")]
    long = first_box + (40_000_000).to_bytes(4, "big") + b"mdat" + bytes(20_000_000)
    request(app, "POST", "/photos", files=[("photo", ("a.mp4", film[:-9]))])  # imports
    tracemalloc.start()
    try:
        status = request(app, "POST", "/photos", files=[("photo", ("a.mp4", long))]).status_code
        gc.collect()
        assert (status, tracemalloc.get_traced_memory()[0] < len(long) / 4) == (422, True)
    finally:
        tracemalloc.stop()


def test_a_film_is_kept_as_far_as_it_can_be_decoded(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (130, 160, 3), np.uint8)
    frames = film_of(picture, 20, step=1, size=(96, 64))
    options = {"movflags": "faststart"}
    data = write_video(tmp_path / "a.mp4", frames, container_options=options).read_bytes()
    app = make_app()
    key = key_of(app, [("photo", ("a.mp4", data[: 6 * len(data) // 10]))])
    assert post(app, "/separate", photo=key).status_code == 200


def test_options_are_not_sent_with_an_upload():
    response = request(
        make_app(), "POST", "/photos", files=as_files(PHOTOS[:1]), data={"strength": "0.4"}
    )
    assert response.status_code == 422


@pytest.mark.parametrize("photos", [PHOTOS[:1], PHOTOS], ids=["photo", "burst"])
def test_json_has_the_record_of_the_headers_and_the_files_of_the_zip(photos):
    app = make_app()
    accept = {"Accept": "text/html, application/json;q=0.9"}
    answer = request(app, "POST", "/separate", files=as_files(photos), headers=accept)
    response = post(app, "/separate", as_files(photos))
    body = answer.json()
    result = body["result"]
    assert result["assessment"]["verdict"] == response.headers["Brewster-Verdict"]
    assert f"{result['residual']:.6f}" == response.headers["Brewster-Residual"]
    assert (result["burst"] is None) == ("Brewster-Burst" not in response.headers)
    assert result["photo_sha256"] == Upload((), tuple(photos)).digests[len(photos) // 2].hex()
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    sent = {row["name"]: base64.b64decode(row["data"]) for row in body["layers"].values()}
    assert sent == files
    assert {row["media_type"] for row in body["layers"].values()} == {"image/png"}


@pytest.mark.parametrize("count", [1, 3])
def test_the_progress_of_a_film_tells_for_what_it_waits(count):
    backend = BlockingBackend()
    preparation = FilmPreparation()
    preparation.share = 0.4
    app = make_app(backend, preparation=preparation)

    async def ask():
        async with client(app) as http:
            path = "/separate?job=window-0001"
            separation = asyncio.create_task(http.post(path, files=as_files(PHOTOS[:count])))
            await asyncio.to_thread(backend.started.wait)
            shares = []
            for share in (0.4, None):
                preparation.share = share
                shares.append((await http.get("/progress/window-0001")).json()["preparing"])
            backend.proceed.set()
            await separation
            return shares

    assert asyncio.run(ask()) == [0.4 if count > 1 else None, None]


def test_nothing_waits_for_a_preparation_that_has_ended():
    preparation = FilmPreparation()
    shares = []

    def output():
        for line in ("0.25\n", "1.0\n"):
            yield line
            shares.append(preparation.share)

    preparation._read(output())
    assert shares == [0.25, 1.0]
    assert preparation.share is None


def test_the_preparation_ends_with_the_server():
    preparation = FilmPreparation()
    with preparation.running():
        pass
    assert preparation.share is None
