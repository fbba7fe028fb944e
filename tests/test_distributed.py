"""Data-parallel training: the process group, sums over processes, and incomplete launches."""

import os
import sys

import accelerate
import pytest

from brewster.errors import DeviceError
from brewster.training import distributed
from other_processes import finished

LAUNCHER_VARIABLES = {"RANK": "0", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29555"}


@pytest.fixture(autouse=True)
def _not_launched(monkeypatch):
    for name in ("WORLD_SIZE", "ACCELERATE_MIXED_PRECISION", *LAUNCHER_VARIABLES):
        monkeypatch.delenv(name, raising=False)


def run_python(code, *launcher, **variables):
    """Runs Python code, with or without a launcher. Returns stdout, stderr and exit code."""
    environment = {
        name: value for name, value in os.environ.items() if name not in {"WORLD_SIZE", *LAUNCHER_VARIABLES}
    }
    done = finished(
        [sys.executable, *launcher, *([] if launcher else ["-c"]), str(code)],
        env=environment | {"OMP_NUM_THREADS": "1"} | variables,
        timeout=300,
    )
    return done.stdout, done.stderr, done.returncode


def test_one_process_is_the_main_process_and_needs_no_accelerate():
    code = """
import sys, torch
sys.modules["accelerate"] = None
from brewster.training import distributed
distributed.initialize()
alone = torch.ones(3)
distributed.all_reduce_sum([alone])
print(distributed.world_size(), distributed.rank(), distributed.is_main_process(), alone.tolist())
"""
    assert run_python(code) == ("1 0 True [1.0, 1.0, 1.0]\n", "", 0)


@pytest.mark.slow
def test_two_processes_have_ranks_and_sum_each_tensor(tmp_path):
    (tmp_path / "two.py").write_text(
        """
import pathlib, torch
from brewster.training import distributed
distributed.initialize()
assert distributed.from_main_process(distributed.rank) == 0
assert distributed.world_size() == 2 and distributed.is_main_process() == (distributed.rank() == 0) and distributed.best_device() == torch.device("cpu")
tensors = [torch.full((2,), 1.0 + distributed.rank()), torch.tensor(10.0 * distributed.rank())]
distributed.all_reduce_sum(tensors)
assert [tensor.tolist() for tensor in tensors] == [[3.0, 3.0], 10.0]
pathlib.Path(__file__).with_name(f"rank {distributed.rank()}").touch()
"""
    )
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    _, stderr, code = run_python(tmp_path / "two.py", *torchrun)
    assert code == 0, stderr
    assert sorted(path.name for path in tmp_path.glob("rank *")) == ["rank 0", "rank 1"]


def test_a_world_size_without_launcher_variables_is_refused(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(DeviceError, match=r"WORLD_SIZE is 2, but .* not set: RANK, .*; .*torchrun"):
        distributed.initialize()


def test_missing_processes_are_reported(monkeypatch):
    accelerate.PartialState(cpu=True)  # as a library may do before initialize
    for name, value in (LAUNCHER_VARIABLES | {"WORLD_SIZE": "2"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(DeviceError, match=r"1 processes have joined; expected 2 processes, .* WORLD_SIZE;"):
        distributed.initialize()
    accelerate.PartialState._reset_state()


def test_a_launcher_that_started_only_one_of_several_processes_is_reported(tmp_path):
    (tmp_path / "one.py").write_text("from brewster.training import distributed\ndistributed.initialize()\n")
    launch = ["-m", "accelerate.commands.launch", "--cpu", "--num_processes", "2"]
    _, stderr, code = run_python(tmp_path / "one.py", *launch)
    assert code == 1
    assert "accelerate launch started one process instead of several" in stderr
