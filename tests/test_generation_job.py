"""Building a set: resuming, growing, packing, refusing, and always the same bytes."""

import errno
import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

import filelock
import pytest
from pyarrow import parquet

import brewster
from brewster.errors import DeviceError, TargetError
from brewster.rendered import store
from brewster.rendered.generation import job as building
from brewster.rendered.generation.workers import SerialExecutor
from set_folders import hashes, job, make, names, statuses


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "four"
    make(out)
    return out


@pytest.fixture
def small_shards(monkeypatch):
    """Three samples a shard."""
    monkeypatch.setattr(store, "SHARD_SIZE", 3)


class Stops(SerialExecutor):
    """An executor that is interrupted before its fourth task."""

    left = 3

    def wait(self):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        return super().wait()


def test_existing_samples_are_skipped_and_nothing_changes(four):
    before = {path: path.stat().st_mtime_ns for path in four.rglob("*.jpg")}
    assert statuses(make(four)) == dict.fromkeys(range(4), "skipped")
    assert before == {path: path.stat().st_mtime_ns for path in four.rglob("*.jpg")}


def test_a_set_can_grow_in_both_directions(four, tmp_path):
    make(tmp_path / "set", count=1, first=2)
    make(tmp_path / "set", count=2)
    assert statuses(make(tmp_path / "set")) == {0: "skipped", 1: "skipped", 2: "skipped", 3: "rendered"}
    assert hashes(tmp_path / "set") == hashes(four)


@pytest.mark.parametrize("shards", [False, True])
def test_an_interrupted_set_equals_an_uninterrupted_one(tmp_path, small_shards, shards):
    make(tmp_path / "undisturbed", count=8, shards=shards)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "set", count=8, executor=Stops, shards=shards)
    assert not list((tmp_path / "set").glob(".brewster-*"))
    assert 3 > len(list(store.read_set(tmp_path / "set"))) - 1 >= 1
    make(tmp_path / "set", count=8, shards=shards)
    assert hashes(tmp_path / "set") == hashes(tmp_path / "undisturbed")


def test_partial_files_of_a_killed_run_are_removed(four, tmp_path):
    shutil.copytree(four, tmp_path / "set")
    (tmp_path / "set" / "000001").rename(tmp_path / "set" / ".brewster-00.part")
    (tmp_path / "set" / ".brewster-01.part").write_bytes(b"half a shard")
    assert statuses(make(tmp_path / "set"))[1] == "rendered"
    assert hashes(tmp_path / "set") == hashes(four)


def test_shards_are_packed_as_they_become_complete_and_grow_with_the_set(tmp_path, small_shards):
    seen = {}

    class Watches(SerialExecutor):
        def submit(self, task):
            seen[task.kind, task.indices[0]] = sorted(path.name for path in out.glob("0*"))
            super().submit(task)

    out = tmp_path / "set"
    make(out, count=7, shards=True, executor=Watches)
    assert seen["render", 4] == ["000003"]
    assert sorted(path.name for path in out.iterdir() if path.name[0] == "s") == [
        "set.toml",
        "shard-000000.tar",
        "shard-000001.tar",
        "shard-000002.tar",
    ]
    assert statuses(make(out, count=7, shards=True)) == dict.fromkeys(range(7), "skipped")
    make(out, count=8, shards=True)
    make(tmp_path / "undisturbed", count=8, shards=True)
    assert hashes(out) == hashes(tmp_path / "undisturbed")
    assert parquet.read_table(out / "index.parquet")["place"].to_pylist()[-2:] == ["shard-000002.tar"] * 2


def test_folders_of_an_earlier_run_are_packed_when_shards_are_requested(tmp_path, small_shards):
    make(tmp_path / "set", count=4)
    make(tmp_path / "set", count=4, shards=True)
    make(tmp_path / "undisturbed", count=4, shards=True)
    assert hashes(tmp_path / "set") == hashes(tmp_path / "undisturbed")


@pytest.mark.parametrize(
    ("renderer", "says"), [("picky", "count by two"), ("clumsy", "ZeroDivisionError: oops")]
)
def test_a_sample_that_fails_is_named_and_the_rest_goes_on(tmp_path, small_shards, renderer, says):
    results = make(tmp_path / "set", count=5, renderer=renderer, shards=True)
    assert statuses(results) == {0: "rendered", 1: "failed", 2: "rendered", 3: "rendered", 4: "rendered"}
    assert says in next(result.error for result in results if result.error)
    assert [entry.place.name for entry in store.read_set(tmp_path / "set")] == [
        "000000",
        "000002",
        "shard-000001.tar",
        "shard-000001.tar",
    ]
    assert parquet.read_table(tmp_path / "set" / "index.parquet")["index"].to_pylist() == [0, 2, 3, 4]


