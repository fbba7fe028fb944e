"""Several processes render the same bytes as one process, even if workers die."""

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import torch

from brewster.base.executors import ray_cluster
from brewster.base.executors.local import ProcessExecutor, run_tasks, single_torch_thread
from brewster.errors import MissingExtra, OutputError, RecipeError
from brewster.render.dataset import store
from brewster.render.dataset.generation import workers
from brewster.render.dataset.generation.job import RenderTask
from brewster.render.dataset.generation.workers import render_again
from other_processes import children, is_alive, started, wait_for
from set_folders import hashes, make_job, names, render_set, statuses

TESTS = Path(__file__).parent


def two_workers(create_runner):
    return ProcessExecutor(create_runner, 2)


def start_blocking_run(out, count):
    """Starts a run in a separate process, with a worker that never finishes sample 2."""
    code = f"""
from pathlib import Path
from brewster.base.executors.local import ProcessExecutor
from set_folders import render_set
def one_worker(create_runner):
    return ProcessExecutor(create_runner, 1)
render_set(Path({str(out)!r}), {count}, renderer="blocking", executor=one_worker)
"""
    environment = {**os.environ, "FAKE_WAIT": "1"}
    return started([sys.executable, "-c", code], cwd=TESTS, stderr=subprocess.PIPE, env=environment)


def threads_of_a_worker():
    return lambda _: [os.environ["OMP_NUM_THREADS"]]


@pytest.mark.parametrize(("set_by_user", "used"), [(None, "1"), ("3", "3")])
def test_a_worker_has_one_thread_unless_the_user_says_otherwise(monkeypatch, set_by_user, used):
    monkeypatch.delenv("OMP_NUM_THREADS")
    if set_by_user:
        monkeypatch.setenv("OMP_NUM_THREADS", set_by_user)
    with ProcessExecutor(threads_of_a_worker, 1) as executor:
        assert executor.start("any task").result() == [used]


def test_ray_sends_no_statistics_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    for value in ("1", "0"):
        monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", value)
        if value == "0":
            monkeypatch.delenv("RAY_USAGE_STATS_ENABLED")
        with pytest.raises(MissingExtra):
            ray_cluster._ray()
        assert os.environ["RAY_USAGE_STATS_ENABLED"] == value


def test_two_workers_render_the_set_of_one_process_even_if_one_of_them_dies(tmp_path, monkeypatch):
    monkeypatch.setenv("FAKE_MARKER", str(tmp_path / "marker"))
    results = render_set(tmp_path / "two", count=5, renderer="crashing_once", executor=two_workers)
    assert (tmp_path / "marker").exists()
    assert statuses(results) == dict.fromkeys(range(5), "rendered")
    render_set(tmp_path / "one", count=5, renderer="crashing_once")
    assert hashes(tmp_path / "one") == hashes(tmp_path / "two")


def test_workers_of_a_killed_run_exit_and_the_run_is_resumed(tmp_path):
    out = tmp_path / "set"
    count = 4
    with start_blocking_run(out, count) as run:
        wait_for(lambda: len(list(out.glob("0*"))) == 2, run)
        workers = children(run)
        run.kill()
        run.communicate()
    wait_for(lambda: not any(map(is_alive, workers)))
    assert sorted(folder.name for folder in out.glob("0*")) == ["000000", "000001"]
    assert all(names(folder) == set(store.SAMPLE_FILES) for folder in out.glob("0*"))
    results = render_set(out, count=count, renderer="blocking")
    assert statuses(results) == {0: "skipped", 1: "skipped", 2: "rendered", 3: "rendered"}
    render_set(tmp_path / "undisturbed", count=count, renderer="blocking")
    assert hashes(out) == hashes(tmp_path / "undisturbed")


def test_ctrl_c_stops_all_workers_and_leaves_no_partial_files(tmp_path):
    out = tmp_path / "set"
    with start_blocking_run(out, 4) as run:
        wait_for(lambda: len(list(out.glob("0*"))) == 2, run)
        workers = children(run)
        for pid in [*map(int, workers), run.pid]:  # as a terminal sends Ctrl-C to all processes
            os.kill(pid, signal.SIGINT)
        _, err = run.communicate()
    assert err.count(b"KeyboardInterrupt") == 1
    wait_for(lambda: not any(map(is_alive, workers)))
    assert not list(out.glob(".brewster-*"))


def test_a_sample_that_kills_every_worker_fails_and_the_others_are_rendered(tmp_path, monkeypatch):
    monkeypatch.setattr(ProcessExecutor, "attempts", 1)
    executor = partial(ProcessExecutor, worker_count=1)
    results = render_set(tmp_path / "set", renderer="crashing", executor=executor)
    assert statuses(results) == {0: "rendered", 1: "rendered", 2: "failed", 3: "rendered"}
    assert "exit code -9" in next(result.error for result in results if result.error)


def test_a_scene_file_cannot_run_a_renderer_that_is_not_in_the_table(tmp_path):
    render_set(tmp_path / "set", count=1)
    with pytest.raises(RecipeError, match="was rendered by 'fake_renderer:render'"):
        render_again(tmp_path / "set" / "000000" / store.SCENE_FILE, tmp_path / "again")


def test_a_scene_is_never_rendered_into_a_folder_with_files(tmp_path):
    render_set(tmp_path / "set", count=1)
    scene = tmp_path / "set" / "000000" / store.SCENE_FILE
    for existing in (scene, scene.parent):
        with pytest.raises(OutputError, match="exists; expected a new or empty folder"):
            render_again(scene, existing, renderer="fake_renderer:render")


def test_every_renderer_can_be_imported():
    assert all(callable(workers.find_renderer(name)) for name in workers.RENDERERS)


def test_a_sample_that_is_tried_again_is_rendered_only_if_it_is_missing(tmp_path):
    job = make_job(tmp_path)
    runner = workers.TaskRunner(job)
    task = RenderTask("render", 0)
    runner(task)
    before = (tmp_path / "000000").stat().st_ino
    assert [result.status for result in runner(task)] == ["rendered"]
    assert (tmp_path / "000000").stat().st_ino == before


def test_torch_has_one_thread_inside_and_as_many_as_before_afterwards():
    torch.set_num_threads(2)
    with contextlib.suppress(ZeroDivisionError), single_torch_thread():
        inside = torch.get_num_threads()
        raise ZeroDivisionError
    after = torch.get_num_threads()
    torch.set_num_threads(1)
    assert (inside, after) == (1, 2)


def die(task):
    """Notes the attempt in the file of the task, and kills the worker."""
    with task.log.open("a") as log:
        log.write("started\n")
    os.kill(os.getpid(), signal.SIGKILL)


@dataclass(frozen=True)
class FatalTask:
    log: Path

    def failed_results(self, reason):
        return [reason]


def create_fatal_runner():
    return die


def test_a_task_that_kills_its_workers_is_started_three_times(tmp_path):
    tasks = [FatalTask(tmp_path / "log")]
    with ProcessExecutor(create_fatal_runner, 1) as executor:
        (reason,) = run_tasks(lambda: tasks.pop() if tasks else None, executor)
    assert (tmp_path / "log").read_text().split() == ["started"] * 3
    assert "died 3 times" in reason
