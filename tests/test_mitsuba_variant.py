"""The choice of the LLVM that compiles Mitsuba's kernels; each import runs in a separate
process.
"""

import os
import sys

import numpy as np
import pytest

from brewster.render.mitsuba import variant
from brewster.render.mitsuba.scene_builder import sample_bilinear
from other_processes import finished

TRACING_PROGRAM = """
import warnings
from brewster.render.mitsuba.renderer import trace
from test_mitsuba_renderer import ASSETS, a_scene

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    scene = a_scene(camera={"width": 16, "height": 16})
    light = float(trace(scene, ASSETS, noise_threshold=0.01, max_samples=64).photo.mean())
assert abs(light - 1) < 0.01, light
import mitsuba
from brewster.errors import DeviceError
from brewster.render.mitsuba import variant
maps = [line for line in open("/proc/self/maps") if "libLLVM" in line]
loaded = {line.split()[-1].rpartition("/")[2] for line in maps}
print(variant.probe().variant, *loaded)
print(*{str(warning.message) for warning in caught})
try:
    trace(scene, ASSETS, max_samples=4, polarised=True)
except DeviceError as error:
    print(error)
"""


def run_program(program, **variables):
    """Runs a Python program with additional environment variables. Returns the finished process."""
    folders = os.pathsep.join((os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")))  # noqa: PTH120
    return finished(
        [sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": folders, **variables}
    )


@pytest.mark.parametrize("name", ["/nonexistent", "libm.so.6"])
def test_without_a_working_llvm_the_scalar_variant_renders_and_no_llvm_is_loaded(mitsuba, name):
    done = run_program(TRACING_PROGRAM, DRJIT_LIBLLVM_PATH=name)
    assert done.returncode == 0, done.stderr
    loaded, warning, error = done.stdout.splitlines()
    assert loaded == "scalar_rgb"
    assert "no LLVM works" in warning
    assert name in warning
    assert variant.INSTALL_LLVM in warning
    assert variant.INSTALL_LLVM in error


def test_the_llvm_of_the_pip_package_comes_first_and_compiles(requires_llvm):
    packaged = variant._packaged_llvm()
    if not packaged:
        pytest.skip(f"the LLVM of the pip package is not installed; run: {variant.INSTALL_LLVM}")
    done = run_program(TRACING_PROGRAM, **{variant.LLVM_PATH_VARIABLE: ""})
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["llvm_ad_rgb", os.path.basename(packaged[0])]  # noqa: PTH119


def test_exceptions_of_other_libraries_are_caught_when_the_llvm_of_the_package_is_loaded(
    requires_llvm,
):
    """If the C++ runtime of the package were in the global scope, the process would end."""
    program = """
import numpy
from brewster.render.mitsuba import variant
mitsuba = variant.load()
mitsuba.set_variant(variant.probe().variant)
import OpenEXR
for fails in (
    lambda: mitsuba.load_dict({"type": "nonsense"}),
    lambda: OpenEXR.File("/nonexistent.exr"),
):
    try:
        fails()
    except RuntimeError:
        print("caught")
"""
    assert run_program(program).stdout.split() == ["caught", "caught"]


def test_known_good_llvm_versions_are_tried_first(tmp_path, monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setattr(variant, "_FOLDERS", [str(tmp_path)])
    monkeypatch.setattr(variant, "_LLVM_PACKAGE", "no-such-package")
    for name in ("libLLVM-14.so.1", "libLLVM-18.so.1", "libLLVM.so.19.1", "libLLVM.so.21.0"):
        (tmp_path / name).touch()
    names = [path and path.rpartition("/")[2] for path in variant._candidates()]
    assert names == ["libLLVM.so.19.1", "libLLVM-18.so.1", "libLLVM.so.21.0", None]


def test_a_missing_libatomic_is_reported_with_its_install_command(mitsuba, tmp_path):
    (tmp_path / "libatomic.so.1").touch()  # found first, but not a valid library
    program = "from brewster.render.mitsuba import variant; variant.load()"
    done = run_program(program, LD_LIBRARY_PATH=str(tmp_path))
    message = done.stderr.splitlines()[-1]
    assert "MissingExtra: mitsuba cannot be imported" in message
    assert "libatomic.so.1" in message
    assert message.endswith("run: apt install libatomic1.")


def test_light_between_texels_is_interpolated_and_wraps_around():
    texels = np.arange(8, dtype=np.float32).reshape(2, 4, 1).repeat(3, 2)
    u_and_v = np.array([0.125, 0.25, 0.0]), np.array([0.0, 0.25, 0.5])
    assert sample_bilinear(texels, *u_and_v)[..., 0].tolist() == [
        [0, 0.5, 1.5],
        [0, 0.5, 1.5],
        [2, 2.5, 3.5],
    ]
