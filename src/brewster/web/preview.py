"""Previews of a separation. The page computes the layers from them, at any strength, mask and zoom.

A preview contains a reduced photo and maps. page/light.js upsamples the maps to the reduced photo
and to tiles of the full photo, and computes in linear light (see separation/guided_upsampling.py):

    change       = change_slope x photo + change_offset
    change       = change + weight x (generated - photo - change)    (with the maps of these names)
    reflection   = reflection_slope x photo + reflection_offset      (without these maps: -change)
    transmission = max(photo + strength x mask x change, 0)
    reflection   = min(strength x mask x reflection, photo)

The maps:

    change_slope, change_offset           transmission - photo at strength 1, as a local linear
                                          function of the photo
    reflection_slope, reflection_offset   the reflection at strength 1, if the model predicts it
    generated                             the transmission of a diffusion model, without the detail
                                          of the photo
    weight                                of `generated`, 0..1: 0 keeps the change, 1 replaces it
    confidence                            the confidence, 0..1

`photo_tile` returns the tiles. Level 0 has the pixels of the photo; each further level halves the
width and the height.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Final

import numpy as np

from brewster.options import Options
from brewster.photo import Photo, Source
from brewster.photo.photo import area_means
from brewster.photo.srgb import REC709_LUMINANCE, to_8bit
from brewster.separation import Separator
from brewster.separation.assessment import Assessment

MAX_PREVIEW_PIXELS: Final = 1_400_000
"""Larger photos are reduced to about this number of pixels, which is enough for a window."""
TILE_PX: Final = 512
MAX_LEVEL: Final = 8


def preview(
    separator: Separator,
    photo: Photo,
    options: Options,
    on_progress: Callable[[float], None],
    hints: Source | None = None,
) -> tuple[bytes, Assessment]:
    """Separates a photo for the page. Of the options, only `quality` is used. `hints` is an image
    file, see `Separator`.

    Returns the assessment, and the preview: one line of JSON, then the reduced photo (3 bytes for
    each pixel, sRGB), and then maps of little-endian 16-bit values, row by row. The JSON has
    `width` and `height` of the reduced photo, `full` (width and height of the photo), and for each
    map `name`, `width`, `height`, `channels`, and `range`, the values that 0 and 65535 stand for.
    Raises BrewsterError if the photo cannot be separated.
    """
    upsampler, prediction, assessment = separator.fit(
        photo, quality=options.quality, hints=hints, on_progress=on_progress
    )
    scale = min(1.0, math.sqrt(MAX_PREVIEW_PIXELS / math.prod(photo.size)))
    width, height = (max(1, round(side * scale)) for side in photo.size)
    maps = {
        "change_slope": upsampler.change.slope,
        "change_offset": upsampler.change.offset,
        "confidence": prediction.confidence_map,
    }
    if upsampler.reflection:
        maps |= {
            "reflection_slope": upsampler.reflection.slope,
            "reflection_offset": upsampler.reflection.offset,
        }
    if upsampler.override:
        maps |= {"generated": upsampler.override.transmission, "weight": upsampler.override.weight}
    if photo.pixels.shape[2] == 1:  # the layers of a grey photo are grey
        weights = np.array(REC709_LUMINANCE, np.float32)
        maps = {
            name: map_ if map_.shape[2] == 1 else (map_ @ weights)[..., None]
            for name, map_ in maps.items()
        }
    # The range is at least 1: smaller steps between the stored values are not visible, and enlarge
    # the map.
    lows = {name: float(map_.min()) for name, map_ in maps.items()}
    highs = {name: max(float(map_.max()), lows[name] + 1) for name, map_ in maps.items()}
    head = {
        "width": width,
        "height": height,
        "full": photo.size,
        "maps": [
            {
                "name": name,
                "width": map_.shape[1],
                "height": map_.shape[0],
                "channels": map_.shape[2],
                "range": (lows[name], highs[name]),
            }
            for name, map_ in maps.items()
        ],
    }
    codes = to_8bit(photo.resized(width, height))
    coefficients = []
    for name, map_ in maps.items():
        scaled = (map_ - np.float32(lows[name])) / np.float32(highs[name] - lows[name])
        coefficients.append(np.rint(65535 * scaled).astype(np.dtype("<u2"), copy=False).tobytes())
    on_progress(1.0)
    return b"".join((json.dumps(head).encode(), b"\n", codes.tobytes(), *coefficients)), assessment


def photo_tile(photo: Photo, level: int, column: int, row: int) -> Photo | None:
    """Returns the tile of a photo at a level, at most TILE_PX wide and high, in sRGB, or None if it
    is outside the photo.

    A pixel of level n is the mean of 2**n x 2**n pixels of the photo, in linear light.
    """
    if not 0 <= level <= MAX_LEVEL:
        return None
    step = 1 << level
    width, height = photo.size
    left, top = TILE_PX * step * column, TILE_PX * step * row
    if not (0 <= left < width and 0 <= top < height):
        return None
    stored = photo.pixels[top : top + TILE_PX * step, left : left + TILE_PX * step]
    linear = photo.colour_space().to_linear(stored)
    for _ in range(2 if step > 1 else 0):  # blocks at the edges have fewer pixels
        edges = np.append(np.arange(0, len(linear), step), len(linear))
        linear = area_means(linear, edges).swapaxes(0, 1)
    return Photo(to_8bit(linear))
