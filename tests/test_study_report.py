"""The report: simulated participants with known preferences, and comparisons with published and independent results."""

import csv
import io
import json
import re

import choix
import numpy as np
import pytest

from brewster import Photo
from brewster.user_study.assignment import Trial, draw_trials
from brewster.user_study.report.figure import plot
from brewster.user_study.report.participants import (
    ExclusionRule,
    ParticipantAnswers,
    collect_answers,
    outcome,
)
from brewster.user_study.report.results import AVERAGES, summarise, write
from brewster.user_study.report.statistics import (
    alpha,
    averages,
    bootstrap_interval,
    bootstrap_weights,
    intraclass_correlation,
    rates,
    resampled_counts,
    sign_flip_test,
    strengths,
)
from brewster.user_study.report.tables import to_csv, to_latex, to_markdown
from brewster.user_study.store import Participant, StoredAnswer
from brewster.user_study.study import Study
from small_studies import choice_for, make_description

RATES = np.array([0.45, 0.28, 0.27])
TABLE_3 = {  # of the paper: Real, Nature, Postcard, SolidObject, Wildscene, Average
    "RDNet": [
        (49.38, 21.25, 29.37), (35.00, 42.08, 22.92), (55.37, 18.66, 25.97),
        (41.43, 26.96, 31.61), (43.68, 29.57, 26.75), (45.15, 27.78, 27.07),
    ],
    "DSIT": [
        (57.32, 21.50, 21.18), (35.00, 53.75, 11.25), (67.03, 12.26, 20.71),
        (40.37, 26.06, 33.57), (48.57, 15.71, 35.71), (49.17, 21.32, 29.51),
    ],
}  # fmt: skip
PICTURES = np.array([20.0, 20, 20, 20, 101])


def simulate_counts(rng, participants, studies, *, pairs=40, correlation=0.05):
    """Counts (participants, studies, 1, 3). Probabilities of participants vary around RATES, with this correlation.

    For Dirichlet probabilities with concentration a, the intraclass correlation of every score is 1 / (1 + a).
    """
    probabilities = rng.dirichlet(RATES * (1 / correlation - 1), (participants, studies))
    return rng.multinomial(pairs, probabilities)[:, :, None].astype(float)


def test_the_average_of_the_paper_weights_datasets_by_their_pictures():
    """For DSIT all rates match. For RDNet the loss rate and win + tie match; 0.76 points are in win instead of tie."""
    by_pictures, by_datasets = averages(np.array(TABLE_3["DSIT"][:5]), PICTURES)
    assert np.abs(by_pictures - TABLE_3["DSIT"][5]).max() < 0.006
    assert np.abs(by_datasets - TABLE_3["DSIT"][5]).max() > 4
    win, tie, lose = averages(np.array(TABLE_3["RDNet"][:5]), PICTURES)[0]
    printed = TABLE_3["RDNet"][5]
    assert lose == pytest.approx(printed[2], abs=0.006)
    assert win + tie == pytest.approx(printed[0] + printed[1], abs=0.006)
    assert win == pytest.approx(printed[0] - 0.76, abs=0.006)


def test_rates_have_a_row_for_each_dataset_and_three_averages():
    counts, pictures = np.array([[6.0, 2, 2], [0, 10, 30]]), np.array([30.0, 10])
    rows = rates(counts, pictures)
    assert rows[:2, :3] == pytest.approx(np.array([[0.6, 0.2, 0.2], [0, 0.25, 0.75]]))
    assert rows[2] == pytest.approx([0.45, 0.2125, 0.3375, 0.1125])
    assert rows[3] == pytest.approx([0.3, 0.225, 0.475, -0.175])
    assert rows[4] == pytest.approx([6 / 50, 12 / 50, 32 / 50, -26 / 50])


def intervals(counts):
    """Intervals of independent studies: (2, studies, 4)."""
    participants, studies = counts.shape[:2]
    return bootstrap_interval(
        rates(resampled_counts(bootstrap_weights(participants, 1000), counts), np.ones((studies, 1))),
        participants,
    )[:, :, 0]


