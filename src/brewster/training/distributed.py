"""Data-parallel training, one GPU per process (torchrun, accelerate launch); a no-op for a single process.

Each process computes the gradients of its part of the batch. Their sum is the gradient of the whole batch, so that a
run can be resumed with another number of processes. Only rank 0 writes files and logs."""

import atexit
import os
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, Final, TypeVar

import torch
from torch import Tensor

from brewster.errors import DeviceError
from brewster.models.diffusion.lazy_imports import import_library

_TIMEOUT: Final = timedelta(hours=12)
"""Maximum time for which a process waits for the other processes. NCCL's default of ten minutes is shorter than the
download of a backbone by rank 0."""
_CURE: Final = "start them with torchrun --nproc_per_node"

_Value = TypeVar("_Value")


def initialize() -> None:
    """Joins the process group if a launcher (torchrun, accelerate launch) started several processes. Raises DeviceError
    if it cannot be created, or fewer processes joined than WORLD_SIZE."""
    try:
        state = _partial_state()
    except (NotImplementedError, RuntimeError, ValueError) as error:
        # NotImplementedError: accelerate refuses RTX 40 GPUs until NCCL_P2P_DISABLE and NCCL_IB_DISABLE are set.
        raise DeviceError(
            f"the process group could not be created: {error}",
            f"expected {_expected_world_size()} processes that can connect to each other",
            _CURE,
        ) from error
    if world_size() != _expected_world_size():
        raise DeviceError(
            f"{world_size()} processes have joined",
            f"expected {_expected_world_size()} processes, the value of WORLD_SIZE",
            _CURE,
        )
    if state:
        atexit.register(state.destroy_process_group)


def world_size() -> int:
    """Returns the number of processes."""
    state = _partial_state()
    return int(state.num_processes) if state else 1


def rank() -> int:
    """Returns the number of this process, from 0."""
    state = _partial_state()
    return int(state.process_index) if state else 0


def is_main_process() -> bool:
    """Whether this process has rank 0, which writes files and logs."""
    return rank() == 0


def best_device(requested: str = "auto") -> torch.device:
    """Returns the GPU of this process, or the CPU if torch finds no GPU or `requested` is "cpu"."""
    if requested == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    state = _partial_state()
    return torch.device(state.device) if state else torch.device("cuda")


def all_reduce_sum(tensors: Sequence[Tensor]) -> None:
    """Replaces each tensor in place by its sum over all processes. All tensors are on one device."""
    if world_size() > 1 and tensors:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        total = import_library("accelerate.utils").reduce(flat, "sum")
        parts = torch.split(total, [tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))


def from_main_process(create: Callable[[], _Value]) -> _Value:
    """Calls `create` in the process of rank 0 only, and returns its picklable result in all processes."""
    values = [create() if is_main_process() else None]
    if world_size() > 1:
        import_library("accelerate.utils").broadcast_object_list(values, from_process=0)
    return values[0]  # type: ignore[return-value]


def _partial_state() -> Any | None:  # noqa: ANN401 - accelerate's state
    """Returns the state of accelerate, a singleton, or None for a single process."""
    if _expected_world_size() == 1:
        return None
    # Without cpu=True and without a GPU, accelerate creates no process group, and each process trains alone.
    return import_library("accelerate").PartialState(cpu=not torch.cuda.is_available(), timeout=_TIMEOUT)


def _expected_world_size() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))
