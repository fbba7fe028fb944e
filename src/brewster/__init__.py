"""Separates a photograph taken through glass into what is behind the glass and what is mirrored in it.

    import brewster

    brewster.separate("window.jpg").transmission.save("clear.jpg")

Names are looked up when they are first used, so `import brewster` wakes neither pyvips nor ONNX Runtime.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from brewster import errors

if TYPE_CHECKING:
    from brewster.inference import Separation, Separator, separate
    from brewster.photo import Photo

    __version__: str
else:  # a type checker would take any name, even a misspelt one, for what __getattr__ returns

    def __getattr__(name: str) -> object:
        """Names are looked up when they are first used."""
        if name in _HOMES:
            return getattr(importlib.import_module(_HOMES[name]), name)
        if name == "__version__":
            return _version()
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["Photo", "Separation", "Separator", "__version__", "errors", "separate"]

_HOMES = {
    "Photo": "brewster.photo",
    "Separation": "brewster.inference",
    "Separator": "brewster.inference",
    "separate": "brewster.inference",
}


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib import metadata  # noqa: PLC0415  (slow to import, seldom asked for)

    try:
        return metadata.version("brewster")
    except metadata.PackageNotFoundError:
        return "0+source"
