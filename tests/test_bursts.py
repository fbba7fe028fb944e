"""Rendered bursts on disk, the command that renders them, and bursts as a benchmark."""

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from benchmark_folders import picture, write
from brewster.errors import RecipeError
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.scoring import GroundTruth
from brewster.render.dataset import store
from brewster.render.dataset.generation import workers
from brewster.render.dataset.store import read_bursts
from brewster.render.scene import recipe
from cli_helpers import error_lines, json_lines
from set_folders import hashes, render_set

RECIPES = Path(recipe.__file__).parent / "recipes"
ROLES = ("frame", "transmission", "reflection")


@pytest.fixture(scope="module")
def two_bursts(tmp_path_factory):
    """Two bursts of five frames, rendered by a fake renderer."""
    out = tmp_path_factory.mktemp("set") / "bursts"
    render_set(out, count=10, recipe="burst")
    return out


@pytest.fixture
def fake_renderer(monkeypatch):
    monkeypatch.setitem(workers.RENDERERS, "analytic", "fake_renderer:render")


# --- on disk


def test_a_burst_has_its_frames_and_its_scenes(two_bursts):
    bursts = list(read_bursts(two_bursts))
    assert [burst.index for burst in bursts] == [0, 1]
    for burst in bursts:
        assert [frame.index for frame in burst.frames] == list(
            range(5 * burst.index, 5 * burst.index + 5)
        )
        assert (len(burst.scenes), burst.reference) == (5, 2)
        assert burst.scenes[burst.reference].burst.is_reference
        assert store.read_scene_of(burst.frames[0]) == burst.scenes[0]


def test_a_burst_without_a_frame_is_left_out_and_one_without_its_scene_is_an_error(
    two_bursts, tmp_path
):
    folder = shutil.copytree(two_bursts, tmp_path / "set")
    shutil.rmtree(folder / "000003")
    assert [burst.index for burst in read_bursts(folder)] == [1]
    (folder / "000007" / "transmission.jpg").unlink()
    (benchmark,) = read_benchmark("bursts", folder)
    assert not benchmark.cases
    assert len(benchmark.excluded) == 5
    shutil.rmtree(folder / "000007")
    render_set(folder, count=10, recipe="burst")
    assert hashes(folder) == hashes(two_bursts)
    (folder / "000003" / "scene.toml").unlink()
    with pytest.raises(RecipeError, match=r"the scene of .*000003 is missing"):
        read_benchmark("bursts", folder)


def test_single_photos_are_not_read_as_bursts(tmp_path):
    render_set(tmp_path / "set", count=1)
    for read in (lambda folder: list(read_bursts(folder)), partial(read_benchmark, "bursts")):
        with pytest.raises(RecipeError, match=r"sample 0 .* is a single photo"):
            read(tmp_path / "set")


# --- the command


def test_the_option_burst_renders_frames_of_a_recipe_and_resumes(
    run_without_model, fake_renderer, tmp_path
):
    """--baseline-mm moves the camera, although all bursts of the recipe are from a tripod."""
    tiny = (RECIPES / "tiny.toml").read_text()
    (tmp_path / "tripod.toml").write_text(f"{tiny}\n[burst]\nstatic_probability = 1.0\n")
    options = "--recipe", "tripod.toml", "--burst", 3, "--baseline-mm", 50
    command = "render", "set", *options, "--workers", 0, "--json"
    code, out, err = run_without_model(*command, "--count", 1, "--first", 2)
    assert code == 0, err
    assert [line["index"] for line in json_lines(out)] == [6, 7, 8]
    code, out, _ = run_without_model(*command, "--count", 3)
    assert code == 0
    statuses = sorted(line["status"] for line in json_lines(out))
    assert statuses == ["rendered"] * 6 + ["skipped"] * 3
    bursts = list(read_bursts(tmp_path / "set"))
    assert [burst.index for burst in bursts] == [0, 1, 2]
    assert {scene.burst.frames for burst in bursts for scene in burst.scenes} == {3}
    for burst in bursts:
        first, _, last = (np.array(scene.camera.position_mm) for scene in burst.scenes)
        assert 30 < np.linalg.norm(last - first) < 70


