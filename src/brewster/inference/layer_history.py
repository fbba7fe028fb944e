"""Records in the metadata of a layer which program, model and options made it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

from brewster.photo import Photo
from brewster.photo.history import PROGRAM, recorded_parameters, sampled_digest, with_layer_history

PHOTO: Final = "photo"
"""The name of the parameter that identifies the photo of a layer: its `sampled_digest`."""


def history_step(*, strength: float, quality: str, additive: bool) -> dict[str, str]:
    """Returns the options of a separation as names and values for the metadata of its layers."""
    return {"strength": f"{strength:g}", "quality": quality, "additive": "yes" if additive else "no"}


def with_step(photo: Photo, layer: str, step: dict[str, str]) -> Photo:
    """Returns a layer whose metadata record the program, its version, the name of the layer and the options in `step`."""
    return replace(photo, file_info=with_layer_history(photo.file_info, layer, step))


def find_layer_of_another_photo(photo: Path, layers: Iterable[Path]) -> Path | None:
    """Returns a layer that was made from another photo, or from another version of this photo. Otherwise returns None.

    The first layer that records its photo decides, and the other layers are not read. A layer without this record is
    accepted: it is from an earlier version of brewster, or its format has no XMP. None is returned if the photo cannot be read.
    """
    for layer in layers:
        recorded = (recorded_parameters(layer, PROGRAM) or {}).get(PHOTO)
        if recorded:
            try:
                with photo.open("rb") as file:
                    return None if sampled_digest(file) == recorded else layer
            except OSError:
                return None
    return None
