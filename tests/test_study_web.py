"""The HTTP API of the study: what a participant receives, and what no response contains."""

import re
from contextlib import closing

import numpy as np
import pytest

from brewster import Photo
from brewster.user_study.create import create
from brewster.user_study.store import AnswerStore
from brewster.web.application import create_app
from brewster.web.middleware import RequestLimits
from brewster.web.study import study_router
from small_studies import copy_without_answers, make_study
from web_servers import request

TOKEN = "a-token-nobody-guesses"


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return make_study(tmp_path_factory.mktemp("original"), consent="First.\n\n<b>Second</b>.")


@pytest.fixture
def study(original, tmp_path):
    return copy_without_answers(original, tmp_path / "study")


@pytest.fixture
def store(study):
    with closing(AnswerStore(study)) as store:
        yield store


@pytest.fixture
def app(study, store):
    return create_app(study_router(study, store), limits=RequestLimits(), index="study.html")


def begin(app):
    answer = request(app, "POST", "/participants", json={"agreed": True})
    assert answer.status_code == 201
    return answer.json()["link"]


def reply(app, link, trial, choice="left", seconds=2.5):
    return request(
        app, "POST", f"{link}/answers", json={"trial": trial, "choice": choice, "seconds": seconds}
    )


def test_a_participant_who_agrees_gets_a_link_and_all_trials(app, store):
    invitation = request(app, "GET", "/invitation").json()
    assert invitation == {"consent": "First.\n\n<b>Second</b>.", "trials": 8, "is_open": True}
    link = begin(app)
    state = request(app, "GET", f"{link}/trial").json()
    for trial in range(8):
        assert state == {"trial": trial, "trials": 8, "width": 24, "height": 18}
        answer = reply(app, link, trial, "similar").json()
        assert answer["kept"] == "similar"
        state = answer["next"]
    assert state["trial"] is None
    ((_, answers),) = store.all_answers()
    assert [answer.seconds for answer in answers.values()] == [2.5] * 8


def test_the_pictures_of_a_trial_are_those_that_were_drawn(app, store, study):
    link = begin(app)
    participant = store.participant(link.removeprefix("/s/"))
    for number, trial in enumerate(participant.trials):
        for side in ("photo", "left", "right"):
            answer = request(app, "GET", f"{link}/pictures/{number}/{side}")
            assert answer.content == study.picture_file(getattr(trial, side)).read_bytes()
            assert answer.headers["content-type"] == "image/png"


def test_no_response_contains_a_method_a_dataset_or_a_file_name(app, store, study):
    link = begin(app)
    paths = ["/", link, f"{link}/trial", "/invitation", "/openapi.json"]
    paths += [f"/page/{name}" for name in ("study.js", "study.css", "lens.js", "style.css")]
    paths += [f"{link}/pictures/{trial}/{side}" for trial in range(8) for side in ("photo", "left", "right")]
    answers = [request(app, "GET", path) for path in paths] + [reply(app, link, 0), reply(app, link, 99)]
    names = {picture.name.removesuffix(".png") for picture in study.description.pictures}
    for answer in answers:
        sent = b"\n".join([*(b"%s: %s" % pair for pair in answer.headers.raw), answer.content]).lower()
        for word in ("secretlus", "rivalino", "nature/", *names):
            assert word.encode() not in sent
        if answer.headers["content-type"] == "image/png":  # no header reveals the age of the file
            assert not {"etag", "last-modified", "content-disposition"} & set(answer.headers)


def test_an_answer_sent_twice_is_stored_once(app, store):
    link = begin(app)
    assert reply(app, link, 0, "left").json()["kept"] == "left"
    again = reply(app, link, 0, "right").json()
    assert (again["kept"], again["next"]["trial"]) == ("left", 1)
    ((_, answers),) = store.all_answers()
    assert len(answers) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"trial": -1, "choice": "left", "seconds": 1},
        {"trial": 0, "choice": "both", "seconds": 1},
        {"trial": 0, "choice": "left", "seconds": -1},
        {"trial": 0, "choice": "left", "seconds": 1, "more": 1},
        {"trial": 0, "choice": "left"},
    ],
)
def test_an_invalid_answer_is_refused_with_a_message(app, store, wrong):
    answer = request(app, "POST", f"{begin(app)}/answers", json=wrong)
    assert answer.status_code == 422
    assert answer.json()["error"]
    assert [len(answers) for _, answers in store.all_answers()] == [0]