@pytest.mark.parametrize("participants", [100, 12])
def test_intervals_contain_the_true_rates_in_95_percent_of_studies(participants):
    """400 studies with 40 pairs for each participant: 95 % within three standard errors."""
    studies = 400
    lows, highs = intervals(simulate_counts(np.random.default_rng(1), participants, studies))
    true_values = np.append(RATES, RATES[0] - RATES[2])
    covered = ((lows <= true_values) & (true_values <= highs)).mean(axis=0)
    assert np.all(np.abs(covered - 0.95) < 3 * np.sqrt(0.95 * 0.05 / studies)), covered


def test_a_dataset_without_answers_has_no_rate_and_does_not_affect_others():
    counts = np.zeros((10, 1, 2, 3))
    counts[:, 0, 0] = [3, 1, 1]
    low, high = bootstrap_interval(
        rates(resampled_counts(bootstrap_weights(10, 200), counts), np.array([[5.0, 5]])), 10
    )
    assert low[0, 0, :3] == pytest.approx([0.6, 0.2, 0.2])
    assert high[0, 0, :3] == pytest.approx([0.6, 0.2, 0.2])
    assert np.isnan(low[0, 1]).all()


def test_the_simulated_intraclass_correlation_is_estimated():
    counts = simulate_counts(np.random.default_rng(3), 4000, 1, correlation=0.08)[:, 0, 0]
    assert intraclass_correlation(counts) == pytest.approx(0.08, abs=0.01)
    assert intraclass_correlation(counts[:1]) is None
    assert intraclass_correlation(np.tile([0.0, 3, 0], (5, 1))) is None


def test_the_sign_flip_test_rejects_equal_methods_in_5_percent_of_studies():
    """400 studies of 12 participants whose wins and losses are equally likely: within three standard errors."""
    rng, studies = np.random.default_rng(8), 400
    probabilities = rng.dirichlet(np.array([0.4, 0.2, 0.4]) * 19, (12, studies))
    counts = rng.multinomial(20, probabilities)[:, :, None].astype(float)
    p_values = sign_flip_test(counts, np.ones((studies, 1)), resamples=1000)[:, 0]
    assert abs((p_values <= 0.05).mean() - 0.05) < 3 * np.sqrt(0.05 * 0.95 / studies)


def test_the_p_value_of_unanimous_participants_is_that_of_all_exchanges():
    """Of the 2^n exchanges of n participants, two are as extreme: all or none exchanged."""
    for participants in (6, 8):
        counts = np.tile([5.0, 1, 0], (participants, 1, 1, 1))
        (p_values,) = sign_flip_test(counts, np.ones((1, 1)))
        assert p_values == pytest.approx([2 / 2**participants] * 4, abs=0.01)
    assert sign_flip_test(np.tile([2.0, 1, 2], (6, 1, 1, 1)), np.ones((1, 1))).min() == 1


@pytest.mark.parametrize("methods", [2, 3, 5])
def test_strengths_equal_those_of_choix(rng, methods):
    wins = rng.integers(1, 30, (methods, methods)) + rng.integers(0, 2, (methods, methods)) / 2
    games = [
        (a, b) for a in range(methods) for b in range(methods) if a != b for _ in range(int(2 * wins[a, b]))
    ]
    ours = strengths(wins)
    assert ours == pytest.approx(choix.opt_pairwise(methods, games, alpha=0, tol=1e-12), abs=1e-5)
    assert ours.sum() == pytest.approx(0)


def test_strengths_of_many_tables_are_those_of_each(rng):
    tables = rng.integers(1, 20, (6, 4, 4)).astype(float)
    tables[2, 0] = 0  # the first method never wins
    together = strengths(tables)
    assert np.isnan(together[2]).all()
    for table, strength in zip(np.delete(tables, 2, 0), np.delete(together, 2, 0), strict=True):
        assert strength == pytest.approx(strengths(table))


