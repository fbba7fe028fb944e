"""Runs a backend on overlapping tiles of an image and blends the outputs. The tiles limit the use
of memory.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Float32

    Image = Float32[NDArray[np.float32], "h w 3"]
    Hints = Float32[NDArray[np.float32], "h w 2"]
    Channels = Float32[NDArray[np.float32], "h w c"]
else:
    Image = Hints = Channels = NDArray

Backend = Callable[[Image], tuple[Image, Image]]
"""Any callable that takes a tile (H, W, 3), float32 linear light in 0..1, and returns its
transmission and reflection, both of the same shape and dtype.
"""


@runtime_checkable
class HintedBackend(Protocol):
    """A `Backend` that takes the hints of a person, (H, W, 2) in 0..1, if `takes_hints` is true."""

    takes_hints: bool

    def __call__(self, tile: Image, hints: Hints | None = None) -> tuple[Image, Image]:
        """Returns the transmission and the reflection of a tile."""


def run_tiled(
    backend: Callable[[Channels], tuple[Image, ...]],
    image: Channels,
    *,
    tile_px: int,
    overlap_px: int,
) -> tuple[Image, ...]:
    """Returns the outputs of the backend, (H, W, 3) each, for an image (H, W, C) of any size.

    Tiles are squares of `tile_px` pixels. Neighbouring tiles overlap by at least `overlap_px`
    pixels. In the overlap their outputs are blended linearly. If the image is not larger than a
    tile, it is passed to the backend directly.
    """
    height, width, _ = image.shape
    tiles = tile_slices((height, width), tile_px=tile_px, overlap_px=overlap_px)
    if len(tiles) == 1:
        return backend(image)
    layers: list[Image] = []
    weight_sum = np.zeros((height, width, 1), np.float32)
    for vertical, horizontal in tiles:
        tile = np.s_[vertical, horizontal]
        weight = np.outer(
            _blend_weights(vertical, height, overlap_px),
            _blend_weights(horizontal, width, overlap_px),
        )[..., None]
        weight_sum[tile] += weight
        outputs = backend(image[tile])
        layers = layers or [np.zeros((height, width, 3), np.float32) for _ in outputs]
        for layer, output in zip(layers, outputs, strict=True):
            layer[tile] += weight * output
    return tuple(layer / weight_sum for layer in layers)


def tile_slices(
    size: tuple[int, int], *, tile_px: int, overlap_px: int
) -> list[tuple[slice, slice]]:
    """Returns the rows and the columns of each tile for an image of this (height, width)."""
    rows, columns = (_tile_spans(side, tile_px, overlap_px) for side in size)
    return list(product(rows, columns))


def _tile_spans(side_px: int, tile_px: int, overlap_px: int) -> list[slice]:
    """Returns spans of length `tile_px` that cover 0..side_px, with about equal overlaps of at
    least `overlap_px`.
    """
    if side_px <= tile_px:
        return [slice(0, side_px)]
    count = -(-(side_px - overlap_px) // (tile_px - overlap_px))
    starts = np.linspace(0, side_px - tile_px, count).round().astype(int)
    return [slice(int(start), int(start) + tile_px) for start in starts]


def _blend_weights(span: slice, side_px: int, overlap_px: int) -> NDArray[np.float32]:
    """Returns weights along a span: 1 in the middle, with a linear ramp at each end within the
    image.
    """
    length = span.stop - span.start
    ramp = (np.arange(length, dtype=np.float32) + 1) / (overlap_px + 1)
    ones = np.ones(length, np.float32)
    left = ones if span.start == 0 else np.minimum(ramp, 1)
    right = ones if span.stop == side_px else np.minimum(ramp[::-1], 1)
    return np.minimum(left, right)
