"""Previews of a separation. The page computes the layers from them, at any strength, mask and zoom.

A preview contains a reduced photo and maps. page/light.js upsamples the maps to the reduced photo and to tiles of the full
photo, and computes in linear light (see inference/guided_upsampling.py):

    change       = change_slope x photo + change_offset
    change       = change + weight x (generated - photo - change), if there are the maps `generated` and `weight`
    reflection   = reflection_slope x photo + reflection_offset, or -change if there are no such maps
    transmission = max(photo + strength x mask x change, 0)
    reflection   = min(strength x mask x reflection, photo)

The maps:

    change_slope, change_offset           transmission - photo at strength 1, as a local linear function of the photo
    reflection_slope, reflection_offset   the reflection at strength 1, if the model predicts it
    generated                             the transmission that a diffusion model generated, without the detail of the photo
    weight                                the weight of `generated`, 0..1: 0 keeps the change, 1 replaces it
    confidence                            the confidence, 0..1

`photo_tile` returns the tiles. Level 0 has the pixels of the photo; each further level halves the width and the height.
"""

from __future__ import annotations

import json
import math
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.inference import Separator
from brewster.options import Options
from brewster.photo import Photo
from brewster.srgb import REC709_LUMINANCE, to_encoded

MAX_PREVIEW_PIXELS: Final = 1_400_000
"""Larger photos are reduced to about this number of pixels, which is enough for a window."""
TILE_PX: Final = 512
MAX_LEVEL: Final = 8


def preview(
    separator: Separator,
    photo: Photo,
    options: Options,
    on_progress: Callable[[float], None],
    hints: bytes | None = None,
) -> bytes:
    """Separates a photo for the page.

    Args:
        separator: the model.
        photo: the photo at full size.
        options: the options of the request; only `quality` is used.
        on_progress: called with the completed fraction, 0 to 1.
        hints: an image file with hints for the model, see the call of a `Separator`.

    Returns:
        One line of JSON, then the reduced photo (3 bytes for each pixel, sRGB), and then maps of little-endian 16-bit
        values, row by row. The JSON has `width` and `height` of the reduced photo, `full` (width and height of the photo),
        `verdict`, and for each map `name`, `width`, `height`, `channels`, and `range`, the values that 0 and 65535 stand for.

    Raises:
        BrewsterError: `Separator` cannot separate the photo.
    """
    upsampler, prediction, assessment = separator.fit(
        photo, quality=options.quality, hints=hints, on_progress=on_progress
    )
    width, height = _preview_size(photo.size)
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
        maps = {name: _luminance(map_) for name, map_ in maps.items()}
    head = {
        "width": width,
        "height": height,
        "full": photo.size,
        "verdict": assessment.verdict,
        "maps": [_describe(name, map_) for name, map_ in maps.items()],
    }
    codes = _to_srgb_bytes(photo.resized(width, height))
    coefficients = (_to_uint16(map_).tobytes() for map_ in maps.values())
    on_progress(1.0)
    return b"".join((json.dumps(head).encode(), b"\n", codes.tobytes(), *coefficients))


def photo_tile(photo: Photo, level: int, column: int, row: int) -> Photo | None:
    """Returns the tile of a photo at a level, at most TILE_PX wide and high, in sRGB, or None if it is outside the photo.

    A pixel of level n is the mean of 2**n x 2**n pixels of the photo, in linear light.
    """
    if not 0 <= level <= MAX_LEVEL:
        return None
    step, (width, height) = 1 << level, photo.size
    left, top = TILE_PX * step * column, TILE_PX * step * row
    if not (0 <= left < width and 0 <= top < height):
        return None
    stored = photo.pixels[top : top + TILE_PX * step, left : left + TILE_PX * step]
    linear = photo.colour_space().to_linear(stored)
    if step > 1:
        linear = _block_means(linear, step)
    return Photo(_to_srgb_bytes(linear))


@final
class PhotoCache:
    """The decoded photos of the last requests by key, for the tiles. Thread-safe.

    Args:
        max_bytes: the maximum size of all photos together. If it is exceeded, the least recently used photos are dropped.
    """

    def __init__(self, max_bytes: int = 400_000_000) -> None:
        self.max_bytes, self._photos, self._lock = max_bytes, OrderedDict[str, Photo](), Lock()

    def put(self, key: str, photo: Photo) -> None:
        """Stores a photo. This photo is kept even if it alone exceeds `max_bytes`."""
        with self._lock:
            self._photos[key] = photo
            self._photos.move_to_end(key)
            while len(self._photos) > 1 and self._bytes() > self.max_bytes:
                self._photos.popitem(last=False)

    def get(self, key: str) -> Photo | None:
        """Returns the photo with this key, or None if it was dropped."""
        with self._lock:
            if key in self._photos:
                self._photos.move_to_end(key)
            return self._photos.get(key)

    def _bytes(self) -> int:
        return sum(photo.pixels.nbytes for photo in self._photos.values())


def _preview_size(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, math.sqrt(MAX_PREVIEW_PIXELS / math.prod(size)))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _block_means(linear: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Returns the means of blocks of step x step pixels. Blocks at the edges have fewer pixels."""
    for axis in (0, 1):
        starts = np.arange(0, linear.shape[axis], step)
        counts = np.minimum(starts + step, linear.shape[axis]) - starts
        sums = np.add.reduceat(linear, starts, axis=axis)
        linear = np.divide(sums, counts.reshape((-1, 1, 1) if axis == 0 else (1, -1, 1)), dtype=np.float32)
    return linear


def _luminance(map_: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the luminance of a map in linear Rec.709 light, or the map itself if it has one channel."""
    if map_.shape[2] == 1:
        return map_
    return (map_ @ np.array(REC709_LUMINANCE, np.float32))[..., None]


def _describe(name: str, map_: NDArray[np.float32]) -> dict[str, Any]:
    height, width, channels = map_.shape
    return {"name": name, "width": width, "height": height, "channels": channels, "range": _range(map_)}


def _range(map_: NDArray[np.float32]) -> tuple[float, float]:
    """Returns the values that 0 and 65535 stand for. They differ by at least 1, because smaller steps between the stored values
    are not visible, and increase the size of the compressed map.
    """
    low = float(map_.min())
    return low, max(float(map_.max()), low + 1)


def _to_srgb_bytes(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * to_encoded(np.clip(linear, 0, 1))).astype(np.uint8)


def _to_uint16(map_: NDArray[np.float32]) -> NDArray[np.uint16]:
    low, high = _range(map_)
    scaled: NDArray[np.float32] = (map_ - np.float32(low)) / np.float32(high - low)
    return np.rint(65535 * scaled).astype(np.dtype("<u2"), copy=False)
