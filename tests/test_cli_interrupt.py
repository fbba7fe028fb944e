"""Ctrl-C during a batch: no partial files, and the same command resumes."""

import ctypes
import os
import signal
import subprocess
import sys

import pytest

from brewster import Photo
from brewster.errors import UnreadablePhoto
from brewster.separation import Separator
from cli_helpers import error_lines, image_bytes, json_lines, layer_files, list_files
from other_processes import started, wait_for


def raise_interrupt_in_c_callback():
    """Simulates Ctrl-C while libvips calls Python to log: C code cannot propagate the exception."""

    def raise_interrupt():
        raise KeyboardInterrupt

    ctypes.CFUNCTYPE(None)(raise_interrupt)()


@pytest.mark.parametrize("with_error", [False, True])
def test_ctrl_c_that_c_code_drops_stops_the_batch_before_it_writes(
    run, tmp_path, monkeypatch, with_error
):
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.jpg").write_bytes(image_bytes())
    separate = Separator.__call__

    def interrupt_at_b(self, source, **options):
        if source.name == "b.jpg":
            raise_interrupt_in_c_callback()
            if with_error:
                raise UnreadablePhoto(
                    "the photo cannot be read", "expected an image file", "choose another file"
                )
        return separate(self, source, **options)

    monkeypatch.setattr(Separator, "__call__", interrupt_at_b)
    code, out, err = run(".", "-o", "out", "--json")
    assert code == 130
    assert list_files(tmp_path / "out") == layer_files("a")
    assert [line["source"] for line in json_lines(out)] == ["a.jpg"]
    assert "Traceback" not in err
    assert not error_lines(err)
    assert (
        run(".", "-o", "out")[0] == 130
    )  # b is interrupted again: no state of the first run remains
    monkeypatch.setattr(Separator, "__call__", separate)
    assert run(".", "-o", "out")[0] == 0


def test_other_exceptions_that_c_code_drops_are_still_reported(run, tmp_path, monkeypatch):
    dropped = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    fsync = os.fsync

    def fail():
        raise ZeroDivisionError

    monkeypatch.setattr(os, "fsync", lambda file: (ctypes.CFUNCTYPE(None)(fail)(), fsync(file)))
    assert run("a.jpg")[0] == 0
    assert {exception.exc_type for exception in dropped} == {ZeroDivisionError}


ENDLESS_CLI = """
import sys
from pathlib import Path
from brewster.cli import main
from brewster.cli.terminal import interrupts
from brewster.separation import Separator
separate = Separator.__call__
def endless(self, source, **options):
    while source.name == "06.jpg":
        separate(self, source, **options)
        Path("started").touch()
        interrupts.raise_pending()
    return separate(self, source, **options)
Separator.__call__ = endless
sys.exit(main(sys.argv[1:]))
"""
"""The command line, with a separator that never finishes the photo 06.jpg and writes the file
`started`.
"""


def test_ctrl_c_during_a_batch_leaves_only_complete_files_and_the_same_command_resumes(
    run, tmp_path, model
):
    names = [f"{index:02}" for index in range(12)]
    (tmp_path / "in").mkdir()
    for index, name in enumerate(names):
        (tmp_path / "in" / f"{name}.jpg").write_bytes(image_bytes(400, 300, seed=index))
    command = [
        sys.executable,
        "-c",
        ENDLESS_CLI,
        "in",
        "-o",
        "out",
        "--model",
        model,
        "--quality",
        "draft",
    ]
    with started(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as batch:
        wait_for((tmp_path / "started").exists, batch)
        batch.send_signal(signal.SIGINT)
        _, err = batch.communicate()
    assert batch.returncode == 130
    assert b"Traceback" not in err
    assert list_files(tmp_path / "out") == layer_files(*names[:6])
    assert all(Photo.open(path).size == (400, 300) for path in tmp_path.glob("out/*"))
    assert run("in", "-o", "out", "--quality", "draft")[0] == 0
    assert list_files(tmp_path / "out") == layer_files(*names)
