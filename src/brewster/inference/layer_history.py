"""Records in the metadata of a layer which program, model and options made it."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import brewster
from brewster.photo import Photo
from brewster.photo.history import with_history

PROGRAM: Final = "brewster"
"""The name under which the metadata of layers record this program."""


def history_step(model: str, *, strength: float, quality: str, additive: bool) -> dict[str, str]:
    """Returns the options of a separation as names and values for the metadata of its layers."""
    return {
        "model": model,
        "strength": f"{strength:g}",
        "quality": quality,
        "additive": "yes" if additive else "no",
    }


def with_step(photo: Photo, layer: str, step: dict[str, str]) -> Photo:
    """Returns a layer whose metadata record the program, its version, the name of the layer and the options in `step`."""
    software = f"{PROGRAM} {brewster.__version__}"
    return replace(photo, file_info=with_history(photo.file_info, software, {"layer": layer} | step))
