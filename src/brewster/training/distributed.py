"""Several processes that learn as one, each on a GPU of its own; alone, nothing of this is noticed.

torchrun --standalone --nproc_per_node 2 -m brewster train recipes/train/klein.toml
accelerate launch --multi_gpu --num_processes 2 -m brewster train recipes/train/klein.toml

They divide each batch, and all end with the same weights as one process with the whole batch: a run may be resumed by
another number of processes. The first of them writes and speaks. accelerate is beneath, where there is more than one.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor

from brewster.errors import DeviceError
from brewster.models.diffusion.lazy_imports import library

_LAUNCHER_VARIABLES: Final = ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
"""What a launcher tells each process, beside WORLD_SIZE."""
_CURE: Final = "start them with torchrun --nproc_per_node"


def initialize() -> None:
    """Meets the others, if the launcher (torchrun, accelerate launch) says that there are some.

    Raises:
        DeviceError: not as many came as were announced.
        MissingExtra: there are some, and accelerate is not installed.
    """
    _check_launch_variables()
    try:
        state = _partial_state()
    except (NotImplementedError, RuntimeError, ValueError) as error:  # the first: cards that need NCCL told
        raise DeviceError(
            f"the processes could not meet: {error}", f"{_expected_world_size()} that reach each other", _CURE
        ) from error
    if world_size() != _expected_world_size():
        raise DeviceError(
            f"{world_size()} processes have met", f"the {_expected_world_size()} that WORLD_SIZE names", _CURE
        )
    if state:
        atexit.register(state.destroy_process_group)


def world_size() -> int:
    """How many processes learn together."""
    state = _partial_state()
    return int(state.num_processes) if state else 1


def rank() -> int:
    """Which of them this one is, from 0."""
    state = _partial_state()
    return int(state.process_index) if state else 0


def is_main_process() -> bool:
    """Whether this is the one that writes and speaks."""
    return rank() == 0


def best_device() -> torch.device:
    """This process's GPU where torch sees one, else the CPU."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    state = _partial_state()
    return torch.device(state.device) if state else torch.device("cuda")


def all_reduce_sum(tensors: Sequence[Tensor]) -> None:
    """Replaces these tensors, of one device, by their sums over all processes."""
    if world_size() > 1 and tensors:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        total = library("accelerate.utils").reduce(flat, "sum")
        parts = torch.split(total, [tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))


def _partial_state() -> Any | None:  # noqa: ANN401 - accelerate's state
    """accelerate's state of all processes, the same at each call; nothing where this one is alone."""
    if _expected_world_size() == 1:
        return None
    # Without a GPU, accelerate has to be told so: else each process quietly believes that it is the only one.
    return library("accelerate").PartialState(cpu=not torch.cuda.is_available())


def _expected_world_size() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))


def _check_launch_variables() -> None:
    """Several processes were wanted, and the launcher started one, or did not tell it who the others are."""
    missing = [name for name in _LAUNCHER_VARIABLES if name not in os.environ]
    if _expected_world_size() > 1 and missing:
        raise DeviceError(
            f"WORLD_SIZE is {_expected_world_size()}, and {', '.join(missing)} not set",
            "all that a launcher sets",
            _CURE,
        )
    # What `accelerate launch --cpu --num_processes 2` sets: it starts a single process, and says nothing.
    if "WORLD_SIZE" not in os.environ and {"ACCELERATE_MIXED_PRECISION", "MASTER_ADDR"} <= os.environ.keys():
        raise DeviceError(
            "accelerate launch was asked for several processes and has started one",
            "several",
            f"{_CURE}, or accelerate launch --multi_gpu",
        )
