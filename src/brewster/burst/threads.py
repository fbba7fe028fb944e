"""The threads that share the frames and the rows of a burst. No result depends on their number."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, Final

import cv2


def _thread_count() -> int:
    """Returns the number of threads: OMP_NUM_THREADS, as for ONNX Runtime, or one for each
    processor of this process.
    """
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    if wanted.isdigit() and int(wanted):
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS: Final = _thread_count()
POOL: Final = ThreadPoolExecutor(THREADS, "brewster-burst")


def run_items(kernel: Callable[..., Any], count: int, *arguments: object) -> None:
    """Runs the items 0 to `count` of a kernel, each thread a range of them."""
    ends = [count * thread // THREADS for thread in range(THREADS + 1)]
    others = [POOL.submit(kernel, begin, end, *arguments) for begin, end in pairwise(ends[1:])]
    kernel(0, ends[1], *arguments)
    for other in others:
        other.result()


@contextmanager
def single_opencv_thread() -> Iterator[None]:
    """Limits OpenCV to one thread in the block, because its threads and those of this module slow
    each other down.
    """
    previous_count = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(previous_count)
