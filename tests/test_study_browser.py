"""The page of the study in a real browser: keyboard, phone, interruptions, and a failing server."""

from contextlib import closing

import numpy as np
import pytest
from playwright.sync_api import expect

from brewster import Photo
from brewster.evaluation.study.store import AnswerStore
from brewster.web.application import create_app
from brewster.web.middleware import AccessPolicy
from brewster.web.study import study_router
from small_studies import copy_without_answers, make_study
from web_servers import served_port

pytestmark = pytest.mark.loopback

expect.set_options(timeout=60_000)  # for slow machines
READY = "#trial:not(.waiting):not([hidden])"


@pytest.fixture(scope="module")
def study_with_pictures(tmp_path_factory):
    return make_study(
        tmp_path_factory.mktemp("study_with_pictures"), size=(240, 180), catch_trials=0
    )


@pytest.fixture
def store(study_with_pictures, tmp_path):
    with closing(
        AnswerStore(copy_without_answers(study_with_pictures, tmp_path / "study"))
    ) as store:
        yield store


@pytest.fixture
def url(store):
    app = create_app(study_router(store.study, store), policy=AccessPolicy(), index="study.html")
    with served_port(app) as port:
        yield f"http://127.0.0.1:{port}/"


def press(page, key):
    """Presses a key after the time in which the page ignores answers."""
    page.wait_for_selector(READY)
    page.wait_for_timeout(320)
    page.keyboard.press(key)


def begin(page):
    page.get_by_role("checkbox").check()
    page.get_by_role("button", name="Begin").click()
    expect(page.get_by_text("Practice: not counted").first).to_be_visible()
    press(page, "1")
    expect(page.get_by_text("Pair 1 of 4", exact=True).first).to_be_visible()
    page.wait_for_selector(READY)


def test_the_whole_study_works_with_the_keyboard_only(new_page, url, store):
    page = new_page()
    page.goto(url)
    page.wait_for_selector("#invitation:not([hidden])")
    for key in ("Tab", "Tab", "Space", "Tab", "Enter"):  # the first is the link to the privacy page
        page.keyboard.press(key)
    press(page, "2")  # the practice pair
    for trial, key in enumerate(["1", "2", "3", "ArrowLeft"]):
        expect(page.get_by_text(f"Pair {trial + 1} of 4", exact=True).first).to_be_visible()
        press(page, key)
    expect(page.get_by_role("heading", name="Thank you.")).to_be_focused()
    expect(page.get_by_text("All 4 answers are saved.")).to_be_visible()
    ((_, answers),) = store.all_answers()
    given = [answer.choice for answer in answers.values()]
    assert given == ["left", "similar", "right", "left"]
    assert all(0.3 < answer.seconds < 60 for answer in answers.values())
    shown = answers[0].conditions
    assert (shown.viewport_width, shown.viewport_height, shown.pixel_ratio) == (1280, 720, 1)
    assert (shown.theme, shown.pointer, shown.view, shown.switches) == ("light", "fine", "all", 0)


def test_the_pictures_of_the_trial_are_shown_on_their_sides_and_have_names(new_page, url, store):
    page = new_page(viewport={"width": 1280, "height": 800})
    page.goto(url)
    begin(page)
    ((participant, _),) = store.all_answers()
    page.wait_for_timeout(300)  # the fade-in of the pictures
    for side in ("left", "photo", "right"):
        shown = Photo.open(page.locator(f".{side} .frame").screenshot()).linear()
        expected = Photo.open(store.study.picture_file(getattr(participant.trials[0], side)))
        difference = np.abs(shown - expected.resized(*shown.shape[1::-1]))
        assert np.median(difference) < 0.002  # not the mean, because the browser smooths edges
    positions = [
        page.locator(f".{side} .frame").bounding_box()["x"] for side in ("left", "photo", "right")
    ]
    assert positions == sorted(positions)
    accessible = {
        "img": ["Result A", "Photo, with the reflection", "Result B"],
        "button": ["Zoom in", "Zoom out", "Show all", "Full size", "Copy your personal link"],
        "progressbar": ["Pair 1 of 4"],
    }
    for role, names in accessible.items():
        for name in names:
            expect(page.get_by_role(role, name=name)).to_be_visible()
    assert page.get_by_role("heading", level=1).all_inner_texts() == ["Which result looks better?"]


def test_the_last_answer_can_be_undone_also_after_the_last_trial(new_page, url, store):
    page = new_page()
    page.goto(url)
    begin(page)
    undo = page.get_by_role("button", name="Undo the last answer")
    expect(undo).to_be_hidden()
    press(page, "1")
    expect(page.get_by_text("Pair 2 of 4").first).to_be_visible()
    page.wait_for_selector(READY)
    undo.click()
    expect(page.get_by_text("Pair 1 of 4", exact=True).first).to_be_visible()
    page.wait_for_selector(READY)
    expect(undo).to_be_hidden()
    for trial in range(4):
        expect(page.get_by_text(f"Pair {trial + 1} of 4", exact=True).first).to_be_visible()
        press(page, "3")
    expect(page.get_by_role("heading", name="Thank you.")).to_be_visible()
    undo.click()
    expect(page.get_by_text("Pair 4 of 4", exact=True).first).to_be_visible()
    ((_, answers),) = store.all_answers()
    assert sorted(answers) == [0, 1, 2]
    assert (answers[0].choice, answers[0].withdrawn) == ("right", ("left",))


def test_an_answer_without_acknowledgement_is_sent_again(new_page, url, store):
    page = new_page()
    page.goto(url)
    begin(page)
    posts = []

    def fail(route):
        posts.append(route)
        if len(posts) > 1:
            route.continue_()
        else:  # the server stores it, but the acknowledgement is lost
            route.fetch()
            route.abort()

    page.route("**/answers", fail)
    press(page, "1")
    expect(page.get_by_text("not saved yet")).to_be_visible()
    page.keyboard.press("3")  # ignored while the first answer is sent
    expect(page.get_by_text("Pair 2 of 4").first).to_be_visible(timeout=15_000)
    ((_, answers),) = store.all_answers()
    assert [answer.choice for answer in answers.values()] == ["left"]
    assert len(posts) == 2


def test_a_phone_shows_everything_without_horizontal_scrolling_and_accepts_touch(
    new_page, url, store
):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    page = new_page(**phone, color_scheme="dark")
    page.goto(url)
    begin(page)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    names = "A is better", "Similar", "B is better"
    buttons = [page.get_by_role("button", name=name, exact=True) for name in names]
    boxes = [button.bounding_box() for button in buttons]
    assert all(box["height"] >= 44 and box["y"] + box["height"] <= 844 for box in boxes)
    shapes = [page.locator(f".{side} .frame").bounding_box() for side in ("left", "photo", "right")]
    assert all(box["width"] > 180 and box["x"] + box["width"] <= 390 for box in shapes)
    assert [box["width"] / box["height"] for box in shapes] == pytest.approx(
        [240 / 180] * 3, rel=0.02
    )
    page.wait_for_timeout(320)
    buttons[2].tap()
    expect(page.get_by_text("Pair 2 of 4").first).to_be_visible()
    ((_, answers),) = store.all_answers()
    assert answers[0].choice == "right"
