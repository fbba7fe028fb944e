"""The same set on a Ray cluster, of which a node is lost; in processes of their own, as tests reach no network."""

import os
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from brewster.errors import DeviceError, MissingExtra
from brewster.rendered.generation import ray_cluster
from set_folders import hashes, job, make, statuses

TESTS = Path(__file__).parent

LOCAL = """
import sys
from pathlib import Path
from brewster.rendered.generation.ray_cluster import RayExecutor
from set_folders import make
results = make(Path(sys.argv[1]), count=9, executor=lambda job: RayExecutor(job, "local", 2), renderer=sys.argv[2])
print([(result.index, result.status) for result in sorted(results, key=lambda result: result.index)])
"""

LOSES_A_NODE = """
import os, sys
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
from pathlib import Path
from ray.cluster_utils import Cluster as Nodes
from brewster.rendered.generation.job import build
from brewster.rendered.generation.ray_cluster import RayExecutor
from set_folders import job
nodes = Nodes(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
doomed = nodes.add_node(num_cpus=1)
nodes.wait_for_nodes()
asked, done = job(Path(sys.argv[1]), "slow"), []

def report(result):
    assert result.status == "rendered", result
    done.append(result.index)
    if len(done) == 8:
        nodes.remove_node(doomed, allow_graceful=False)

build(asked, range(40), Cluster(asked, nodes.address), report=report)
print(len(set(done)))
nodes.shutdown()
"""


def offline(code, *args):
    """Ray's nodes find the fake renderer by PYTHONPATH."""
    environment = {**os.environ, "PYTHONPATH": str(TESTS), "RAY_USAGE_STATS_ENABLED": "0"}
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, args)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def test_without_ray_the_line_that_installs_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"pip install 'brewster\[cluster\]'"):
        make(tmp_path / "set", executor=ray_cluster.RayExecutor)


def test_making_a_crew_wakes_no_ray(tmp_path):
    code = "import sys, brewster.rendered.generation.ray_cluster; assert 'ray' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not ray_cluster.RayExecutor(job(tmp_path)).is_busy()


@pytest.mark.slow
def test_a_cluster_on_this_machine_makes_what_one_process_makes(tmp_path):
    pytest.importorskip("ray")
    done = offline(LOCAL, tmp_path / "set", "picky")
    plain = make(tmp_path / "plain", count=9, renderer="picky")
    assert done.stdout.strip() == str(sorted(statuses(plain).items())), done.stderr
    assert hashes(tmp_path / "set") == hashes(tmp_path / "plain")


@pytest.mark.slow
def test_a_sample_that_kills_its_process_everywhere_is_named(tmp_path):
    pytest.importorskip("ray")
    done = offline(LOCAL, tmp_path / "set", "deadly")
    expected = [(index, "failed" if index == 2 else "rendered") for index in range(9)]
    assert done.stdout.strip() == str(expected), done.stderr


@pytest.mark.slow
def test_a_set_is_complete_and_the_same_though_a_node_is_lost(tmp_path):
    pytest.importorskip("ray")
    done = offline(LOSES_A_NODE, tmp_path / "set")
    assert done.stdout.strip().endswith("40"), done.stderr
    make(tmp_path / "plain", count=40, renderer="slow")
    assert hashes(tmp_path / "set") == hashes(tmp_path / "plain")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere.invalid:6379"])
def test_an_address_where_nobody_answers_is_named(tmp_path, monkeypatch, address):
    pytest.importorskip("ray")

    def refuse(*_, **__):
        raise ConnectionRefusedError("Connection refused")

    monkeypatch.setattr(socket, "create_connection", refuse)
    with pytest.raises(DeviceError, match=f"no cluster at {address}"):
        make(tmp_path / "set", executor=partial(ray_cluster.RayExecutor, address=address))
