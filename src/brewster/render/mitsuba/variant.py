"""Loads Mitsuba: compiled by an LLVM that works here, else as the slow scalar variant.

    mitsuba = load()
    mitsuba.set_variant(probe().variant)  # "llvm_ad_rgb" or "scalar_rgb"

Dr.Jit loads an LLVM when it is imported, and an unsuitable one (14 to 16) aborts the whole process at the first kernel.
So each candidate renders a small picture in a process of its own first. The candidates are the LLVM of the pip package
`karellen-llvm-core`, then those of the system; `DRJIT_LIBLLVM_PATH` names one and ends the search.
"""

from __future__ import annotations

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

LIBRARY: Final = "DRJIT_LIBLLVM_PATH"
COMPILED: Final = "llvm_ad_rgb"
SCALAR: Final = "scalar_rgb"

INSTALL_LLVM: Final = (
    "pip install karellen-llvm-core"
    if (sys.platform, platform.machine()) == ("linux", "x86_64")
    else "apt install libllvm19"
)
"""The line that installs an LLVM that works; the pip package exists for x86-64 Linux only."""

_PACKAGE: Final = "karellen-llvm-core"
_RUNTIME: Final = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")
"""What the package's LLVM is linked to, in the order in which one needs the other."""
_KNOWN_GOOD: Final = (19, 20, 18, 17)
_FOLDERS: Final = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt", "/usr/local/opt")
_PATTERNS: Final = ("libLLVM*.so*", "*/libLLVM*.so*", "*/lib/libLLVM*.so*", "*/lib/libLLVM*.dylib")
_NO_LLVM: Final = "no-llvm"
"""A library that does not exist, so that Dr.Jit loads none."""
_SECONDS: Final = 60
_PICTURE: Final = """
import ctypes, sys
for runtime in sys.argv[1:]:
    ctypes.CDLL(runtime)
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
ball = {"type": "sphere", "bsdf": {"type": "dielectric"}}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": {"type": "perspective"},
                      "light": {"type": "constant"}, "ball": ball})
assert 0 < mi.Bitmap(mi.render(scene, spp=1)).channel_count()
"""


@dataclass(frozen=True)
class VariantProbe:
    """What was found: the variant, the LLVM to load (None: the one Dr.Jit finds), and why it is not compiled."""

    variant: str
    library: str | None = None
    reason: str = ""


def load() -> ModuleType:
    """Mitsuba, with the LLVM that works here; without any, with none, so that only scalar variants can be chosen.

    The first call takes a second or two, and warns if only the scalar variant works.

    Raises:
        MissingExtra: mitsuba is not installed, or a system library that it needs is missing.
    """
    found = probe()
    for runtime in _runtime_of(found.library):
        ctypes.CDLL(
            runtime
        )  # never RTLD_GLOBAL: exceptions of other C++ libraries would then end the process
    if found.library:
        os.environ[LIBRARY] = found.library
    try:
        mitsuba = importlib.import_module("mitsuba")
    except (ImportError, NameError) as error:  # Dr.Jit hides the ImportError behind a NameError of its own
        reason = str(error.__context__ or error)
        raise MissingExtra(
            f"mitsuba cannot be imported ({reason})", "the tracer renders with it", f"run: {cure(reason)}"
        ) from error
    if found.variant != COMPILED:
        warnings.warn(
            f"no LLVM works for Mitsuba, so that rendering is several times slower; install LLVM 17 or newer"
            f" ({INSTALL_LLVM}) or name it in {LIBRARY} ({found.reason})",
            RuntimeWarning,
            stacklevel=2,
        )
    return mitsuba


def cure(reason: str) -> str:
    """The line that installs what is missing if importing Mitsuba fails for this reason."""
    return (
        "apt install libatomic1" if "libatomic" in reason else "pip install --force-reinstall mitsuba drjit"
    )


@lru_cache(maxsize=1)
def probe() -> VariantProbe:
    """Tries every LLVM in a process of its own; once a process, since nothing changes.

    Raises:
        MissingExtra: mitsuba is not installed.
    """
    if find_spec("mitsuba") is None:
        raise MissingExtra(
            "mitsuba is not installed", "the tracer renders with it", "run: pip install 'brewster[render]'"
        )
    reasons = []
    for library in _candidates():
        reason = _fails(library)
        if not reason:
            return VariantProbe(COMPILED, library)
        reasons.append(f"{library or 'the one Dr.Jit finds'}: {reason}")
    return VariantProbe(SCALAR, _NO_LLVM, "; ".join(reasons))


def _candidates() -> list[str | None]:
    """The one that the user named; else those found, known good ones first, then what Dr.Jit finds by itself.

    If Dr.Jit is imported already, it has loaded what the variable names, or what it found: that one only.
    """
    named = os.environ.get(LIBRARY)
    if named or "drjit" in sys.modules:
        return [named]
    paths = {
        path.resolve() for folder in _FOLDERS for pattern in _PATTERNS for path in Path(folder).glob(pattern)
    }
    dated = {_version(path): str(path) for path in sorted(paths)}
    newer = sorted(version for version in dated if version > max(_KNOWN_GOOD))
    known = [dated[version] for version in (*_KNOWN_GOOD, *newer) if version in dated]
    return [*_of_the_package(), *known, None]


def _of_the_package() -> list[str]:
    try:
        files = metadata.files(_PACKAGE) or []
    except metadata.PackageNotFoundError:
        return []
    return [
        str(Path(file.locate()).resolve()) for file in files if re.fullmatch(r"libLLVM\.so[.\d]+", file.name)
    ]


def _runtime_of(library: str | None) -> list[str]:
    """The C++ runtime that the package installs in a folder next to its LLVM; nothing for any other LLVM.

    It must be loaded before, as the links by which the LLVM would find it are only made when Python next starts.
    """
    folder = Path(library or "").parent / "x86_64-unknown-linux-gnu"
    return [str(folder / name) for name in _RUNTIME if (folder / name).exists()]


def _version(path: Path) -> int:
    """`libLLVM.so.19.1`, `libLLVM-19.so` and `llvm@19/lib/libLLVM.dylib` are all 19."""
    number = re.search(r"LLVM[-.]\D*(\d+)|llvm[@-]?/?(\d+)", str(path))
    return int(number[1] or number[2]) if number else 0


def _fails(library: str | None) -> str:
    """Why a picture cannot be rendered with this LLVM, in one line; empty if it can.

    An empty home keeps Dr.Jit from reusing kernels that another LLVM compiled, which would prove nothing.
    """
    with tempfile.TemporaryDirectory() as home:
        places = {"HOME": home, "LOCALAPPDATA": home, "PYTHONUSERBASE": site.getuserbase()}
        chosen = {LIBRARY: library} if library else {}
        try:
            subprocess.run(  # noqa: S603 - our own interpreter and program
                [sys.executable, "-c", _PICTURE, *_runtime_of(library)],
                env={**os.environ, **places, **chosen},
                capture_output=True,
                text=True,
                timeout=_SECONDS,
                check=True,
            )
        except subprocess.TimeoutExpired:
            return f"no picture in {_SECONDS} seconds"
        except subprocess.CalledProcessError as error:
            if error.returncode < 0:
                return f"its first kernel ends the process (signal {-error.returncode})"
            return str(error.stderr).strip().rpartition("\n")[2] or f"exit code {error.returncode}"
    return ""
