"""What processes that share work owe to each other: sums in one order, and an end when their parent ends."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Torch with one thread: it sums in another order with more, so that results would depend on the machine."""
    import torch  # noqa: PLC0415  (only where it is used anyway)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def exit_with_parent() -> None:
    """From now on this process ends when its parent does, however that ends: nobody works on for a run that is gone."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent:
        parent.join()
        os._exit(1)
