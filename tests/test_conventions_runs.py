"""The scripts in runs/ and bench/ work: the tiny experiment completely, the large ones as far as
possible on a CPU.
"""

import importlib
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
import torch

from brewster.cli import cli, main
from brewster.diffusion.adapter.lora import LORA_FILE
from brewster.photo import Photo
from brewster.training.recipe import read_recipe, with_value
from other_processes import finished

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "runs"
BIN = Path(sys.executable).parent


PAPER_FOLDERS = (
    "photos",
    "pairs/real",
    "pairs/nature",
    "real20",
    "nature20",
    "SIR2",
    "real/dev/nature",
)


def run_script(script, *args, path=BIN, code=0, **variables):
    """Runs a script, by default of runs/, in its own process. Returns its output, or its messages
    if it must fail.
    """
    process = finished(
        [RUNS / script, *map(str, args)],
        env=os.environ | {"PATH": f"{path}:{os.environ['PATH']}"} | variables,
    )
    assert process.returncode == code, process.stderr
    return process.stderr if code else process.stdout


def write_program(path, text):
    """Writes a program. Returns its folder, for PATH."""
    path.parent.mkdir()
    path.write_text(text)
    path.chmod(0o755)
    return path.parent


def write_recorder(folder):
    """Writes a program `brewster` that only records its arguments, see `recorded`. Returns its
    folder, for PATH.
    """
    calls = str(folder / "calls")
    code = f"import json, sys\nopen({calls!r}, 'a').write(json.dumps(sys.argv[1:]) + chr(10))\n"
    return write_program(folder / "bin" / "brewster", f"#!{sys.executable}\n{code}")


def recorded(folder):
    """Returns the arguments of each call of the program of `write_recorder`."""
    return [json.loads(line) for line in (folder / "calls").read_text().splitlines()]


def rows_by_first_cell(table):
    """Returns the rows of a Markdown table: first cell -> the other cells."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in table.splitlines()
        if "|" in line
    ]
    return {first: rest for first, *rest in rows}


def test_the_tiny_experiment_renders_trains_separates_and_evaluates(tmp_path, monkeypatch, capfd):
    """A stub records the commands of the script, with their arguments. They are run in this
    process, which imports torch, diffusers and Mitsuba once, not for each command.
    """
    stub = write_recorder(tmp_path)
    run_script("tiny.sh", tmp_path, path=stub)
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("BREWSTER_DATA", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for arguments in recorded(tmp_path):
        capfd.readouterr()
        assert main(arguments) == 0, capfd.readouterr().err
    card = capfd.readouterr().out
    tables = (tmp_path / "evaluate" / "tables.md").read_text()
    rows = rows_by_first_cell(tables.partition("###")[0])
    cells = [rows[method][0].split(" / ") for method in ("input (unprocessed)", "compact", "lora")]
    scores = {(float(psnr), float(ssim)) for psnr, ssim in cells}
    assert all(psnr > 5 and ssim > 0 for psnr, ssim in scores)
    assert len(scores) == 3
    assert len(list((tmp_path / "sets" / "tiny").glob("00000?"))) == 4
    for layer in ("transmission", "reflection"):
        made = Photo.open(tmp_path / "separated" / f"mixture-coffee-rocket.{layer}.jpg")
        assert made.size == Photo.open(ROOT / "tests/pictures/mixture-coffee-rocket.jpg").size
    assert "**This model is for software tests.**" in card
    assert rows_by_first_cell(card.partition("## Benchmark scores")[2])["lora"] == rows["lora"]
    written = {path.name for path in (tmp_path / "lora").iterdir()}
    assert written == {"README.md", LORA_FILE, "prompt.safetensors", "recipe.json"}


def test_the_full_size_check_runs_on_tiny_models(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["full_size_check.py", "--tiny", "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(RUNS / "full_size_check.py"), run_name="__main__")
    output = rows_by_first_cell(capsys.readouterr().out)
    rows = json.loads((tmp_path / "full_size.json").read_text())["rows"]
    assert [(row["backbone"], row["quantization"]) for row in rows] == [
        ("kontext", "int8"),
        ("klein", None),
    ]
    assert all(row["step_s"] > 0 and row["photo_s"] > 0 and row["fits"] for row in rows)
    assert output["kind"] == ["tiny version, not full size"] * 2
    assert rows_by_first_cell((tmp_path / "full_size.md").read_text()) == output


def test_the_tree_in_contributing_is_that_of_the_package():
    """After a change of a module's first sentence: make docs."""
    write_tree = runpy.run_path(str(RUNS / "write_tree.py"))
    page = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    assert write_tree["page"]() == page
    modules = {
        path.stem
        for path in (ROOT / "src" / "brewster").rglob("*.py")
        if (path.parent / "__init__.py").exists()  # others are scripts, shipped as data
    }
    modules -= {"__init__", "__main__", "burst"}  # the last one is an old path
    assert {name for name in modules if f" {name}: " not in page} == set()


