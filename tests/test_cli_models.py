"""The commands models, doctor and train."""

import importlib.util
import json
import shutil
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.cli import doctor, extras
from brewster.cli.extras import CORE, EXTRAS
from brewster.diffusion.model_table import DIFFUSION_MODELS
from brewster.errors import DeviceError, MissingExtra
from brewster.separation.models import zoo
from brewster.separation.models.published_networks import PUBLISHED_NETWORKS

ROOT = Path(__file__).parents[1]


@pytest.fixture
def model_zoo(model, monkeypatch, tmp_path):
    """A model zoo with an intact model and a damaged one."""
    copy = Path(shutil.copy(model, tmp_path.parent / f"{tmp_path.name}-intact.onnx"))
    intact = zoo.ModelFile(
        "compact", copy, zoo.ModelFile("", copy, None, "").verify(), "Apache-2.0"
    )
    damaged_file = tmp_path.parent / f"{tmp_path.name}.onnx"
    damaged_file.write_bytes(b"truncated")
    copy.with_suffix(".md").write_text("# pane\nIt fails on photos taken at night.\n")
    damaged = zoo.ModelFile("research", damaged_file, "0" * 64, "CC-BY-NC-4.0")
    monkeypatch.setattr(zoo, "MODELS", {"compact": intact, "research": damaged})


def test_models_are_listed_with_licence_and_damage(run_without_model, model_zoo):
    code, out, _ = run_without_model("models", "list")
    assert code == 0
    lines = [line for line in out.decode().splitlines() if not line.startswith(" ")]
    names = ["compact", "research", *PUBLISHED_NETWORKS, *DIFFUSION_MODELS]
    assert [line.split()[0] for line in lines] == ["name", *names]
    assert b"damaged" in out
    rows = json.loads(run_without_model("models", "list", "--json")[1])
    assert rows[0]["licence"] == "Apache-2.0"
    assert rows[1]["error"]
    assert [row["name"] for row in rows] == names


def test_a_model_has_a_card_and_a_path(run_without_model, model_zoo):
    assert run_without_model("models", "card") == (
        0,
        b"# pane\nIt fails on photos taken at night.\n\n",
        "",
    )
    path = f"{zoo.MODELS['compact'].path}\n".encode()
    assert run_without_model("models", "path", "compact") == (0, path, "")
    assert run_without_model("models", "path", "research")[0] == 1
    assert run_without_model("models", "card", "nonsense")[0] == 1


def test_the_network_of_films_has_a_card_and_a_checksum_and_separates_no_photo(
    run_without_model, tmp_path
):
    assert b"## Trained on" in run_without_model("models", "card", "film-light")[1]
    assert b"film-light: " in run_without_model("models", "verify")[1]
    (tmp_path / "a.png").write_bytes(b"")
    code, _, error = run_without_model(str(tmp_path / "a.png"), "--model", "film-light")
    assert code == 1
    assert "separates no photo" in error


def test_damaged_models_are_found(run_without_model, model_zoo):
    assert run_without_model("models", "verify", "compact")[0] == 0
    code, out, err = run_without_model("models", "verify")
    assert code == 1
    assert out.startswith(b"compact: ")
    assert err.startswith("error: ")
    code, out, _ = run_without_model("models", "verify", "--json")
    assert (code, [bool(row["error"]) for row in json.loads(out)]) == (1, [False, True, False])


def test_the_doctor_checks_every_dependency():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(CORE) == {line.split(">")[0] for line in settings["dependencies"]}
    extras = {
        name: {
            line.split(">")[0] for line in lines if ";" not in line
        }  # independent of the platform
        for name, lines in settings["optional-dependencies"].items()
        if name not in ("dev", "docs")  # for developers: no command needs them
    }
    assert extras == {name: set(packages) for name, packages in EXTRAS.items()}


