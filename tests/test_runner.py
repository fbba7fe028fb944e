"""A resumed run, several workers and failures of other methods do not change the scores."""

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmark_folders import paint
from brewster import Photo
from brewster.errors import BrewsterError
from brewster.evaluation import runner
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import IdentityBaseline, MethodOutput, ModelMethod
from brewster.evaluation.runner import SCORES_FILE
from other_processes import children, is_alive, started, wait_for

QUICK = EvaluationConfig(metrics=("psnr", "ssim"))
NAMES = ["1", "2", "3"]


def score(*args, **kwargs):
    """Returns the rows of `runner.score`."""
    return runner.score(*args, **kwargs)[0]


class FakeMethod:
    """A method with given predictions or failures, which records the cases that it was run on."""

    exclusive = False

    def __init__(self, name="fake", predictions=None):
        self.name = name
        self.predictions = predictions or {}
        self.requested = []

    def about(self):
        return {"kind": "fake"}

    def key(self, case):
        return f"{self.name}"

    def predict(self, case, photo):
        self.requested.append(case.name)
        prediction = self.predictions.get(case.name, MethodOutput(photo))
        if isinstance(prediction, Exception):
            raise prediction
        return prediction

    def cached(self, case):
        return None


def requested(benchmarks, out, config=None):
    """Runs a method without failures, and returns the cases that it was run on."""
    method = FakeMethod()
    assert not any(row.error for row in score(benchmarks, [method], config or QUICK, out))
    return method.requested


@pytest.fixture
def real20(tmp_path):
    for i, name in enumerate(NAMES):
        paint(tmp_path / "real20" / "blended" / f"{name}.png", i, noise=20)
        paint(tmp_path / "real20" / "transmission_layer" / f"{name}.png", i)
    return read_benchmark("real20", tmp_path / "real20")


def comparable(rows):
    return [(row.id, row.scores, row.error) for row in rows]


def test_every_method_is_scored_on_every_case_in_order(real20, tmp_path):
    rows = score(real20, [IdentityBaseline(), FakeMethod()], QUICK, tmp_path / "out")
    names = ("input (unprocessed)", "fake")
    assert [row.id[1:] for row in rows] == [(case, method) for case in NAMES for method in names]
    assert rows[0].scores == rows[1].scores
    assert (rows[0].width, rows[0].height) == (24, 16)
    assert len((tmp_path / "out" / SCORES_FILE).read_text().splitlines()) == 6


def test_logged_scores_are_reused(real20, tmp_path):
    first = score(real20, [FakeMethod()], QUICK, tmp_path / "out")
    again = FakeMethod()
    for config in (QUICK, replace(QUICK, protocol="paper", paper_subset=True, quality="draft")):
        assert comparable(score(real20, [again], config, tmp_path / "out")) == comparable(first)
    assert again.requested == []


def test_a_run_that_was_killed_in_the_middle_of_a_line_is_resumed(real20, tmp_path):
    complete = score(real20, [FakeMethod()], QUICK, tmp_path / "complete")
    log = tmp_path / "out" / SCORES_FILE
    log.parent.mkdir()
    lines = (tmp_path / "complete" / SCORES_FILE).read_text().splitlines()
    log.write_text(lines[0] + "\n" + lines[1][:40])
    fake = FakeMethod()
    assert comparable(score(real20, [fake], QUICK, tmp_path / "out")) == comparable(complete)
    assert fake.requested == ["2", "3"]
    assert requested(real20, tmp_path / "out") == []


def test_a_changed_photo_ground_truth_or_setting_is_scored_again(real20, tmp_path):
    score(real20, [FakeMethod()], QUICK, tmp_path / "out")
    paint(tmp_path / "real20" / "transmission_layer" / "2.png", 77)
    assert requested(real20, tmp_path / "out") == ["2"]
    paint(tmp_path / "real20" / "blended" / "3.png", 78)
    assert requested(real20, tmp_path / "out") == ["3"]
    config = QUICK
    for change in ({"threshold": 0.2}, {"border": 2}, {"short_side_px": 12}, {"size_divisor": 8}):
        config = replace(config, **change)
        assert requested(real20, tmp_path / "out", config) == NAMES, change
    only_psnr = replace(config, metrics=("psnr",))  # the log has this column
    assert requested(real20, tmp_path / "out", only_psnr) == []


