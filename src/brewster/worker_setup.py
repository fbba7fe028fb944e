"""Set-up of workers: one torch thread, for reproducible results."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Limits torch to one thread in the block, because rounding errors of sums depend on the number of threads."""
    import torch  # noqa: PLC0415  (slow to import, and needed here only)

    previous_count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(previous_count)
