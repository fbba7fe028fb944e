"""A study as static files: export, answers in a browser, import, report."""

import json
import sqlite3
from contextlib import closing
from functools import partial
from http.server import SimpleHTTPRequestHandler

import pytest

from brewster.errors import BrewsterError
from brewster.user_study.answer_file import read_answer_file
from brewster.user_study.store import AnswerStore
from brewster.web.study_bundle import export_bundle
from file_server import on_loopback
from small_studies import make_study

pytestmark = pytest.mark.loopback

ANSWERED_AT = "2026-11-22T12:00:00.250Z"
CONDITIONS = {
    "viewport_width": 1280, "viewport_height": 720, "pixel_ratio": 1, "picture_width": 400, "theme": "dark",
    "pointer": "fine", "view": "all", "switches": 2, "zoomed": False,
}  # fmt: skip


@pytest.fixture
def study(tmp_path):
    return make_study(tmp_path, size=(240, 180), pairs=3, catch_trials=2)


@pytest.fixture
def store(study):
    with closing(AnswerStore(study)) as store:
        yield store


@pytest.fixture
def token(study, store, tmp_path):
    """The token of the only participant of a bundle."""
    (token,) = export_bundle(study, store, tmp_path / "bundle", participants=1)
    return token


@pytest.fixture
def answers(tmp_path):
    """Writes a file of answers."""

    def write(token, choices, **changes):
        given = {"seconds": 4.5, "answered_at": ANSWERED_AT, "conditions": CONDITIONS}
        rows = [{"trial": i, "choice": choice, **given} for i, choice in enumerate(choices)]
        content = {"format": 1, "participant": token, "consented_on": "2026-11-22", "answers": rows}
        path = tmp_path / "answers.json"
        path.write_text(json.dumps(content | changes))
        return path

    return write


def served_folder(folder):
    """Serves the files of a folder; yields its URL."""
    return on_loopback(partial(SimpleHTTPRequestHandler, directory=str(folder)), lambda url: f"{url}/")


def test_a_bundle_names_no_method_and_no_correct_choice(study, store, tmp_path):
    tokens = export_bundle(study, store, tmp_path / "bundle", participants=2)
    files = [path for path in (tmp_path / "bundle").rglob("*") if path.is_file()]
    text = "\n".join(path.read_text() for path in files if path.suffix != ".png")
    assert not any(word in text for word in ("Secretlus", "Rivalino", "nature", "study.json"))
    described = json.loads((tmp_path / "bundle" / "participants" / f"{tokens[0]}.json").read_text())
    assert len(described["trials"]) == 5
    assert all(trial.keys() == {"photo", "left", "right", "width", "height"} for trial in described["trials"])
    pictures = {path.name for path in (tmp_path / "bundle" / "pictures").glob("*.png")}
    assert {trial[side] for trial in described["trials"] for side in ("photo", "left", "right")} <= pictures
    assert not [path for path in files if '"/' in path.read_text("latin-1") and path.suffix == ".html"]
    for folder in ("participants", "pictures"):  # a web server then lists no files, and so no tokens
        assert (tmp_path / "bundle" / folder / "index.html").read_bytes() == b""


def test_participants_of_a_bundle_and_of_the_server_share_one_assignment(study, store, tmp_path):
    store.admit()
    (token,) = export_bundle(study, store, tmp_path / "bundle", participants=1)
    assert store.participant(token, exported=True).number == 1
    assert store.participant(token) is None  # the server does not accept the link without consent
    assert store.participant(store.admit()).number == 2


def test_imported_answers_are_stored_once(store, answers, token):
    withdrawn = [{"trial": 1, "choice": "similar", "seconds": 1e9, "answered_at": ANSWERED_AT}]
    path = answers(token, ["left", "right"], withdrawn=withdrawn)
    assert [store.import_answers(read_answer_file(path)) for _ in range(2)] == [2, 0]
    changed = answers(token, ["right", "right", "left"])
    assert store.import_answers(read_answer_file(changed)) == 1
    ((_, stored),) = store.all_answers()
    assert [answer.choice for answer in stored.values()] == ["left", "right", "left"]
    assert (stored[0].answered_at, stored[0].conditions.theme) == ("2026-11-22T12:00:00+00:00", "dark")
    assert stored[1].withdrawn == ("similar",)


def test_the_date_of_the_consent_is_that_of_the_first_import(study, store, answers, token):
    for day in ("2026-11-22", "2026-11-23"):
        store.import_answers(read_answer_file(answers(token, ["left"], consented_on=day)))
    with closing(sqlite3.connect(study.answers_file)) as database:
        assert database.execute("SELECT consented_on FROM participants").fetchall() == [("2026-11-22",)]


def test_an_answer_that_was_withdrawn_is_not_imported_from_an_earlier_file(store, answers, token):
    withdrawn = [{"trial": 1, "choice": "left", "seconds": 4.5, "answered_at": ANSWERED_AT}]
    store.import_answers(read_answer_file(answers(token, ["left"], withdrawn=withdrawn)))
    assert store.import_answers(read_answer_file(answers(token, ["left", "left"]))) == 0


