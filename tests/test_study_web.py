"""The HTTP API of the study: what a participant receives, and what no response contains."""

import re
from contextlib import closing
from dataclasses import asdict
from itertools import product

import pytest

from brewster.evaluation.study.store import AnswerStore
from brewster.web.application import create_app
from brewster.web.middleware import AccessPolicy
from brewster.web.study import study_router
from small_studies import copy_without_answers, make_study
from web_servers import request

TOKEN = "a-token-for-the-tests"


@pytest.fixture(scope="module")
def study_with_pictures(tmp_path_factory):
    return make_study(
        tmp_path_factory.mktemp("study_with_pictures"), consent="First.\n\n<b>Second</b>."
    )


@pytest.fixture
def study(study_with_pictures, tmp_path):
    return copy_without_answers(study_with_pictures, tmp_path / "study")


@pytest.fixture
def store(study):
    with closing(AnswerStore(study)) as store:
        yield store


@pytest.fixture
def app(study, store):
    return app_of(study, store)


def app_of(study, store, policy=None, **options):
    return create_app(
        study_router(study, store, **options), policy=policy or AccessPolicy(), index="study.html"
    )


def admit_participant(app):
    response = request(app, "POST", "/participants", json={"agreed": True})
    assert response.status_code == 201
    return response.json()["link"]


def post_answer(app, link, trial, choice="left", seconds=2.5):
    given = {"trial": trial, "choice": choice, "seconds": seconds}
    return request(app, "POST", f"{link}/answers", json=given)


def test_a_participant_who_agrees_gets_a_link_and_all_trials(app, store):
    invitation = request(app, "GET", "/invitation").json()
    assert invitation == {"consent": "First.\n\n<b>Second</b>.", "trials": 8}
    link = admit_participant(app)
    state = request(app, "GET", f"{link}/trial").json()
    for trial in range(8):
        assert state["practice"] is None or trial == 0
        assert state | {"practice": None} == {
            "trial": trial, "trials": 8, "width": 24, "height": 18,
            "practice": None, "last": trial - 1 if trial else None,
        }  # fmt: skip
        response = post_answer(app, link, trial, "similar").json()
        assert response["kept"] == "similar"
        state = response["next"]
    assert state["trial"] is None
    ((_, answers),) = store.all_answers()
    assert [answer.seconds for answer in answers.values()] == [2.5] * 8


def test_no_response_contains_a_method_a_dataset_or_a_file_name(app, store, study):
    link = admit_participant(app)
    paths = ["/", link, f"{link}/trial", "/invitation", "/privacy", "/openapi.json"]
    paths += [f"/page/{name}" for name in ("study.js", "study.css", "pan_zoom.js", "style.css")]
    pictures = product(("practice", *range(8)), ("photo", "left", "right"))
    paths += [f"{link}/pictures/{trial}/{side}" for trial, side in pictures]
    responses = [request(app, "GET", path) for path in paths]
    responses += [post_answer(app, link, trial) for trial in (0, 99)]
    names = {picture.name.removesuffix(".png") for picture in study.description.pictures}
    for response in responses:
        sent = b"\n".join(
            [*(b"%s: %s" % pair for pair in response.headers.raw), response.content]
        ).lower()
        for word in ("secretlus", "rivalino", "nature/", *names):
            assert word.encode() not in sent
        if response.headers["content-type"] == "image/png":  # no header reveals the age of the file
            assert not {"etag", "last-modified", "content-disposition"} & set(response.headers)


def test_the_practice_pair_has_a_known_answer_and_its_pictures(app, store, study):
    link = admit_participant(app)
    practice = request(app, "GET", f"{link}/trial").json()["practice"]
    trial = store.participant(link.removeprefix("/s/")).practice
    assert practice == {"width": 24, "height": 18, "expected": trial.expected}
    better = getattr(trial, practice["expected"])
    assert better in {catch.good for catch in study.description.catch_pool}
    assert {trial.left, trial.right} - {better} <= {
        catch.degraded for catch in study.description.catch_pool
    }
    for side in ("photo", "left", "right"):
        shown = request(app, "GET", f"{link}/pictures/practice/{side}").content
        assert shown == study.picture_file(getattr(trial, side)).read_bytes()


def test_only_the_last_answer_can_be_withdrawn_and_a_second_withdrawal_changes_nothing(app, store):
    link = admit_participant(app)
    for trial in range(2):
        post_answer(app, link, trial, "left")
    refused = request(app, "POST", f"{link}/withdrawals", json={"trial": 0})
    assert (refused.status_code, "only the last answer" in refused.json()["error"]) == (422, True)
    for _ in range(2):
        state = request(app, "POST", f"{link}/withdrawals", json={"trial": 1}).json()
        assert (state["trial"], state["last"]) == (1, 0)
    assert post_answer(app, link, 1, "right").json()["kept"] == "right"
    ((_, answers),) = store.all_answers()
    stored = [(answer.choice, answer.withdrawn) for answer in answers.values()]
    assert stored == [("left", ()), ("right", ("left",))]