def test_strengths_converge_for_very_unequal_methods():
    wins = np.array([[0, 5000.0, 0], [0.5, 0, 5000], [0, 0.5, 0]])
    strength = strengths(wins)
    assert np.diff(strength) == pytest.approx([-np.log(10_000)] * 2)


def test_alpha_of_the_example_of_krippendorff_is_reproduced():
    """Krippendorff 2011, part C: four observers, twelve units, missing values; nominal alpha is 0.743."""
    observers = "123321412...", "1233224125.3", ".3332342251.", "12332441251."
    ratings = np.array(
        [[sum(row[unit] == value for row in observers) for value in "12345"] for unit in range(12)], float
    )
    assert alpha(ratings) == pytest.approx(0.743, abs=5e-4)


def test_alpha_is_1_for_agreement_0_for_chance_and_none_where_undefined(rng):
    assert alpha(np.array([[4.0, 0, 0], [0, 3, 0]])) == 1
    assert alpha(rng.multinomial(20, RATES, 2000).astype(float)) == pytest.approx(0, abs=0.01)
    assert alpha(np.array([[4.0, 0, 0], [5, 0, 0]])) is None
    assert alpha(np.array([[1.0, 0, 0], [0, 1, 0]])) is None


@pytest.mark.parametrize(
    ("flipped", "choice", "means"),
    [(False, "left", 0), (False, "right", 2), (True, "left", 2), (True, "right", 0), (True, "similar", 1)],
)
def test_the_outcome_of_a_choice_depends_on_the_side_of_the_first_method(flipped, choice, means):
    assert outcome(Trial("", "", "", 0, flipped), choice) == means


def participant_answers(**fields):
    return ParticipantAnswers(
        **{"number": 0, "votes": {0: 1}, "catch_trials": 4, "failed": 0, "seconds": 5.0, "is_complete": True}
        | fields
    )


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
    """A participant who chooses outcomes with these probabilities and passes this share of the catch trials."""
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
    """100 participants x 40 pairs of three methods; five fail all catch trials, and five are too fast."""
    description = make_description(pictures=50, methods=("ours", "R&D_Net", "DSIT"), pairs=40, catch_trials=4)
    rng = np.random.default_rng(4)
    records = [
        simulate_participant(
            description,
            number,
            rng,
            RATES if number >= 10 else [0, 0, 1],
            catch_trials=0.95 if number >= 5 else 0.0,
            seconds=0.6 if 5 <= number < 10 else 6.0,
            trials=20 if number == 99 else None,
        )
        for number in range(100)
    ]
    study = Study(tmp_path_factory.mktemp("hundred_participants"), description)
    participants = collect_answers(records)
    return study, participants, summarise(study, participants, ExclusionRule())


def test_the_results_of_a_hundred_simulated_participants_are_correct(hundred_participants):
    _, _, results = hundred_participants
    included, everyone = results["included"], results["everyone"]
    assert results["excluded"] == {"failed": 6, "fast": 4}
    assert (included["participants"], everyone["participants"], included["complete"]) == (90, 100, 89)
    assert everyone["answers"] == included["answers"] + 400
    for table in included["tables"]:
        row = next(row for row in table["rows"] if row["key"] == "/average")
        found = [row[name]["mean"] for name in ("win", "tie", "lose")]
        assert found == pytest.approx(RATES, abs=0.05)
        assert all(
            row[name]["low"] < row[name]["mean"] < row[name]["high"] for name in ("win", "tie", "lose")
        )
        with_excluded = next(row for row in everyone["tables"][0]["rows"] if row["key"] == "/average")
        assert with_excluded["lose"]["mean"] > row["lose"]["mean"] + 0.03
    strength = {name: entry["mean"] for name, entry in included["strengths"].items()}
    assert strength["ours"] - strength["DSIT"] == pytest.approx(np.log(0.59 / 0.41), abs=0.15)
    assert abs(included["agreement"]) < 0.05


