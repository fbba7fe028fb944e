"""The threads that share the frames and the rows of a burst. No result depends on their number."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from threading import Lock
from typing import Any, Final, final

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


@final
class _OpenCVThreads:
    """The number of threads of OpenCV, which is one for the whole process.

    Bursts overlap in a server. The number is restored when the last one ends; each of them would
    otherwise restore the number that it found, which may be the one of another burst.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._users = 0
        self._previous_count = 0

    @contextmanager
    def single(self) -> Iterator[None]:
        """Limits OpenCV to one thread while there are users."""
        with self._lock:
            if self._users == 0:
                self._previous_count = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0:
                    cv2.setNumThreads(self._previous_count)


_OPENCV_THREADS: Final = _OpenCVThreads()


def single_opencv_thread() -> AbstractContextManager[None]:
    """Limits OpenCV to one thread in the block, because its threads and those of this module slow
    each other down.
    """
    return _OPENCV_THREADS.single()