def test_viewing_conditions_are_stored_and_others_are_refused(app, store):
    conditions = {
        "viewport_width": 1280,
        "viewport_height": 800,
        "pixel_ratio": 1.5,
        "picture_width": 417,
        "theme": "dark",
        "pointer": "fine",
        "view": "single",
        "switches": 3,
        "zoomed": False,
    }
    link = admit_participant(app)
    given = {"trial": 0, "choice": "left", "seconds": 2}
    for wrong in ({"theme": "red"}, {"viewport_width": -1}, {"user_agent": "x"}):
        body = given | {"conditions": conditions | wrong}
        assert request(app, "POST", f"{link}/answers", json=body).status_code == 422
    request(app, "POST", f"{link}/answers", json=given | {"conditions": conditions})
    ((_, answers),) = store.all_answers()
    assert asdict(answers[0].conditions) == conditions
    assert re.fullmatch(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", answers[0].answered_at)


@pytest.mark.parametrize(
    "wrong",
    [{"trial": -1}, {"choice": "both"}, {"seconds": "long"}, {"more": 1}, {"seconds": None}],
)
def test_an_invalid_answer_is_refused_with_a_message(app, store, wrong):
    given = {"trial": 0, "choice": "left", "seconds": 1} | wrong
    response = request(app, "POST", f"{admit_participant(app)}/answers", json=given)
    assert (response.status_code, response.json()["error"].count("; ")) == (422, 2)
    assert [len(answers) for _, answers in store.all_answers()] == [0]


def test_without_agreement_there_is_no_link(app, store):
    for body in ({}, {"agreed": False}, {"agreed": True, "name": "Jo"}):
        assert request(app, "POST", "/participants", json=body).status_code == 422
    assert store.count_participants() == 0


def test_an_unknown_link_is_an_error(app):
    for path in ("/s/nobody/trial", "/s/nobody/link", "/s/nobody/pictures/0/left"):
        response = request(app, "GET", path)
        assert response.status_code == 404
        assert "/s/nobody is unknown; expected" in response.json()["error"]
    assert post_answer(app, "/s/nobody", 0).status_code == 404
    whole = request(app, "GET", "/s/nobody")
    assert (whole.status_code, "<title>Compare pictures" in whole.text) == (404, True)


def test_a_full_study_admits_no_one_else_and_its_participants_can_continue(study, store):
    app = app_of(study, store, max_participants=1)
    link = admit_participant(app)
    invited = request(app, "GET", "/invitation")
    refused = request(app, "POST", "/participants", json={"agreed": True})
    assert invited.status_code == refused.status_code == 403
    assert invited.json()["error"] == refused.json()["error"]
    assert "has all the participants that it needs (1);" in refused.json()["error"]
    assert post_answer(app, link, 0).status_code == 200


def test_a_personal_link_contains_the_token_of_the_server(study, store):
    app = app_of(study, store, AccessPolicy(token=TOKEN), token=TOKEN)
    assert request(app, "POST", "/participants", json={"agreed": True}).status_code == 401
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    link = request(app, "POST", "/participants", json={"agreed": True}, headers=bearer).json()[
        "link"
    ]
    participant, _, token = link.partition("?token=")
    assert token == TOKEN
    assert request(app, "GET", f"{participant}/link", headers=bearer).json()["link"] == link
    assert request(app, "GET", participant).status_code == 401
    assert "Refresh" in request(app, "GET", link).headers


def test_all_assets_of_the_page_are_served_locally(app):
    page = request(app, "GET", "/").text
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(links) >= 4
    assert all(link.startswith(("/page/", "/privacy")) for link in links)
    assert all(request(app, "GET", link).status_code == 200 for link in links)


def test_an_answer_that_cannot_be_written_is_not_acknowledged_and_can_be_sent_again(app, store):
    link = admit_participant(app)
    store._database.execute("PRAGMA query_only = ON")  # like a full or read-only disk
    refused = post_answer(app, link, 0)
    assert refused.status_code == 500  # the page repeats requests that fail with 500 or more
    assert refused.json()["error"].startswith("answers.sqlite cannot be used")
    store._database.execute("PRAGMA query_only = OFF")
    assert post_answer(app, link, 0, "right").json()["kept"] == "right"


def test_a_missing_picture_is_a_permanent_error(tmp_path):
    study = make_study(tmp_path)
    with closing(AnswerStore(study)) as store:
        app = app_of(study, store)
        link = admit_participant(app)
        trial = store.participant(link.removeprefix("/s/")).trials[0]
        study.picture_file(trial.left).unlink()
        response = request(app, "GET", f"{link}/pictures/0/left")
    assert response.status_code == 410  # the page repeats requests that fail with 500 or more
    assert response.json()["error"].startswith("result A of pair 1 is missing on the server")
    assert trial.left.removesuffix(".png") not in response.text
