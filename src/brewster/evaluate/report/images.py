"""The pictures of a case in the HTML report: downscaled layers, coloured error maps, and the region as an overlay."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster import srgb
from brewster.photo import FileInfo, Photo

Pixels = NDArray[np.uint8]
Float32 = NDArray[np.float32]

MAX_SIDE_PX: Final = 480
"""The maximum of the longer side of an embedded picture, in px."""

MAX_ERROR: Final = 96
"""The error, of 255, that gets the last colour of the map; larger errors get it too."""

_INFERNO: Final = (
    0x000004,
    0x1B0C41,
    0x4A0C6B,
    0x781C6D,
    0xA52C60,
    0xCF4446,
    0xED6925,
    0xFB9B06,
    0xF7D13D,
    0xFCFFA4,
)
_STEPS: Final = 16


def _colour_map() -> Pixels:
    anchors = np.array([[colour >> shift & 255 for shift in (16, 8, 0)] for colour in _INFERNO])
    at = np.linspace(0, 1, _STEPS)
    channels = [np.interp(at, np.linspace(0, 1, len(anchors)), anchors[:, channel]) for channel in range(3)]
    colours: Pixels = np.rint(np.stack(channels, axis=1)).astype(np.uint8)
    return colours


COLOUR_MAP: Final = _colour_map()
"""Colours of error maps, sRGB uint8 (16, 3): matplotlib's "inferno" (CC0). Its lightness grows evenly, so that it can be
read in a grey print. Each colour covers a sixteenth of MAX_ERROR. With 16 colours, lossless files are small."""

_LINEAR: Final = srgb.to_linear(np.linspace(0, 1, 256, dtype=np.float32))
_TINT: Final = (255, 40, 150)
_TINT_ALPHA: Final = 115


@final
@dataclass(frozen=True, eq=False)
class CaseImages:
    """The pictures of a case at full size: uint8 sRGB (H, W, 3); region bool (H, W).

    `predictions` are the transmissions by method, without the baseline; `reflections` the reflection layers by method,
    if the method predicts them.
    """

    benchmark: str
    name: str
    photo: Pixels
    truth: Pixels
    region: NDArray[np.bool_]
    predictions: Mapping[str, Pixels]
    reflections: Mapping[str, Pixels] = field(default_factory=dict)
    reflection_truth: Pixels | None = None


@final
@dataclass(frozen=True)
class CaseTiles:
    """The pictures of a case as HTML with embedded files. `size` is that of the photo, (width, height) in px."""

    benchmark: str
    name: str
    size: tuple[int, int]
    photo: str
    methods: Mapping[str, str]


def to_tiles(case: CaseImages) -> CaseTiles:
    """Downscales and encodes all pictures of a case."""
    height, width = case.photo.shape[:2]
    names = dict.fromkeys((*case.predictions, *case.reflections))
    methods = {name: method_tiles(case, name) for name in names}
    return CaseTiles(case.benchmark, case.name, (width, height), photo_tiles(case), methods)


def photo_tiles(case: CaseImages) -> str:
    """HTML of the photo, its error, the ground truth, the region and, if there is one, the true reflection."""
    tiles = [
        _tile(case, "picture", "photo", webp(case.photo)),
        _tile(case, "error", "error of the photo", lossless(error_map(case.photo, case.truth))),
        _tile(case, "picture", "truth", webp(case.truth)),
        _tile(case, "region", "reflection region", overlay(case.region)),
    ]
    if case.reflection_truth is not None:
        tiles.append(_tile(case, "reflection", "true reflection", webp(case.reflection_truth)))
    return "".join(tiles)


def method_tiles(case: CaseImages, method: str) -> str:
    """HTML of a method's transmission, its error and its reflection. Empty if the method failed."""
    tiles = []
    if method in case.predictions:
        prediction = case.predictions[method]
        tiles.append(_tile(case, "picture", method, webp(prediction)))
        tiles.append(_tile(case, "error", f"error of {method}", lossless(error_map(prediction, case.truth))))
    if method in case.reflections:
        tiles.append(_tile(case, "reflection", f"reflection by {method}", webp(case.reflections[method])))
    return "".join(tiles)


def _tile(case: CaseImages, kind: str, caption: str, data: bytes) -> str:
    """A picture as a button that opens it. In the viewer, arrow keys step through pictures of one kind."""
    width, height = size_of(case.photo)
    return (
        f"<figure><button type=button data-kind={kind}><img width={width} height={height} loading=lazy "
        f'alt="{escape(caption)}, {escape(case.name)}" src="data:image/webp;base64,{base64.b64encode(data).decode()}">'
        f"</button><figcaption>{escape(caption)}</figcaption></figure>"
    )


def size_of(picture: NDArray[Any]) -> tuple[int, int]:
    """(width, height) of the embedded version of a picture."""
    height, width = picture.shape[:2]
    scale = min(1, MAX_SIDE_PX / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def webp(picture: Pixels) -> bytes:
    """A picture as WebP, sRGB (H, W, 3), downscaled to `size_of` it by area means in linear light."""
    if size_of(picture) != picture.shape[1::-1]:
        encoded = srgb.to_encoded(_area_means(_LINEAR[picture]))
        picture = np.rint(encoded * 255).clip(0, 255).astype(np.uint8)
    return Photo.from_array(picture, encoding="srgb").encode("webp")


def error_map(prediction: Pixels, truth: Pixels) -> Pixels:
    """The error of a prediction (H, W, 3) in colours of COLOUR_MAP, uint8 (h, w, 3), downscaled like the picture.

    The error is the largest absolute difference of the channels, averaged over the area of each new pixel.
    """
    errors = np.abs(prediction.astype(np.int16) - truth).max(axis=2)
    means = _area_means(errors.astype(np.float32)[..., None])[..., 0]
    colours: Pixels = COLOUR_MAP[(means / MAX_ERROR * _STEPS).astype(int).clip(0, _STEPS - 1)]
    return colours


def lossless(picture: Pixels, alpha: Pixels | None = None) -> bytes:
    """A picture (H, W, 3) with its `alpha` (H, W) as lossless WebP."""
    return Photo(picture, alpha, FileInfo(container="webp", lossless=True)).encode()


def overlay(region: NDArray[np.bool_]) -> bytes:
    """A WebP that is tinted where at least half of a pixel is in the region, else transparent. The page draws it over the photo."""
    inside = _area_means(region.astype(np.float32)[..., None])[..., 0] >= 0.5
    alpha = np.where(inside, np.uint8(_TINT_ALPHA), np.uint8(0))
    tint = np.broadcast_to(np.array(_TINT, np.uint8), (*alpha.shape, 3)).copy()
    return lossless(tint, alpha)


def _area_means(values: Float32) -> Float32:
    """Downscales (H, W, C) to the size of embedded pictures: the mean over the area of each new pixel.

    Photo.small computes the same row by row to save memory; this is faster.
    """
    width, height = size_of(values)
    rows = np.tensordot(_area_weights(values.shape[0], height), values, 1)
    return np.tensordot(_area_weights(values.shape[1], width), rows, (1, 1)).transpose(1, 0, 2)


def _area_weights(old: int, new: int) -> Float32:
    """The weights of `old` pixels in the means of `new` pixels along one axis, (new, old). Each row sums to 1."""
    edges, pixels = np.linspace(0, old, new + 1), np.arange(old)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (overlap.clip(0) * new / old).astype(np.float32)
