"""Several processes that learn as one, each on a GPU of its own; alone, nothing of this is noticed.

torchrun --standalone --nproc_per_node 2 -m brewster train recipes/train/klein.toml

They divide each batch, and all end with the same weights as one process with the whole batch: a run may be resumed by
another number of processes. The first of them writes and speaks.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Sequence

import torch
from torch import Tensor, distributed

from brewster.errors import DeviceError


def assemble() -> None:
    """Meets the others, if the launcher (torchrun, accelerate launch) says that there are some.

    Raises:
        DeviceError: not as many came as were announced.
    """
    announced = int(os.environ.get("WORLD_SIZE", "1"))
    if announced > 1 and not distributed.is_initialized():
        if torch.cuda.is_available():
            torch.cuda.set_device(_local())
        distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        atexit.register(distributed.destroy_process_group)
    if size() != announced:
        raise DeviceError(
            f"{size()} processes have met",
            f"the {announced} that WORLD_SIZE names",
            "start them with torchrun",
        )


def size() -> int:
    """How many processes learn together."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this one is, from 0."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def leads() -> bool:
    """Whether this is the one that writes and speaks."""
    return rank() == 0


def best_device() -> torch.device:
    """This process's GPU where torch sees one, else the CPU."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", _local()) if size() > 1 else torch.device("cuda")


def add_up(tensors: Sequence[Tensor]) -> None:
    """Replaces these tensors, of one device, by their sums over all processes."""
    if size() > 1 and tensors:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        distributed.all_reduce(flat)
        parts = torch.split(flat, [tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))


def _local() -> int:
    return int(os.environ.get("LOCAL_RANK", "0"))
