"""The commands `brewster evaluate` and `brewster render`."""

import json

import numpy as np
import pytest
from pyarrow import parquet

from benchmark_folders import paint, picture, write
from brewster import Photo
from brewster.cli.evaluate import _default_workers
from brewster.render.dataset import store
from brewster.render.dataset.generation import workers
from cli_helpers import error_lines, image_bytes, json_lines
from set_folders import hashes


@pytest.fixture
def benchmark(tmp_path):
    """Writes three pairs and the predictions of a method named "theirs". Returns the value of
    --benchmark.
    """
    for name in ("1", "2", "3"):
        paint(tmp_path / "pairs" / "blended" / f"{name}.png", int(name), noise=20)
        paint(tmp_path / "pairs" / "transmission" / f"{name}.png", int(name))
        paint(tmp_path / "theirs" / f"{name}.png", int(name), noise=5)
    return "real20=pairs"


@pytest.fixture
def evaluate(run_without_model, benchmark):
    """Runs the command on the three pairs."""
    return lambda *options: run_without_model(
        "evaluate", "--benchmark", benchmark, *QUICK_OPTIONS, *options
    )


QUICK_OPTIONS = ("--metrics", "psnr,ssim", "-o", "out")


def test_tables_go_to_standard_output_and_all_results_into_a_folder(evaluate, model, tmp_path):
    code, out, err = evaluate("--model", f"pane={model}", "--predictions", "theirs=theirs")
    assert code == 0, err
    text = out.decode()
    assert text.count("input (unprocessed)") == text.count("\ntheirs") == 1
    assert "Real20 (3 images)" in text
    assert (
        "theirs \N{MINUS SIGN} input (unprocessed)" in (tmp_path / "out" / "tables.md").read_text()
    )
    assert "found 3 images, expected 20" in err
    assert (tmp_path / "out" / "report.html").is_file()
    assert (tmp_path / "out" / "predictions" / "pane" / "real20" / "3.reflection.png").is_file()


def test_a_dry_run_scores_nothing(evaluate, tmp_path):
    code, out, err = evaluate("--dry-run")
    assert (code, out.decode().split()) == (0, ["real20/1", "real20/2", "real20/3"])
    assert "Real20: 3 images" in err
    assert not (tmp_path / "out").exists()
    code, out, err = evaluate("--dry-run", "--limit", 2)
    assert (code, out.decode().split()) == (0, ["real20/1", "real20/2"])
    assert "2 of 3 images are scored (--limit)" in err
    assert "1 of 3 images is scored (--limit)" in evaluate("--dry-run", "--limit", 1)[2]


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [(["2"], "2"), (["real20/3", "1"], "13"), (["real20/*"], "123"), (["[12]"], "12")],
)
def test_a_subset_of_images_is_chosen_by_name(evaluate, patterns, expected):
    options = [part for pattern in patterns for part in ("--only", pattern)]
    code, out, _ = evaluate("--dry-run", *options)
    assert (code, out.decode().split()) == (0, [f"real20/{name}" for name in expected])


def test_a_name_that_no_image_has_is_an_error(evaluate, tmp_path):
    code, _, err = evaluate("--only", "2", "--only", "27")
    assert code == 1
    assert "27" in error_lines(err)[0]
    assert not (tmp_path / "out").exists()


def test_photos_without_ground_truth_are_listed_and_the_others_are_scored(evaluate, tmp_path):
    paint(tmp_path / "pairs" / "blended" / "4.png", 4)
    paint(tmp_path / "pairs" / "blended" / "5.png", 5, size=(48, 32))
    paint(tmp_path / "pairs" / "transmission" / "5.png", 5)
    code, out, err = evaluate("--json")
    assert code == 1
    assert len(json.loads(out)["cases"]) == 3
    messages = error_lines(err)
    assert any("4.png" in line for line in messages)
    assert any("blended/5:" in line and "resized by the factor 0.5" in line for line in messages)


def test_a_method_that_fails_on_a_photo_is_listed_and_the_exit_code_is_one(evaluate, tmp_path):
    (tmp_path / "theirs" / "2.png").write_bytes(b"not an image")
    code, out, err = evaluate("--predictions", "theirs=theirs")
    assert code == 1
    assert ", 2 of 3" in out.decode()
    assert any("1 prediction could not be scored" in line for line in error_lines(err))


