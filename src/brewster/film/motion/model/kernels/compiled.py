"""How a kernel is compiled and kept on the disk, and numbers with the types that kernels need."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np
from numba import njit

F: Final = np.float32
U: Final = np.uint64
ZERO, HALF, ONE, TWO, QUARTER, THIRD = (F(value) for value in (0, 0.5, 1, 2, 0.25, 1 / 3))

# off by default; without it, the arithmetic of the four channels stays scalar
numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]
_OPTIONS: Final[dict[str, Any]] = {
    "fastmath": {"reassoc", "contract", "arcp", "nsz"}, "error_model": "numpy", "nogil": True
}  # fmt: skip


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function without the interpreter's lock, once for all processes if the folder of
    the cache can be written.

    Args:
        function: its arguments are arrays and numbers.
    """
    try:
        compiled: Any = njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder for the cache
        compiled = njit(**_OPTIONS)(function)
    if compiled.stats.cache_path is not None:
        _forget_older(Path(compiled.stats.cache_path))
    callable_kernel: Callable[..., Any] = compiled
    return callable_kernel


@cache
def _forget_older(folder: Path) -> None:
    """Removes what was compiled before the last change of any module of this package: numba looks
    only at the file of the kernel, but a kernel contains the functions and numbers of the others.
    """
    with suppress(OSError):
        changed = max(path.stat().st_mtime for path in Path(__file__).parent.glob("*.py"))
        for index in folder.glob("*.nbi"):
            if index.stat().st_mtime < changed:
                index.unlink(missing_ok=True)
