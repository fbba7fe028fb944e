"""A complete evaluation: reads folders and writes the output files; and flipped and shifted
predictions.
"""

import json
import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from benchmark_folders import paint
from brewster import Photo
from brewster.cli.evaluate import evaluate as command
from brewster.errors import BrewsterError, DownloadError, PhotoError
from brewster.evaluation.benchmarks.registry import Benchmark, read_benchmark
from brewster.evaluation.config import (
    PROTOCOLS,
    EvaluationConfig,
    describe_protocol,
    protocol_config,
)
from brewster.evaluation.evaluation import evaluate
from brewster.evaluation.methods import IdentityBaseline, ModelMethod, PredictionFolder
from brewster.evaluation.registration import find_misregistration
from brewster.metrics import METRICS

QUICK = EvaluationConfig(metrics=("psnr", "ssim", "psnr_region"))


@pytest.fixture
def real20(tmp_path):
    for name in ("1", "2"):
        paint(tmp_path / "real20" / "blended" / f"{name}.png", int(name), noise=20)
        paint(tmp_path / "real20" / "transmission_layer" / f"{name}.png", int(name))
        paint(tmp_path / "theirs" / f"{name}.png", int(name), noise=5)
    return read_benchmark("real20", tmp_path / "real20")


@pytest.fixture
def late(monkeypatch):
    """A metric "late" whose weights are missing while the list `weights` is empty. Returns
    `weights` and the calls.
    """
    weights = []
    calls = []

    def prepare():
        if not weights:
            raise DownloadError("the weights are missing", "expected a network", "connect")

    def measure(case):
        calls.append(case)
        return 0.5

    row = replace(METRICS["lpips"], name="late", title="Late", score=measure, prepare=prepare)
    monkeypatch.setitem(METRICS, "late", row)
    return weights, calls


@pytest.fixture
def methods(model, tmp_path):
    return [
        IdentityBaseline(),
        ModelMethod("pane", str(model), tmp_path / "stored"),
        PredictionFolder("theirs", tmp_path / "theirs"),
    ]


def test_an_evaluation_writes_results_tables_and_a_report(real20, methods, tmp_path):
    results = evaluate(real20, methods, QUICK, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "results.json").read_text())
    assert written == results
    assert results["tables"]["real20"]["theirs"]["psnr"]["mean"] > 30
    names = {path.name for path in (tmp_path / "out").iterdir()}
    tables = {"scores.csv", "tables.md", "table.tex"}
    assert names == tables | {"results.json", "report.html", "scores.jsonl"}
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<article") == 2
    links = set(re.findall('<a href="([^"]+)"', page))
    assert {
        "../real20/blended/1.png",
        "../theirs/1.png",
        "../stored/real20/1.reflection.png",
    } <= links
    assert all((tmp_path / "out" / link).resolve().is_file() for link in links)


