"""Bursts by HTTP: several photos of one window in one request."""

import asyncio
import gc
import hashlib
import io
import sys
import tracemalloc
import zipfile
from functools import partial
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image

from brewster import Photo
from brewster.film import fit_burst, read_video, separate_burst
from brewster.film.measuring import measure_layers
from brewster.film.motion.model.levels import Level
from brewster.film.motion.solver import solve
from brewster.film.photo_film import fit_photo_film
from brewster.separation import Separator
from brewster.web.job_queue import JobCancelled, JobQueue
from cli_helpers import image_bytes
from motion_photos import google_xmp, small_film
from picture_files import file_of
from simulated_bursts import PICTURES, linear_pictures, read_photo, simulate_burst
from test_preview import Maps, sent_preview
from video_files import film_of, write_audio, write_video
from web_servers import BlockingBackend, FakeModelCache, client, form, make_app, pane, request


@pytest.fixture(scope="module")
def photos():
    """Three photos of 128 x 96 pixels, in which the reflection moves by 12 pixels."""
    motion = {"relative_px": 12, "common_px": 3, "strength": 0.4, "noise": 0}
    burst = simulate_burst(*linear_pictures((160, 120)), frames=3, size=(128, 96), **motion)
    return [file_of(frame, "PNG") for frame in burst.frames]


