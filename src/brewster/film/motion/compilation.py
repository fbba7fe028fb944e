"""Compiles the kernels of bursts beside other work.

numba compiles a kernel when it is first called, and keeps the machine code on the disk. After an
installation this is more work than the film itself, and could be done while its frames are read.
"""

from functools import cache
from pathlib import Path
from threading import Thread, main_thread
from typing import Any

from brewster.film.motion.model.kernels.data_term import data_term
from brewster.film.motion.model.optimiser import compile_kernels
from brewster.separation.predictor import ProgressCallback


def is_compiled() -> bool:
    """Returns whether kernels of an earlier process are on the disk."""
    kernel: Any = data_term
    folder = kernel.stats.cache_path
    return folder is not None and any(Path(folder).glob("data_term.*.nbi"))


def compile_all(on_progress: ProgressCallback = lambda _fraction: None) -> None:
    """Compiles all kernels.

    Args:
        on_progress: called with the completed fraction, 0 to 1.
    """
    for done in compile_kernels():
        on_progress(done)


@cache
def compile_in_background() -> None:
    """Starts to compile all kernels in a thread, once in a process. Whoever needs a kernel before
    it is compiled waits for it. At the end of the process, the kernel at hand is completed.
    """
    Thread(target=_compile, name="brewster-compilation").start()


def _compile() -> None:
    try:
        for _ in compile_kernels():
            if not main_thread().is_alive():
                return
    except RuntimeError:  # no threads for a kernel at the end of the process
        if main_thread().is_alive():
            raise
