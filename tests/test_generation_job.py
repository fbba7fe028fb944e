"""Rendering a dataset: resume, growth, shards, refused folders, and equal bytes in all cases."""

import errno
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import filelock
import pytest
from pyarrow import parquet

import brewster
from brewster.base.executors.local import SerialExecutor
from brewster.errors import DeviceError, OutputError
from brewster.render.dataset import store
from brewster.render.dataset.generation import job as job_module
from brewster.render.dataset.generation.workers import TaskRunner
from set_folders import hashes, make_job, names, render_set, statuses


@pytest.fixture(scope="module")
def four_samples(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "four"
    render_set(out)
    return out


@pytest.fixture
def small_shards(monkeypatch):
    """Sets the size of a shard to three samples."""
    monkeypatch.setattr(store, "SHARD_SIZE", 3)


class InterruptedExecutor(SerialExecutor):
    """An executor that is interrupted before its fourth task."""

    remaining = 3

    def start(self, task):
        if self.remaining == 0:
            raise KeyboardInterrupt
        self.remaining -= 1
        return super().start(task)


def test_existing_samples_are_skipped_and_nothing_changes(four_samples):
    before = {path: path.stat().st_mtime_ns for path in four_samples.rglob("*.jpg")}
    assert statuses(render_set(four_samples)) == dict.fromkeys(range(4), "skipped")
    assert before == {path: path.stat().st_mtime_ns for path in four_samples.rglob("*.jpg")}


def test_a_dataset_can_grow_in_both_directions(four_samples, tmp_path):
    render_set(tmp_path / "set", count=1, first=2)
    render_set(tmp_path / "set", count=2)
    assert statuses(render_set(tmp_path / "set")) == {
        0: "skipped",
        1: "skipped",
        2: "skipped",
        3: "rendered",
    }
    assert hashes(tmp_path / "set") == hashes(four_samples)


@pytest.mark.parametrize("shards", [False, True])
def test_an_interrupted_dataset_equals_an_uninterrupted_one(tmp_path, small_shards, shards):
    render_set(tmp_path / "undisturbed", count=8, shards=shards)
    with pytest.raises(KeyboardInterrupt):
        render_set(tmp_path / "set", count=8, executor=InterruptedExecutor, shards=shards)
    assert not list((tmp_path / "set").glob(".brewster-*"))
    assert 3 > len(list(store.read_dataset(tmp_path / "set"))) - 1 >= 1
    render_set(tmp_path / "set", count=8, shards=shards)
    assert hashes(tmp_path / "set") == hashes(tmp_path / "undisturbed")


def test_partial_files_of_a_killed_run_are_removed(four_samples, tmp_path):
    shutil.copytree(four_samples, tmp_path / "set")
    (tmp_path / "set" / "000001").rename(tmp_path / "set" / ".brewster-00.part")
    (tmp_path / "set" / ".brewster-01.part").write_bytes(b"part of a shard")
    assert statuses(render_set(tmp_path / "set"))[1] == "rendered"
    assert hashes(tmp_path / "set") == hashes(four_samples)


def test_shards_are_packed_as_they_become_complete_and_grow_with_the_dataset(
    tmp_path, small_shards
):
    folders_at_submit = {}

    class RecordingExecutor(SerialExecutor):
        def start(self, task):
            folders_at_submit[task.kind, task.index] = sorted(path.name for path in out.glob("0*"))
            return super().start(task)

    out = tmp_path / "set"
    render_set(out, count=7, shards=True, executor=RecordingExecutor)
    assert folders_at_submit["render", 4] == ["000003"]
    shards = [f"shard-00000{number}.tar" for number in range(3)]
    assert sorted(path.name for path in out.iterdir() if path.name[0] == "s") == [
        "set.toml",
        *shards,
    ]
    assert statuses(render_set(out, count=7, shards=True)) == dict.fromkeys(range(7), "skipped")
    render_set(out, count=8, shards=True)
    render_set(tmp_path / "undisturbed", count=8, shards=True)
    assert hashes(out) == hashes(tmp_path / "undisturbed")
    assert (
        parquet.read_table(out / "index.parquet")["path"].to_pylist()[-2:]
        == ["shard-000002.tar"] * 2
    )


def test_folders_of_an_earlier_run_are_packed_when_shards_are_requested(tmp_path, small_shards):
    render_set(tmp_path / "set", count=4)
    render_set(tmp_path / "set", count=4, shards=True)
    render_set(tmp_path / "undisturbed", count=4, shards=True)
    assert hashes(tmp_path / "set") == hashes(tmp_path / "undisturbed")


@pytest.mark.parametrize(
    ("renderer", "message"),
    [("rejecting", "choose another index"), ("buggy", "ZeroDivisionError: division by zero")],
)
def test_a_sample_that_fails_is_reported_and_others_are_rendered(
    tmp_path, small_shards, renderer, message
):
    results = render_set(tmp_path / "set", count=5, renderer=renderer, shards=True)
    assert statuses(results) == {
        0: "rendered",
        1: "failed",
        2: "rendered",
        3: "rendered",
        4: "rendered",
    }
    assert message in next(result.error for result in results if result.error)
    places = [entry.path.name for entry in store.read_dataset(tmp_path / "set")]
    assert places == ["000000", "000002", "shard-000001.tar", "shard-000001.tar"]
    assert parquet.read_table(tmp_path / "set" / "index.parquet")["index"].to_pylist() == [
        0,
        2,
        3,
        4,
    ]


def test_an_error_of_every_sample_ends_the_run_with_its_message(tmp_path):
    with pytest.raises(DeviceError, match=r"^there is no GPU; expected a GPU; or a CPU"):
        render_set(tmp_path / "set", renderer="without_device")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_ends_the_run_and_finished_samples_remain(
    four_samples, tmp_path, monkeypatch, number
):
    fsync = os.fsync
    calls = []

    def fail_after_25_calls(file):
        calls.append(file)
        if len(calls) > 25:
            raise OSError(number, os.strerror(number))
        fsync(file)

    monkeypatch.setattr(os, "fsync", fail_after_25_calls)
    with pytest.raises(OutputError, match=os.strerror(number)):
        render_set(tmp_path / "set")
    finished = list(store.read_dataset(tmp_path / "set"))
    assert 0 < len(finished) < 4
    assert all(names(entry.path) == set(store.SAMPLE_FILES) for entry in finished)
    assert not list((tmp_path / "set").glob(".brewster-*"))
    monkeypatch.setattr(os, "fsync", fsync)
    render_set(tmp_path / "set")
    assert hashes(tmp_path / "set") == hashes(four_samples)


def test_a_disk_that_is_full_for_a_shard_or_the_index_loses_nothing(
    four_samples, tmp_path, monkeypatch
):
    replace = Path.replace

    def raise_disk_full(part, target):
        if target.suffix in (".tar", ".parquet"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(part, target)

    shutil.copytree(four_samples, tmp_path / "set")
    monkeypatch.setattr(Path, "replace", raise_disk_full)
    for shards, name in ((True, "shard-000000.tar"), (False, "index.parquet")):
        with pytest.raises(OutputError, match=name):
            render_set(tmp_path / "set", shards=shards)
    assert hashes(tmp_path / "set") == hashes(four_samples)


@pytest.mark.parametrize(("changes", "message"), [
    ({"seed": 8}, "its seed is 7, and 8 was requested"),
    ({"recipe": "window"}, "its recipe.name is tiny, and window was requested"),
    ({"renderer": "slow"}, "its renderer is fake_renderer:render"),
])  # fmt: skip
def test_another_job_in_the_same_folder_is_refused_with_the_difference(
    four_samples, changes, message
):
    before = hashes(four_samples)
    with pytest.raises(OutputError, match=message):
        render_set(four_samples, **changes)
    assert hashes(four_samples) == before


def test_other_maps_are_another_job(four_samples):
    job = make_job(four_samples)
    smaller = job.catalog.model_copy(update={"maps": job.catalog.maps[1:]})
    other = job_module.RenderJob(**{**vars(job), "catalog": smaller})
    with pytest.raises(OutputError, match="its catalog is"):
        job_module.build(other, range(4), SerialExecutor(partial(TaskRunner, job)))


def test_a_dataset_grows_across_versions_until_its_samples_change(
    four_samples, tmp_path, monkeypatch
):
    shutil.copytree(four_samples, tmp_path / "set")
    monkeypatch.setattr(brewster, "__version__", "99")
    assert statuses(render_set(tmp_path / "set", count=5))[4] == "rendered"
    monkeypatch.setattr(store, "SAMPLE_FORMAT", 99)
    with pytest.raises(OutputError, match="its format is 3, and 99 was requested"):
        render_set(tmp_path / "set")


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(OutputError, match=r"holiday\.jpg, but no rendered dataset"):
        render_set(tmp_path)
    with pytest.raises(OutputError, match="cannot be written to"):
        render_set(tmp_path / "holiday.jpg")


def test_two_runs_in_one_folder_are_refused_until_one_has_ended(four_samples):
    lock = filelock.FileLock(four_samples / ".lock")
    with lock, pytest.raises(OutputError, match="another run is writing"):
        render_set(four_samples)
    render_set(four_samples)


def test_rendering_starts_without_the_module_fcntl():
    """Windows has no such module."""
    code = (
        "import sys; sys.modules['fcntl'] = None; import brewster.render.dataset.generation.workers"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