def test_an_answer_of_an_earlier_file_that_was_withdrawn_is_replaced(store, answers, token):
    earlier = read_answer_file(answers(token, ["left", "left"]))
    store.import_answers(earlier)
    withdrawn = [{"trial": 1, "choice": "left", "seconds": 4.5, "answered_at": ANSWERED_AT}]
    later = answers(token, ["left", "right"], withdrawn=withdrawn)
    assert [store.import_answers(read_answer_file(later)) for _ in range(2)] == [1, 0]
    ((_, stored),) = store.all_answers()
    choices = [(answer.choice, answer.withdrawn) for answer in stored.values()]
    assert choices == [("left", ()), ("right", ("left",))]


@pytest.mark.parametrize(("changes", "message"), [
    ({"participant": "../../x"}, "who is not in this study"), ({"format": 2}, "format"), ({"extra": 1}, "extra"),
    ({"answers": [{"trial": 5, "choice": "left", "seconds": 1, "answered_at": ANSWERED_AT}]}, "trial 5"),
    ({"answers": [{"trial": 0, "choice": "up", "seconds": 1, "answered_at": ANSWERED_AT}]}, "0.choice"),
    ({"answers": [{"trial": 0, "choice": "left", "seconds": 1, "answered_at": "2026-11-22"}]}, "answered_at"),
])  # fmt: skip
def test_an_invalid_file_of_answers_is_refused_and_stores_nothing(changes, message, store, answers, token):
    with pytest.raises(BrewsterError, match=message):
        store.import_answers(read_answer_file(answers(token, ["left"], **changes)))
    ((_, stored),) = store.all_answers()
    assert not stored
    assert store.participant(token) is None


def test_the_commands_export_links_and_import_files(run_without_model, study, answers, tmp_path):
    (tmp_path / "bad.json").write_text("{}")
    options = ("-o", "bundle", "--participants", 2, "--url", "https://example.org/study")
    code, out, err = run_without_model("study", "export", "study", *options)
    links = out.decode().split()
    assert (code, len(links)) == (0, 2)
    assert all(link.startswith("https://example.org/study/?p=") for link in links)
    path = answers(links[1].split("=")[1], ["left"])
    code, _, err = run_without_model("study", "import", "study", "bad.json", path.name)
    assert code == 1
    assert "bad.json is not a valid file of answers" in err
    assert "answers.json: 1 new answers of 1" in err
    answers("nobody", ["left"])
    assert "error: answers.json: " in run_without_model("study", "import", "study", path.name)[2]
    code, out, _ = run_without_model("study", "progress", "study", "--json")
    assert [row["answers"] for row in json.loads(out)["rows"]] == [0, 1]


def test_a_participant_answers_in_a_browser_and_the_file_is_imported(store, token, new_page, tmp_path):
    from playwright.sync_api import expect  # noqa: PLC0415

    page = new_page()
    with served_folder(tmp_path / "bundle") as url:
        page.goto(f"{url}?p=0000000000000000")
        page.get_by_text("The link with ?p=0000000000000000 is unknown.").wait_for()
        page.route("**/participants/*", lambda route: route.abort())
        page.goto(f"{url}?p={token}")
        page.get_by_text("Your list of pairs could not be loaded.").wait_for()
        page.unroute("**/participants/*")
        page.goto(f"{url}?p={token}")
        page.get_by_role("checkbox").check()
        page.get_by_role("button", name="Begin").click()
        for title, key in (("Practice: not counted", "1"), *((f"Pair {i} of 5", "2") for i in range(1, 6))):
            page.get_by_text(title, exact=True).first.wait_for()
            page.wait_for_selector("#trial:not(.waiting):not([hidden])")
            page.wait_for_timeout(320)
            page.keyboard.press(key)
            if title == "Pair 2 of 5":
                page.get_by_text("Pair 3 of 5", exact=True).first.wait_for()
                page.reload()  # the browser has stored the answers
                page.get_by_text("Pair 3 of 5", exact=True).first.wait_for()
                page.get_by_role("button", name="Undo the last answer").click()
                page.get_by_text("Pair 2 of 5", exact=True).first.wait_for()
                page.wait_for_selector("#trial:not(.waiting):not([hidden])")
                page.wait_for_timeout(320)
                page.keyboard.press("3")
        page.get_by_role("heading", name="Thank you.").wait_for()
        expect(page.get_by_text("You can close this page.", exact=True)).to_be_hidden()
        with page.expect_download() as waiting:
            page.get_by_role("button", name="Download your answers").click()
        path = tmp_path / waiting.value.suggested_filename
        waiting.value.save_as(path)
        page.goto(f"{url}privacy.html")
        expect(page.get_by_text("Your browser keeps your answers")).to_be_visible()
    assert path.name == f"answers-{token[:8]}.json"
    assert store.import_answers(read_answer_file(path)) == 5
    ((_, stored),) = store.all_answers()
    assert [answer.choice for answer in stored.values()] == ["similar", "right", *["similar"] * 3]
    assert stored[1].withdrawn == ("similar",)
    assert all(answer.conditions.viewport_width == 1280 for answer in stored.values())
