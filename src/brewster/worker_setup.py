"""Set-up of worker processes: reproducible sums, and no orphans when the parent process ends."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Limits torch to one thread: the order of sums, and so the result, depends on the number of threads."""
    import torch  # noqa: PLC0415  (only where torch is loaded anyway)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def exit_with_parent() -> None:
    """Makes this process exit when its parent process ends, also when the parent is killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent:
        parent.join()
        os._exit(1)
