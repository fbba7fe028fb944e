"""Rendering on a Ray cluster, also if a node is lost. Ray runs in other processes, as tests may
open no connections.
"""

import os
import sys
import threading
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from brewster.base.executors import ray_cluster
from brewster.base.executors.local import ProcessExecutor, run_tasks
from brewster.errors import DeviceError
from brewster.render.dataset.generation.job import RenderTask
from brewster.render.dataset.generation.workers import TaskRunner
from other_processes import finished
from set_folders import hashes, render_set

TESTS = Path(__file__).parent

LOCAL = """
import sys
from pathlib import Path
from brewster.base.executors.ray_cluster import RayExecutor
from set_folders import render_set
def two_workers(create_runner):
    return RayExecutor(create_runner, "local", 2)
results = render_set(Path(sys.argv[1]), count=9, executor=two_workers, renderer=sys.argv[2])
results = sorted(results, key=lambda result: result.index)
print([(result.index, result.status) for result in results])
"""

LOSES_A_NODE = """
import os, sys
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
from pathlib import Path
from ray.cluster_utils import Cluster
from functools import partial
from brewster.render.dataset.generation.job import build
from brewster.render.dataset.generation.workers import TaskRunner
from brewster.base.executors.ray_cluster import RayExecutor
from set_folders import make_job
nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
lost_node = nodes.add_node(num_cpus=1)
nodes.wait_for_nodes()
job, done = make_job(Path(sys.argv[1]), "slow"), []

def report(result):
    assert result.status == "rendered", result
    done.append(result.index)
    if len(done) == 8:
        nodes.remove_node(lost_node, allow_graceful=False)

build(job, range(40), RayExecutor(partial(TaskRunner, job), nodes.address), report=report)
print(len(set(done)))
nodes.shutdown()
"""


def run_in_process(code, *args, **variables):
    """Runs code in a process with these environment variables. The nodes of Ray import the fake
    renderer from PYTHONPATH.
    """
    paths = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "RAY_USAGE_STATS_ENABLED": "0"} | variables
    return finished([sys.executable, "-c", code, *map(str, args)], env=environment, timeout=300)


def test_ray_tries_a_task_as_often_as_a_pool_of_processes(monkeypatch):
    options = {}
    client = SimpleNamespace(init=lambda *_, **__: None, put=id, shutdown=lambda: None)
    client.remote = lambda **given: options.update(given) or id
    monkeypatch.setattr(ray_cluster, "_ray", lambda: client)
    with ray_cluster.RayExecutor(partial(TaskRunner, None)) as executor:
        assert executor.attempts * (options["max_retries"] + 1) == ProcessExecutor.attempts


class UnpicklableError(Exception):
    def __init__(self):
        super().__init__()
        self.cannot_be_pickled = threading.Lock()


def results_if(error):
    """Runs a task whose future has the error."""
    executor = ray_cluster.RayExecutor(partial(TaskRunner, None))
    errors = pytest.importorskip("ray").exceptions
    executor._ray = SimpleNamespace(exceptions=errors, cluster_resources=lambda: {"CPU": 1})
    executor._create_runner_ref = None
    future = Future()
    future.set_exception(error)
    executor._run_task = SimpleNamespace(remote=lambda *_: SimpleNamespace(future=lambda: future))
    tasks = iter([RenderTask("render", 1)])
    return list(run_tasks(lambda: next(tasks, None), executor))


@pytest.mark.parametrize(
    "raised", [ZeroDivisionError("a bug"), DeviceError("no GPU", "expected a GPU", "add a GPU")]
)
def test_an_exception_of_the_runner_is_raised_with_the_traceback_of_the_worker(raised):
    errors = pytest.importorskip("ray").exceptions
    in_worker = errors.RayTaskError("run", "traceback of the worker", raised).as_instanceof_cause()
    with pytest.raises(type(raised)) as caught:
        results_if(in_worker)
    assert caught.value is raised
    assert "traceback of the worker" in str(caught.value.__cause__)


def test_an_exception_of_the_runner_that_cannot_be_pickled_is_raised():
    errors = pytest.importorskip("ray").exceptions
    in_worker = errors.RayTaskError("run", "traceback of the worker", UnpicklableError())
    with pytest.raises(errors.RayError, match="UnpicklableError"):
        results_if(in_worker)


@pytest.mark.parametrize("are_arguments_lost", [False, True])
def test_a_task_that_is_lost_after_all_attempts_of_ray_fails(are_arguments_lost):
    errors = pytest.importorskip("ray").exceptions
    lost = (
        errors.ObjectLostError("00", None, "")
        if are_arguments_lost
        else errors.WorkerCrashedError()
    )
    (result,) = results_if(errors.RayTaskError("run", "", lost) if are_arguments_lost else lost)
    assert (result.index, result.status, result.kind) == (1, "failed", "WorkerLost")
    assert "was lost 3 times" in result.error


@pytest.mark.slow
def test_a_sample_that_kills_its_process_on_every_node_fails(tmp_path):
    pytest.importorskip("ray")
    done = run_in_process(LOCAL, tmp_path / "set", "crashing", HOME=str(tmp_path))
    expected = [(index, "failed" if index == 2 else "rendered") for index in range(9)]
    assert done.stdout.strip() == str(expected), done.stderr
    # Ray requires this token of the nodes and programs of all later clusters of the user
    assert not (tmp_path / ".ray").exists()


@pytest.mark.slow
def test_a_set_is_complete_and_has_the_same_bytes_if_a_node_is_lost(tmp_path):
    pytest.importorskip("ray")
    done = run_in_process(LOSES_A_NODE, tmp_path / "set")
    assert done.stdout.strip().endswith("40"), done.stderr
    render_set(tmp_path / "plain", count=40, renderer="slow")
    assert hashes(tmp_path / "set") == hashes(tmp_path / "plain")
