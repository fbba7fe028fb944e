"""The content of results.json, from rows with known numbers."""

import json

import pytest

from benchmark_folders import repacked, sir2
from brewster.benchmarks.image_files import Case, ImageFile
from brewster.benchmarks.registry import Benchmark, read_benchmark
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import IdentityBaseline, PredictionFolder
from brewster.evaluate.results import summarise
from brewster.evaluate.runner import ScoreRow

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
    score_rows = make_rows(parts, methods, lambda case, one: int(case.name) ** 2 + (one.name == "theirs"))
    assert summarise(parts, methods, PSNR, score_rows) == summarise(parts, methods, PSNR, score_rows[::-1])


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


def test_the_papers_protocol_averages_over_181_images_and_also_reports_whole_benchmarks(tmp_path, methods):
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


def test_the_papers_average_uses_only_the_papers_benchmarks_and_reports_missing_images(tmp_path, methods):
    parts = [make_benchmark("real20", 20), make_benchmark("nature20", 10), make_benchmark("mine", 7)]
    config = EvaluationConfig(metrics=("psnr",), paper_subset=True)
    results = summarise(parts, methods, config, make_rows(parts, methods, lambda *_: 1.0))
    assert results["selections"]["average"]["cases"] == 30
    assert "is over 20 of real20, 10 of nature20." in results["protocol"]["choices"][-1]
