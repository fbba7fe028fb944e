"""Data-parallel training: the process group, sums over processes, and incomplete launches."""

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
    done = finished([sys.executable, "-c", code])
    assert (done.stdout, done.stderr, done.returncode) == ("1 0 True [1.0, 1.0, 1.0]\n", "", 0)


@pytest.mark.slow
def test_two_processes_have_ranks_and_sum_each_tensor(tmp_path):
    (tmp_path / "two.py").write_text("""
import pathlib, torch
from brewster.training import distributed
distributed.initialize()
assert distributed.from_main_process(distributed.rank) == 0
assert distributed.world_size() == 2 and distributed.is_main_process() == (distributed.rank() == 0)
assert distributed.best_device() == torch.device("cpu")
tensors = [torch.full((2,), 1.0 + distributed.rank()), torch.tensor(10.0 * distributed.rank())]
distributed.all_reduce_sum(tensors)
assert [tensor.tolist() for tensor in tensors] == [[3.0, 3.0], 10.0]
pathlib.Path(__file__).with_name(f"rank {distributed.rank()}").touch()
""")
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    done = finished([sys.executable, *torchrun, tmp_path / "two.py"], timeout=300)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.glob("rank *")) == ["rank 0", "rank 1"]


def test_missing_processes_are_reported(monkeypatch):
    accelerate.PartialState(cpu=True)  # as a library may do before initialize
    for name, value in (LAUNCHER_VARIABLES | {"WORLD_SIZE": "2"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(DeviceError, match=r"1 processes have joined; expected 2 processes, .* WORLD_SIZE;"):
        distributed.initialize()
    accelerate.PartialState._reset_state()
