"""Ctrl-C in mid-batch: nothing is half written, and the same command goes on."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from brewster import Photo
from brewster.errors import UnreadablePhoto
from brewster.separate import Separator
from front_door import errors, lines, picture, results, tree


def test_ctrl_c_while_a_file_is_written_leaves_no_half_file(run, tmp_path, monkeypatch):
    (tmp_path / "a.jpg").write_bytes(picture())
    fsync, calls = os.fsync, []

    def interrupted(file):
        calls.append(file)
        if len(calls) == 2:
            raise KeyboardInterrupt
        fsync(file)

    monkeypatch.setattr(os, "fsync", interrupted)
    code, _, err = run("a.jpg")
    assert code == 130
    assert "stopped" in err
    assert tree(tmp_path) == ["a.jpg", "a.transmission.jpg"]


def interrupt_that_gets_lost():
    """As when Ctrl-C is pressed while libvips logs through Python: C code has nowhere to pass the exception to."""

    def press():
        raise KeyboardInterrupt

    ctypes.CFUNCTYPE(None)(press)()


@pytest.mark.parametrize("goes_wrong", [False, True])
def test_ctrl_c_that_c_code_drops_stops_the_batch_before_anything_is_written(
    run, tmp_path, monkeypatch, goes_wrong
):
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.jpg").write_bytes(picture())
    separate = Separator.__call__

    def interrupted(self, source, **options):
        if source.name == "b.jpg":
            interrupt_that_gets_lost()
            if goes_wrong:
                raise UnreadablePhoto("half a call", "a whole one", "do not press Ctrl-C")
        return separate(self, source, **options)

    monkeypatch.setattr(Separator, "__call__", interrupted)
    code, out, err = run(".", "-o", "out", "--json")
    assert code == 130
    assert tree(tmp_path / "out") == results("a")
    assert [line["source"] for line in lines(out)] == ["a.jpg"]
    assert "Traceback" not in err
    assert not errors(err)
    assert run(".", "-o", "out")[0] == 130  # b is interrupted again: nothing of the first time is left over
    monkeypatch.setattr(Separator, "__call__", separate)
    assert run(".", "-o", "out")[0] == 0


def test_what_else_c_code_drops_is_still_reported(run, tmp_path, monkeypatch):
    dropped = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)
    (tmp_path / "a.jpg").write_bytes(picture())
    fsync = os.fsync

    def stumble():
        raise ZeroDivisionError

    monkeypatch.setattr(os, "fsync", lambda file: (ctypes.CFUNCTYPE(None)(stumble)(), fsync(file)))
    assert run("a.jpg")[0] == 0
    assert [what.exc_type for what in dropped] == [ZeroDivisionError] * 2


def test_ctrl_c_in_mid_batch_leaves_whole_files_only_and_the_same_command_goes_on(run, tmp_path, model):
    count = 12
    (tmp_path / "in").mkdir()
    for index in range(count):
        (tmp_path / "in" / f"{index}.jpg").write_bytes(picture(400, 300, seed=index))
    command = [sys.executable, "-m", "brewster", "in", "-o", "out", "--model", model, "--quality", "draft"]
    batch = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE)
    patience = time.monotonic() + 30
    while len(list(tmp_path.glob("out/*.jpg"))) < 5 and time.monotonic() < patience:
        time.sleep(0.01)
    batch.send_signal(signal.SIGINT)
    _, err = batch.communicate(timeout=30)
    assert batch.returncode == 130
    assert b"Traceback" not in err
    written = [Path(path) for path in tmp_path.glob("out/*")]
    assert 5 <= len(written) < 2 * count
    assert {path.suffix for path in tmp_path.glob("out/.*")} <= set()
    assert all(Photo.open(path).size == (400, 300) for path in written)
    assert run("in", "-o", "out", "--quality", "draft")[0] == 0
    assert len(tree(tmp_path / "out")) == 2 * count
