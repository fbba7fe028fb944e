"""Compiles the kernels of bursts before they are needed.

Numba compiles a function at its first call. All kernels take about ten seconds of a processor, once
after an installation: then they are read from a folder.
"""

from pathlib import Path
from typing import Any

import numpy as np

from brewster.burst import kernels
from brewster.burst.levels import Level
from brewster.burst.registration import MotionCandidate
from brewster.burst.solver import solve

_FRAMES = 3
_SIZE = (48, 64)
_LEVELS = (
    Level(64, steps=1, spline_size=(4, 6), density=1.5),
    Level(64, steps=1, spline_size=(4, 6), every=2),
)
_SEARCH = (Level(64, steps=1, spline_size=None),)


def is_prepared() -> bool:
    """Returns whether kernels of an earlier run are in the folder of the cache."""
    compiled: Any = kernels.data_term
    folder = compiled.stats.cache_path
    return folder is not None and any(Path(folder).glob("kernels.*.nbi"))


def prepare() -> None:
    """Solves a burst of a few pixels, with one step at each level."""
    texture = np.random.default_rng(0).random((*_SIZE, 3), np.float32)
    frames = [np.roll(texture, 2 * shift, axis=1) for shift in range(_FRAMES)]
    still = np.broadcast_to(np.eye(3), (_FRAMES, 3, 3)).copy()
    moved = still.copy()
    moved[:, 0, 2] = np.arange(_FRAMES) / _SIZE[1]
    candidates = [
        MotionCandidate("one layer", still, still, is_locked=True),
        MotionCandidate("two layers", still, moved),
    ]
    solve(
        frames,
        1,
        np.float32(0.8) * texture,
        candidates,
        search=_SEARCH,
        levels=_LEVELS,
        small_levels=_LEVELS,
    )
