"""What the page shows of a separation: maps small enough to be composited in the browser at any strength.

The photo is made smaller first and then separated in floats, so that nothing is rounded or clipped. The browser
computes, in linear light (page/light.js does the same sums):

    transmission = max(photo + strength x (transmission at 1 - photo), 0)
    reflection   = min(strength x reflection at 1, photo)
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

PREVIEW_PIXELS: Final = 1_400_000
"""Larger photos are made smaller: about as many pixels as a window shows."""

LOWEST, HIGHEST = -1.0, 2.0
"""Linear light that the 16-bit numbers of a transmission at full strength stand for, from 0 to 65535."""

_FAINT: Final = 1 / 64
"""Strength asked for in place of 1: layers so faint are not clipped, and grow in proportion."""


def preview(
    separator: Separator, photo: Photo, options: Options, on_progress: Callable[[float], None]
) -> bytes:
    """Four maps of one size after a line of JSON: `width`, `height`, `full` (the photo's own size), `range`, `doubtful`.

    Each goes row by row: the photo (3 bytes a pixel, sRGB), the transmission at strength 1 (3 little-endian 16-bit
    numbers, linear over `range`), the reflection at 1 (3 bytes, sRGB), and confidence (1 byte).

    Raises:
        BrewsterError: as `Separator` does.
    """
    width, height = _fitting(photo.size)
    small = photo.resized(width, height)
    asked = options.call_options() | {"strength": _FAINT, "additive": False}
    shown = Photo.from_array(small[..., : photo.pixels.shape[2]], encoding="linear")  # grey stays grey
    layers = separator(shown, on_progress=on_progress, **asked)
    transmission = small + (layers.transmission.linear() - small) / np.float32(_FAINT)
    reflection = layers.reflection.linear() / np.float32(_FAINT)
    head = {"width": width, "height": height, "full": photo.size, "range": (LOWEST, HIGHEST)}
    head["doubtful"] = layers.doubtful
    maps = _srgb(small), _numbers(transmission), _srgb(reflection), layers.confidence.pixels
    return b"".join((json.dumps(head).encode(), b"\n", *(map_.tobytes() for map_ in maps)))


def _fitting(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, math.sqrt(PREVIEW_PIXELS / math.prod(size)))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _srgb(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * to_encoded(np.clip(linear, 0, 1))).astype(np.uint8)


def _numbers(linear: NDArray[np.float32]) -> NDArray[np.uint16]:
    share: NDArray[np.float32] = (np.clip(linear, LOWEST, HIGHEST) - LOWEST) / (HIGHEST - LOWEST)
    return np.rint(65535 * share).astype(np.dtype("<u2"), copy=False)
