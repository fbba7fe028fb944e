"""Set-up of worker processes: one torch thread for reproducible results, and exit when the parent process ends."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process


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


def exit_with_parent() -> None:
    """Makes this process exit when its parent process ends, even if the parent is killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent:
        parent.join()
        os._exit(1)