def test_the_files_of_a_report_agree_with_each_other(hundred_participants, tmp_path):
    study, participants, results = hundred_participants
    write(results, study, participants, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text()) == results
    assert Photo.open(tmp_path / "plot.png").size[0] > 800
    lines = list(csv.DictReader(io.StringIO((tmp_path / "answers.csv").read_text())))
    reasons = {int(line["participant"]): line["left_out"] for line in lines}
    assert [reasons[i] for i in range(5)] == ["failed"] * 5
    # one of the fast participants also fails catch trials
    assert {reasons[i] for i in range(5, 10)} == {"failed", "fast"}
    assert {reasons[i] for i in range(10, 100)} == {""}
    catch_trials = [line for line in lines if line["kind"] == "catch"]
    assert len(lines) - len(catch_trials) == results["everyone"]["answers"]
    assert sum(line["choice"] != line["expected"] for line in catch_trials) == results["everyone"]["failed"]
    for line in lines:
        if line["kind"] == "comparison" and line["outcome"] != "tie":
            assert line[line["choice"]] == line["first" if line["outcome"] == "win" else "second"]
    wins = [
        line["outcome"] for line in lines if line["second"] == "DSIT" and line["dataset"] == "real"
    ].count("win")
    row = next(row for row in results["everyone"]["tables"][1]["rows"] if row["key"] == "real")
    assert wins / row["answers"] == pytest.approx(row["win"]["mean"], abs=1e-6)


def test_one_participant_gives_rates_without_intervals(hundred_participants):
    study, participants, _ = hundred_participants
    row = summarise(study, participants[20:21], ExclusionRule())["included"]["tables"][0]["rows"][-1]
    assert row["win"]["mean"] is not None
    assert row["win"]["low"] is None


def test_a_rule_that_excludes_everyone_still_gives_the_results_of_all(hundred_participants):
    study, participants, _ = hundred_participants
    results = summarise(study, participants[:5], ExclusionRule())
    assert results["included"]["participants"] == 0
    assert to_latex(results).startswith("% the rule excludes everyone")
    assert plot(results)[1:4] == b"PNG"
    assert "## All participants" in to_markdown(results)


def make_study_with_names(tmp_path, datasets, methods):
    description = make_description(pictures=3, datasets=datasets, methods=methods, catch_trials=0)
    rng, study = np.random.default_rng(5), Study(tmp_path, description)
    return study, collect_answers(
        [simulate_participant(description, number, rng, RATES) for number in range(6)]
    )


def test_a_dataset_named_average_differs_from_the_average(tmp_path):
    study, participants = make_study_with_names(tmp_path, ("Average", "real"), ("ours", "RDNet"))
    results = summarise(study, participants, ExclusionRule())
    lines = csv.DictReader(io.StringIO(to_csv(results)))
    titles = {line["key"]: line["dataset"] for line in lines}
    assert titles == {"Average": "Average (dataset)", "real": "real"} | AVERAGES
    for text in (to_latex(results), to_markdown(results)):
        assert len(re.findall(r"Average +[|&]", text)) in (1, 2)  # once for each group
        assert "Average (dataset)" in text


def test_strengths_that_are_equal_in_all_resamples_have_no_interval(hundred_participants):
    study, *_ = hundred_participants
    tied = [participant_answers(number=i, votes={0: 1, 1: 1}) for i in range(5)]
    strength = summarise(study, tied, ExclusionRule())["included"]["strengths"]["ours"]
    assert strength == {"mean": pytest.approx(0), "low": None, "high": None}


def test_the_plot_does_not_interpret_names_as_formulas(tmp_path, recwarn):
    study, participants = make_study_with_names(tmp_path, ("$x^$", "\u96e8"), ("$a_{b$", "RDNet"))
    assert plot(summarise(study, participants, ExclusionRule()))[1:4] == b"PNG"
    assert not [str(warning.message) for warning in recwarn]
