"""The command `brewster render`."""

import importlib.util
import json
import os
import resource
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest
from pyarrow import parquet

from brewster import Photo
from brewster.cli import main
from brewster.rendered import store
from brewster.rendered.generation import workers
from cli_helpers import error_lines, json_lines, run_process
from set_folders import hashes

COMMAND_WITH_FAKE_RENDERER = """
import sys
from brewster.cli import main
from brewster.rendered.generation import workers
workers.RENDERERS["analytic"] = "fake_renderer:{}"
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def fake_renderer(monkeypatch):
    monkeypatch.setitem(workers.RENDERERS, "analytic", "fake_renderer:render")


def start_with_fake_renderer(*args, renderer="render", **options):
    """Starts the command with a fake renderer in a process of its own."""
    path = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [
        sys.executable,
        "-c",
        COMMAND_WITH_FAKE_RENDERER.format(renderer),
        "render",
        *map(str, args),
        "--workers",
        "0",
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=path, **options)


def test_a_dataset_is_rendered_with_preview_and_each_scene_can_be_rendered_again(run_without_model, tmp_path):
    """Uses the real renderer and the built-in maps and photos."""
    options = ("--recipe", "tiny", "--count", 2, "--seed", 7, "--size", "48x32", "--orders", "truncated")
    code, out, err = run_without_model("render", "set", *options, "--workers", 0, "--json", "--preview")
    assert code == 0, err
    assert [(line["index"], line["status"]) for line in json_lines(out)] == [(0, "rendered"), (1, "rendered")]
    assert "2 rendered" in err
    assert {path.name for path in (tmp_path / "set" / "000001").iterdir()} == set(store.SAMPLE_FILES)
    assert Photo.open(tmp_path / "set" / "000001" / "photo.jpg").size == (48, 32)
    assert Photo.open(tmp_path / "set" / "preview.png").size == (800, 240)
    assert parquet.read_table(tmp_path / "set" / "index.parquet")["orders"].to_pylist() == ["truncated"] * 2
    for index in ("000000", "000001"):
        assert (
            run_without_model("render", "--scene", f"set/{index}/scene.toml", "-o", f"again/{index}")[0] == 0
        )
        assert hashes(tmp_path / "again" / index) == hashes(tmp_path / "set" / index)


def test_the_same_command_resumes_and_a_larger_count_adds_samples(run_without_model, fake_renderer, tmp_path):
    run_without_model("render", "set", "--recipe", "tiny", "--count", 2, "--workers", 0)
    code, out, err = run_without_model(
        "render", "-o", "set", "--recipe", "tiny", "--count", 3, "--workers", 0, "--json"
    )
    assert (code, [line["status"] for line in json_lines(out)]) == (0, ["skipped", "skipped", "rendered"])
    assert "sample 2 (" in err
    assert "1 rendered, 2 skipped" in err


def test_the_option_shards_packs_samples_into_tar_files(run_without_model, fake_renderer, tmp_path):
    assert (
        run_without_model(
            "render", "set", "--recipe", "tiny", "--count", 2, "--first", 99, "--workers", 0, "--shards"
        )[0]
        == 0
    )
    for shard, key in (("shard-000000.tar", "000099"), ("shard-000001.tar", "000100")):
        with tarfile.open(tmp_path / "set" / shard) as tar:
            assert tar.getnames() == [f"{key}.{name}" for name in store.SAMPLE_FILES]


def test_quiet_prints_nothing(run_without_model, fake_renderer):
    assert run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 1, "--workers", 0, "--quiet"
    ) == (0, b"", "")


def test_a_sample_that_fails_is_reported_and_the_exit_code_is_one(run_without_model, monkeypatch):
    monkeypatch.setitem(workers.RENDERERS, "analytic", "fake_renderer:rejecting")
    code, _, err = run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 3, "--workers", 0, "--quiet"
    )
    assert code == 1
    assert error_lines(err) == [
        "error: sample 1: sample 1 cannot be rendered; expected another sample; choose another index."
    ]


def test_another_job_in_the_folder_is_one_error_line(run_without_model, fake_renderer):
    run_without_model("render", "set", "--recipe", "tiny", "--count", 1, "--workers", 0)
    code, _, err = run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 1, "--workers", 0, "--seed", 3
    )
    assert code == 1
    assert len(error_lines(err)) == 1
    assert "its seed is 0, and 3 was requested" in err


def test_a_damaged_photo_is_excluded_and_reported(run_without_model, fake_renderer, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "broken.jpg").write_bytes(b"not an image")
    grey = Photo.open(next((Path(__file__).parent / "pictures").glob("mixture*.jpg")))
    grey.save(tmp_path / "photos" / "fine.jpg")
    code, _, err = run_without_model(
        "render", "set", "--recipe", "tiny", "--count", 1, "--workers", 0, "--photos", "photos"
    )
    assert code == 0
    assert "left out" in error_lines(err)[0]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((), "Give one output folder"),
        (("set", "-o", "other"), "Give one output folder"),
        (("set", "--size", "512"), "such as 512x384"),
        (("set", "--size", "8x8"), "from 16 to 16384"),
        (("set", "--count", "-1"), "--count"),
        (("set", "--maps", "nowhere"), "--maps"),
        (("set", "--size", f"{'1' * 5000}x512"), "from 16 to 16384"),
        (("set", "--size", "\u0661\u0666x16"), "from 16 to 16384"),
        (("set", "--scene", "scene.toml", "--count", "3"), "--count is an option for datasets"),
        (("set", "--scene", "scene.toml", "--json"), "--json is an option for datasets"),
    ],
)
def test_a_wrong_usage_is_explained(run_without_model, args, message):
    code, _, err = run_without_model("render", *args)
    assert code == 2
    assert message in err


def test_the_error_for_a_missing_package_has_the_command_that_installs_it(run_without_model, monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "torch" else find_spec(name, *rest)
    )
    code, _, err = run_without_model("render", "set")
    assert code == 1
    assert "rendering needs packages that are not installed: torch" in err
    assert "pip install -c constraints.txt -e '.[render]'" in err


def test_help_imports_no_heavy_library():
    code = "import sys; from brewster.cli import main; main(['render', '--help']); assert not {'torch', 'pyarrow', 'ray', 'pyvips'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_a_full_disk_is_one_error_line(tmp_path):
    def limit_file_size():
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    run = start_with_fake_renderer(
        "set", "--recipe", "tiny", "--count", 2, cwd=tmp_path, preexec_fn=limit_file_size
    )
    _, err = run.communicate()
    assert run.returncode == 1
    assert err.startswith(b"error: ")
    assert b"File too large" in err
    assert len(err.splitlines()) == 1
    assert sorted(path.name for path in (tmp_path / "set").iterdir()) == [".lock", "set.toml"]


def test_a_killed_and_restarted_run_gives_the_same_dataset_as_an_uninterrupted_run(
    run_without_model, fake_renderer, tmp_path
):
    command = ("--recipe", "tiny", "--count", 20, "--shards")
    run = start_with_fake_renderer("set", *command, renderer="slow", cwd=tmp_path)
    deadline = time.monotonic() + 30
    while len(list(tmp_path.glob("set/0*"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    code, _, err = run_without_model("render", "set", *command, "--workers", 0)
    assert (code, len(error_lines(err))) == (1, 1)
    assert "another run is writing to" in err
    run.kill()
    run.communicate()
    assert 4 <= len(list(tmp_path.glob("set/0*"))) < 20
    for name in ("set", "uninterrupted"):
        assert run_without_model("render", name, *command, "--workers", 0)[0] == 0
    assert hashes(tmp_path / "set") == hashes(tmp_path / "uninterrupted")


@pytest.mark.slow
def test_a_run_with_two_workers_can_be_killed_and_resumed(tmp_path):
    command = ("--recipe", "tiny", "--count", 6, "--seed", 7, "--workers", 2)
    run = subprocess.Popen(
        [sys.executable, "-m", "brewster", "render", "set", *map(str, command)], cwd=tmp_path
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("set/0*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    run.kill()
    run.wait()
    time.sleep(1)  # until the workers have exited
    for name in ("set", "uninterrupted"):
        process = run_process("render", name, *command, "--json", cwd=tmp_path)
        assert process.returncode == 0, process.stderr
    assert {json.loads(line)["status"] for line in process.stdout.splitlines()} == {"rendered"}
    assert hashes(tmp_path / "set") == hashes(tmp_path / "uninterrupted")


def test_render_is_a_command_of_brewster(capsys):
    assert main(["--help"]) == 0
    assert "render " in capsys.readouterr().out