@pytest.mark.parametrize(("options", "message"), [
    (("--benchmark", "real20=nowhere"), "nowhere"),
    (("--benchmark", "real20=pairs", "--metrics", "pnsr"), "did you mean psnr"),
    (("--benchmark", "real20=pairs", "--model", "compac"), "did you mean compact"),
    (("--benchmark", "real20=pairs", "--predictions", "theirs=others"), "has the name of a case"),
])  # fmt: skip
def test_invalid_benchmarks_metrics_and_methods_are_errors(
    options, message, run_without_model, benchmark, tmp_path
):
    (tmp_path / "empty").mkdir()
    write(tmp_path / "others", "a.png", data=picture())
    for dry_run in ((), ("--dry-run",)):
        code, out, err = run_without_model("evaluate", "--metrics", "psnr", *options, *dry_run)
        assert (code, out) == (1, b"")
        assert message in error_lines(err)[-1]


@pytest.mark.parametrize("options", [
    (), ("--benchmark", "pairs"), ("--benchmark", "real20=pairs", "--model", "compact", "--burst"),
    ("--benchmark", "real20=pairs", "--size", "big"),
    ("--benchmark", "real20=pairs", "--region-threshold", "1.5"),
    ("--benchmark", "real20=pairs", "--predictions", "theirs"),
    ("--benchmark", "real20=pairs", "--workers", "0"),
])  # fmt: skip
def test_invalid_options_give_exit_code_2(options, run_without_model, benchmark):
    assert run_without_model("evaluate", *options)[0] == 2


def test_another_threshold_and_a_smaller_size_are_evaluated(evaluate):
    options = ("--metrics", "psnr,psnr_region", "--region-threshold", "0.03", "--size", "12")
    code, out, _ = evaluate("--json", *options)
    results = json.loads(out)
    assert code == 0
    assert list(results["metrics"]) == ["psnr", "psnr_region"]
    assert results["protocol"]["region_thresholds"] == [0.03]
    assert {(row["width"], row["height"]) for row in results["cases"]} == {(18, 12)}


@pytest.mark.parametrize(("options", "size"), [
    (("--size", "native"), (450, 430)), (("--protocol", "xreflection"), (416, 416)),
    (("--protocol", "xreflection", "--size", "native"), (448, 416)),
    (("--protocol", "xreflection", "--size", "100"), (96, 96)),
])  # fmt: skip
def test_images_have_the_size_of_the_option_or_else_of_the_protocol(
    run_without_model, tmp_path, options, size
):
    for role in ("blended", "transmission"):
        write(tmp_path / "one" / role, "1.png", size=(450, 430))
    command = ("evaluate", "--benchmark", "pairs=one", "--metrics", "psnr", "--pictures", 0)
    code, out, err = run_without_model(*command, "--json", "-o", "out", *options)
    assert code == 0, err
    assert [(row["width"], row["height"]) for row in json.loads(out)["cases"]] == [size]


@pytest.mark.parametrize("intervals", [(), ("--intervals",)])
def test_intervals_are_printed_if_they_are_asked_for(evaluate, tmp_path, intervals):
    code, out, err = evaluate("--predictions", "theirs=theirs", *intervals)
    assert code == 0, err
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    score = results["tables"]["real20"]["theirs"]["psnr"]
    low, high = score["low"], score["high"]
    assert low < score["mean"] < high
    shown = f"{low:.2f} to {high:.2f}"
    assert f"{score['mean']:.2f}" in out.decode()
    assert (shown in out.decode()) == (" to " in out.decode()) == bool(intervals)
    assert (f"{low:.2f}" in (tmp_path / "out" / "table.tex").read_text()) == bool(intervals)


def test_the_development_pairs_have_their_published_psnr(run_without_model, data, tmp_path):
    """The unprocessed input on the ten Nature pairs."""
    folder = data / "real/dev/nature"
    code, out, _ = run_without_model(
        "evaluate", "--benchmark", f"nature20={folder}", "--json", *QUICK_OPTIONS
    )
    assert code == 0
    table = json.loads(out)["tables"]["nature20"]["input (unprocessed)"]
    assert table["psnr"]["mean"] == pytest.approx(22.09, abs=0.005)


@pytest.mark.parametrize(("images", "workers"), [(3, 1), (49, 1), (50, 2), (1000, 4)])
def test_there_is_a_process_for_25_images_and_at_most_one_for_each_core(
    monkeypatch, images, workers
):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2, 3})
    assert _default_workers(images) == workers