def test_the_baseline_of_the_recipe_is_replaced(run_without_model, fake_renderer, tmp_path):
    run_without_model(
        "render", "set", "--recipe", "burst", "--count", 1, "--workers", 0, "--baseline-mm", 0
    )
    (burst,) = read_bursts(tmp_path / "set")
    positions = np.array([scene.camera.position_mm for scene in burst.scenes])
    assert np.abs(positions - positions[2]).max() < 12  # only the tremble
    code, _, err = run_without_model(
        "render", "set", "--recipe", "burst", "--count", 1, "--workers", 0
    )
    assert code == 1
    assert "baseline_mm" in error_lines(err)[0]


# --- the benchmark


def test_rendered_bursts_are_cases_with_frames_and_exact_layers(two_bursts):
    (benchmark,) = read_benchmark("bursts", two_bursts)
    assert [case.name for case in benchmark.cases] == ["burst-000000", "burst-000001"]
    assert not benchmark.excluded
    assert not benchmark.remarks
    case = benchmark.cases[1]
    assert case.relative_path == "000007/photo"
    assert case.photo == case.frames[2]
    assert len(set(case.frames)) == 5
    assert case.ground_truth.path == two_bursts / "000007" / "transmission.jpg"
    GroundTruth.open(case, EvaluationConfig())


def photographed(root, numbers=(1, 2, 3), truths=(2,)):
    write(root, *(f"frame{number}.jpg" for number in numbers))
    return write(root, *(f"{role}{number}.png" for role in ROLES[1:] for number in truths))


def test_photographed_bursts_have_the_middle_frame_as_photo(tmp_path):
    photographed(tmp_path / "stone", (1, 2, 3, 4, 10), truths=(1, 3))
    photographed(tmp_path / "toy")
    photographed(tmp_path / "20240115")  # a date, and no rendered sample
    (tmp_path / "xue").mkdir()
    (benchmark,) = read_benchmark("bursts", tmp_path)
    assert [(case.name, case.relative_path) for case in benchmark.cases] == [
        ("20240115", "20240115/frame2"), ("stone", "stone/frame3"), ("toy", "toy/frame2"),
    ]  # fmt: skip
    stone = benchmark.cases[1]
    assert [file.path.stem for file in stone.frames] == [
        "frame1",
        "frame2",
        "frame3",
        "frame4",
        "frame10",
    ]
    assert (stone.ground_truth.path.stem, stone.reflection.path.stem) == (
        "transmission3",
        "reflection3",
    )
    assert benchmark.remarks == ("xue has no frames",)
    (alone,) = read_benchmark("bursts", tmp_path / "toy")
    assert [case.name for case in alone.cases] == ["toy"]


@pytest.mark.parametrize(("numbers", "middle"), [((1, 2), 2), ((3, 5, 8, 9), 8)])
def test_the_middle_of_an_even_burst_is_the_later_frame(tmp_path, numbers, middle):
    photographed(tmp_path / "even", numbers, truths=numbers)
    (benchmark,) = read_benchmark("bursts", tmp_path)
    assert [case.photo.path.stem for case in benchmark.cases] == [f"frame{middle}"]
    (tmp_path / "even" / f"transmission{middle}.png").unlink()
    (benchmark,) = read_benchmark("bursts", tmp_path)
    assert f"the middle frame, frame {middle}" in benchmark.excluded[0]


@pytest.mark.parametrize(("numbers", "truths", "change", "reason"), [
    ((1, 2, 3), (1,), {}, "no transmission of the middle frame, frame 2"),
    ((2,), (2,), {}, "there is one"),
    ((1, 2, 3), (2,), {"frame2.png": picture()}, "frame 2 is ambiguous"),
    ((1, 2, 3), (2,), {"frame3.jpg": picture((16, 6))}, "the frame 3 is 16x6"),
    ((1, 2, 3), (2,), {"frame3.jpg": b""}, "the frame 3 cannot be read"),
])  # fmt: skip
def test_an_unusable_burst_is_excluded_with_the_reason(tmp_path, numbers, truths, change, reason):
    photographed(tmp_path / "fine")
    photographed(tmp_path / "other", numbers, truths)
    for name, data in change.items():
        write(tmp_path / "other", name, data=data)
    (benchmark,) = read_benchmark("bursts", tmp_path)
    assert [case.name for case in benchmark.cases] == ["fine"]
    assert len(benchmark.excluded) == 1
    assert reason in benchmark.excluded[0]
