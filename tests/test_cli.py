"""The command line: commands, options, help, standard input and output, errors and progress."""

import contextlib
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo
from cli_helpers import image_bytes, list_files, run_process

ROOT = Path(__file__).parents[1]


def test_without_a_command_the_photo_is_separated_and_the_layers_are_next_to_it(run, tmp_path):
    (tmp_path / "photo.jpg").write_bytes(image_bytes())
    code, out, err = run("photo.jpg")
    assert (code, out) == (0, b"")
    assert list_files(tmp_path) == ["photo.jpg", "photo.reflection.jpg", "photo.transmission.jpg"]
    assert "photo.transmission.jpg, photo.reflection.jpg" in err


@pytest.mark.parametrize("arguments", [["separate", "a.png", "-o", "x"], ["-o", "x", "a.png"]])
def test_the_command_name_separate_is_optional_and_options_may_come_first(run, tmp_path, arguments):
    (tmp_path / "a.png").write_bytes(image_bytes(format_name="png"))
    assert run(*arguments)[0] == 0
    assert list_files(tmp_path / "x") == ["a.reflection.png", "a.transmission.png"]


@pytest.mark.parametrize(("format_", "suffix"), [(None, "tiff"), ("exr", "exr")])
def test_additive_layers_are_floats_that_sum_to_the_photo(run, tmp_path, format_, suffix):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    assert run("a.jpg", "--additive", *(["--format", format_] if format_ else []))[0] == 0
    layers = [
        Photo.open(tmp_path / f"a.{layer}.{suffix}") for layer in ("transmission", "reflection")
    ]
    assert all(layer.pixels.dtype == np.float32 for layer in layers)
    assert (
        layers[0].linear() + layers[1].linear() == Photo.open(tmp_path / "a.jpg").linear()
    ).all()


@pytest.mark.parametrize("format_name", ["jpeg", "png", "tiff", "webp"])
def test_standard_input_goes_to_standard_output_in_its_format(run, format_name):
    code, out, err = run("-", stdin=image_bytes(format_name=format_name))
    assert (code, Photo.open(out).file_info.format_name) == (0, format_name)
    assert "- -> -" in err


def test_standard_output_accepts_another_layer_and_format(run):
    code, out, err = run("-", "--layers", "confidence", "--quiet", stdin=image_bytes())
    assert (code, err, Photo.open(out).pixels.shape) == (0, "", (40, 60, 1))
    exr = Photo.open(run("-", "--additive", "--format", "exr", stdin=image_bytes())[1])
    assert exr.file_info.format_name == "exr"


