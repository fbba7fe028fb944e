"""Results and their tables, with known numbers."""

import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmark_folders import repacked, sir2
from brewster.evaluation.benchmarks.image_files import Case, ImageFile
from brewster.evaluation.benchmarks.registry import Benchmark, read_benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import IdentityBaseline, PredictionFolder
from brewster.evaluation.report import tables
from brewster.evaluation.results import summarise
from brewster.evaluation.runner import ScoreRow
from brewster.evaluation.statistics import Stratum, differences, estimate
from known_results import METRICS, entry, known_results


@pytest.fixture
def results():
    return known_results()


def test_markdown_shows_means_intervals_and_paired_differences(results):
    text = tables.to_markdown(results)
    assert "20.00 (18.50 to 21.25)" in text
    assert "+1.50 (-0.25 to +3.00), better on 15 of 20" in text
    assert "21.50 / 0.123" in text


def test_all_lines_of_a_table_have_the_same_number_of_cells_with_any_names(results):
    for block in re.findall(r"(?:^\|.*\n)+", tables.tables_to_markdown(results), re.M):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


def test_a_method_with_errors_shows_the_number_of_scored_images(results):
    row = {"psnr": entry(21.5, count=19)}
    results["tables"]["real20"] = {"input (unprocessed)": {"psnr": entry(20.0)}, "A_b|c": row}
    assert "21.50 / - (0 to 19 of 20)" in tables.to_markdown(results)
    assert "| 21.50, 19 of 20 " in tables.to_markdown(results)


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_the_tables_fit_the_terminal(results, width):
    results["metrics"] = {f"psnr{i}": METRICS["psnr"] for i in range(12)}
    name = "a method with a name of many words, quality draft"
    results["methods"] = {"input (unprocessed)": {}, name: {}, f"{name} 2": {}}
    row = {f"psnr{i}": entry(20.0 + i, low=18.0, high=21.0) for i in range(12)}
    results["tables"] = {key: dict.fromkeys(results["methods"], row) for key in results["tables"]}
    text = tables.to_terminal(results, width)
    assert max(map(len, text.splitlines())) <= width
    for i in range(12):
        assert f"{20 + i}.00" in text
    assert "18.00" not in text
    assert "31.00 (18.00 to 21.00)" in tables.to_terminal(results, width, intervals=True)
    shown = [line for line in text.splitlines() if line.startswith("a me")]
    assert (
        len({re.split(" {2,}", line)[0] for line in shown}) == 2
    )  # shortened names stay different


def test_the_latex_table_has_the_papers_layout(results):
    text = tables.to_latex(results)
    assert r"\begin{tabular}{l|cc|cc|cc|cc|cc|cc}" in text
    assert r"A\_b|c & \textbf{21.50} & \textbf{0.123}" in text
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    spans = [sum(int(n) - 1 for n in re.findall(r"multicolumn\{(\d+)\}", line)) for line in body]
    assert [span + line.count("&") for span, line in zip(spans, body, strict=True)] == [12] * 4


def test_the_best_three_are_marked_but_not_the_worst(results):
    means = {
        "A_b|c": 21.5,
        "input (unprocessed)": 20.0,
        "third": 19.0,
        "fourth": 18.0,
        "equal": 18.0,
    }
    results["methods"] = {key: {} for key in means}
    table = {name: {"psnr": entry(mean)} for name, mean in means.items()}
    results["tables"] = dict.fromkeys(results["tables"], table)
    text = tables.to_latex(results)
    assert r"A\_b|c & \textbf{21.50}" in text
    assert r"input (unprocessed) & \underline{20.00}" in text
    assert r"third & \uuline{19.00}" in text
    assert all(f"{name} & 18.00" in text for name in ("fourth", "equal"))


def test_a_mean_over_fewer_images_has_a_dagger_and_no_mark(results):
    assert "dagger" not in tables.to_latex(results)
    results["tables"]["real20"] = {
        "input (unprocessed)": {"psnr": entry(20.0), "lpips": entry(0.2)},
        "A_b|c": {"psnr": entry(21.5, count=10), "lpips": entry(0.1, count=10)},
    }
    text = tables.to_latex(results)
    assert r"A\_b|c & 21.50$^\dagger$" in text
    assert r"\multicolumn{13}{l}{$^\dagger$ mean over fewer images" in text


@pytest.mark.parametrize(
    "names", [["psnr_channels", "ssim"], ["psnr", "ssim_clipped", "lpips", "psnr_region"]]
)
def test_requested_metrics_are_in_the_table_and_in_the_overview(results, names):
    results["metrics"] = {
        name: results["metrics"]["psnr"] | {"title": name.upper()} for name in names
    }
    titles = [name.upper() for name in names[:3]]
    assert " & ".join(f"{title}$\\uparrow$" for title in titles) in tables.to_latex(results)
    assert tables.to_markdown(results).startswith(
        " / ".join(f"{title}, dB ↑" for title in titles) + "\n"
    )


PSNR = EvaluationConfig(metrics=("psnr",))


