"""Ablation studies: one model for each value of a key, all trained and scored in the same way."""

import io
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmark_folders import paint, write
from brewster.benchmarks.registry import read_benchmark
from brewster.errors import BrewsterError, DownloadError
from brewster.evaluate import ablation as module
from brewster.evaluate.ablation import ablate, read_study
from brewster.metrics import METRICS
from brewster.training.recipe import read_recipe, with_value

RECIPES = Path(__file__).parents[1] / "recipes" / "ablations"
STUDIES = [
    path
    for path in sorted(RECIPES.glob("*.toml"))
    if "base" in tomllib.loads(path.read_text()) and not path.stem.endswith("-tiny")
]
"""The studies of the compact model. runs/paper.sh --tiny runs the tiny variants of those of the diffusion model."""


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_study_changes_one_value_of_both_the_full_and_the_tiny_recipe(path):
    full, variant = read_study(path), path.with_stem(f"{path.stem}-tiny")
    tiny = (
        read_study(variant) if variant.is_file() else full.model_copy(update={"base": RECIPES / "tiny.toml"})
    )
    for study in (full, tiny):
        base = read_recipe(study.base)
        recipes = [with_value(base, study.key, value) for value in study.values]
        assert base in recipes
        assert len({recipe.model_dump_json() for recipe in recipes}) == len(study.values)


@pytest.fixture
def without_training(monkeypatch, model):
    """Replaces training: every trained model is a copy of the model of the fixture. Returns the recipes that are trained."""

    recipes = []

    def train(recipe, folder, on_step):
        recipes.append(recipe)
        on_step(1, 1, {"loss": 0.5}, True)
        folder.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(model, folder / "model.onnx"))

    monkeypatch.setattr(module, "_train", train)
    return recipes


@pytest.fixture
def lpips_weights(data, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(data))


@pytest.fixture
def pairs(tmp_path):
    for name in ("1", "2"):
        paint(tmp_path / "real20" / "blended" / f"{name}.png", int(name), size=(96, 80), noise=20)
        paint(tmp_path / "real20" / "transmission" / f"{name}.png", int(name), size=(96, 80))
    return read_benchmark("real20", tmp_path / "real20")


@pytest.mark.usefixtures("lpips_weights")
def test_values_are_compared_with_the_first_and_numbers_are_plotted(without_training, pairs, tmp_path):
    calls = []
    study = read_study(RECIPES / "size.toml")
    results = ablate(study, pairs, tmp_path / "out", on_progress=lambda *values: calls.append(values))
    labels = [f"count {count}" for count in (0, 10, 50, 100, 300, 1000)]
    assert list(results["methods"]) == ["input (unprocessed)", *labels]
    assert [values[0] for values in calls] == labels
    assert [recipe.data.rendered.count for recipe in without_training] == [0, 10, 50, 100, 300, 1000]
    compared = {(row["method"], row["reference"]) for row in results["differences"]["real20"]}
    assert ("count 300", "count 0") in compared
    plot = np.asarray(Image.open(io.BytesIO((tmp_path / "out" / "plot.png").read_bytes())).convert("L"))
    assert plot.shape[1] > plot.shape[0] > 300
    assert 0.005 < (plot < 128).mean() < 0.5


def test_missing_weights_of_a_metric_are_reported_before_training(pairs, tmp_path, monkeypatch):
    def refuse():
        raise DownloadError("LPIPS has no weights", "expected a network connection", "connect")

    def train(*_):
        raise AssertionError("training started without the weights of LPIPS")

    monkeypatch.setattr(module, "_train", train)
    monkeypatch.setitem(METRICS, "lpips", replace(METRICS["lpips"], prepare=refuse))
    with pytest.raises(DownloadError, match="LPIPS has no weights"):
        ablate(read_study(RECIPES / "size.toml"), pairs, tmp_path / "out")


def test_labels_that_cannot_name_methods_are_refused_before_training(pairs, tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(module, "_train", lambda *recipe: trained.append(recipe) or Path("trained.onnx"))
    study = read_study(RECIPES / "size.toml").model_copy(update={"key": "prompt", "values": ["a/b", "a b"]})
    with pytest.raises(BrewsterError, match="2 methods have the name 'prompt a b'"):
        ablate(study, pairs, tmp_path / "out")
    assert not trained


def test_two_benchmarks_of_folders_with_one_name_are_renamed(tmp_path, monkeypatch):
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path))
    write(tmp_path / "real" / "dev", "blended/1.png", "transmission/1.png")
    write(tmp_path / "bursts" / "dev" / "stone", "frame1.jpg", "frame2.jpg", "transmission2.jpg")
    benchmarks = {"pairs": Path("real/dev"), "bursts": Path("bursts/dev")}
    study = read_study(RECIPES / "size.toml").model_copy(update={"benchmarks": benchmarks})
    assert len({part.name for part in study.open_benchmarks()}) == 2


@pytest.mark.usefixtures("lpips_weights")
def test_values_that_are_not_numbers_are_not_plotted(without_training, pairs, tmp_path):
    ablate(read_study(RECIPES / "blend-space.toml"), pairs, tmp_path / "out")
    assert not (tmp_path / "out" / "plot.png").exists()
    assert (tmp_path / "out" / "blend_space-srgb" / "model.onnx").is_file()


@pytest.mark.usefixtures("lpips_weights")
def test_prompts_are_compared_on_a_backbone_without_training(pairs, tmp_path):
    study = read_study(RECIPES / "prompt.toml").model_copy(update={"base": RECIPES / "no-lora-tiny.toml"})
    results = ablate(study, pairs, tmp_path / "out")
    assert list(results["methods"]) == [
        "input (unprocessed)", "prompt none", "prompt generic", "prompt detailed",
    ]  # fmt: skip
    assert not (tmp_path / "out" / "prompt-generic" / "checkpoint.pt").exists()
    means = [row["psnr"]["mean"] for row in results["tables"]["real20"].values()]
    assert len(set(means)) == 4