def test_a_file_can_go_to_standard_output_and_standard_input_to_a_file(run, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    code, out, _ = run("a.jpg", "-o", "-")
    assert code == 0
    assert run("-", "-o", "b.jpg", "--json", stdin=image_bytes())[0] == 0
    assert (tmp_path / "b.jpg").read_bytes() == out
    assert run("a.jpg", "-o", "new/clear.png")[0] == 0
    assert Photo.open(tmp_path / "new" / "clear.png").file_info.format_name == "png"


@pytest.mark.parametrize("stdin", [b"", b"hello"])
def test_standard_input_without_an_image_is_an_error_and_gives_no_output(run, stdin):
    code, out, err = run("-", stdin=stdin)
    assert (code, out) == (1, b"")
    assert err.startswith("error: -: ")
    assert err.count("\n") == 1


def test_a_full_standard_output_gives_one_error_line(model):
    command = [sys.executable, "-m", "brewster", "-", "--model", model]
    with Path("/dev/full").open("wb") as full:
        process = subprocess.run(
            command, input=image_bytes(), stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert process.returncode == 1
    assert process.stderr.splitlines()[-1].startswith(
        b"error: -: standard output was not written (No space"
    )


def test_no_image_is_written_to_a_terminal(run, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    code, out, err = run("-", stdin=image_bytes())
    assert (code, out) == (2, b"")
    assert "terminal" in err


PRINTING_CLI = """
import ctypes, os, sys
from brewster.cli import main
from brewster.photo import Photo

original = Photo.open.__func__
def print_and_open(cls, *args, **options):
    print("printed in Python")
    ctypes.CDLL(None).puts(b"printed in C")
    os.system("echo printed by a child")
    return original(cls, *args, **options)
Photo.open = classmethod(print_and_open)
sys.exit(main(sys.argv[1:]))
"""


def test_output_of_libraries_does_not_reach_standard_output(model, tmp_path):
    """C code has its own buffer, which is written when the process exits, after any temporary
    redirection has ended.
    """
    command = [sys.executable, "-c", PRINTING_CLI, "-", "--model", model]
    process = subprocess.run(command, input=image_bytes(), capture_output=True, check=False)
    expected = run_process("-", "--model", model, input=image_bytes())
    assert (process.returncode, process.stdout) == (0, expected.stdout)
    for origin in (b"in Python", b"in C", b"by a child"):
        assert process.stderr.count(b"printed " + origin) == 1


def test_help_goes_to_standard_output():
    for arguments in (["--help"], ["separate", "-h"], ["models", "list", "-h"], ["--version"]):
        process = run_process(*arguments)
        assert (process.returncode, process.stderr) == (0, b"")
        assert process.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        "", "separate", "a.jpg --strength 2", ("a.jpg --device "
                                              "tpu"), "a.jpg --max-pixels 0", "a.jpg --sharpen",
        "a.jpg --additive --format jpeg", ("a.jpg b.jpg -o "
                                          "clear.jpg"), "a.jpg - -o x", "- -o folder", "- --json",
        "- --layers transmission,reflection", ("a.jpg -o clear.jpg --format "
                                              "png"), "a.jpg -o clear.jpg --additive",
        "a.jpg -o clear.gif", "a.jpg -o clear.bmp", ("a.jpg --format "
                                                    "gif"), "a.jpg --contact-sheet s.bmp",
        "- --contact-sheet s.jpg", "a.jpg --cluster local", "a.jpg --workers 2 -o -",
        "a.jpg --workers 2 -o b.jpg", "models delete",
    ],
)  # fmt: skip
def test_contradictory_or_invalid_arguments_give_exit_code_2(
    run_without_model, tmp_path, arguments
):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    code, out, err = run_without_model(*arguments.split())
    assert (code, out) == (2, b"")
    assert "Traceback" not in err
    assert list_files(tmp_path) == ["a.jpg"]


def test_a_misspelled_command_gives_a_suggestion_unless_a_photo_has_it(
    run, run_without_model, tmp_path
):
    assert "Did you mean models?" in run_without_model("modles")[2]
    (tmp_path / "modles").write_bytes(image_bytes())
    assert run("modles")[0] == 0
    assert (tmp_path / "modles.transmission.jpg").exists()


@pytest.mark.parametrize(("arguments", "message"), [
    (["a.jpg", "--model", "compcat"], "did you mean compact?"),
    (["a.jpg", "--model", "a.jpg"], "is not a model"),
    (["a.jpg", "--device", "coreml"], "device coreml is not available"),
    (["missing.jpg"], "missing.jpg cannot be read"),
    (["empty"], "there is no photo in empty"),
])  # fmt: skip
def test_an_error_is_one_line_with_exit_code_1(
    run, run_without_model, tmp_path, arguments, message
):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    (tmp_path / "empty").mkdir()
    code, out, err = (run_without_model if "--model" in arguments else run)(*arguments)
    assert (code, out) == (1, b"")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err


def run_on_terminal(*args, folder):
    """Runs the command with a pseudo terminal as standard error. Returns standard output and the
    terminal's text.
    """
    controller, terminal = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "brewster", *map(str, args)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=terminal,
        env=os.environ | {"TERM": "xterm", "COLUMNS": "200"},
    ) as process:
        os.close(terminal)
        output = b""
        with contextlib.suppress(
            OSError
        ):  # Linux reports an error when the process has closed the terminal
            while part := os.read(controller, 1 << 16):
                output += part
        os.close(controller)
        out = process.stdout.read()
    assert process.returncode == 0
    return out, output.decode()


def test_a_terminal_shows_progress_and_standard_output_stays_clean(model, tmp_path):
    for index in range(3):
        (tmp_path / f"{index}.jpg").write_bytes(image_bytes())
    out, shown = run_on_terminal(".", "--model", model, folder=tmp_path)
    assert out == b""
    assert "\x1b[" in shown
    assert "/3" in shown
    assert "0.transmission.jpg" in shown


def test_public_names_exist_in_any_order_of_imports():
    for start in (
        "import brewster",
        "import brewster.separation.tiles as brewster_tiles; import brewster",
    ):
        code = f"{start}\nassert callable(brewster.separate) and callable(brewster.separate)\n"
        code += (
            "from brewster import Separator; assert brewster.separation.Separator is Separator\n"
        )
        code += "assert callable(brewster.separate) and not hasattr(brewster, 'nonsense')\n"
        code += "assert set(brewster.__all__) <= set(dir(brewster)); from brewster import *"
        subprocess.run([sys.executable, "-c", code], check=True)


def test_a_single_photo_has_a_percentage_but_not_with_json(model, tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    out, shown = run_on_terminal("a.jpg", "--model", model, folder=tmp_path)
    assert out == b""
    assert re.search(r"\d%", shown)
    assert "/1" not in shown
    for option in ("--json", "--quiet"):
        out, shown = run_on_terminal(
            "a.jpg", "--model", model, "--overwrite", option, folder=tmp_path
        )
        assert (bool(out), "%" in shown) == (option == "--json", False)
