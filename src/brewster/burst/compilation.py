"""Compiles the kernels of bursts beside other work.

numba compiles a kernel when it is first called, and keeps the machine code on the disk. After an
installation this is more work than the film itself, and could be done while its frames are read.
"""

from functools import cache
from threading import Thread, main_thread

from brewster.burst.optimiser import compile_kernels


@cache
def compile_in_background() -> None:
    """Starts to compile all kernels in a thread, once in a process. Whoever needs a kernel before
    it is compiled waits for it. At the end of the process, the kernel at hand is completed.
    """
    Thread(target=_compile, name="brewster-compilation").start()


def _compile() -> None:
    for _ in compile_kernels():
        if not main_thread().is_alive():
            return
