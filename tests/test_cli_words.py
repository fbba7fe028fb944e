"""What people type and expect: short options, percentages, help, and messages that fit."""

import shutil
import signal
import subprocess
import sys

import pytest
from PIL import Image

from benchmark_folders import write
from brewster import Photo
from brewster.errors import OutputError
from cli_helpers import image_bytes, list_files


def test_help_is_a_command_and_a_photo_of_this_name_is_a_photo(run_without_model, tmp_path):
    assert run_without_model("help")[:2] == run_without_model("--help")[:2]
    assert (
        run_without_model("help", "models", "install")[:2]
        == run_without_model("models", "install", "--help")[:2]
    )
    (tmp_path / "help").write_bytes(image_bytes())
    assert b"help.transmission" in run_without_model("help", "--dry-run")[1]


def test_v_is_the_version_and_q_is_quiet(run, tmp_path):
    assert run("-v") == run("-V") == run("--version")
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    assert run("a.jpg", "-q") == (0, b"", "")


@pytest.mark.parametrize("command", ["separate", "burst", "train", "evaluate", "render"])
def test_each_command_that_can_be_quiet_has_the_short_option(run_without_model, command):
    assert b"-q, --quiet" in run_without_model(command, "--help")[1]


def test_a_strength_in_percent_is_the_same_as_a_fraction(run, tmp_path):
    (tmp_path / "a.png").write_bytes(image_bytes(format_name="png"))
    for strength, folder in (("70%", "percent"), ("0.7", "fraction")):
        assert run("a.png", "--strength", strength, "-o", f"{folder}/")[0] == 0
    layers = [tmp_path / folder / "a.transmission.png" for folder in ("percent", "fraction")]
    assert layers[0].read_bytes() == layers[1].read_bytes()


@pytest.mark.parametrize("strength", ["70", "101%", "-1%", "x%", "%", "nan", "1.01"])
def test_other_strengths_are_refused(run, tmp_path, strength):
    (tmp_path / "a.png").write_bytes(image_bytes())
    assert run("a.png", f"--strength={strength}")[0] == 2
    assert list_files(tmp_path) == ["a.png"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_that_the_shell_accepts(run_without_model, shell):
    code, script, err = run_without_model("completion", shell)
    assert code == 0, err
    assert b"_BREWSTER_COMPLETE" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, check=True)


def test_folders_of_other_programs_are_skipped_and_counted(run, tmp_path):
    for name in ("@eaDir", "#recycle", ".thumbnails", "album"):
        (tmp_path / "holiday" / name).mkdir(parents=True)
        (tmp_path / "holiday" / name / "a.jpg").write_bytes(image_bytes())
    code, out, err = run("holiday", "-o", "clear", "--dry-run")
    assert code == 0
    assert len(out.splitlines()) == 1
    assert b"album" in out
    assert "3 folders" in err
    assert b"a.transmission" in run("holiday/@eaDir", "-o", "clear", "--dry-run")[1]


def test_python_is_not_advised_to_use_options_of_the_command_line(tmp_path):
    photo = Photo.open(image_bytes())
    (tmp_path / "file").write_bytes(b"")
    for path in (tmp_path, tmp_path / "file" / "a.png"):
        with pytest.raises(OutputError) as raised:
            photo.save(path if path.suffix else path / "sub.png" / "..", format="png")
        assert " -o" not in str(raised.value)


INTERRUPTED = """
import os, signal, sys
from brewster.cli import main
from brewster.separation import Separator
separate = Separator.__call__
def interrupt(self, source, **options):
    if source.name == "b.jpg":
        os.kill(os.getpid(), signal.SIGINT)
    return separate(self, source, **options)
Separator.__call__ = interrupt
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for other processes")
@pytest.mark.parametrize(("photos", "is_resumed"), [(["b.jpg"], False), (["a.jpg", "b.jpg"], True)])
def test_ctrl_c_speaks_of_resuming_only_where_something_is_finished(tmp_path, photos, is_resumed):
    for name in photos:
        (tmp_path / name).write_bytes(image_bytes())
    stopped = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, *photos],
        cwd=tmp_path,
        capture_output=True,
        check=False,
    )
    assert stopped.returncode == 128 + signal.SIGINT
    assert (b"resume" in stopped.stderr) == is_resumed


def test_a_last_path_that_does_not_exist_may_be_meant_as_the_output(run, tmp_path):
    write(tmp_path, "a.jpg", "b.jpg", data=image_bytes())
    for last in ("clear.jpg", "clear/"):
        code, _, err = run("a.jpg", last, "--overwrite")
        assert (code, f"brewster a.jpg -o {last}" in err) == (1, True)
    for arguments in (("a.jpg", "b.jpg"), ("a.jpg", "none.jpg", "-o", "out"), ("none.jpg",)):
        assert "give it with -o" not in run(*arguments, "--overwrite")[2]


@pytest.mark.parametrize("format_name", ["gif", "png", "webp"])
def test_an_animation_given_as_a_photo_names_the_command_that_opens_it(run, tmp_path, format_name):
    frames = [Image.new("RGB", (40, 30), colour) for colour in ("red", "green", "blue")]
    path = tmp_path / f"a.{format_name}"
    frames[0].save(path, save_all=True, append_images=frames[1:])
    code, _, err = run(path.name)
    assert (code, "brewster burst" in err) == (1, True)
