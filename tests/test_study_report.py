"""The report on simulated participants with known preferences."""

import csv
import io
import json
import re

import numpy as np
import pytest

from brewster.evaluation.study.assignment import Trial, draw_trials
from brewster.evaluation.study.report.participants import (
    ExclusionRule,
    ParticipantAnswers,
    collect_answers,
    outcome,
)
from brewster.evaluation.study.report.results import AVERAGES, summarise, write
from brewster.evaluation.study.report.tables import to_latex, to_markdown
from brewster.evaluation.study.store import Participant, StoredAnswer
from brewster.evaluation.study.study import Study
from small_studies import choice_for, make_description

RATES = np.array([0.45, 0.28, 0.27])


@pytest.mark.parametrize(
    ("flipped", "choice", "means"),
    [
        (False, "left", 0),
        (False, "right", 2),
        (True, "left", 2),
        (True, "right", 0),
        (True, "similar", 1),
    ],
)
def test_the_outcome_of_a_choice_depends_on_the_side_of_the_first_method(flipped, choice, means):
    assert outcome(Trial("", "", "", 0, flipped), choice) == means


def participant_answers(**fields):
    passed = {"number": 0, "votes": {0: 1}, "catch_trials": 4, "failed": 0, "seconds": 5.0}
    return ParticipantAnswers(is_complete=True, **passed | fields)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, None),
        ({"failed": 1}, None),
        ({"failed": 2}, "failed"),
        ({"failed": 3, "seconds": 0.1}, "failed"),
        ({"seconds": 1.49}, "fast"),
        ({"seconds": 1.5}, None),
        ({"catch_trials": 0}, None),
        ({"catch_trials": 1, "failed": 1}, "failed"),
    ],
)
def test_the_rule_excludes_participants_who_fail_catch_trials_or_are_too_fast(fields, reason):
    assert ExclusionRule().reason(participant_answers(**fields)) == reason


def simulate_participant(
    description, number, rng, probabilities, *, catch_trials=1.0, seconds=6.0, trials=None
):
    """A participant who chooses outcomes with these probabilities and passes this share of the
    catch trials.
    """
    row = draw_trials(description, number)
    answers = {}
    for i, trial in enumerate(row[:trials]):
        if trial.expected is None:
            choice = choice_for(trial, rng.choice(3, p=probabilities))
        else:
            wrong = "left" if trial.expected != "left" else "right"
            choice = trial.expected if rng.random() < catch_trials else wrong
        answers[i] = StoredAnswer(choice, seconds * rng.uniform(0.5, 2))
    return Participant(number, row, row[0]), answers


@pytest.fixture(scope="module")
def hundred_participants(tmp_path_factory):
    """100 participants x 40 pairs of three methods; five fail all catch trials, and five are too
    fast.
    """
    description = make_description(
        pictures=50, methods=("ours", "R&D_Net", "DSIT"), pairs=40, catch_trials=4
    )
    rng = np.random.default_rng(4)
    records = [
        simulate_participant(
            description,
            number,
            rng,
            RATES if number >= 10 else [0, 0, 1],
            trials=20 if number == 99 else None,
            catch_trials=0.95 if number >= 5 else 0.0,
            seconds=0.6 if 5 <= number < 10 else 6.0,
        )
        for number in range(100)
    ]
    study = Study(tmp_path_factory.mktemp("hundred_participants"), description)
    participants = collect_answers(records)
    return study, participants, summarise(study, participants, ExclusionRule())


def test_the_results_of_a_hundred_simulated_participants_are_correct(hundred_participants):
    _, _, results = hundred_participants
    included = results["included"]
    everyone = results["everyone"]
    assert results["excluded"] == {"failed": 6, "fast": 4}
    assert (included["participants"], everyone["participants"], included["complete"]) == (
        90,
        100,
        89,
    )
    assert everyone["answers"] == included["answers"] + 400
    for table in included["tables"]:
        row = next(row for row in table["rows"] if row["key"] == "/average")
        for name, rate in zip(("win", "tie", "lose"), RATES, strict=True):
            assert row[name]["mean"] == pytest.approx(rate, abs=0.05)
            assert row[name]["low"] < row[name]["mean"] < row[name]["high"]
        with_excluded = next(
            row for row in everyone["tables"][0]["rows"] if row["key"] == "/average"
        )
        assert with_excluded["lose"]["mean"] > row["lose"]["mean"] + 0.03
    assert abs(included["agreement"]) < 0.05


def test_the_files_of_a_report_agree_with_each_other(hundred_participants, tmp_path):
    study, participants, results = hundred_participants
    write(results, study, participants, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text()) == results
    lines = list(csv.DictReader(io.StringIO((tmp_path / "answers.csv").read_text())))
    reasons = {int(line["participant"]): line["left_out"] for line in lines}
    assert [reasons[i] for i in range(5)] == ["failed"] * 5
    assert {reasons[i] for i in range(5, 10)} == {
        "failed",
        "fast",
    }  # one of them also fails catch trials
    assert {reasons[i] for i in range(10, 100)} == {""}
    catch_trials = [line for line in lines if line["kind"] == "catch"]
    assert len(lines) - len(catch_trials) == results["everyone"]["answers"]
    assert (
        sum(line["choice"] != line["expected"] for line in catch_trials)
        == results["everyone"]["failed"]
    )
    for line in lines:
        if line["kind"] == "comparison" and line["outcome"] != "tie":
            assert line[line["choice"]] == line["first" if line["outcome"] == "win" else "second"]
    outcomes = [
        row["outcome"] for row in lines if (row["second"], row["dataset"]) == ("DSIT", "real")
    ]
    row = next(row for row in results["everyone"]["tables"][1]["rows"] if row["key"] == "real")
    assert outcomes.count("win") / row["answers"] == pytest.approx(row["win"]["mean"], abs=1e-6)


def test_one_participant_gives_rates_without_intervals(hundred_participants):
    study, participants, _ = hundred_participants
    row = summarise(study, participants[20:21], ExclusionRule())["included"]["tables"][0]["rows"][
        -1
    ]
    assert row["win"]["mean"] is not None
    assert row["win"]["low"] is None


def test_a_rule_that_excludes_everyone_still_gives_the_results_of_all(hundred_participants):
    study, participants, _ = hundred_participants
    results = summarise(study, participants[:5], ExclusionRule())
    assert results["included"]["participants"] == 0
    assert to_latex(results).startswith("% the rule excludes everyone")
    assert "## All participants" in to_markdown(results)


def make_study_with_names(tmp_path, datasets, methods):
    description = make_description(pictures=3, datasets=datasets, methods=methods, catch_trials=0)
    rng = np.random.default_rng(5)
    study = Study(tmp_path, description)
    records = [simulate_participant(description, number, rng, RATES) for number in range(6)]
    return study, collect_answers(records)


def test_a_dataset_named_average_differs_from_the_average(tmp_path):
    study, participants = make_study_with_names(tmp_path, ("Average", "real"), ("ours", "RDNet"))
    results = summarise(study, participants, ExclusionRule())
    titles = {
        row["key"]: row["title"] for table in results["included"]["tables"] for row in table["rows"]
    }
    assert titles == {"Average": "Average (dataset)", "real": "real"} | AVERAGES
    for text in (to_latex(results), to_markdown(results)):
        assert len(re.findall(r"Average +[|&]", text)) in (1, 2)  # once for each group
        assert "Average (dataset)" in text
