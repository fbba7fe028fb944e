"""At 1:1 the page shows the pixels of the photo and of its layers, tested in a real browser with a
real server.
"""

import base64
import math

import numpy as np
import pytest

from brewster import Photo
from cli_helpers import image_bytes
from page_helpers import difference, settle, upload

SIZE = 2600, 1500
VIEW = {"viewport": {"width": 1000, "height": 700}}


@pytest.fixture
def large_page(open_page):
    """The page with a photo that is larger than its preview, at 1:1, and the photo."""
    data = image_bytes(*SIZE, "png")
    page = open_page(**VIEW)
    upload(page, ("large.png", data))
    page.get_by_role("button", name="1:1").click()
    return page, data


def view(page):
    """The pixels on the screen, when all tiles have arrived."""
    page.wait_for_selector("glass-compare[aria-busy=false]")
    settle(page)
    page.wait_for_selector("glass-compare[aria-busy=false]")
    value = page.evaluate("document.querySelector('glass-compare canvas').toDataURL()")
    return Photo.open(base64.b64decode(value.partition(",")[2])).pixels


def middle(pixels, shape):
    """The middle of an image, with the shape of a view; a half pixel is rounded as on the page."""
    top, left = (
        -math.floor((view - full + 1) / 2)
        for view, full in zip(shape, pixels.shape[:2], strict=False)
    )
    return pixels[top : top + shape[0], left : left + shape[1]]


def test_at_one_to_one_each_screen_pixel_is_a_pixel_of_the_result(large_page, run):
    page, data = large_page
    page.get_by_label("Result", exact=True).check()
    page.get_by_label("Strength", exact=True).fill("0.7")
    for layer in ("transmission", "reflection"):
        page.get_by_label(layer.capitalize(), exact=True).check()
        settle(page)
        shown = view(page)
        made = Photo.open(run("-", "--strength", 0.7, "--layers", layer, stdin=data)[1]).pixels
        assert difference(shown, middle(made, shown.shape)).max() <= 2


def test_beyond_one_to_one_a_photo_pixel_is_a_square(large_page):
    page, data = large_page
    photo = Photo.open(data).pixels
    page.keyboard.press("b")  # the photo in place of the result
    shown = view(page)
    assert (shown == middle(photo, shown.shape)).all()
    for _ in range(2):
        page.get_by_role("button", name="Zoom in").click()
    assert page.locator("#zoom output").inner_text() == "400 %"
    shown = view(page)
    changes = np.flatnonzero((np.diff(shown.astype(int), axis=1) != 0).any(axis=(0, 2))) + 1
    assert len(changes)
    assert len(set(changes % 4)) == 1  # all edges of squares are multiples of 4 apart


def test_a_photo_that_the_server_has_dropped_is_sent_again_once(open_page):
    page = open_page(**VIEW)
    upload(page, ("large.png", image_bytes(*SIZE, "png")))
    sent = []
    refused = []

    def refuse(route):
        if sent:
            route.continue_()
        else:
            refused.append(route.request.url)
            route.fulfill(status=404, json={"error": "dropped"})

    page.route("**/tile/**", refuse)
    page.on(
        "response",
        lambda answer: sent.append(answer.url) if answer.url.endswith("/photos") else None,
    )
    page.get_by_role("button", name="1:1").click()
    view(page)
    assert len(refused) > 1
    assert len(sent) == 1
