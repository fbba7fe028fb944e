"""What a user sees of a burst before its layers are measured."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from brewster import Photo
from brewster.film import fit_burst
from brewster.film.motion.model.kernels import compiled
from brewster.photo.srgb import to_linear
from brewster.separation import Separator


def test_the_compilation_covers_every_kernel_that_python_calls():
    script = """
from numba.core.registry import CPUDispatcher
from brewster.film.motion.model.kernels import adam, data_term, edges, sampling
from brewster.film.motion.compilation import compile_all, is_compiled
compile_all()
assert is_compiled()
called = {
    name: each
    for module in (adam, data_term, edges, sampling)
    for name, each in vars(module).items()
    if isinstance(each, CPUDispatcher) and each.py_func.__module__ == module.__name__
}
public = [name for name in called if not name.startswith("_")]
assert len(public) > 6
print([name for name in public if not called[name].signatures])
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.stdout == "[]\n", done.stderr


def test_a_change_of_any_module_of_kernels_forgets_all_that_was_compiled_before(tmp_path):
    """A kernel contains the functions and numbers of other modules, which numba does not notice."""
    kept = tmp_path / "kept.nbi"
    forgotten = tmp_path / "forgotten.nbi"
    for index in (kept, forgotten):
        index.touch()
    last_change = max(path.stat().st_mtime for path in Path(compiled.__file__).parent.glob("*.py"))
    os.utime(forgotten, (last_change - 1, last_change - 1))
    compiled._forget_older(tmp_path)
    assert [*tmp_path.iterdir()] == [kept]


def test_the_first_layers_of_a_burst_are_those_of_the_single_photo():
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(40, 220, (12, 18, 3)), np.ones((10, 10, 1))).astype(np.uint8)
    photos = [
        Photo.from_array(np.roll(texture, 4 * shift, axis=1), encoding="srgb") for shift in range(3)
    ]
    shown = []
    fit_burst(
        photos, separator=Separator(lambda tile: (0.7 * tile, 0.3 * tile)), on_layers=shown.append
    )
    transmission, reflection = shown[0]
    assert (
        np.abs(transmission + reflection - to_linear(np.roll(texture, 4, axis=1) / 255)).max()
        < 0.01
    )
    ratio = transmission.mean() / (transmission + reflection).mean()
    assert abs(ratio - 0.7) < 0.02