def test_the_doctor_finds_missing_or_broken_packages(run_without_model, monkeypatch):
    assert run_without_model("doctor")[0] == 0
    monkeypatch.setattr(doctor, "CORE", (*CORE, "no-such-package"))
    monkeypatch.setitem(extras._MODULES, "click", "no_such_module")
    code, out, _ = run_without_model("doctor", "--json")
    found = {check["name"]: check["status"] for check in json.loads(out)["checks"]}
    assert (code, found["no-such-package"], found["click"]) == (1, "missing", "broken")


@pytest.mark.parametrize(("setting", "value"), [("steps=0", "0"), ("steps=many", '"many"')])
def test_a_value_of_the_recipe_is_replaced_before_it_is_checked(run_without_model, setting, value):
    code, _, err = run_without_model("train", ROOT / "recipes/train/tiny.toml", "--set", setting)
    assert code != 0
    assert f"steps is {value}; expected integer" in err


@pytest.mark.parametrize(("options", "device"), [((), "auto"), (("--device", "cpu"), "cpu")])
def test_a_model_is_trained_on_the_device_that_is_asked_for(
    recipe, run_without_model, monkeypatch, options, device
):
    def start(parsed, asked):
        raise DeviceError(f"{parsed.steps} steps on {asked}", "expected no start", "stop here")

    monkeypatch.setattr("brewster.training.loop.open_trainer", start)
    path = ROOT / "recipes" / "train" / "tiny.toml"
    code, _, err = run_without_model("train", path, *options)
    assert (code, f"{recipe.steps} steps on {device}" in err) == (1, True)


@pytest.mark.slow
def test_a_run_prints_its_progress_and_exports_a_model_that_separates(
    recipe, run_without_model, tmp_path
):
    path = ROOT / "recipes" / "train" / "tiny.toml"
    code, out, err = run_without_model("train", path, "--json")
    assert code == 0
    events = [json.loads(line) for line in out.splitlines()]
    steps = [(event["event"], event.get("step")) for event in events]
    assert steps == [("start", 0), ("report", 3), ("report", 6), ("end", None)]
    logged = [
        json.loads(line)
        for line in (tmp_path / "out" / "tiny" / "log.jsonl").read_text().splitlines()
    ]
    assert [event["metrics"].keys() | {"step"} for event in events[1:3]] == [
        line.keys() for line in logged
    ]
    assert events[-1]["model"] == "out/tiny/model.onnx"
    shown = [line[:11] for line in err.splitlines() if line.startswith("step")]
    assert shown == ["step 3 of 6", "step 6 of 6"]
    run = tmp_path / "out" / "tiny"
    names = {
        path.name for path in run.iterdir() if not path.name.startswith("events.out.tfevents.")
    }
    assert names == {"checkpoint.pt", "log.jsonl", "model.onnx", "samples.png"}
    _, out, err = run_without_model("train", path)
    assert out == b""
    assert err.startswith("the run in out/tiny is complete at step 6 of 6, after 0.")
    photo = Photo.from_array(np.full((50, 70, 3), 128, np.uint8), encoding="srgb")
    assert Separator.load(str(run / "model.onnx"))(photo).transmission.size == (70, 50)


def test_another_build_of_onnx_runtime_is_accepted(monkeypatch):
    monkeypatch.setattr(doctor, "_version", {"onnxruntime-gpu": "1.31"}.get)
    checks = {check.name: check for check in doctor._packages()}
    assert (checks["onnxruntime"].status, checks["onnxruntime"].detail) == (
        "ok",
        "1.31 (onnxruntime-gpu)",
    )
    assert checks["numpy"].status == "missing"


def test_a_script_is_told_all_missing_extras_and_one_command_that_installs_them(monkeypatch):
    find_spec = importlib.util.find_spec
    missing = {"peft", "mitsuba"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in missing else find_spec(name)
    )
    with pytest.raises(MissingExtra, match=r"mitsuba, peft; .*'\.\[render,web,diffusion\]'"):
        doctor.doctor.main(["--needs", "render,web,diffusion"], standalone_mode=False)
    doctor.doctor.main(["--needs", "evaluate,web"], standalone_mode=False)
    with pytest.raises(click.BadParameter, match="no extra 'trian'"):
        doctor.doctor.main(["--needs", "trian"], standalone_mode=False)
