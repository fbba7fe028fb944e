"""The scores of one case: which metrics apply, what each of them receives, and how images are
resized.
"""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from benchmark_folders import paint
from brewster import Photo
from brewster.evaluation import runner
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import IdentityBaseline, MethodOutput
from brewster.evaluation.scoring import GroundTruth, Scorer, resize
from brewster.metrics import METRICS, Metric, psnr
from set_folders import render_set


def open_case(folder, config, name="pairs"):
    ((case, *_),) = (part.cases for part in read_benchmark(name, folder))
    truth = GroundTruth.open(case, config)
    return truth, Scorer(truth, config)


@pytest.fixture
def triplet(tmp_path):
    folder = tmp_path / "mine"
    paint(folder / "transmission" / "a.png", 1)
    paint(folder / "blended" / "a.png", 1, noise=25)
    paint(folder / "reflection" / "a.png", 2)
    return folder


@pytest.fixture
def rendered(tmp_path):
    """A sample as `brewster render` writes it, with a bright reflection in the right half."""
    render_set(tmp_path / "set", count=1)
    background = np.full((48, 64, 3), 0.3, np.float32)
    background[8:40, 4:28] = 0.05
    reflection = np.zeros_like(background)
    reflection[:, 34:] = 0.2
    layers = {"photo": background + reflection, "background": background, "reflection": reflection}
    for name, light in layers.items():
        data = Photo.from_array(light, encoding="linear").encode("jpeg", depth=8)
        (tmp_path / "set" / "000000" / f"{name}.jpg").write_bytes(data)
    return tmp_path / "set"


def test_the_reflection_is_scored_if_there_is_a_ground_truth_and_a_prediction(triplet):
    config = EvaluationConfig(metrics=("psnr", "psnr_reflection"))
    truth, scorer = open_case(triplet, config)
    reflection_image = Photo.from_array(truth.images["reflection"], encoding="srgb")
    assert scorer.score(MethodOutput(truth.photo, reflection_image))["psnr_reflection"] == 100
    assert "psnr_reflection" not in scorer.score(MethodOutput(truth.photo))


def test_without_a_reflection_the_region_has_no_score(tmp_path):
    for role in ("blended", "transmission"):
        paint(tmp_path / "mine" / role / "a.png", 1)
    config = EvaluationConfig(metrics=("psnr", "psnr_region", "ssim_region"))
    truth, scorer = open_case(tmp_path / "mine", config)
    expected = {"psnr": 100.0, "psnr_region": None, "ssim_region": None}
    assert scorer.score(MethodOutput(truth.photo)) == expected
    assert scorer.region_share == 0


def test_the_failure_cases_are_scored_on_rendered_samples_only(triplet, rendered):
    config = EvaluationConfig(metrics=("psnr", "removed_content", "kept_reflection"))
    truth, scorer = open_case(triplet, config)
    assert list(scorer.score(MethodOutput(truth.photo))) == ["psnr"]
    truth, scorer = open_case(rendered, config, "rendered")
    perfect = Photo.from_array(truth.images["transmission"], encoding="srgb")
    unchanged = scorer.score(MethodOutput(truth.photo))
    removed = scorer.score(MethodOutput(perfect))
    assert removed["kept_reflection"] == pytest.approx(0, abs=0.02)
    assert unchanged["kept_reflection"] > 0.5
    assert removed["removed_content"] == 0


def test_images_that_are_too_small_for_a_metric_have_no_score(tmp_path):
    for role in ("blended", "transmission"):
        paint(tmp_path / "mine" / role / "a.png", 1, size=(8, 4))
    truth, scorer = open_case(tmp_path / "mine", EvaluationConfig(metrics=("psnr", "ssim")))
    assert scorer.score(MethodOutput(truth.photo)) == {"psnr": 100.0, "ssim": None}


def make_metric(name, score, **more):
    return Metric(name, name, "", True, 3, "A score.", "transmission", score, **more)


