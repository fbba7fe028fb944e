"""The command `brewster render`."""

import pytest
from pyarrow import parquet

from benchmark_folders import write
from brewster import Photo
from brewster.rendered import store
from brewster.rendered.generation import workers
from cli_helpers import error_lines, image_bytes, json_lines
from set_folders import hashes


def test_a_dataset_is_rendered_with_preview_and_each_scene_can_be_rendered_again(run_without_model, tmp_path):
    """Uses the real renderer and the built-in maps and photos."""
    options = ("--recipe", "tiny", "--count", 2, "--seed", 7, "--size", "48x32", "--orders", "truncated")
    code, out, err = run_without_model("render", "set", *options, "--workers", 0, "--json", "--preview")
    assert code == 0, err
    assert [(line["index"], line["status"]) for line in json_lines(out)] == [(0, "rendered"), (1, "rendered")]
    assert "2 rendered" in err
    assert {path.name for path in (tmp_path / "set" / "000001").iterdir()} == set(store.SAMPLE_FILES)
    assert Photo.open(tmp_path / "set" / "000001" / "photo.jpg").size == (48, 32)
    assert Photo.open(tmp_path / "set" / "preview.png").size == (272, 72)
    assert parquet.read_table(tmp_path / "set" / "index.parquet")["orders"].to_pylist() == ["truncated"] * 2
    for index in ("000000", "000001"):
        again = ("render", "--scene", f"set/{index}/scene.toml", "-o", f"again/{index}")
        assert run_without_model(*again)[0] == 0
        assert hashes(tmp_path / "again" / index) == hashes(tmp_path / "set" / index)


def test_a_sample_that_fails_is_reported_and_the_exit_code_is_one(run_without_model, monkeypatch):
    monkeypatch.setitem(workers.RENDERERS, "analytic", "fake_renderer:rejecting")
    code, _, err = run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 3, "--workers", 0, "--quiet"
    )
    assert code == 1
    assert error_lines(err) == [
        "error: sample 1: sample 1 cannot be rendered; expected another sample; choose another index."
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