def test_other_metrics_do_not_run_the_model_again(real20, model, tmp_path, monkeypatch):
    method = ModelMethod("pane", str(model), tmp_path / "out" / "predictions" / "pane")
    first = score(real20, [method], QUICK, tmp_path / "out")
    monkeypatch.setattr(ModelMethod, "predict", lambda *_: pytest.fail("the model ran again"))
    more = score(
        real20, [method], EvaluationConfig(metrics=("psnr", "psnr_region")), tmp_path / "out"
    )
    assert [row.scores["psnr"] for row in more] == [row.scores["psnr"] for row in first]


def test_a_stored_prediction_that_was_changed_is_computed_again(real20, model, tmp_path):
    method = ModelMethod("pane", str(model), tmp_path / "predictions")
    first = score(real20, [method], QUICK, tmp_path / "out")
    stored = tmp_path / "predictions" / "real20" / "2.transmission.png"
    stored.write_bytes((tmp_path / "real20" / "blended" / "2.png").read_bytes())
    again = score(real20, [method], EvaluationConfig(metrics=("psnr",)), tmp_path / "out")
    assert [row.scores["psnr"] for row in again] == [row.scores["psnr"] for row in first]


@pytest.mark.parametrize(
    ("changed", "names"),
    [("brewster.__version__", []), ("brewster.evaluation.runner.SCORE_FORMAT_VERSION", NAMES)],
)
def test_scores_are_computed_again_for_a_new_format_but_no_new_release(
    real20, tmp_path, monkeypatch, changed, names
):
    score(real20, [FakeMethod()], QUICK, tmp_path / "out")
    monkeypatch.setattr(changed, 99)
    assert requested(real20, tmp_path / "out") == names


@pytest.mark.parametrize(
    ("changed", "count"),
    [("brewster.__version__", 0), ("brewster.evaluation.methods.PREDICTION_FORMAT_VERSION", 3)],
)
def test_predictions_are_made_again_for_a_new_format_only(
    real20, model, tmp_path, monkeypatch, changed, count
):
    method = ModelMethod("pane", str(model), tmp_path / "predictions")
    score(real20, [method], QUICK, tmp_path / "out")
    monkeypatch.setattr(changed, 99)
    calls = []
    predict = ModelMethod.predict
    monkeypatch.setattr(
        ModelMethod, "predict", lambda self, *case: calls.append(1) or predict(self, *case)
    )
    score(real20, [method], QUICK, tmp_path / "out")
    assert len(calls) == count


def test_a_worker_that_dies_is_an_error(real20, model, tmp_path):
    with pytest.raises(BrewsterError, match="a worker process died"):
        score(
            real20,
            [IdentityBaseline(), MethodThatKillsItsProcess()],
            QUICK,
            tmp_path / "out",
            workers=2,
        )


class MethodThatKillsItsProcess(FakeMethod):
    """A method whose prediction ends the process."""

    def predict(self, case, photo):
        os._exit(1)


class EndlessMethod(FakeMethod):
    """A method that creates a file when it starts and never returns."""

    def predict(self, case, photo):
        Path(self.name, case.name).touch()
        time.sleep(1000)


def test_killing_a_run_ends_its_workers(real20, tmp_path):
    (tmp_path / "started").mkdir()
    code = f"""
from pathlib import Path
from test_runner import QUICK, EndlessMethod, read_benchmark, score
folder = Path({str(tmp_path)!r})
if __name__ == "__main__":
    parts = read_benchmark("real20", folder / "real20")
    score(parts, [EndlessMethod("started")], QUICK, folder / "out", workers=2)
"""
    (tmp_path / "run.py").write_text(code)
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])
    }
    with started([sys.executable, tmp_path / "run.py"], cwd=tmp_path, env=environment) as run:
        wait_for(lambda: len(list((tmp_path / "started").iterdir())) == 2, run)
        workers = children(run)
        run.kill()
    wait_for(lambda: not any(map(is_alive, workers)))
    assert len(workers) >= 2


def test_a_crash_is_reported_with_its_case_and_the_next_run_tries_again(real20, tmp_path):
    rows = score(
        real20, [FakeMethod(predictions={"2": RuntimeError("boom")})], QUICK, tmp_path / "out"
    )
    assert rows[1].error == "fake failed on real20/2: RuntimeError: boom"
    assert requested(real20, tmp_path / "out") == ["2"]


