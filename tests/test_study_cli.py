"""The commands `brewster study create, serve, report`."""

import json
import os
import re
import signal
import subprocess
import sys
from functools import partial

import httpx
import pytest

from brewster.evaluation.study.store import AnswerStore
from brewster.evaluation.study.study import read_study
from other_processes import started
from small_studies import choice_for, write_pictures

pytestmark = pytest.mark.loopback

get, post = (
    partial(ask, timeout=None) for ask in (httpx.get, httpx.post)
)  # the test has its own time limit


@pytest.fixture
def folders(tmp_path):
    for seed, name in enumerate(("inputs", "ours", "rdnet")):
        write_pictures(tmp_path / name, seed=seed)
    return ["--inputs", "inputs", "--method", "ours=ours", "--method", "RDNet=rdnet"]


@pytest.fixture
def study(run_without_model, folders, tmp_path):
    assert run_without_model("study", "create", "study", *folders, "--seed", 4)[0] == 0
    return read_study(tmp_path / "study")


def add_answers(study, participants, rng):
    store = AnswerStore(study)
    for _ in range(participants):
        participant = store.participant(store.admit())
        for number, trial in enumerate(participant.trials):
            choice = trial.expected or choice_for(trial, rng.choice(3, p=[0.6, 0.2, 0.2]))
            store.record_answer(participant, number, choice, seconds=4)
    store.close()


def test_create_exits_with_1_for_wrong_files_and_2_for_wrong_arguments(
    run_without_model, folders, tmp_path
):
    assert run_without_model("study", "create", "study", *folders[:4])[0] == 1
    code, _, err = run_without_model("study", "create", "study", *folders, "--method", "ours=rdnet")
    assert (code, "share a name" in err) == (1, True)
    assert run_without_model("study", "create", "study", *folders, "--method", "nameless")[0] == 2
    assert not (tmp_path / "study").exists()


def test_report_prints_tables_and_writes_all_files(run_without_model, study, rng):
    add_answers(study, 12, rng)
    code, out, err = run_without_model("study", "report", "study")
    assert code == 0
    assert "### ours and RDNet" in out.decode()
    assert "12 participants (12 complete), 48 answers; 0 of 48 catch trials failed." in out.decode()
    assert "the report is in study/report" in err
    names = {path.name for path in (study.folder / "report").iterdir()}
    assert names == {"report.json", "report.md", "table.tex", "answers.csv"}
    code, out, _ = run_without_model(
        "study", "report", "study", "--json", "--min-seconds", 99
    )  # replaces the first
    assert json.loads(out)["excluded"] == {"failed": 0, "fast": 12}


def test_progress_counts_participants_and_answers_without_results(run_without_model, study, rng):
    add_answers(study, 2, rng)
    code, out, _ = run_without_model("study", "progress", "study", "--max-failed", 0.5)
    assert code == 0
    text = out.decode()
    assert text.startswith("2 participants, 2 complete")
    assert not re.search(r"\b(win|lose|ours|RDNet)\b", text)
    found = json.loads(run_without_model("study", "progress", "study", "--json")[1])
    assert (found["participants"], found["answers"], found["excluded"]) == (2, 8, 0)


def test_create_uses_only_the_inputs_that_are_named(run_without_model, folders, tmp_path):
    only = ("--only", "real/2", "--only", "nature/1.png")
    assert run_without_model("study", "create", "study", *folders, *only)[0] == 0
    comparisons = read_study(tmp_path / "study").description.comparisons
    assert {(row.dataset, row.name) for row in comparisons} == {("real", "2"), ("nature", "1")}


def test_create_uses_only_the_inputs_of_a_list(run_without_model, folders, tmp_path):
    (tmp_path / "list.txt").write_text("real/2.png\n\nnature/1\n")
    assert run_without_model("study", "create", "study", *folders, "--list", "list.txt")[0] == 0
    comparisons = read_study(tmp_path / "study").description.comparisons
    assert {(row.dataset, row.name) for row in comparisons} == {("real", "2"), ("nature", "1")}
    for text, message in ("real/3\n", "no picture for these names: real/3"), ("\n", "is empty"):
        (tmp_path / "list.txt").write_text(text)
        code, _, err = run_without_model("study", "create", "other", *folders, "--list", "list.txt")
        assert (code, message in err) == (1, True)


ON_LOOPBACK = """
import sys
from brewster.cli import main
from brewster.web import application
listen = application.listen
application.listen = lambda host, port: listen("127.0.0.1", port)
sys.exit(main(sys.argv[1:]))
"""
"""A program that runs the command line; servers bind to a loopback address, independent of --host.
"""


def serve_study(folder, *args):
    """Starts a server process, which is killed at the end if it still runs. Its first line of
    output is a link.
    """
    command = [sys.executable, "-c", ON_LOOPBACK, "study", "serve", folder, "--port", "0", *args]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return started(command, **pipes, env={**os.environ, "PYTHONUNBUFFERED": "1"})


def stop_server(server):
    """Stops a server with Ctrl-C; returns its standard error."""
    server.send_signal(signal.SIGINT)
    return server.communicate()[1]


def test_a_server_continues_after_a_kill_and_stops_with_ctrl_c(study):
    with serve_study(study.folder) as first:
        url = first.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url)
        link = post(f"{url}participants", json={"agreed": True}).json()["link"]
        given = {"trial": 0, "choice": "right", "seconds": 3}
        assert post(f"{url}{link[1:]}/answers", json=given).json()["kept"] == "right"
    with serve_study(study.folder, "--host-name", "study.example") as second:
        url = second.stdout.readline().strip()
        state = get(f"{url}{link[1:]}/trial", headers={"Host": "study.example"}).json()
        assert state["trial"] == 1
        assert "all answers are stored" in stop_server(second)
    assert second.returncode == 0


def test_serving_a_study_whose_pictures_changed_is_refused(run_without_model, study):
    next((study.folder / "pictures").iterdir()).unlink()
    code, _, err = run_without_model("study", "serve", "study")
    assert (code, "missing or changed" in err) == (1, True)


def test_an_automatic_token_is_stored_for_its_owner_only_and_links_survive_a_restart(study):
    with serve_study(study.folder, "--token", "auto") as first:
        url, _, token = first.stdout.readline().strip().partition("?token=")
        bearer = {"Authorization": f"Bearer {token}"}
        link = post(f"{url}participants", json={"agreed": True}, headers=bearer).json()["link"]
    path = study.folder / "token"
    assert path.read_text().strip() == token
    assert path.stat().st_mode & 0o777 == 0o600
    with serve_study(study.folder, "--token", "auto") as second:
        url = second.stdout.readline().strip().partition("?")[0]
        assert get(url + link[1:]).status_code == 200
        stop_server(second)


@pytest.mark.parametrize(
    "name",
    [
        "study.example.org:443",
        "https://study.example.org",
        "study.example.org/",
        "",
        "bücher.example",
    ],
)
def test_a_name_that_cannot_be_in_a_host_header_is_a_wrong_argument(run_without_model, study, name):
    code, _, err = run_without_model("study", "serve", "study", "--host-name", name, "--port", 0)
    assert (code, "is not a bare host name" in err) == (2, True)


def test_report_without_answers_creates_no_database(run_without_model, study):
    run_without_model("study", "report", "study")
    assert sorted(path.name for path in study.folder.iterdir()) == ["pictures", "study.json"]
