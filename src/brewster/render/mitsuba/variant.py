"""Loads Mitsuba with a working LLVM. Without one, only the slow scalar variant is available.

    mitsuba = load()
    mitsuba.set_variant(probe().variant)  # "llvm_ad_rgb" or "scalar_rgb"

Dr.Jit loads an LLVM when it is imported. An incompatible LLVM (14 to 16) aborts the whole process
at the first kernel. Therefore each candidate first renders a small image in a separate process. The
candidates are the LLVM of the pip package `karellen-llvm-core`, then those of the system. If
`DRJIT_LIBLLVM_PATH` is set, only that path is tried.
"""

import ctypes
import importlib
import os
import platform
import re
import site
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Final

from brewster.errors import MissingExtra

LLVM_PATH_VARIABLE: Final = "DRJIT_LIBLLVM_PATH"
COMPILED: Final = "llvm_ad_rgb"
SCALAR: Final = "scalar_rgb"

INSTALL_LLVM: Final = (
    "pip install karellen-llvm-core"
    if (sys.platform, platform.machine()) == ("linux", "x86_64")
    else "apt install libllvm19"
)
"""The command that installs a working LLVM; the pip package exists for x86-64 Linux only."""

_LLVM_PACKAGE: Final = "karellen-llvm-core"
_RUNTIME_LIBRARIES: Final = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")
"""The libraries that the package's LLVM needs, in the order in which they must be loaded."""
_KNOWN_GOOD: Final = (19, 20, 18, 17)
_FOLDERS: Final = (
    "/usr/lib",
    "/usr/lib64",
    "/usr/local/lib",
    "/opt/homebrew/opt",
    "/usr/local/opt",
)
_PATTERNS: Final = ("libLLVM*.so*", "*/libLLVM*.so*", "*/lib/libLLVM*.so*", "*/lib/libLLVM*.dylib")
_NO_LLVM: Final = "no-llvm"
"""The name of a library that does not exist, so that Dr.Jit loads none."""
_TIMEOUT_S: Final = 60
_TEST_PROGRAM: Final = """
import ctypes, sys
for runtime in sys.argv[1:]:
    ctypes.CDLL(runtime)
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
ball = {"type": "sphere", "bsdf": {"type": "dielectric"}}
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "path"},
    "sensor": {"type": "perspective"},
    "light": {"type": "constant"},
    "ball": ball,
})
assert 0 < mi.Bitmap(mi.render(scene, spp=1)).channel_count()
"""


@dataclass(frozen=True)
class VariantProbe:
    """The variant to use, the path of its LLVM (None: the LLVM that Dr.Jit finds), and the reason
    if no LLVM works.
    """

    variant: str
    library: str | None = None
    reason: str = ""


def load() -> ModuleType:
    """Imports Mitsuba with a working LLVM. If no LLVM works, only scalar variants can be selected,
    and a warning is given. Raises MissingExtra if mitsuba is not installed, or a system library
    that it needs is missing.
    """
    found = probe()
    for runtime in _runtime_libraries(found.library):
        # RTLD_GLOBAL is not set, because with it, exceptions of other C++ libraries end the
        # process.
        ctypes.CDLL(runtime)
    if found.library:
        os.environ[LLVM_PATH_VARIABLE] = found.library
    try:
        mitsuba = importlib.import_module("mitsuba")
    except (
        ImportError,
        NameError,
    ) as error:  # Dr.Jit raises a NameError while it handles the ImportError
        reason = str(error.__context__ or error)
        raise MissingExtra(
            f"mitsuba cannot be imported ({reason})",
            "expected a working package mitsuba for this renderer",
            f"run: {install_command(reason)}",
        ) from error
    if found.variant != COMPILED:
        warnings.warn(
            f"no LLVM works with Mitsuba ({found.reason}), so rendering is much slower; expected "
            "LLVM 17 or newer;"
            f" install it ({INSTALL_LLVM}) or set {LLVM_PATH_VARIABLE} to its path",
            RuntimeWarning,
            stacklevel=2,
        )
    return mitsuba