def test_a_later_error_does_not_delete_scores(real20, tmp_path):
    first = score(real20, [FakeMethod()], QUICK, tmp_path / "out")
    more = EvaluationConfig(metrics=("psnr", "ssim", "psnr_region"))
    failed = score(
        real20, [FakeMethod(predictions={"2": RuntimeError("boom")})], more, tmp_path / "out"
    )
    assert failed[1].error
    again = FakeMethod()
    rows = score(real20, [again], QUICK, tmp_path / "out")
    assert [row.scores["psnr"] for row in rows] == [row.scores["psnr"] for row in first]
    assert again.requested == []


def test_a_prediction_of_another_size_is_an_error_and_is_not_resized(real20, tmp_path):
    small = Photo.from_array(np.zeros((8, 8, 3), np.uint8), encoding="srgb")
    rows = score(
        real20, [FakeMethod(predictions={"1": MethodOutput(small)})], QUICK, tmp_path / "out"
    )
    assert "fake's transmission of real20/1 is 8x8; expected 24x16" in rows[0].error


def test_a_photo_that_cannot_be_decoded_is_an_error_for_all_methods(real20, tmp_path):
    path = tmp_path / "real20" / "blended" / "2.png"
    path.write_bytes(path.read_bytes()[:200])
    rows = score(real20, [IdentityBaseline(), FakeMethod()], QUICK, tmp_path / "out")
    assert [row.case for row in rows if row.error] == ["2", "2"]


def test_grey_images_alpha_and_sixteen_bits_are_compared_by_their_8_bit_colours(tmp_path):
    rng = np.random.default_rng(3)
    grey = rng.integers(0, 256, (16, 24, 1), np.uint8)
    alpha = np.concatenate([grey.repeat(3, 2), np.full_like(grey, 9)], axis=2)
    deep = grey.repeat(3, 2).astype(np.uint16) * 257
    for role, pixels in (
        ("blended", grey),
        ("transmission_layer", alpha),
        ("reflection_layer", deep),
    ):
        Photo.from_array(pixels, encoding="srgb").save(tmp_path / "real20" / role / "1.png")
    benchmarks = read_benchmark("real20", tmp_path / "real20")
    (row,) = score(benchmarks, [IdentityBaseline()], QUICK, tmp_path / "out")
    assert row.scores == {"psnr": 100.0, "ssim": 1.0}


def test_lines_of_another_version_are_ignored(real20, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / SCORES_FILE).write_text(
        json.dumps({"benchmark": "real20", "odd": 1}) + "\n[]\n7\n"
    )
    assert len(score(real20, [FakeMethod()], QUICK, tmp_path / "out")) == 3


def test_the_scores_before_an_interrupt_are_saved(real20, tmp_path, monkeypatch):
    fake = FakeMethod()

    def predict(case, photo):
        if case.name == "3":
            raise KeyboardInterrupt
        return MethodOutput(photo)

    monkeypatch.setattr(fake, "predict", predict)
    with pytest.raises(KeyboardInterrupt):
        score(real20, [fake], QUICK, tmp_path / "out")
    assert len((tmp_path / "out" / SCORES_FILE).read_text().splitlines()) == 2


class ExclusiveMethod(FakeMethod):
    """An exclusive method that logs the process, its name and the case."""

    exclusive = True

    def __init__(self, name, log):
        super().__init__(name)
        self.log = log

    def predict(self, case, photo):
        with self.log.open("a") as file:
            file.write(f"{os.getpid()} {self.name} {case.name}\n")
        return super().predict(case, photo)


@pytest.mark.parametrize("workers", [1, 2])
def test_exclusive_methods_run_one_after_another_on_all_cases(real20, tmp_path, workers):
    log = tmp_path / "log"
    methods = [ExclusiveMethod("one", log), FakeMethod("small"), ExclusiveMethod("two", log)]
    rows = score(real20, methods, QUICK, tmp_path / "out", workers=workers)
    requested = [line.split() for line in log.read_text().splitlines()]
    assert [name for _, name, _ in requested] == ["one"] * 3 + ["two"] * 3
    assert {int(process) for process, _, _ in requested} == {os.getpid()}
    assert [row.method for row in rows[:3]] == ["one", "small", "two"]