def test_without_agreement_there_is_no_link(app, store):
    for body in ({}, {"agreed": False}, {"agreed": True, "name": "Jo"}):
        assert request(app, "POST", "/participants", json=body).status_code == 422
    assert store.count_participants() == 0


def test_an_unknown_link_is_an_error(app):
    for path in ("/s/nobody/trial", "/s/nobody/link", "/s/nobody/pictures/0/left"):
        answer = request(app, "GET", path)
        assert answer.status_code == 404
        assert "this link is unknown" in answer.json()["error"]
    assert reply(app, "/s/nobody", 0).status_code == 404
    whole = request(app, "GET", "/s/nobody")
    assert (whole.status_code, "<title>Compare pictures" in whole.text) == (404, True)


def test_trials_beyond_the_last_are_an_error(app):
    link = begin(app)
    for trial in (-1, 8):
        assert request(app, "GET", f"{link}/pictures/{trial}/left").status_code == 404
    assert request(app, "GET", f"{link}/pictures/0/middle").status_code == 422
    assert reply(app, link, 8).status_code == 404


def test_a_full_study_admits_nobody_and_its_participants_continue(study, store):
    app = create_app(
        study_router(study, store, max_participants=1), limits=RequestLimits(), index="study.html"
    )
    link = begin(app)
    assert not request(app, "GET", "/invitation").json()["is_open"]
    refused = request(app, "POST", "/participants", json={"agreed": True})
    assert refused.status_code == 403
    assert "all the participants" in refused.json()["error"]
    assert reply(app, link, 0).status_code == 200


def test_a_personal_link_contains_the_token_of_the_server(study, store):
    limits = RequestLimits(token=TOKEN)
    app = create_app(study_router(study, store, token=TOKEN), limits=limits, index="study.html")
    assert request(app, "POST", "/participants", json={"agreed": True}).status_code == 401
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    link = request(app, "POST", "/participants", json={"agreed": True}, headers=bearer).json()["link"]
    participant, _, token = link.partition("?token=")
    assert token == TOKEN
    assert request(app, "GET", f"{participant}/link", headers=bearer).json()["link"] == link
    assert request(app, "GET", participant).status_code == 401
    assert "Refresh" in request(app, "GET", link).headers


def test_a_16_bit_picture_is_shown_as_8_bit_srgb(tmp_path):
    """The pixels are those that `brewster evaluate` measures."""
    make_study(tmp_path, names=("a",))
    deep = Photo.from_array(np.full((18, 24, 3), 30_000, np.uint16), encoding="srgb")
    for folder in ("inputs", "Secretlus", "Rivalino"):
        deep.save(tmp_path / folder / "a.png", overwrite=True)
    methods = {name: tmp_path / name for name in ("Secretlus", "Rivalino")}
    study = create(tmp_path / "again", tmp_path / "inputs", methods)
    with closing(AnswerStore(study)) as store:
        app = create_app(study_router(study, store), limits=RequestLimits(), index="study.html")
        shown = Photo.open(request(app, "GET", f"{begin(app)}/pictures/0/photo").content)
    assert shown.pixels.dtype == np.uint8
    assert np.array_equal(shown.pixels, deep.srgb_8bit())


def test_all_assets_of_the_page_are_served_locally(app):
    page = request(app, "GET", "/").text
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(links) >= 4
    assert all(link.startswith("/page/") and request(app, "GET", link).status_code == 200 for link in links)


def test_an_answer_that_cannot_be_written_is_not_acknowledged_and_can_be_sent_again(app, store):
    link = begin(app)
    store._database.execute("PRAGMA query_only = ON")  # like a full or read-only disk
    refused = reply(app, link, 0)
    assert refused.status_code == 500  # the page repeats requests that fail with 500 or more
    assert refused.json()["error"].startswith("answers.sqlite cannot be used")
    store._database.execute("PRAGMA query_only = OFF")
    assert reply(app, link, 0, "right").json()["kept"] == "right"


def test_a_missing_picture_is_a_permanent_error(tmp_path):
    study = make_study(tmp_path)
    with closing(AnswerStore(study)) as store:
        app = create_app(study_router(study, store), limits=RequestLimits(), index="study.html")
        link = begin(app)
        trial = store.participant(link.removeprefix("/s/")).trials[0]
        study.picture_file(trial.left).unlink()
        answer = request(app, "GET", f"{link}/pictures/0/left")
    assert answer.status_code == 410  # the page repeats requests that fail with 500 or more
    assert answer.json()["error"].startswith("a picture is missing on the server")
    assert trial.left.removesuffix(".png") not in answer.text
