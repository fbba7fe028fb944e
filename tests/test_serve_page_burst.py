"""Bursts on the page, and the page on a phone, with small photos and with files that the browser cannot decode."""

import io
import zipfile

import pytest

from brewster import Photo
from cli_helpers import image_bytes
from page_helpers import downloaded, names_in_list, upload

PHOTOS = [(f"{number}.png", image_bytes(90, 60, "png", number)) for number in (1, 2, 3)]


def test_photos_of_one_size_can_be_one_burst_that_is_downloaded_and_split_again(open_page, run):
    """The photos are unrelated, so that the burst reports this and gives the result of the middle photo."""
    page = open_page()
    upload(page, *PHOTOS)
    page.get_by_role("heading", name="Are these photos of one window?").wait_for()
    page.get_by_role("button", name="Yes, one window").click()
    page.wait_for_selector("li.done")
    page.get_by_text("No other photo shows the same scene").wait_for()
    assert names_in_list(page) == ["3 \N{MULTIPLICATION SIGN} 2.png"]
    assert not page.locator("#burst").is_visible()
    page.get_by_label("Strength", exact=True).fill("0.5")
    name, data = downloaded(page, page.get_by_role("button", name="Download transmission").click)
    alone = Photo.open(run("-", "--strength", 0.5, stdin=PHOTOS[1][1])[1])
    assert name == "2.transmission.png"
    assert (Photo.open(data).pixels == alone.pixels).all()
    page.get_by_role("button", name="Remove 2.png").click()
    page.get_by_role("button", name="Undo removal").click()
    page.get_by_role("button", name="Separate the photos one by one").click()
    page.wait_for_selector("li.done >> nth=2")
    assert names_in_list(page) == ["1.png", "2.png", "3.png"]


def test_photos_of_two_sizes_and_the_answer_no_leave_the_list_as_it_is(open_page):
    page = open_page()
    upload(page, *PHOTOS[:2])
    page.get_by_role("button", name="No", exact=True).click()
    assert names_in_list(page) == ["1.png", "2.png"]
    upload(page, ("a.png", image_bytes(80, 60, "png")), ("b.png", image_bytes(60, 80, "png")))
    assert not page.locator("#burst").is_visible()


@pytest.mark.parametrize("mode", ["Slider", "Side by side"])
def test_one_to_one_is_always_100_percent_and_fit_shows_the_whole_photo_again(open_page, mode):
    page = open_page()
    upload(page, PHOTOS[0])
    page.get_by_label(mode, exact=True).check()
    size = page.locator(".zoom output")
    fitted = size.inner_text()
    assert fitted == "200 %"
    page.get_by_role("button", name="1:1").click()
    assert size.inner_text() == "100 %"
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
    page.wait_for_function("() => document.querySelectorAll('#photos img')[1].naturalWidth === 90")


@pytest.mark.parametrize("layers", [("confidence",), ("transmission", "confidence")])
def test_the_zip_of_a_burst_and_a_photo_contains_the_chosen_layers(open_page, layers):
    page = open_page()
    upload(page, *PHOTOS[:2])
    page.get_by_role("button", name="Yes, one window").click()
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
