"""Bursts on the page, and the page on a phone, with small photos and with files that the browser
cannot decode.
"""

import gzip
import importlib
import io
import json
import sys
import zipfile
from pathlib import Path

import av
import numpy as np
import pytest

from brewster import Photo
from brewster.film import read_video
from cli_helpers import image_bytes
from motion_photos import small_film
from page_helpers import canvas, difference, downloaded, names_in_list, settle, upload, wait_until
from picture_files import file_of
from simulated_bursts import PICTURES, read_photo, simulate_burst
from video_files import write_video
from web_servers import make_app, served_port

PICTURE = Photo.open(Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg").pixels
SCENE = [
    (f"{number}.png", file_of(np.ascontiguousarray(PICTURE[100:160, at : at + 90]), "PNG"))
    for number, at in enumerate((100, 104, 108), 1)
]
"""Photos of one scene, which are too small to show a motion, so that the burst gives the result of
the middle photo.
"""
PHOTOS = [
    (
        f"{number}.png",
        file_of((255 * read_photo(path, (90, 60)).clip(0, 1)).astype(np.uint8), "PNG"),
    )
    for number, path in enumerate(PICTURES[:3], 1)
]
"""Unrelated photos of one size."""


def add(page, *files):
    page.set_input_files(
        "#files", [{"name": name, "mimeType": "", "buffer": data} for name, data in files]
    )


def as_burst(page):
    add(page, *SCENE)
    page.get_by_role("button", name="Yes, one window").click()
    page.wait_for_selector("li.done")
    page.wait_for_selector("glass-compare:not([hidden])")


def test_photos_of_one_scene_can_be_one_burst_that_is_downloaded_and_split_again(open_page, run):
    page = open_page()
    as_burst(page)
    page.get_by_text("too small to show the motion").wait_for()
    assert names_in_list(page) == ["3 \N{MULTIPLICATION SIGN} 2.png"]
    assert not page.locator("#burst").is_visible()
    assert page.locator("li .state").inner_text() == "single photo"
    page.get_by_label("Strength", exact=True).fill("0.5")
    name, data = downloaded(page, page.get_by_role("button", name="Download transmission").click)
    alone = Photo.open(run("-", "--strength", 0.5, stdin=SCENE[1][1])[1])
    assert name == "2.transmission.png"
    assert (Photo.open(data).pixels == alone.pixels).all()
    page.get_by_role("button", name="Remove 2.png").click()
    page.get_by_role("button", name="Undo removal").click()
    page.get_by_role("button", name="Separate the photos one by one").click()
    page.wait_for_selector("li.done >> nth=2")
    assert names_in_list(page) == ["1.png", "2.png", "3.png"]


def test_files_are_sent_once_and_again_if_the_server_has_dropped_them(open_page):
    page = open_page()
    uploads = []
    page.on("request", lambda one: uploads.append(one) if one.url.endswith("/photos") else None)
    as_burst(page)
    download = page.get_by_role("button", name="Download transmission")
    name, data = downloaded(page, download.click)
    assert (name, len(uploads)) == ("2.transmission.png", 1)
    dropped = []

    def drop_once(route):
        if dropped:
            route.continue_()
        else:
            dropped.append(route)
            route.fulfill(status=404, json={"error": "dropped"})

    page.route("**/separate?*", drop_once)
    assert downloaded(page, download.click) == (name, data)
    assert len(uploads) == 2


def test_unrelated_photos_photos_of_two_sizes_and_the_answer_no_leave_the_list_as_it_is(open_page):
    page = open_page()
    separated = []
    page.on("request", lambda request: separated.append(1) if "preview?" in request.url else None)
    add(page, *SCENE[:2])
    page.get_by_role("button", name="Download all").click()
    page.locator("#export-status", has_text="Waiting for your answer").wait_for()
    page.get_by_role("button", name="Stop").click()
    add(page, PHOTOS[0])
    page.wait_for_selector("li.done")
    assert len(separated) == 1  # the photos of the open question wait
    page.get_by_role("button", name="No", exact=True).click()
    page.wait_for_selector("li.done >> nth=2")
    assert names_in_list(page) == ["1.png", "2.png", "1.png"]
    with page.expect_response("**/related") as compared:
        upload(page, *PHOTOS)
    assert compared.value.json() == {"are_related": False}
    upload(page, ("a.png", image_bytes(80, 60, "png")), ("b.png", image_bytes(60, 80, "png")))
    settle(page)
    assert not page.locator("#burst").is_visible()


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film of a window, 240 x 180 pixels, whose reflection moves by 30 pixels."""
    layers = [np.clip(read_photo(path, (320, 240)), 0, 1) for path in (PICTURES[2], PICTURES[1])]
    motion = {"relative_px": 30, "common_px": 6, "strength": 0.4, "noise": 0}
    burst = simulate_burst(*layers, frames=5, size=(240, 180), **motion)
    return write_video(tmp_path_factory.mktemp("film") / "window.mp4", burst.frames)


@pytest.mark.timeout(300)  # it measures a burst, and compiles the solver if its cache is empty
def test_a_film_is_separated_swapped_undone_and_downloaded_with_its_verdict_in_the_zip(
    open_page, film
):
    page = open_page()
    upload(page, (film.name, film.read_bytes()))
    photos = read_video(film, 7)
    assert (canvas(page, "left") == photos[2].pixels).all()
    if page.locator(
        "#naming"
    ).is_visible():  # whether the names are certain is not the subject of this test
        page.get_by_role("button", name="The first picture").click()
    assert page.locator("#summary").inner_text() == "1 film: removed"
    settle(page)
    before = canvas(page, "right")

    def is_exchanged():
        return np.median(difference(canvas(page, "right"), before)) > 10

    page.get_by_role("button", name="Swap").click()
    wait_until(page, is_exchanged)
    page.keyboard.press("Control+z")
    wait_until(page, lambda: not difference(canvas(page, "right"), before).any())
    page.keyboard.press("Control+y")
    wait_until(page, is_exchanged)
    page.wait_for_function("() => !document.querySelector('#update-bar').checkVisibility()")
    _, data = downloaded(page, page.get_by_role("button", name="Download all").click)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        made = Photo.open(archive.read("window.mp4.transmission.png"))
        report = archive.read("brewster-report.txt").decode()
    shown = canvas(page, "right")
    assert np.quantile(difference(made.pixels, shown), 0.99) <= 2
    assert "(removed, strength 100 %, layers exchanged). The layers moved" in report


def test_a_photo_and_its_film_are_one_entry_and_the_page_tells_what_the_film_was_used_for(
    open_page, tmp_path
):
    page = open_page()
    add(page, ("IMG_1.png", PHOTOS[0][1]), ("IMG_1.MOV", small_film(tmp_path / "film.mov")))
    page.wait_for_selector("li.done")
    assert names_in_list(page) == ["IMG_1.png"]
    text = page.locator("#verdict-text").inner_text()
    assert "contains a film of 0.2 s" in text
    assert "Separated as a photo alone" in text
    name, _ = downloaded(page, page.get_by_role("button", name="Download transmission").click)
    assert name == "IMG_1.transmission.png"


def with_result(page, *, verdict=None, burst=None, **values):
    """Replaces values of the results of previews, and returns the list of their forms."""
    forms = []

    def replace(route):
        forms.append(route.request.post_data_buffer)
        response = route.fetch()
        line, maps = gzip.decompress(response.body()).split(b"\n", 1)
        head = json.loads(line)
        head["result"] |= values
        if burst:
            head["result"]["burst"] |= burst
        if verdict:
            head["result"]["assessment"]["verdict"] = verdict
        route.fulfill(body=gzip.compress(json.dumps(head).encode() + b"\n" + maps))

    page.route("**/preview?*", replace)
    return forms


def field(form, name):
    return form.split(f'name="{name}"\r\n\r\n'.encode())[1].split(b"\r\n")[0].decode()


@pytest.mark.parametrize(
    ("choice", "swap"), [("The first picture", "no"), ("The second picture", "yes")]
)
def test_the_user_is_asked_which_layer_is_behind_the_glass_if_it_is_unsure(open_page, choice, swap):
    page = open_page()
    forms = with_result(
        page, burst={"method": "burst", "are_names_certain": False, "is_measured": True}
    )
    as_burst(page)
    assert page.get_by_role("heading", name="Which one is behind the glass?").is_visible()
    assert page.locator("li .state").inner_text() == "open question"
    assert page.get_by_role("button", name="Download transmission").is_disabled()
    page.get_by_role("button", name="Download all").click()
    page.locator("#export-status", has_text="which layer of 2.png").wait_for()
    page.get_by_role("button", name="Stop").click()
    page.wait_for_selector("#export", state="hidden")  # what is below it moves up
    page.set_viewport_size({"width": 390, "height": 700})
    landscape = (
        "for (const c of naming.querySelectorAll('canvas')) [c.width, c.height] = [1200, 800]"
    )
    page.evaluate(f"{landscape}; naming.classList.add('wide')")
    parts = "#name-transmission canvas", "#name-reflection canvas", "#naming"
    first, second, question = (page.locator(part).bounding_box() for part in parts)
    assert first["y"] + first["height"] <= second["y"]
    assert second["y"] + second["height"] <= question["y"] + question["height"]
    page.get_by_role("button", name=choice).click()
    page.wait_for_selector("#naming", state="hidden")
    assert page.evaluate("document.activeElement.tagName") == "GLASS-COMPARE"
    page.wait_for_selector("li.done")
    assert field(forms[-1], "swap") == swap
    page.get_by_role("button", name="Undo", exact=True).click()
    page.wait_for_selector("#naming", state="visible")


def test_refused_layers_are_shown_on_request_and_the_automatic_result_again(open_page):
    page = open_page()
    forms = with_result(page, burst={"method": "single photo", "is_measured": True})
    as_burst(page)
    page.unroute("**/preview?*")
    forms = with_result(page, burst={"method": "burst", "is_measured": True})
    page.route(
        "**/preview?*", lambda route: (forms.append(route.request.post_data_buffer), route.abort())
    )
    page.get_by_role("button", name="Use the measured layers anyway").click()
    page.wait_for_selector("li.failed")
    assert field(forms[-1], "method") == "motion"


def test_a_single_photo_of_which_little_was_removed_names_the_next_step_on_the_picture(open_page):
    page = open_page(has_touch=True, is_mobile=True)
    with_result(page, verdict="little found", next_step="Film it.")
    upload(page, PHOTOS[0])
    assert "Film it." in page.locator("#verdict").inner_text()
    with page.expect_file_chooser() as choosing:
        page.locator("#film-next").click()
    assert choosing.value.element.get_attribute("capture") == "environment"
    assert page.locator("li .state").inner_text() == "little found"


def test_a_server_without_the_extra_for_films_says_so_before_an_upload(new_page, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with served_port(make_app()) as port:
        page = new_page(has_touch=True, is_mobile=True)
        uploads = []
        page.on("request", lambda request: uploads.append(request.url) if request.post_data else 0)
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_selector("#photos-only", state="visible")
        assert not page.locator("#advice").is_visible()
        assert "video" not in page.locator("#files").get_attribute("accept")
        upload(page, ("window.mp4", b"a film"))
        assert "separates photos only" in page.locator("#error-text").inner_text()
        assert page.locator("#discard").get_attribute("class") == "main"
        assert uploads == []
        with_result(page, verdict="little found", next_step="Film it.")
        page.get_by_role("button", name="Remove", exact=True).click()
        page.get_by_role("button", name="Try an example").click()
        page.wait_for_selector("li.done")
        assert names_in_list(page) == ["example.jpg"]
        assert page.locator("#verdict").is_visible()
        assert not page.locator("#film-next").is_visible()


def test_the_example_is_the_film_that_its_script_makes(open_page, monkeypatch, tmp_path):
    page = open_page()
    page.route("**/preview?*", lambda _: None)  # its separation takes long
    page.get_by_role("button", name="Try an example").click()
    page.wait_for_selector("li")
    assert names_in_list(page) == ["example.mp4"]
    codes = page.evaluate("""async () => {
        const film = await fetch("page/example.mp4");
        return Array.from(new Uint8Array(await film.arrayBuffer()));
    }""")
    (tmp_path / "example.mp4").write_bytes(bytes(codes))
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "runs")
    made = importlib.import_module("example_film").frames()
    with av.open(str(tmp_path / "example.mp4")) as film:
        kept = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(kept) == len(made)
    for number in (0, len(made) // 3):
        assert np.median(difference(kept[number], made[number])) <= 4


@pytest.mark.parametrize("is_phone", [True, False])
def test_a_film_is_offered_where_the_browser_opens_a_camera(open_page, is_phone):
    page = open_page(has_touch=is_phone, is_mobile=is_phone)
    assert page.locator("#film").is_visible() == is_phone


def test_one_to_one_is_always_100_percent_and_fit_shows_the_whole_photo_again(open_page):
    page = open_page()
    upload(page, PHOTOS[0])
    page.get_by_label("Side by side", exact=True).check()
    size = page.locator("#zoom output")
    fitted = size.inner_text()
    assert fitted == "200 %"
    page.get_by_role("button", name="1:1").click()
    assert size.inner_text() == "100 %"
    for mode in ("Result", "Slider", "Side by side"):
        page.get_by_label(mode, exact=True).check()
        page.set_viewport_size({"width": 900 + 10 * len(mode), "height": 700})
        settle(page)
        assert size.inner_text() == "100 %"
    page.set_viewport_size({"width": 1100, "height": 760})
    page.get_by_role("button", name="Fit").click()
    assert size.inner_text() == fitted
    page.locator("glass-compare").focus()
    page.keyboard.press("1")
    assert size.inner_text() == "100 %"


def test_a_text_file_and_a_tiff_have_the_right_button_and_thumbnail(open_page):
    """Chromium cannot decode TIFF, like HEIC."""
    page = open_page()
    tiff = Photo.open(PHOTOS[0][1]).encode("tiff")
    upload(page, ("notes.txt", b"some text"), ("a.tiff", tiff))
    assert page.locator("#discard").get_attribute("class") == "main"
    assert page.locator("#retry").get_attribute("class") == "quiet"
    page.wait_for_function("() => document.querySelectorAll('#photos img')[1].naturalWidth > 1")


def test_the_zip_of_a_burst_and_a_photo_contains_the_chosen_layers(open_page):
    page = open_page()
    layers = ("transmission", "confidence")
    as_burst(page)
    upload(page, ("a.png", image_bytes(80, 60, "png")))
    for layer in ("transmission", "reflection", "confidence"):
        page.locator(f"input[name=zip][value={layer}]").set_checked(layer in layers)
    _, data = downloaded(page, page.get_by_role("button", name="Download all").click)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        expected = [f"{name}.{layer}.png" for name in "2a" for layer in layers]
        assert archive.namelist() == [*expected, "brewster-report.txt"]
    for layer in layers:
        page.locator(f"input[name=zip][value={layer}]").uncheck()
    assert page.get_by_role("button", name="Download all").is_disabled()
