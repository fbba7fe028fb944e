"""Separates a photo taken through glass into transmission (behind the glass) and reflection (in the
glass).

    import brewster

    brewster.separate("window.jpg").transmission.save("clear.jpg")

Public names are imported on first use, so `import brewster` loads neither pyvips nor ONNX Runtime.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from brewster import errors

if TYPE_CHECKING:
    from brewster.batch import separate
    from brewster.film import separate_burst
    from brewster.photo import Photo
    from brewster.separation import Separation, Separator

    __version__: str
else:  # not for type checkers, which accept misspelt names if a module has __getattr__

    def __getattr__(name: str) -> object:
        """Imports a public name on first use."""
        if name in _MODULES:
            return getattr(importlib.import_module(_MODULES[name]), name)
        if name == "__version__":
            return _version()
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Photo",
    "Separation",
    "Separator",
    "__version__",
    "errors",
    "separate",
    "separate_burst",
]

_MODULES = {
    "Photo": "brewster.photo",
    "Separation": "brewster.separation",
    "Separator": "brewster.separation",
    "separate": "brewster.batch.one_photo",
    "separate_burst": "brewster.film",
}


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib import metadata  # noqa: PLC0415  (slow to import, rarely needed)

    try:
        return metadata.version("brewster")
    except metadata.PackageNotFoundError:
        return "0+source"
