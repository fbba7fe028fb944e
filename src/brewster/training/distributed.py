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
from brewster.models.diffusion.lazy_imports import import_library

_LAUNCHER: Final = ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
"""What a launcher tells each process, beside WORLD_SIZE."""
_CURE: Final = "start them with torchrun --nproc_per_node"


def initialize() -> None:
    """Meets the others, if the launcher (torchrun, accelerate launch) says that there are some.

    Raises:
        DeviceError: not as many came as were announced.
        MissingExtra: there are some, and accelerate is not installed.
    """
    _refuse_half_a_launch()
    try:
        together = _together()
    except (NotImplementedError, RuntimeError, ValueError) as error:  # the first: cards that need NCCL told
        raise DeviceError(
            f"the processes could not meet: {error}", f"{_announced()} that reach each other", _CURE
        ) from error
    if world_size() != _announced():
        raise DeviceError(
            f"{world_size()} processes have met", f"the {_announced()} that WORLD_SIZE names", _CURE
        )
    if together:
        atexit.register(together.destroy_process_group)


def world_size() -> int:
    """How many processes learn together."""
    together = _together()
    return int(together.num_processes) if together else 1


def rank() -> int:
    """Which of them this one is, from 0."""
    together = _together()
    return int(together.process_index) if together else 0


def is_main_process() -> bool:
    """Whether this is the one that writes and speaks."""
    return rank() == 0


def best_device() -> torch.device:
    """This process's GPU where torch sees one, else the CPU."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    together = _together()
    return torch.device(together.device) if together else torch.device("cuda")


def all_reduce_sum(tensors: Sequence[Tensor]) -> None:
    """Replaces these tensors, of one device, by their sums over all processes."""
    if world_size() > 1 and tensors:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        total = import_library("accelerate.utils").reduce(flat, "sum")
        parts = torch.split(total, [tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))


def _together() -> Any | None:  # noqa: ANN401 - accelerate's state
    """accelerate's state of all processes, the same at each call; nothing where this one is alone."""
    if _announced() == 1:
        return None
    # Without a GPU, accelerate has to be told so: else each process quietly believes that it is the only one.
    return import_library("accelerate").PartialState(cpu=not torch.cuda.is_available())


def _announced() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))


def _refuse_half_a_launch() -> None:
    """Several processes were wanted, and the launcher started one, or did not tell it who the others are."""
    lacking = [name for name in _LAUNCHER if name not in os.environ]
    if _announced() > 1 and lacking:
        raise DeviceError(
            f"WORLD_SIZE is {_announced()}, and {', '.join(lacking)} not set",
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