def test_a_metric_of_the_region_receives_the_region_of_the_threshold(triplet, monkeypatch):
    row = make_metric("share", lambda case: float(case.region.mean()), area="region")
    monkeypatch.setitem(METRICS, "share", row)
    truth, scorer = open_case(triplet, EvaluationConfig(metrics=("share",), threshold=0.1))
    expected = pytest.approx(truth.region(0.1).mean(), abs=1e-6)
    assert scorer.score(MethodOutput(truth.photo)) == {"share": expected}


def test_a_metric_is_prepared_before_the_first_score(triplet, tmp_path, monkeypatch):
    order = []
    row = make_metric(
        "late", lambda case: float(len(order)), prepare=lambda: order.append("prepared")
    )
    monkeypatch.setitem(METRICS, "late", row)
    benchmarks = read_benchmark("pairs", triplet)
    config = EvaluationConfig(metrics=("late",))
    (first,), _ = runner.score(benchmarks, [IdentityBaseline()], config, tmp_path / "out")
    (again,), _ = runner.score(benchmarks, [IdentityBaseline()], config, tmp_path / "out")
    assert first.scores == again.scores == {"late": 1.0}


def test_the_border_is_not_scored(triplet):
    config = EvaluationConfig(metrics=("psnr", "ssim"))
    truth, scorer = open_case(triplet, config)
    spoilt = truth.images["transmission"].copy()
    spoilt[:4] = 0
    spoilt[-4:] = 255
    spoilt[:, :4] = 0
    spoilt[:, -4:] = 255
    prediction = MethodOutput(Photo.from_array(spoilt, encoding="srgb"))
    _, without_border = open_case(triplet, replace(config, border=4))
    assert scorer.score(prediction)["psnr"] < 40
    assert without_border.score(prediction) == {"psnr": 100, "ssim": 1}


@pytest.mark.parametrize("size", [(40, 24), (24, 40), (32, 32)])
@pytest.mark.parametrize("border", [1, 8])
def test_the_scores_with_a_border_are_those_of_the_images_without_it(tmp_path, size, border):
    paint(tmp_path / "mine/transmission/a.png", 1, size=size)
    paint(tmp_path / "mine/blended/a.png", 1, size=size, noise=25)
    config = EvaluationConfig(metrics=("psnr",), border=border)
    truth, scorer = open_case(tmp_path / "mine", config)
    inner = [
        truth.images[name][border : size[1] - border, border : size[0] - border]
        for name in ("photo", "transmission")
    ]
    expected = pytest.approx(psnr(*inner), abs=1e-3)
    assert scorer.score(MethodOutput(truth.photo)) == {"psnr": expected}


MULTIPLES = EvaluationConfig(size_divisor=32)


@pytest.mark.parametrize("size", [(540, 400), (95, 70), (33, 64), (127, 31)])
def test_the_result_is_that_of_pillow(rng, size):
    pixels = rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    width, height = (max(side // 32 * 32, min(side, 32)) for side in size)
    expected = np.asarray(Image.fromarray(pixels).resize((width, height)))
    ours = resize(Photo.from_array(pixels, encoding="srgb"), MULTIPLES).srgb_8bit()
    assert ours.shape == expected.shape
    # Pillow computes with integer weights, so values that lie between two integers can differ.
    assert abs(ours.astype(int) - expected).max() <= 1
    assert (ours != expected).mean() < 0.001


def test_a_photo_with_such_sides_is_not_changed():
    photo = Photo.from_array(np.zeros((64, 96, 3), np.uint8), encoding="srgb")
    assert resize(photo, MULTIPLES) is photo
    assert resize(photo, EvaluationConfig()) is photo


def test_a_photo_is_first_downscaled_and_then_rounded():
    photo = Photo.from_array(np.zeros((500, 700, 3), np.uint8), encoding="srgb")
    assert resize(photo, EvaluationConfig(short_side_px=420, size_divisor=32)).size == (576, 416)


@pytest.mark.parametrize(
    ("size", "small"), [((60, 40), (30, 20)), ((40, 60), (20, 30)), ((50, 18), (50, 18))]
)
def test_a_photo_is_downscaled_to_the_shorter_side_and_never_enlarged(size, small):
    photo = Photo.from_array(np.zeros((*size[::-1], 3), np.uint8), encoding="srgb")
    assert resize(photo, EvaluationConfig(short_side_px=20)).size == small