def make_benchmark(name, count, excluded=()):
    file = ImageFile("nowhere")
    cases = tuple(Case(name, str(i), str(i), str(i), file, file) for i in range(count))
    return Benchmark(name, name.title(), cases, excluded=excluded)


def make_rows(benchmarks, methods, score):
    return [
        ScoreRow(case.benchmark, case.name, method.name, "", "", {"psnr": score(case, method)})
        for part in benchmarks
        for case in part.cases
        for method in methods
    ]


@pytest.fixture
def methods(tmp_path):
    return [IdentityBaseline(), PredictionFolder("theirs", tmp_path)]


def test_the_average_is_over_all_images(methods):
    parts = [make_benchmark("a", 20), make_benchmark("b", 80)]
    rows = make_rows(parts, methods, lambda case, _: 20.0 if case.benchmark == "a" else 30.0)
    results = summarise(parts, methods, PSNR, rows)
    assert results["tables"]["a"]["theirs"]["psnr"]["mean"] == 20
    assert results["tables"]["average"]["theirs"]["psnr"]["mean"] == 28
    assert results["selections"]["average"] == {"title": "Average", "cases": 100}


def test_the_order_of_rows_does_not_matter(methods):
    parts = [make_benchmark("a", 9)]
    score_rows = make_rows(
        parts, methods, lambda case, one: int(case.name) ** 2 + (one.name == "theirs")
    )
    assert summarise(parts, methods, PSNR, score_rows) == summarise(
        parts, methods, PSNR, score_rows[::-1]
    )


def test_a_failed_case_is_not_counted_and_is_named(methods):
    parts = [make_benchmark("a", 3, excluded=("x.png has no partner",))]
    score_rows = make_rows(parts, methods, lambda case, method: float(case.name))
    score_rows[1] = ScoreRow("a", "0", "theirs", "", "", error="theirs failed")
    results = summarise(parts, methods, PSNR, score_rows)
    mean = results["tables"]["a"]["theirs"]["psnr"]
    assert (mean["mean"], mean["count"]) == (1.5, 2)
    assert results["cases"][0]["errors"] == {"theirs": "theirs failed"}
    assert results["benchmarks"]["a"]["excluded"] == ["x.png has no partner"]


def test_a_benchmark_without_pairs_is_listed_and_has_no_table_and_one_benchmark_no_average(methods):
    parts = [make_benchmark("a", 2), make_benchmark("b", 0, excluded=("b.png has no partner",))]
    results = summarise(parts, methods, PSNR, make_rows(parts, methods, lambda *_: 1.0))
    assert list(results["tables"]) == ["a"]
    assert results["benchmarks"]["b"]["cases"] == 0


def test_the_papers_protocol_averages_over_181_images_and_also_reports_whole_benchmarks(
    tmp_path, methods
):
    for name in ("real20", "nature20"):
        repacked(tmp_path / name, map(str, range(20)))
    sir2(tmp_path / "sir2")
    names = ("real20", "nature20", "sir2")
    parts = [part for name in names for part in read_benchmark(name, tmp_path / name)]
    config = EvaluationConfig(metrics=("psnr",), paper_subset=True)
    results = summarise(parts, methods, config, make_rows(parts, methods, lambda *_: 1.0))
    pictures = {key: selection["cases"] for key, selection in results["selections"].items()}
    whole = {"real20": 20, "nature20": 20, "postcard": 199, "solidobject": 200, "wildscene": 101}
    assert pictures == whole | {"postcard:paper": 20, "solidobject:paper": 20, "average": 181}
    assert len(results["draw"]["postcard:paper"]) == 20
    json.dumps(results, allow_nan=False)


def test_the_papers_average_uses_only_the_papers_benchmarks_and_reports_missing_images(
    tmp_path, methods
):
    parts = [
        make_benchmark("real20", 20),
        make_benchmark("nature20", 10),
        make_benchmark("mine", 7),
    ]
    config = EvaluationConfig(metrics=("psnr",), paper_subset=True)
    results = summarise(parts, methods, config, make_rows(parts, methods, lambda *_: 1.0))
    assert results["selections"]["average"]["cases"] == 30
    assert "is over 20 of real20, 10 of nature20." in results["protocol"]["choices"][-1]


def make_stratum(values, scenes=None, name="set"):
    values = np.atleast_2d(np.asarray(values, float).T).T
    return Stratum(name, scenes or [str(i) for i in range(len(values))], values)


def estimate_one(strata):
    (estimated,) = estimate(strata)
    return estimated


def test_the_mean_is_over_all_images_with_a_score_not_over_benchmarks():
    estimated = estimate_one(
        [make_stratum([1.0, 1.0, 1.0], name="a"), make_stratum([5.0], name="b")]
    )
    assert estimated.mean == 2.0
    assert estimated.count == 4
    estimated = estimate_one([make_stratum([1.0, np.nan, 3.0])])
    assert (estimated.mean, estimated.count) == (2.0, 2)
    assert estimate_one([make_stratum([np.nan, np.nan])]) is None