@pytest.fixture
def few_steps(monkeypatch):
    """For tests that do not measure the separation."""
    few = (Level(48, 20, None),)
    monkeypatch.setattr("brewster.film.measuring.solve", partial(solve, search=few, levels=few))


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film of 12 frames of 240 x 180 pixels."""
    picture = (255 * np.clip(read_photo(PICTURES[0], (480, 360)), 0, 1)).astype(np.uint8)
    return write_video(tmp_path_factory.mktemp("film") / "window.mp4", film_of(picture, 12, step=6))


def send_film(path, film, app=None, name="window.mp4", **fields):
    content = film if isinstance(film, bytes) else film.read_bytes()
    return request(app or make_app(), "POST", path, files=[("photo", (name, content))], data=fields)


def send(path, photos, app=None, mask=None, **fields):
    files = [("photo", (f"{number}.png", photo)) for number, photo in enumerate(photos, 1)]
    if mask:
        files.append(("mask", ("mask.png", mask)))
    return request(app or make_app(), "POST", path, files=files, data=fields)


@pytest.mark.usefixtures("few_steps")
def test_a_burst_with_a_mask_returns_the_layers_of_the_python_function(photos):
    mask = np.zeros((96, 128), np.uint8)
    mask[:, 60:] = 255
    response = send("/separate", photos, mask=file_of(mask, "PNG"), reference="3", strength="0.7")
    assert response.status_code == 200, response.text
    options = {"strength": 0.7, "mask": file_of(mask, "PNG")}
    expected = separate_burst(
        photos, reference=2, separator=Separator(pane, name="pane"), **options
    )
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        made = {name: Photo.open(archive.read(name)).pixels for name in archive.namelist()}
    assert list(made) == ["3.transmission.png", "3.reflection.png"]
    assert (made["3.transmission.png"] == expected.transmission.pixels).all()
    assert (made["3.transmission.png"][:, :60] == Photo.open(photos[2]).pixels[:, :60]).all()
    headers = response.headers
    assert headers["Brewster-Burst"] == expected.burst.method
    assert headers["Brewster-Burst-Message"] == expected.burst.message
    assert headers["Brewster-Verdict"] == expected.assessment.verdict
    assert float(headers["Brewster-Burst-Doubtful"]) == expected.burst.doubtful_area
    assert headers["Brewster-Model"] == quote(expected.model)


@pytest.mark.usefixtures("few_steps")
def test_the_preview_of_a_burst_shows_the_layers_of_the_download(photos):
    app = make_app()
    response = send("/preview", photos, app)
    assert response.status_code == 200, response.text
    shown = Maps(sent_preview(response)[1]).at(0.7)[0]
    downloaded = send("/separate", photos, app, layers="transmission", strength="0.7")
    assert downloaded.headers["Brewster-Verdict"] == response.headers["Brewster-Verdict"]
    made = Photo.open(downloaded.content).pixels
    assert np.quantile(np.abs(made.astype(int) - shown), 0.99) <= 2
    tile = request(app, "GET", f"/tile/{response.headers['Brewster-Photo']}/0/0/0")
    assert (Photo.open(tile.content).pixels == Photo.open(photos[1]).pixels).all()


@pytest.mark.usefixtures("few_steps")
@pytest.mark.parametrize("is_moving", [False, True])
def test_the_preview_of_a_burst_tells_what_its_download_tells(photos, is_moving):
    app = make_app()
    still = Photo.open(photos[0]).pixels.copy()
    still[0, 0] += 1
    files = photos if is_moving else [photos[0], file_of(still, "PNG")]
    head, _ = sent_preview(send("/preview", files, app))
    files = [("photo", (f"{number}.png", photo)) for number, photo in enumerate(files)]
    accept = {"Accept": "application/json"}
    downloaded = request(app, "POST", "/separate", files=files, headers=accept).json()["result"]
    for name in ("model", "photo_sha256", "device", "next_step", "burst", "note"):
        assert head["result"][name] == downloaded[name], name
    assert (downloaded["next_step"] is None) == is_moving


@pytest.mark.usefixtures("few_steps")
def test_a_download_after_a_preview_measures_only_other_photos_or_references(
    photos, monkeypatch, few_steps
):
    measured = []

    def count(frames, reference, prior, **keywords):
        measured.append(reference)
        return measure_layers(frames, reference, prior, **keywords)

    monkeypatch.setattr("brewster.film.separate.measure_layers", count)
    app = make_app()
    send("/preview", photos, app)
    one, other, same = (
        send(
            "/separate", photos, app, layers="transmission", strength="0.5", reference=number
        ).content
        for number in ("2", "1", "1")
    )
    forced, swapped = (
        send(
            "/separate",
            photos,
            app,
            layers="transmission",
            reference="1",
            method="motion",
            swap=swap,
        )
        for swap in ("no", "yes")
    )
    assert measured == [1, 0]
    assert one != other == same
    assert forced.headers["Brewster-Burst-Measured"] == "yes"
    assert forced.content != swapped.content
    send("/separate", photos[:2], app, layers="transmission", reference="1")
    assert measured == [1, 0, 0]


@pytest.mark.parametrize(("changed", "is_measured_again"), [
    ({"hints": "other strokes"}, True), ({"reference": "1"}, True), ({"model": "another"}, True),
    ({"photos": "in another order"}, True),
    ({"strength": "0.3", "format": "tiff", "layers": "reflection", "quality": "draft"}, False),
], ids=str)  # fmt: skip
def test_a_burst_is_measured_again_if_what_it_uses_changes(
    photos, monkeypatch, changed, is_measured_again
):
    measured = []

    def fit(frames, **options):
        measured.append(options)
        return fit_burst(frames, **options).chosen("single", swap=False)

    monkeypatch.setattr("brewster.film.fit_burst", fit)
    monkeypatch.setattr("brewster.film.separate.measure_layers", lambda *_, **__: (None, ()))
    strokes = [np.zeros((96, 128, 3), np.uint8) for _ in range(2)]
    for colour, picture in enumerate(strokes):
        picture[20:40, 20:40, colour] = 255
    separators = {name: Separator(HintedPane(), name=name) for name in ("pane", "another")}
    monkeypatch.setattr(FakeModelCache, "names", tuple(separators))
    monkeypatch.setattr(FakeModelCache, "separator", lambda _, name: separators[name])
    app = make_app()
    for change in ({}, changed):
        fields = {"method": "single", **change}
        ordered = photos[::-1] if fields.pop("photos", None) else photos
        hints = strokes[1 if fields.pop("hints", None) else 0]
        files = [("photo", (f"{n}.png", photo)) for n, photo in enumerate(ordered)]
        files.append(("hints", ("hints.png", file_of(hints, "PNG"))))
        assert request(app, "POST", "/separate", files=files, data=fields).status_code == 200
    assert len(measured) == 1 + is_measured_again


@pytest.mark.usefixtures("few_steps")
def test_a_film_gives_the_layers_of_its_middle_frame_and_is_measured_once_for_both_orders(
    film, monkeypatch
):
    app = make_app()
    measured = []
    monkeypatch.setattr(
        "brewster.film.separate.measure_layers",
        lambda *args, **keywords: measured.append(1) or measure_layers(*args, **keywords),
    )
    preview = send_film("/preview", film, app)
    frames = read_video(film, 7)
    tile = request(app, "GET", f"/tile/{preview.headers['Brewster-Photo']}/0/0/0")
    assert (Photo.open(tile.content).pixels == frames[3].pixels).all()
    made = [
        send_film("/separate", film, app, layers="transmission", method="motion", swap=swap)
        for swap in ("no", "yes")
    ]
    expected = separate_burst(
        frames, separator=Separator(pane, name="pane"), method="motion", swap=True
    )
    assert (Photo.open(made[1].content).pixels == expected.transmission.pixels).all()
    assert made[0].content != made[1].content
    assert measured == [1, 1]  # the second time by the line above
    assert 'filename="window.mp4.transmission.png"' in made[0].headers["Content-Disposition"]
    other = make_app()  # a server that has dropped the photo
    key = send_film("/photo", film, other).headers["Brewster-Photo"]
    assert key == preview.headers["Brewster-Photo"]
    assert request(other, "GET", f"/tile/{key}/0/0/0").content == tile.content


@pytest.mark.usefixtures("few_steps")
def test_each_frame_of_a_film_has_its_own_tiles(film):
    app = make_app()
    responses = [
        send_film("/preview", film, app, reference=number, method="single") for number in "12"
    ]
    assert len({response.headers["Brewster-Photo"] for response in responses}) == 2


@pytest.mark.parametrize("path", ["/photo", "/preview", "/separate"])
@pytest.mark.parametrize("reference", ["8", "12"])
def test_a_reference_beyond_the_frames_that_are_read_is_refused(film, path, reference):
    # Seven of the twelve frames are read
    response = send_film(path, film, reference=reference)
    assert response.status_code == 422
    assert response.json()["kind"] == "PhotoError"


def test_a_film_without_a_suffix_is_recognised_and_a_film_among_photos_is_refused(film, photos):
    assert send_film("/photo", film, name="upload").headers["Brewster-Size"] == "240x180"
    response = send("/separate", [photos[0], film.read_bytes()])
    assert response.status_code == 422
    assert "send the video alone" in response.json()["error"]


def test_videos_that_cannot_be_used_are_refused_with_a_reason(film, tmp_path):
    cut = film.read_bytes()[:600]
    write_audio(tmp_path / "sound.wav")
    sound = (tmp_path / "sound.wav").read_bytes()
    for content, reason in ((cut, "cannot be read as a video"), (sound, "it has no video stream")):
        response = send_film("/preview", content)
        assert (response.status_code, response.json()["kind"]) == (422, "UnreadablePhoto")
        assert reason in response.json()["error"]
    response = send_film("/preview", film, make_app(max_pixels=10_000))
    assert response.status_code == 413


class HintedPane:
    """A model that takes hints, and counts its runs."""

    takes_hints = True
    runs = 0

    def __call__(self, tile, _hints=None):
        self.runs += 1
        return pane(tile)


@pytest.mark.usefixtures("few_steps")
@pytest.mark.parametrize("run", [1, 2, 3])
def test_a_burst_stops_after_each_run_of_the_model(photos, run):
    """The model runs twice for the photo, and then twice with the hints of the measured layers."""
    model = HintedPane()
    separator_calls = []

    def stop(fraction):
        separator_calls.append(fraction)
        if model.runs == run:
            raise JobCancelled

    with pytest.raises(JobCancelled):
        fit_burst(photos, separator=Separator(model), on_progress=stop)
    assert model.runs == run
    assert separator_calls == sorted(separator_calls)


@pytest.mark.parametrize(("sizes", "status", "part"), [
    ([(30, 20), (20, 30)], 422, "photo 1 of the burst has 30 x 20 pixels"),
    ([(30, 20)] * 16, 422, "expected 2 to 15 photos"),
    ([(30, 20), (300, 200)], 413, "photo 2 of the burst"),
])  # fmt: skip
def test_the_limits_hold_for_each_photo(sizes, status, part):
    photos = [image_bytes(*size, "png") for size in sizes]
    response = send("/separate", photos, make_app(max_pixels=10_000), reference="2")
    assert response.status_code == status
    assert part in response.json()["error"]


def test_a_server_without_the_extra_names_it(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("brewster.film")]:
        monkeypatch.delitem(sys.modules, name)
    assert request(make_app(), "GET", "/health").json()["takes_films"]
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert not request(make_app(), "GET", "/health").json()["takes_films"]
    response = send("/separate", [image_bytes(30, 20, "png")] * 2)
    assert response.status_code == 501
    assert response.json()["kind"] == "MissingExtra"
    assert "[burst]" in response.json()["error"]


@pytest.fixture
def photo_with_film(film, tmp_path):
    """A photo that contains a film of another scene, so that nothing is measured."""
    photo = (255 * np.clip(read_photo(PICTURES[1], (240, 180)), 0, 1)).astype(np.uint8)
    data = film.read_bytes()
    path = tmp_path / "photo.jpg"
    Image.fromarray(photo).save(path, xmp=google_xmp(len(data)))
    return path.read_bytes() + data


@pytest.mark.parametrize("path", ["/separate", "/preview"])
def test_the_film_in_a_photo_is_used_unless_the_client_refuses(photo_with_film, path):
    response = send(path, [photo_with_film])
    assert response.status_code == 200, response.text
    assert response.headers["Brewster-Film"] == "Google Motion Photo"
    assert float(response.headers["Brewster-Film-Seconds"]) == pytest.approx(11 / 30, abs=0.05)
    assert response.headers["Brewster-Burst"] in ("single photo", "unchanged")
    refused = send(path, [photo_with_film], film="no")
    assert "Brewster-Film" not in refused.headers


def test_the_film_of_a_photo_can_be_sent_as_a_file_and_an_unreadable_one_leaves_it_alone(film):
    photo = image_bytes(240, 180)
    files = [("photo", ("a.jpg", photo)), ("film", ("a.mov", film.read_bytes()))]
    response = request(make_app(), "POST", "/separate", files=files)
    assert response.headers["Brewster-Film"] == "given"
    for unreadable in (b"no film", film.read_bytes()[:600]):
        files[1] = ("film", ("a.mov", unreadable))
        response = request(make_app(), "POST", "/separate", files=files)
        assert response.status_code == 200
        assert "was%20not%20used" in response.headers["Brewster-Note"]
        assert "Brewster-Film" not in response.headers


@pytest.mark.parametrize(("changed", "is_measured_again"), [
    ({"hints": "other strokes"}, True), ({"film": "another"}, True), ({"model": "another"}, True),
    ({"photo": "another"}, True),
    ({"strength": "0.3", "format": "tiff", "layers": "reflection", "quality": "draft"}, False),
], ids=str)  # fmt: skip
def test_a_film_of_a_photo_is_measured_again_if_what_it_uses_changes(
    film, tmp_path, monkeypatch, changed, is_measured_again
):
    measured = []

    def fit(photo, *args, **options):
        measured.append(photo)
        return fit_photo_film(photo, *args, **options)

    monkeypatch.setattr("brewster.film.photo_film.fit_photo_film", fit)
    separators = {name: Separator(HintedPane(), name=name) for name in ("pane", "another")}
    monkeypatch.setattr(FakeModelCache, "names", tuple(separators))
    monkeypatch.setattr(FakeModelCache, "separator", lambda _, name: separators[name])
    app = make_app()
    digests = []
    for change in ({}, changed, {}):
        fields = dict(change)
        hints = np.zeros((180, 240, 3), np.uint8)
        hints[20:40, 20:40, 1 if fields.pop("hints", None) else 0] = 255
        number = 2 if fields.pop("film", None) else 1
        content = small_film(tmp_path / "film.mp4", 3 + number, (96, 64))
        photo = image_bytes(240, 180, seed=1 if fields.pop("photo", None) else 0)
        files = [("photo", ("a.jpg", photo)), ("film", ("a.mov", content))]
        files.append(("hints", ("hints.png", file_of(hints, "PNG"))))
        accept = {"Accept": "application/json"}
        response = request(app, "POST", "/separate", files=files, data=fields, headers=accept)
        assert response.status_code == 200, response.text
        digests.append(response.json()["result"]["burst"]["film"]["sha256"])
        assert digests[-1] == hashlib.sha256(content).hexdigest()
    assert len(measured) == 1 + is_measured_again  # the third request is that of the first


@pytest.mark.parametrize("film", ["/etc/passwd", "../a.mp4", "maybe"])
def test_a_film_is_never_read_from_a_path_on_the_server(film):
    response = send("/separate", [image_bytes(60, 40)], film=film)
    assert response.status_code == 422


@pytest.mark.parametrize(("sizes", "part"), [
    ([(30, 20)], "no two photos"), ([(30, 20), (20, 30)], "photo 2 has other sides"),
    ([(30, 20)] * 2 + [(30, 24)], "photo 3 has other sides"),
])  # fmt: skip
def test_thumbnails_that_cannot_be_compared_are_refused(sizes, part):
    response = send("/related", [image_bytes(*size, "png") for size in sizes])
    assert response.status_code == 422
    assert part in response.json()["error"]


def test_grey_thumbnails_are_compared_with_coloured_ones_and_with_those_of_16_bits(photos):
    pixels = np.array(Photo.open(photos[0]).srgb_8bit())
    others = pixels[..., :1], 257 * pixels.astype(np.uint16)
    encoded = [Photo.from_array(other, encoding="srgb").encode("png") for other in others]
    response = send("/related", [photos[0], *encoded])
    assert response.json() == {"are_related": True}


def test_comparisons_do_not_wait_for_a_separation_and_their_number_is_limited(photos):
    backend = BlockingBackend()
    app = make_app(backend, job_queue=JobQueue(max_waiting=2))
    files = [("photo", (f"{number}.png", photo)) for number, photo in enumerate(photos)]

    async def ask():
        async with client(app) as http:
            separation = asyncio.create_task(http.post("/separate", **form(photos[0])))
            await asyncio.to_thread(backend.started.wait)
            answer = await http.post("/related", files=files)
            many = await asyncio.gather(*(http.post("/related", files=files) for _ in range(8)))
            backend.proceed.set()
            return answer, many, await separation

    answer, many, separation = asyncio.run(ask())
    assert (answer.json(), separation.status_code) == ({"are_related": True}, 200)
    assert {response.status_code for response in many} == {200, 503}


@pytest.mark.usefixtures("few_steps")
def test_a_kept_burst_holds_the_memory_that_is_counted(photos):
    """Whatever the measurement leaves behind is held, such as an array of which a part is kept."""
    fit_burst(photos, separator=Separator(pane))  # what only the first one imports and compiles
    gc.collect()
    tracemalloc.start()
    try:
        fitted = fit_burst(photos, separator=Separator(pane))
        whole = fitted.nbytes
        kept = fitted.without_model()
        del fitted
        gc.collect()
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept.nbytes < whole
    assert kept.nbytes == pytest.approx(held, rel=0.15)