def test_a_dataset_is_rendered_with_preview_and_each_scene_can_be_rendered_again(
    run_without_model, tmp_path
):
    """Uses the real renderer and the built-in maps and photos."""
    options = (
        "--recipe",
        "tiny",
        "--count",
        2,
        "--seed",
        7,
        "--size",
        "48x32",
        "--orders",
        "truncated",
    )
    code, out, err = run_without_model(
        "render", "set", *options, "--workers", 0, "--json", "--preview", "--sheet", "sheet.png"
    )
    assert code == 0, err
    assert [(line["index"], line["status"]) for line in json_lines(out)] == [
        (0, "rendered"),
        (1, "rendered"),
    ]
    assert "2 rendered" in err
    assert {path.name for path in (tmp_path / "set" / "000001").iterdir()} == set(
        store.SAMPLE_FILES
    )
    assert Photo.open(tmp_path / "set" / "000001" / "photo.jpg").size == (48, 32)
    assert Photo.open(tmp_path / "set" / "preview.png").size == (272, 72)
    sheet = Photo.open(tmp_path / "sheet.png").pixels
    assert sheet.shape == (2 * 272, 3 * 48 + 2 * 8, 3)
    for row, index in enumerate(("000000", "000001")):
        for column, layer in enumerate(("photo", "transmission", "reflection")):
            shown = sheet[272 * row : 272 * row + 32, 56 * column : 56 * column + 48]
            layer_pixels = Photo.open(tmp_path / "set" / index / f"{layer}.jpg").srgb_8bit()
            assert np.abs(shown.astype(int) - layer_pixels).max() <= 1
    assert (
        parquet.read_table(tmp_path / "set" / "index.parquet")["orders"].to_pylist()
        == ["truncated"] * 2
    )
    for index in ("000000", "000001"):
        again = ("render", "--scene", f"set/{index}/scene.toml", "-o", f"again/{index}")
        assert run_without_model(*again)[0] == 0
        assert hashes(tmp_path / "again" / index) == hashes(tmp_path / "set" / index)


@pytest.mark.parametrize(("sheet", "says"), [
    ("sheet.txt", "must be an image file"), ("other.png", "is not a contact sheet"),
])  # fmt: skip
def test_a_sheet_that_cannot_be_written_is_refused_before_anything_is_rendered(
    run_without_model, tmp_path, sheet, says
):
    Photo.from_array(np.zeros((2, 2, 3), np.uint8), encoding="srgb").save(tmp_path / "other.png")
    code, _, err = run_without_model("render", "set", "--recipe", "tiny", "--sheet", sheet)
    assert (code, says in err, (tmp_path / "set").exists()) == (2, True, False)


def test_a_sample_that_fails_is_reported_and_the_exit_code_is_one(run_without_model, monkeypatch):
    monkeypatch.setitem(workers.RENDERERS, "analytic", "fake_renderer:rejecting")
    code, _, err = run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 3, "--workers", 0, "--quiet"
    )
    assert code == 1
    assert error_lines(err) == [
        (
            "error: sample 1: sample 1 cannot be rendered; expected another sample; choose another "
            "index."
        )
    ]


def test_a_damaged_photo_is_excluded_and_reported(run_without_model, monkeypatch, tmp_path):
    monkeypatch.setitem(workers.RENDERERS, "analytic", "fake_renderer:render")
    write(tmp_path / "photos", "broken.jpg", data=b"not an image")
    write(tmp_path / "photos", "fine.jpg", data=image_bytes())
    code, _, err = run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 1, "--workers", 0, "--photos", "photos"
    )
    assert code == 0
    assert "left out" in error_lines(err)[0]


@pytest.mark.parametrize(("args", "message"), [
    ((), "Give one output folder"), (("set", "--size", "512"), "such as 512x384"),
    (("set", "--size", "8x8"), "from 16 to 16384"), (("set", "--maps", "nowhere"), "--maps"),
    (("set", "--size", f"{'1' * 5000}x512"), "from 16 to 16384"),
    (("set", "--size", "\u0661\u0666x16"), "from 16 to 16384"),
    (("set", "--scene", "scene.toml", "--count", "3"), "--count is an option for datasets"),
])  # fmt: skip
def test_a_wrong_usage_is_explained(run_without_model, args, message):
    code, _, err = run_without_model("render", *args)
    assert code == 2
    assert message in err