def test_two_runs_and_two_workers_write_the_same_bytes(real20, methods, tmp_path):
    for name, workers in (("a", 1), ("b", 2)):
        evaluate(real20, methods, QUICK, tmp_path / name, workers=workers)
    for name in ("results.json", "tables.md", "table.tex", "report.html"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_the_report_shows_failures_then_the_worst_scores_and_no_unreadable_case(
    real20, methods, tmp_path
):
    def shown(methods):
        results = evaluate(real20, methods, QUICK, tmp_path / "out", max_report_cases=1)
        return results, re.findall(
            '<article.*data-name="(.*?)"', (tmp_path / "out/report.html").read_text()
        )

    results, names = shown(methods)
    scores = {picture["name"]: picture["scores"]["pane"]["psnr"] for picture in results["cases"]}
    assert names == [min(scores, key=scores.get)]
    (tmp_path / "theirs" / "2.png").unlink()
    assert shown([IdentityBaseline(), methods[2]])[1] == ["2"]
    path = tmp_path / "real20" / "transmission_layer" / "2.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert shown([IdentityBaseline(), methods[2]])[1] == ["1"]


@pytest.mark.parametrize(
    "change", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:100])]
)
def test_a_deleted_or_damaged_prediction_is_computed_again_for_the_report(
    real20, methods, tmp_path, change
):
    first = evaluate(real20, methods, QUICK, tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_bytes()
    for stored in (tmp_path / "stored").rglob("1.*.png"):
        change(stored)
    assert evaluate(real20, methods, QUICK, tmp_path / "out") == first
    assert (tmp_path / "out" / "report.html").read_bytes() == page


def test_a_photo_whose_name_is_not_text_is_in_the_report(tmp_path):
    name = os.fsdecode(b"\xff")
    for layer, noise in (("blended", 20), ("transmission", 0)):
        paint(tmp_path / "pairs" / layer / f"{name}.png", 1, noise=noise)
    evaluate(
        read_benchmark("pairs", tmp_path / "pairs"), [IdentityBaseline()], QUICK, tmp_path / "out"
    )
    assert "/blended/%FF.png" in (tmp_path / "out" / "report.html").read_text()


def test_a_folder_with_the_ground_truth_gives_a_remark(real20, tmp_path):
    methods = [IdentityBaseline(), PredictionFolder("self", tmp_path / "real20")]
    results = evaluate(real20, methods, QUICK, tmp_path / "out")
    assert "equal the ground truth for 2 images" in results["methods"]["self"]["remark"]
    assert "remark" not in results["methods"]["input (unprocessed)"]


def test_downscaled_photos_are_written_for_methods_that_run_elsewhere(real20, tmp_path):
    small = EvaluationConfig(metrics=("psnr",), short_side_px=8)
    evaluate(real20, [IdentityBaseline()], small, tmp_path / "out")
    inputs = tmp_path / "out" / "inputs"
    copied = PredictionFolder("copied", inputs)
    results = evaluate(real20, [IdentityBaseline(), copied], small, tmp_path / "out")
    table = results["tables"]["real20"]
    assert table["copied"] == table["input (unprocessed)"]
    assert Photo.open(inputs / "real20" / "1.png").size == (12, 8)


@pytest.mark.parametrize("settings", [
    {"metrics": ()}, {"metrics": ("psnr", "psnr")}, {"threshold": 0.0}, {"threshold": 1.5},
    {"short_side_px": 0},
])  # fmt: skip
def test_invalid_settings_are_an_error(settings):
    with pytest.raises(BrewsterError):
        EvaluationConfig(**settings)


def test_equal_benchmark_names_and_benchmarks_without_cases_are_an_error(real20, methods, tmp_path):
    with pytest.raises(BrewsterError, match="2 benchmarks have the name 'real20'"):
        evaluate([*real20, *real20], methods, QUICK, tmp_path / "out")
    empty = Benchmark("real20", "Real20", (), excluded=("a.png has no partner",))
    with pytest.raises(PhotoError, match=r"no case in real20.*a\.png has no partner"):
        evaluate([empty], methods, QUICK, tmp_path / "out")


def test_a_metric_without_weights_does_not_stop_the_run_and_is_added_later(
    real20, methods, tmp_path, late
):
    weights, calls = late
    config = EvaluationConfig(metrics=("psnr", "late"))
    run = partial(evaluate, real20, [IdentityBaseline(), methods[2]], config, tmp_path / "out")
    first = run()
    assert "the weights are missing" in first["unavailable"]["late"]
    assert set(first["tables"]["real20"]["theirs"]) == {"psnr"}
    assert not calls
    assert "- late: the weights are missing" in (tmp_path / "out" / "tables.md").read_text()
    weights.append("found")
    second = run()
    assert not second["unavailable"]
    assert (
        second["tables"]["real20"]["theirs"]["psnr"] == first["tables"]["real20"]["theirs"]["psnr"]
    )
    assert second["tables"]["real20"]["theirs"]["late"]["mean"] == 0.5
    assert len(calls) == 4
    run()
    assert len(calls) == 4


def test_an_outdated_score_does_not_count_if_the_weights_are_missing_now(
    real20, methods, tmp_path, late
):
    weights, _ = late
    weights.append("found")
    config = EvaluationConfig(metrics=("psnr", "late"))
    run = partial(evaluate, real20, [IdentityBaseline(), methods[2]], out=tmp_path / "out")
    run(config=config)
    weights.clear()
    unchanged = run(config=config)
    assert not unchanged["unavailable"]
    assert unchanged["tables"]["real20"]["theirs"]["late"]["mean"] == 0.5
    changed = run(config=replace(config, border=1))
    assert "the weights are missing" in changed["unavailable"]["late"]
    assert set(changed["tables"]["real20"]["theirs"]) == {"psnr"}


def test_a_mirrored_prediction_gives_a_remark(tmp_path, rng):
    photo = rng.integers(0, 256, (40, 60, 3)).astype(np.uint8)
    for path in ("real20/blended", "real20/transmission_layer", "good", "bad"):
        flipped = photo[:, ::-1].copy() if path == "bad" else photo
        Photo.from_array(flipped, encoding="srgb").save(tmp_path / path / "46.png")
    parts = read_benchmark("real20", tmp_path / "real20")
    folders = [PredictionFolder(name, tmp_path / name) for name in ("good", "bad")]
    results = evaluate(parts, [IdentityBaseline(), *folders], QUICK, tmp_path / "out")
    assert "remark" not in results["methods"]["good"]
    remark = results["methods"]["bad"]["remark"]
    assert (
        remark == "1 image of 1 not registered with the photo: real20/46 is mirrored left to right"
    )


def test_a_changed_setting_is_named():
    lines = describe_protocol(protocol_config("xreflection", short_side_px=None, quality="draft"))
    assert lines[-1] == "This run differs from the protocol xreflection in: short_side_px."


def test_the_command_offers_all_protocols():
    (option,) = (option for option in command.params if option.name == "protocol")
    assert [name.lower() for name in option.type.choices] == [*PROTOCOLS]


def scene(rng, height=200, width=270):
    """Noise with the spectrum of photographs, uint8 (H, W, 3)."""
    squares = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.fftfreq(width) ** 2
    spectrum = np.fft.fft2(rng.standard_normal((height, width, 3)), axes=(0, 1))
    values = np.fft.ifft2(spectrum / (squares + 1e-4)[..., None] ** 0.5, axes=(0, 1)).real
    return (255 * (values - values.min()) / (values.max() - values.min())).astype(np.uint8)


@pytest.fixture
def photo(rng):
    return scene(rng)


@pytest.mark.parametrize(("flip", "found"), [
    (np.s_[:, ::-1], "mirrored left to right"), (np.s_[::-1], "mirrored top to bottom"),
    (np.s_[::-1, ::-1], "rotated by 180 degrees"),
])  # fmt: skip
def test_a_flip_is_found_with_the_changes_of_a_good_method(photo, rng, flip, found):
    prediction = (0.7 * photo + 0.3 * scene(rng)).astype(np.uint8)
    assert find_misregistration(prediction, photo) == ""
    assert find_misregistration(prediction[flip], photo) == found


@pytest.mark.parametrize(("rows", "columns", "found"), [
    (0, 12, "shifted by about 12 px to the right"), (-8, 0, "shifted by about 8 px up"),
    (6, -10, "shifted by about 6 px down and 10 px to the left"),
])  # fmt: skip
def test_a_shift_is_found_with_its_direction(photo, rows, columns, found):
    assert find_misregistration(np.roll(photo, (rows, columns), axis=(0, 1)), photo) == found


def test_small_shifts_other_images_and_flat_images_give_no_remark(photo, rng):
    assert find_misregistration(np.roll(photo, 1, axis=1), photo) == ""
    assert find_misregistration(scene(rng), photo) == ""
    assert find_misregistration(np.full_like(photo, 90), photo) == ""
    for size in (8, 16, 24):
        noise = rng.integers(0, 256, (2, size, size, 3)).astype(np.uint8)
        assert find_misregistration(*noise) == ""
    assert find_misregistration(photo[:3, :3], photo[:3, :3]) == ""