def test_a_score_of_a_single_image_or_scene_has_no_interval():
    assert estimate_one([make_stratum([1.0, 2.0, 3.0], scenes=["x"] * 3)]).low is None
    assert estimate_one([make_stratum([1.0, np.nan, np.nan])]).low is None
    assert estimate_one([make_stratum([1.0], name="a"), make_stratum([2.0], name="b")]).low is None
    assert (
        estimate_one([make_stratum([1.0], name="a"), make_stratum([2.0, 3.0], name="b")]).low
        is not None
    )


def test_intervals_agree_with_normal_intervals_for_normal_values(rng):
    values = rng.normal(20, 3, 400)
    estimated = estimate_one([make_stratum(values)])
    half = 1.96 * values.std(ddof=1) / np.sqrt(400)
    assert estimated.high - estimated.mean == pytest.approx(half, rel=0.06)
    assert estimated.mean - estimated.low == pytest.approx(half, rel=0.06)


def test_intervals_contain_the_true_mean_in_95_percent_of_the_cases(rng):
    """The coverage of a percentile bootstrap is slightly below 95 % for 60 values."""
    covered = 0
    for i in range(200):
        estimated = estimate_one([make_stratum(rng.normal(0, 1, 60), name=str(i))])
        covered += estimated.low <= 0 <= estimated.high
    assert 0.90 <= covered / 200 <= 0.99


def test_ten_equal_images_of_each_scene_do_not_narrow_the_interval(rng):
    scenes = rng.normal(0, 1, 20)
    one = estimate_one([make_stratum(scenes)])
    ten = estimate_one(
        [make_stratum(np.repeat(scenes, 10), scenes=[str(i // 10) for i in range(200)])]
    )
    assert ten.high - ten.low == pytest.approx(one.high - one.low, rel=0.05)


def test_the_interval_of_a_benchmark_does_not_depend_on_the_order_of_its_images(rng):
    values = rng.normal(0, 1, 12)
    scenes = [f"s{i % 4}" for i in range(12)]
    order = rng.permutation(12)
    a = estimate_one([make_stratum(values, scenes)])
    b = estimate_one([make_stratum(values[order], [scenes[i] for i in order])])
    assert a.low == pytest.approx(b.low)
    assert a.high == pytest.approx(b.high)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=20))
def test_the_mean_is_in_its_interval_and_the_interval_between_minimum_and_maximum(values):
    estimated = estimate_one([make_stratum(values)])
    assert min(values) - 1e-9 <= estimated.low <= estimated.high <= max(values) + 1e-9
    assert estimated.mean == pytest.approx(np.mean(values), abs=1e-9)


def test_paired_differences_have_narrower_intervals_than_the_means(rng):
    baseline = rng.normal(22, 5, 50)
    values = np.stack([baseline, baseline + rng.normal(0.5, 0.1, 50)], axis=1)
    series = [("input", "psnr"), ("ours", "psnr")]
    (row,) = differences([make_stratum(values)], series, {"psnr": True})
    assert (row.method, row.reference, row.metric) == ("ours", "input", "psnr")
    assert row.estimate.mean == pytest.approx(0.5, abs=0.06)
    assert row.estimate.high - row.estimate.low < 0.1
    assert estimate([make_stratum(values)])[0].high - estimate([make_stratum(values)])[0].low > 2
    assert row.improved_count == 50


def test_better_uses_the_direction_of_the_metric_and_skips_images_without_both_scores():
    values = np.array([[0.2, 0.1], [0.2, 0.3], [0.2, 0.1], [0.2, 0.2], [0.2, np.nan]])
    (row,) = differences([make_stratum(values)], [("a", "lpips"), ("b", "lpips")], {"lpips": False})
    assert (row.improved_count, row.estimate.count) == (2, 4)  # an equal score is no better one
    assert row.estimate.mean == pytest.approx(-0.1 / 4)


def test_every_pair_of_methods_is_compared():
    series = [(method, "psnr") for method in "abc"]
    rows = differences([make_stratum(np.arange(6.0).reshape(2, 3))], series, {"psnr": True})
    assert [(row.method, row.reference) for row in rows] == [("b", "a"), ("c", "a"), ("c", "b")]
    assert differences([make_stratum([1.0])], series[:1], {"psnr": True}) == []


def test_each_benchmark_has_its_own_resamples():
    """With equal resamples, the errors of benchmarks would be added up in the interval of their
    average.
    """
    values = np.arange(12.0)
    names = "nature20", "real20", "nature20"
    one, other, same = (estimate_one([make_stratum(values, name=name)]) for name in names)
    assert one == same
    assert (one.mean, one.count) == (other.mean, other.count)
    assert (one.low, one.high) != (other.low, other.high)


def test_the_interval_of_an_average_assumes_independent_benchmarks(rng):
    values = rng.normal(size=40)
    alone = estimate_one([make_stratum(values)])
    both = estimate_one([make_stratum(values, name=name) for name in ("a", "b")])
    assert both.high - both.low == pytest.approx((alone.high - alone.low) / 2**0.5, rel=0.1)
