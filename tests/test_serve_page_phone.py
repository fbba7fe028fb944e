"""The page on the screen of a phone, upright and across, with a finger."""

import pytest

from cli_helpers import image_bytes
from page_helpers import settle, upload

SCREENS = {"small": (320, 568), "upright": (390, 844), "across": (844, 390)}


@pytest.fixture(params=SCREENS)
def phone(request, open_page):
    """The page with two photos, on the screen of a phone."""
    width, height = SCREENS[request.param]
    page = open_page(viewport={"width": width, "height": height}, has_touch=True, is_mobile=True)
    upload(page, *((f"{name}.png", image_bytes(300, 200, "png", name)) for name in (1, 2)))
    return page


def box_of(page, selector):
    return page.locator(selector).bounding_box()


def test_the_page_is_not_wider_than_the_screen_and_its_text_can_be_read(phone):
    for tool in ("move", "protect", "erase"):
        phone.locator(f"input[name=tool][value={tool}]").check(force=True)
        settle(phone)
        screen = phone.viewport_size["width"]
        assert phone.evaluate("document.documentElement.scrollWidth") == screen
        small = phone.evaluate("""() => [...document.querySelectorAll("body *")]
            .filter((one) => one.checkVisibility()
                && parseFloat(getComputedStyle(one).fontSize) < 14
                && [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim()))
            .map((one) => one.outerHTML)""")
        assert small == []


def test_nothing_covers_the_picture_and_nothing_lies_on_it_while_marks_are_drawn(phone):
    phone.locator("input[name=tool][value=protect]").check(force=True)
    phone.evaluate("scrollTo(0, 0)")
    settle(phone)
    covering = phone.evaluate("""() => {
        const picture = document.querySelector("glass-compare");
        const { x, y, width, height } = picture.getBoundingClientRect();
        const found = new Set();
        for (let across = 0.02; across < 1; across += 0.04)
            for (let down = 0.02; down < 1; down += 0.04)
                found.add(document.elementFromPoint(x + across * width, y + down * height).tagName);
        return [...found];
    }""")
    assert covering == ["CANVAS"]
    picture = box_of(phone, "glass-compare")
    assert picture["height"] > 0.4 * phone.viewport_size["height"]


def test_picture_and_strength_are_shown_together(phone):
    phone.locator("#strength").scroll_into_view_if_needed()
    settle(phone)
    picture, strength = box_of(phone, "glass-compare"), box_of(phone, "#strength")
    screen = phone.viewport_size["height"]
    assert picture["y"] >= 0
    assert picture["y"] + picture["height"] <= screen
    assert strength["y"] + strength["height"] <= screen
    is_beside = strength["x"] >= picture["x"] + picture["width"]
    assert is_beside or strength["y"] >= picture["y"] + picture["height"]


def test_a_finger_on_the_result_shows_the_photo_while_it_stays(phone):
    phone.get_by_label("Result", exact=True).check(force=True)
    picture = box_of(phone, "glass-compare")
    at = {"x": picture["x"] + picture["width"] / 2, "y": picture["y"] + picture["height"] / 2}
    finger = phone.context.new_cdp_session(phone)
    shown = []
    for kind, points in (("touchStart", [at]), ("touchEnd", [])):
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        shown.append(phone.evaluate("compare.isBefore"))
    assert shown == [True, False]


def test_the_picture_is_at_the_top_of_the_screen_after_photos_were_added(phone):
    assert phone.evaluate("scrollY") == 0
    assert box_of(phone, "glass-compare")["y"] < 0.2 * phone.viewport_size["height"]