def test_an_error_of_every_sample_ends_the_run_with_its_message(tmp_path):
    with pytest.raises(DeviceError, match=r"^there is no light; a lamp; or two; buy one\.$"):
        make(tmp_path / "set", renderer="deviceless")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_ends_the_run_and_what_is_finished_is_kept(four, tmp_path, monkeypatch, number):
    fsync, calls = os.fsync, []

    def fill(file):
        calls.append(file)
        if len(calls) > 25:
            raise OSError(number, os.strerror(number))
        fsync(file)

    monkeypatch.setattr(os, "fsync", fill)
    with pytest.raises(TargetError, match=os.strerror(number)):
        make(tmp_path / "set")
    finished = list(store.read_set(tmp_path / "set"))
    assert 0 < len(finished) < 4
    assert all(names(entry.place) == set(store.FILES) for entry in finished)
    assert not list((tmp_path / "set").glob(".brewster-*"))
    monkeypatch.setattr(os, "fsync", fsync)
    make(tmp_path / "set")
    assert hashes(tmp_path / "set") == hashes(four)


def test_a_disk_that_is_full_when_a_shard_or_the_index_is_written_loses_nothing(four, tmp_path, monkeypatch):
    replace = Path.replace

    def full(part, place):
        if place.suffix in (".tar", ".parquet"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(part, place)

    shutil.copytree(four, tmp_path / "set")
    monkeypatch.setattr(Path, "replace", full)
    for shards, name in ((True, "shard-000000.tar"), (False, "index.parquet")):
        with pytest.raises(TargetError, match=name):
            make(tmp_path / "set", shards=shards)
    assert hashes(tmp_path / "set") == hashes(four)


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"seed": 8}, "its seed is 7, and 8 was requested"),
        ({"recipe": "window"}, "its recipe.name is tiny, and window was requested"),
        ({"renderer": "slow"}, "its renderer is fake_renderer:render"),
    ],
)
def test_another_job_in_the_same_folder_is_refused_and_the_difference_named(four, other, says):
    before = hashes(four)
    with pytest.raises(TargetError, match=says):
        make(four, **other)
    assert hashes(four) == before


def test_other_maps_are_another_job(four):
    requested = job(four)
    poorer = requested.catalog.model_copy(update={"maps": requested.catalog.maps[1:]})
    with pytest.raises(TargetError, match="its catalog is"):
        building.build(
            building.RenderJob(**{**vars(requested), "catalog": poorer}), range(4), SerialExecutor(requested)
        )


def test_a_set_grows_across_versions_until_its_samples_change(four, tmp_path, monkeypatch):
    shutil.copytree(four, tmp_path / "set")
    monkeypatch.setattr(brewster, "__version__", "99")
    assert statuses(make(tmp_path / "set", count=5))[4] == "rendered"
    monkeypatch.setattr(store, "SAMPLE_FORMAT", 99)
    with pytest.raises(TargetError, match="its format is 1, and 99 was requested"):
        make(tmp_path / "set")


def test_a_record_that_cannot_be_read_is_named(four, tmp_path):
    shutil.copytree(four, tmp_path / "set")
    (tmp_path / "set" / "set.toml").write_text("not toml")
    with pytest.raises(TargetError, match=r"set\.toml cannot be read"):
        make(tmp_path / "set")


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(TargetError, match=r"holiday\.jpg and is no set"):
        make(tmp_path)
    with pytest.raises(TargetError, match="cannot be written to"):
        make(tmp_path / "holiday.jpg")


def test_two_runs_in_one_folder_are_refused_until_one_has_ended(four):
    with filelock.FileLock(four / ".lock"), pytest.raises(TargetError, match="another run is writing"):
        make(four)
    make(four)


def test_a_run_releases_its_lock_even_if_it_fails(four):
    with pytest.raises(TargetError, match="its seed is"):
        make(four, seed=8)
    with filelock.FileLock(four / ".lock", blocking=False):
        pass


def test_rendering_starts_where_there_is_no_fcntl():
    """As on Windows."""
    code = "import sys; sys.modules['fcntl'] = None; import brewster.rendered.generation.workers"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS])
def test_a_file_system_without_locks_is_named(four, monkeypatch, number):
    def refuse(file, how):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(TargetError, match="cannot be locked"):
        make(four)


def test_a_schedule_looks_no_further_ahead_than_a_block(tmp_path):
    """A billion samples are as easily begun as ten."""
    schedule = building._Schedule(tmp_path, range(10**9), 4, shards=True, report=lambda _: None)
    tasks = [schedule.next() for _ in range(3)]
    assert [task.indices for task in tasks] == [(0, 1, 2, 3), (4, 5, 6, 7), (8, 9, 10, 11)]
    assert len(schedule._left) == 1
