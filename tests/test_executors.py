"""Thread limits of workers."""

import contextlib

import torch

from brewster.executors.local import single_torch_thread


def test_torch_has_one_thread_inside_and_as_many_as_before_afterwards():
    torch.set_num_threads(2)
    with contextlib.suppress(ZeroDivisionError), single_torch_thread():
        inside = torch.get_num_threads()
        raise ZeroDivisionError
    after = torch.get_num_threads()
    torch.set_num_threads(1)
    assert (inside, after) == (1, 2)
