"""Inference: separates a photo into transmission and reflection. It imports neither the renderer
nor the trainer.

Public names are imported on first use, so that the table of models needs no ONNX Runtime.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brewster.options import Quality
    from brewster.separation.predictor import QUALITIES
    from brewster.separation.registry import Model
    from brewster.separation.separation import Separation
    from brewster.separation.separator import Separator
else:  # not for type checkers, which accept misspelt names if a module has __getattr__

    def __getattr__(name: str) -> object:
        """Imports a public name on first use."""
        if name in _MODULES:
            return getattr(importlib.import_module(_MODULES[name]), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["QUALITIES", "Model", "Quality", "Separation", "Separator"]

_MODULES = {
    "Model": "brewster.separation.registry",
    "QUALITIES": "brewster.separation.predictor",
    "Quality": "brewster.options",
    "Separation": "brewster.separation.separation",
    "Separator": "brewster.separation.separator",
}


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