def test_every_command_of_the_paper_experiment_is_valid(tmp_path):
    """A stub records the arguments of each call. The command line then parses them, and runs
    nothing.
    """
    stub = write_recorder(tmp_path)
    for folder in (*PAPER_FOLDERS, "hdri", "out/evaluate"):
        (tmp_path / folder).mkdir(parents=True)
    scores = tmp_path / "out" / "evaluate"
    (scores / "table.tex").touch()
    run_script("paper.sh", tmp_path / "out", path=stub, BREWSTER_DATA=str(tmp_path))
    commands = recorded(tmp_path)
    for arguments in commands:
        parse(arguments)
    render = next(arguments for arguments in commands if arguments[0] == "render")
    with pytest.raises(click.UsageError):
        parse([*render, "--no-such-option"])
    trainings = [arguments for arguments in commands if arguments[0] == "train"]
    for _, name, *options in trainings:
        recipe = read_recipe(ROOT / name)
        if "--set" in options:  # the values of the ablations are valid
            key, value = options[options.index("--set") + 1].split("=")
            with_value(recipe, key, int(value) if value.isdecimal() else value)
    check_that_models_are_trained_before(commands)
    first, *others = [
        arguments
        for arguments in commands
        if arguments[0] == "evaluate" and value_after("-o", arguments) == str(scores)
    ]
    assert others
    for later in others:  # the same benchmarks, metrics and folder: the first scores are kept
        assert later[: len(first)] == first


def check_that_models_are_trained_before(commands):
    """Every LoRA that is evaluated, used or described is one of an earlier training run."""
    trained = set()
    used = set()
    for arguments in commands:
        if arguments[0] == "train":
            assert value_after("-o", arguments) not in trained  # no run overwrites another
            trained.add(value_after("-o", arguments))
        loras = {word.rpartition("=")[2] for word in arguments if word.endswith("/lora")}
        assert {lora.removesuffix("/lora") for lora in loras} <= trained
        used |= loras
    assert {run + "/lora" for run in trained} == used


def value_after(option, arguments):
    return arguments[arguments.index(option) + 1]


def test_the_paper_experiment_starts_nothing_if_folders_of_its_data_are_missing(tmp_path):
    stub = write_program(tmp_path / "bin" / "brewster", '#!/bin/sh\n[ "$1" = doctor ] || exit 7\n')
    for folder in PAPER_FOLDERS[2:]:
        (tmp_path / folder).mkdir(parents=True)
    error = run_script("paper.sh", tmp_path / "out", path=stub, code=1, BREWSTER_DATA=str(tmp_path))
    assert error.startswith(f"error: {tmp_path} has no photos pairs/real; expected")


@pytest.mark.slow
def test_the_tiny_paper_experiment_trains_evaluates_and_ablates(tmp_path):
    run_script("paper.sh", "--tiny", tmp_path)
    table = rows_by_first_cell((tmp_path / "evaluate" / "tables.md").read_text())
    assert {"input (unprocessed)", "compact", "syn", "syn+real"} <= table.keys()
    assert "\\begin{tabular}" in (tmp_path / "table1.tex").read_text()
    results = json.loads((tmp_path / "failures" / "results.json").read_text())
    assert {"removed_white", "kept_reflection"} <= results["metrics"].keys()
    studies = {"blend_space": "blend_space srgb", "size": "count 0", "prompt": "prompt none"}
    for name, label in studies.items():
        assert label in (tmp_path / "ablations" / name / "tables.md").read_text()
    loras = [(tmp_path / name / "lora" / LORA_FILE).read_bytes() for name in ("syn", "syn+real")]
    assert loras[0] != loras[1]


