"""Which Mitsuba can run here: compiled by LLVM where a good one is found, else the slow scalar one.

    name = variant()  # "llvm_ad_rgb" or "scalar_rgb"

Dr.Jit loads the first LLVM it finds, and an unsuitable one (14 to 16) aborts the whole process at the first kernel.
So each candidate is tried in a process of its own first. `DRJIT_LIBLLVM_PATH` names one and ends the search.
"""

from __future__ import annotations

import os
import re
import site
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from brewster.errors import MissingExtra

LIBRARY: Final = "DRJIT_LIBLLVM_PATH"
COMPILED: Final = "llvm_ad_rgb"
SCALAR: Final = "scalar_rgb"

_KNOWN_GOOD: Final = (19, 20, 18, 17)
_FOLDERS: Final = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt", "/usr/local/opt")
_PATTERNS: Final = ("libLLVM*.so*", "*/libLLVM*.so*", "*/lib/libLLVM*.so*", "*/lib/libLLVM*.dylib")
_SECONDS: Final = 60
_PICTURE: Final = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
ball = {"type": "sphere", "bsdf": {"type": "dielectric"}}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": {"type": "perspective"},
                      "light": {"type": "constant"}, "ball": ball})
assert 0 < mi.Bitmap(mi.render(scene, spp=1)).channel_count()
"""


@dataclass(frozen=True)
class Probe:
    """What was found: the variant, the LLVM it needs (None: the one Dr.Jit finds), and why it is not compiled."""

    variant: str
    library: str | None = None
    reason: str = ""


def variant() -> str:
    """The Mitsuba variant that works here; it points `DRJIT_LIBLLVM_PATH` of this process to the LLVM that does.

    The first call takes a second or two and warns if it must fall back to the scalar variant.

    Raises:
        MissingExtra: mitsuba is not installed.
    """
    found = probe()
    if found.library:
        os.environ[LIBRARY] = found.library
    return found.variant


@lru_cache(maxsize=1)
def probe() -> Probe:
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
            return Probe(COMPILED, library)
        reasons.append(f"{library or 'the one Dr.Jit finds'}: {reason}")
    found = Probe(SCALAR, reason="; ".join(reasons))
    warnings.warn(
        f"no LLVM works for Mitsuba, so that rendering is several times slower; install LLVM 17 or newer"
        f" (apt install libllvm19) or name it in {LIBRARY} ({found.reason})",
        RuntimeWarning,
        stacklevel=3,
    )
    return found


def _candidates() -> list[str | None]:
    """The one that the user named; else those found, known good ones first, then what Dr.Jit finds by itself."""
    if named := os.environ.get(LIBRARY):
        return [named]
    paths = {
        path.resolve() for folder in _FOLDERS for pattern in _PATTERNS for path in Path(folder).glob(pattern)
    }
    dated = {_version(path): str(path) for path in sorted(paths)}
    newer = sorted(version for version in dated if version > max(_KNOWN_GOOD))
    return [*(dated[version] for version in (*_KNOWN_GOOD, *newer) if version in dated), None]


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
                [sys.executable, "-c", _PICTURE],
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
