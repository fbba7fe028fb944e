"""The scores of one case, against scikit-image and by hand."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from benchmark_folders import paint
from brewster import Photo
from brewster.dataset.benchmarks import read_benchmark
from brewster.evaluate.judge import Judge, Truth
from brewster.evaluate.methods import Answer, Nothing
from brewster.evaluate.protocol import Protocol
from set_folders import make


def open_case(folder, protocol, name="pairs"):
    ((case, *_),) = (part.cases for part in read_benchmark(name, folder))
    truth = Truth.open(case, protocol)
    return truth, Judge(truth, protocol)


@pytest.fixture
def triplet(tmp_path):
    folder = tmp_path / "mine"
    paint(folder / "transmission" / "a.png", 1)
    paint(folder / "blended" / "a.png", 1, noise=25)
    paint(folder / "reflection" / "a.png", 2)
    return folder


@pytest.fixture
def rendered(tmp_path):
    """A sample in which the right half mirrors a bright patch, as brewster render leaves it."""
    make(tmp_path / "set", count=1)
    background = np.full((48, 64, 3), 0.3, np.float32)
    background[8:40, 4:28] = 0.05
    reflection = np.zeros_like(background)
    reflection[:, 34:] = 0.2
    for name, light in (
        ("photo", background + reflection),
        ("background", background),
        ("reflection", reflection),
    ):
        data = Photo.from_array(light, encoding="linear").encode("jpeg", depth=8)
        (tmp_path / "set" / "000000" / f"{name}.jpg").write_bytes(data)
    return tmp_path / "set"


def test_doing_nothing_scores_what_scikit_image_says(triplet):
    truth, judge = open_case(triplet, Protocol(metrics=("psnr", "ssim", "ssim_gaussian")))
    photo, transmission = truth.pictures["photo"], truth.pictures["transmission"]
    scores = judge.score(Nothing().answer(truth.case, truth.photo))
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    assert scores == {
        "psnr": pytest.approx(peak_signal_noise_ratio(transmission, photo), abs=1e-6),
        "ssim": pytest.approx(structural_similarity(transmission, photo, channel_axis=2), abs=1e-6),
        "ssim_gaussian": pytest.approx(
            structural_similarity(transmission, photo, channel_axis=2, **gaussian), abs=1e-6
        ),
    }


def test_the_reflection_is_measured_where_there_is_truth_and_an_answer(triplet):
    protocol = Protocol(metrics=("psnr", "psnr_reflection"))
    truth, judge = open_case(triplet, protocol)
    mirrored = Photo.from_array(truth.pictures["reflection"], encoding="srgb")
    assert judge.score(Answer(truth.photo, mirrored))["psnr_reflection"] == 100
    assert "psnr_reflection" not in judge.score(Answer(truth.photo))


def test_where_there_is_no_reflection_the_region_has_no_score(tmp_path):
    for role in ("blended", "transmission"):
        paint(tmp_path / "mine" / role / "a.png", 1)
    truth, judge = open_case(tmp_path / "mine", Protocol(metrics=("psnr", "psnr_region", "ssim_region")))
    assert judge.score(Answer(truth.photo)) == {"psnr": 100.0, "psnr_region": None, "ssim_region": None}
    assert judge.region_share == 0


def test_swept_thresholds_measure_smaller_and_smaller_regions(triplet):
    protocol = Protocol(metrics=("psnr_region",), thresholds=(0.01, 0.1))
    truth, judge = open_case(triplet, protocol)
    scores = judge.score(Answer(truth.photo))
    assert scores["psnr_region@0.1"] < scores["psnr_region@0.01"]


def test_the_failure_cases_are_scored_on_rendered_pictures_only(triplet, rendered):
    protocol = Protocol(metrics=("psnr", "removed_content", "kept_reflection"))
    truth, judge = open_case(triplet, protocol)
    assert list(judge.score(Answer(truth.photo))) == ["psnr"]
    truth, judge = open_case(rendered, protocol, "rendered")
    perfect = Photo.from_array(truth.pictures["transmission"], encoding="srgb")
    kept, removed = judge.score(Answer(truth.photo)), judge.score(Answer(perfect))
    assert removed["kept_reflection"] == pytest.approx(0, abs=0.02)
    assert kept["kept_reflection"] > 0.5
    assert removed["removed_content"] == 0


def test_pictures_too_small_for_a_metric_have_no_score(tmp_path):
    for role in ("blended", "transmission"):
        paint(tmp_path / "mine" / role / "a.png", 1, size=(8, 4))
    truth, judge = open_case(tmp_path / "mine", Protocol(metrics=("psnr", "ssim")))
    assert judge.score(Answer(truth.photo)) == {"psnr": 100.0, "ssim": None}


def test_lpips_of_the_dev_pairs_is_small_for_the_truth_and_large_for_noise(data, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(data))
    protocol = Protocol(metrics=("lpips", "lpips_region"))
    truth, judge = open_case(data / "real/dev/nature", protocol, "nature20")
    perfect = Photo.from_array(truth.pictures["transmission"], encoding="srgb")
    noise = np.random.default_rng(1).integers(0, 256, truth.pictures["photo"].shape, np.uint8)
    scores = [
        judge.score(Answer(photo))["lpips"]
        for photo in (perfect, truth.photo, Photo.from_array(noise, encoding="srgb"))
    ]
    assert scores[0] == 0 < scores[1] < 0.5 < scores[2]
    assert judge.score(Answer(truth.photo))["lpips_region"] > scores[1]