def install_command(reason: str) -> str:
    """Returns the command that installs the missing package when the import of Mitsuba fails for
    this reason.
    """
    has_package = "libatomic" not in reason
    return (
        "pip install --force-reinstall mitsuba drjit" if has_package else "apt install libatomic1"
    )


@lru_cache(maxsize=1)
def probe() -> VariantProbe:
    """Tries each LLVM in a separate process. Returns the variant to use; the result is cached.
    Raises MissingExtra if mitsuba is not installed.
    """
    if find_spec("mitsuba") is None:
        expected = "expected the package mitsuba for this renderer"
        raise MissingExtra.for_extra("render", "mitsuba is not installed", expected)
    reasons = []
    for library in _candidates():
        reason = _failure_reason(library)
        if not reason:
            return VariantProbe(COMPILED, library)
        reasons.append(f"{library or 'the LLVM that Dr.Jit finds'}: {reason}")
    return VariantProbe(SCALAR, _NO_LLVM, "; ".join(reasons))


def _candidates() -> list[str | None]:
    """Returns the paths of the LLVMs to try, versions known to work first. None: the one that
    Dr.Jit finds.
    """
    configured = os.environ.get(LLVM_PATH_VARIABLE)
    if (
        configured or "drjit" in sys.modules
    ):  # if Dr.Jit is already imported, its LLVM cannot change
        return [configured]
    found = {
        path.resolve()
        for at in _FOLDERS
        for pattern in _PATTERNS
        for path in Path(at).glob(pattern)
    }
    by_version = {_version(path): str(path) for path in sorted(found)}
    newer = sorted(version for version in by_version if version > max(_KNOWN_GOOD))
    ordered = [by_version[version] for version in (*_KNOWN_GOOD, *newer) if version in by_version]
    return [*_packaged_llvm(), *ordered, None]


def _packaged_llvm() -> list[str]:
    try:
        files = metadata.files(_LLVM_PACKAGE) or []
    except metadata.PackageNotFoundError:
        return []
    libraries = (file for file in files if re.fullmatch(r"libLLVM\.so[.\d]+", file.name))
    return [str(Path(file.locate()).resolve()) for file in libraries]


def _runtime_libraries(library: str | None) -> list[str]:
    """Returns the libraries of the C++ runtime that the package installs next to its LLVM; empty
    for any other LLVM. They must be loaded before the LLVM: it finds them through links, which
    exist only when Python has started.
    """
    folder = Path(library or "").parent / "x86_64-unknown-linux-gnu"
    return [str(folder / name) for name in _RUNTIME_LIBRARIES if (folder / name).exists()]


def _version(path: Path) -> int:
    """Returns the major version: 19 for `libLLVM.so.19.1`, `libLLVM-19.so`,
    `llvm@19/lib/libLLVM.dylib`; or 0.
    """
    number = re.search(r"LLVM[-.]\D*(\d+)|llvm[@-]?/?(\d+)", str(path))
    return int(number[1] or number[2]) if number else 0


def _failure_reason(library: str | None) -> str:
    """Renders a test image with this LLVM in a separate process. Returns the error in one line, or
    "" if it succeeds. The home folder of the process is empty, so that Dr.Jit does not reuse cached
    kernels of another LLVM.
    """
    with tempfile.TemporaryDirectory() as home:
        folders = {"HOME": home, "LOCALAPPDATA": home, "PYTHONUSERBASE": site.getuserbase()}
        llvm = {LLVM_PATH_VARIABLE: library} if library else {}
        try:
            subprocess.run(  # noqa: S603 - our own interpreter and program
                [sys.executable, "-c", _TEST_PROGRAM, *_runtime_libraries(library)],
                env={**os.environ, **folders, **llvm},
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
                check=True,
            )
        except subprocess.TimeoutExpired:
            return f"no image after {_TIMEOUT_S} seconds"
        except subprocess.CalledProcessError as error:
            if error.returncode < 0:
                return f"the first kernel ends the process (signal {-error.returncode})"
            return str(error.stderr).strip().rpartition("\n")[2] or f"exit code {error.returncode}"
    return ""
