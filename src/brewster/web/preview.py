"""Small maps of a separation, from which the browser computes the layers at any strength.

The photo is reduced first and then separated in floating point, so the layers are not rounded or clipped. page/light.js
computes, in linear light:

    transmission = max(photo + strength x (transmission at strength 1 - photo), 0)
    reflection   = min(strength x reflection at strength 1, photo)
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from brewster.inference import Separator
from brewster.options import Options
from brewster.photo import Photo
from brewster.srgb import to_encoded

MAX_PREVIEW_PIXELS: Final = 1_400_000
"""Larger photos are reduced to about this number of pixels, which is enough for a window."""

RANGE_MIN, RANGE_MAX = -1.0, 2.0
"""The linear light of the 16-bit values 0 and 65535 in the transmission map."""

_SMALL_STRENGTH: Final = 1 / 64
"""The strength of the separation. At this strength no layer is clipped, so the layers can be scaled to strength 1."""


def preview(
    separator: Separator, photo: Photo, options: Options, on_progress: Callable[[float], None]
) -> bytes:
    """Separate a photo for the page.

    Args:
        separator: the model.
        photo: the photo at full size.
        options: the options of the request; `strength` and `additive` are ignored.
        on_progress: called with the completed fraction, 0 to 1.

    Returns:
        One line of JSON with `width`, `height`, `full` (the width and height of the photo), `range` and `verdict`, and
        then four maps of width x height pixels, row by row: the photo (3 bytes for each pixel, sRGB), the transmission at strength 1 (3
        little-endian 16-bit values, linear over `range`), the reflection at strength 1 (3 bytes, sRGB), and the confidence
        (1 byte).

    Raises:
        BrewsterError: `Separator` cannot separate the photo.
    """
    width, height = _preview_size(photo.size)
    small = photo.resized(width, height)
    arguments = options.call_options() | {"strength": _SMALL_STRENGTH, "additive": False}
    channels = photo.pixels.shape[2]  # one for a grey photo
    reduced = Photo.from_array(small[..., :channels], encoding="linear")
    layers = separator(reduced, on_progress=on_progress, **arguments)
    transmission = small + (layers.transmission.linear() - small) / np.float32(_SMALL_STRENGTH)
    reflection = layers.reflection.linear() / np.float32(_SMALL_STRENGTH)
    head = {"width": width, "height": height, "full": photo.size, "range": (RANGE_MIN, RANGE_MAX)}
    head["verdict"] = layers.assessment.verdict
    maps = (
        _to_srgb_bytes(small),
        _to_uint16(transmission),
        _to_srgb_bytes(reflection),
        layers.confidence.pixels,
    )
    return b"".join((json.dumps(head).encode(), b"\n", *(array.tobytes() for array in maps)))


def _preview_size(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, math.sqrt(MAX_PREVIEW_PIXELS / math.prod(size)))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _to_srgb_bytes(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * to_encoded(np.clip(linear, 0, 1))).astype(np.uint8)


def _to_uint16(linear: NDArray[np.float32]) -> NDArray[np.uint16]:
    scaled: NDArray[np.float32] = (np.clip(linear, RANGE_MIN, RANGE_MAX) - RANGE_MIN) / (
        RANGE_MAX - RANGE_MIN
    )
    return np.rint(65535 * scaled).astype(np.dtype("<u2"), copy=False)
