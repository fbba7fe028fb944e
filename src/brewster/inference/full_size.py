"""Computes the layers of a photo at its full size, in strips, with few threads and little memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final

import numpy as np

from brewster.inference.guided_upsampling import GuidedUpsampler
from brewster.photo import Mask, Photo

_WORKERS: Final = 2


def upsample_layers(
    photo: Photo,
    upsampler: GuidedUpsampler,
    mask: Mask | None,
    *,
    additive: bool,
    on_progress: Callable[[float], None],
) -> tuple[Photo, Photo, float]:
    """Returns transmission, reflection and the mean residual. The layers are encoded like the photo.

    If `additive` is true, the layers are 32-bit floats in linear light, and their sum is exactly the photo.
    """
    template = _float_template(photo) if additive else photo
    canvases = [np.empty(template.pixels.shape, template.pixels.dtype) for _ in range(2)]

    def fill(rows: slice) -> float:
        linear = photo.linear_rows(rows.start, rows.stop)
        strength_mask = None if mask is None else mask.rows(rows.start, rows.stop)
        layers = upsampler.apply(linear, rows.start, photo.size[1], strength_mask)
        stored = [template.stored_rows(layer, rows.start) for layer in layers]
        if additive:
            # At least one of the two differences is exact (Sterbenz 1974), which makes the sum exact.
            whole = template.stored_rows(linear, rows.start)
            remainder = whole - np.minimum(stored[0], whole)
            stored = [whole - remainder, remainder]
        for canvas, layer in zip(canvases, stored, strict=True):
            canvas[rows] = layer
        return 0.0 if additive else float(np.abs(linear - layers[0] - layers[1]).sum(dtype=np.float64))

    strips, residual_sum = list(photo.strips()), 0.0
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done, strip_residual in enumerate(pool.map(fill, strips), 1):
            residual_sum += strip_residual
            on_progress(done / len(strips))
    transmission, reflection = (template.with_pixels(canvas) for canvas in canvases)
    return transmission, reflection, residual_sum / (math.prod(photo.size) * 3)


def _float_template(photo: Photo) -> Photo:
    """Returns a black photo of the same size, 32-bit floats in linear light, with the alpha and EXIF of the photo."""
    file_info = replace(
        photo.file_info, format_name="tiff", bits=32, compression=None, icc=None, primaries=None, header=None
    )
    alpha = photo.alpha
    if alpha is not None and alpha.dtype.kind == "u":
        alpha = alpha / np.float32(np.iinfo(alpha.dtype).max)
    black = np.broadcast_to(np.float32(0), photo.pixels.shape)
    return Photo(black, alpha, file_info)