@pytest.mark.slow
def test_the_first_gpu_day_runs_completely_on_tiny_models(tmp_path):
    run_script("first_gpu_day.sh", "--tiny", tmp_path)
    report = (tmp_path / "report.html").read_text()
    assert "All steps finished" in report
    assert report.count("none: a tiny model") == 2  # no verdict on WindowSeat
    assert (
        report.count("data:image/jpeg") == 2 * 2 * 6
    )  # of each photo: itself, predictions, ground truth
    assert report.count("data:image/png") == 1  # samples of the training
    scores = json.loads((tmp_path / "evaluate" / "results.json").read_text())["tables"]
    for name in ("real20", "nature20"):
        means = {method: columns["psnr"]["mean"] for method, columns in scores[name].items()}
        assert means.keys() == {
            "input (unprocessed)",
            "WindowSeat",
            "WindowSeat-guided",
            "LoRA",
            "compact",
        }
        assert all(mean > 5 for mean in means.values())
        assert len(set(means.values())) == 5
        assert f"<td>{means['LoRA']:.2f} dB" in report
    assert json.loads((tmp_path / "evaluate-rendered" / "results.json").read_text())["tables"][
        "test"
    ]["LoRA"]
    assert (tmp_path / "lora-run" / "lora" / LORA_FILE).is_file()


def test_the_first_gpu_day_lists_all_that_is_missing_and_starts_nothing(tmp_path):
    blended = tmp_path / "real20" / "blended"
    blended.mkdir(parents=True)
    for number in range(19):
        (blended / f"{number}.jpg").touch()
    folders = dict.fromkeys(("BREWSTER_DATA", "HF_HOME"), str(tmp_path))
    error = run_script("first_gpu_day.sh", tmp_path / "out", code=1, HF_HUB_OFFLINE="1", **folders)
    assert f"20 photos in {blended} (found 19;" in error
    assert f"20 photos in {tmp_path / 'nature20' / 'blended'} (found 0;" in error
    assert "access to https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev" in error
    assert not (tmp_path / "out").exists()


def test_the_first_gpu_day_reports_also_after_a_failure(tmp_path, monkeypatch):
    (tmp_path / "log.txt").write_text("error: <WindowSeat> failed\n")
    monkeypatch.setattr(sys, "argv", ["first_gpu_day.py", "report", str(tmp_path), "1", "full"])
    runpy.run_path(str(RUNS / "first_gpu_day.py"), run_name="__main__")
    assert "error: &lt;WindowSeat&gt; failed" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("measured", "is_reproduced"), [(26.7, True), (26.31, True), (26.2, False), (27.2, False)]
)
def test_windowseat_is_reproduced_if_its_score_is_close_to_the_published_one(
    measured, is_reproduced
):
    first_gpu_day = runpy.run_path(str(RUNS / "first_gpu_day.py"))
    scores = {"tables": {"real20": {"WindowSeat": {"psnr": {"mean": measured}}}}}
    (table,) = first_gpu_day["verdicts"](scores, is_tiny=False)
    assert ("NOT reproduced" not in table) == is_reproduced


def parse(arguments):
    """Parses the arguments of a command line, including those of subcommands, without running the
    command.
    """
    command = cli
    context = cli.make_context("brewster", list(arguments))
    while isinstance(command, click.Group):
        _, command, arguments = command.resolve_command(
            context, [*context._protected_args, *context.args]
        )
        context = command.make_context(command.name, arguments, parent=context)


@pytest.mark.parametrize("count", [0, 5, 8, 201, 400])
def test_the_verdicts_are_measured_on_the_given_number_of_mixtures(monkeypatch, count):
    def stream(step, batch_size, size_px):
        images = torch.full((batch_size, 3, 2, 2), step / 255)
        return SimpleNamespace(photo_encoded=images, transmission_encoded=images)

    monkeypatch.syspath_prepend(ROOT / "bench")
    verdict = importlib.import_module("verdict")
    monkeypatch.setattr(verdict, "read_recipe", lambda _: None)
    monkeypatch.setattr(verdict, "held_out_mixtures", lambda _: stream)
    steps = [pixels[0, 0, 0] for _, pixels in verdict.mixtures(count)]
    assert steps == [index // 8 for index in range(count)]


@pytest.mark.parametrize("script", sorted(RUNS.glob("*.sh")), ids=lambda path: path.stem)
def test_a_script_can_be_parsed_stops_at_the_first_error_and_names_existing_files(script):
    subprocess.run(["bash", "-n", script], check=True)
    assert "\nset -euo pipefail\n" in script.read_text()
    files = re.findall(
        r"(?:runs|recipes|docs|tests)/[\w/.-]+\.(?:sh|py|toml|md|jpg)", script.read_text()
    )
    assert all((ROOT / name).exists() for name in files)
