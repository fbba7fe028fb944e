"""A case in pictures, for the report: one reduction for all, errors in colour, the region as a tint to lay over."""

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
"""The longer side of an embedded picture in px, at most."""

MAX_ERROR: Final = 96
"""The error, of 255, from which on the brightest colour is given."""

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
"""Colours of errors (16, 3), sRGB: matplotlib's "inferno" (CC0), whose lightness grows evenly, so that grey prints
tell as much. Each stands for a sixteenth of BRIGHTEST_ERROR: few enough for small files without loss."""

_LINEAR: Final = srgb.to_linear(np.linspace(0, 1, 256, dtype=np.float32))
_TINT: Final = (255, 40, 150)
_TINT_ALPHA: Final = 115


@final
@dataclass(frozen=True, eq=False)
class CaseImages:
    """A case as the page shows it: uint8 sRGB (H, W, 3), region bool (H, W).

    `answers` are methods' transmissions, without the baseline; `reflections` their reflection layers, where there
    are any.
    """

    benchmark: str
    name: str
    photo: Pixels
    truth: Pixels
    region: NDArray[np.bool_]
    predictions: Mapping[str, Pixels]
    reflections: Mapping[str, Pixels] = field(default_factory=dict)
    reflection_truth: Pixels | None = None


def photo_tiles(case: CaseImages) -> str:
    """What is known of a case, as HTML: photo, its error, truth, region, and the true reflection where there is one."""
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
    """What a method made of a case, as HTML: its transmission, the error of that, its reflection; empty where it failed."""
    tiles = []
    if method in case.predictions:
        prediction = case.predictions[method]
        tiles.append(_tile(case, "picture", method, webp(prediction)))
        tiles.append(_tile(case, "error", f"error of {method}", lossless(error_map(prediction, case.truth))))
    if method in case.reflections:
        tiles.append(_tile(case, "reflection", f"reflection by {method}", webp(case.reflections[method])))
    return "".join(tiles)


def _tile(case: CaseImages, kind: str, said: str, data: bytes) -> str:
    """A picture that can be opened; arrow keys step through those of one kind."""
    width, height = size_of(case.photo)
    return (
        f"<figure><button type=button data-kind={kind}><img width={width} height={height} loading=lazy "
        f'alt="{escape(said)}, {escape(case.name)}" src="data:image/webp;base64,{base64.b64encode(data).decode()}">'
        f"</button><figcaption>{escape(said)}</figcaption></figure>"
    )


def size_of(picture: NDArray[Any]) -> tuple[int, int]:
    """Width and height of an embedded picture."""
    height, width = picture.shape[:2]
    scale = min(1, MAX_SIDE_PX / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def webp(picture: Pixels) -> bytes:
    """The file of a picture, sRGB (H, W, 3), reduced to `size_of` it by area means in linear light."""
    if size_of(picture) != picture.shape[1::-1]:
        encoded = srgb.to_encoded(_area_means(_LINEAR[picture]))
        picture = np.rint(encoded * 255).clip(0, 255).astype(np.uint8)
    return Photo.from_array(picture, encoding="srgb").encode("webp")


def error_map(prediction: Pixels, truth: Pixels) -> Pixels:
    """Where an answer (H, W, 3) is wrong: uint8 (h, w, 3) in the colours of the RAMP, reduced like the picture.

    The absolute difference of the largest channel, averaged over the area of each new pixel, then coloured.
    """
    errors = np.abs(prediction.astype(np.int16) - truth).max(axis=2)
    means = _area_means(errors.astype(np.float32)[..., None])[..., 0]
    colours: Pixels = COLOUR_MAP[(means / MAX_ERROR * _STEPS).astype(int).clip(0, _STEPS - 1)]
    return colours


def lossless(picture: Pixels, alpha: Pixels | None = None) -> bytes:
    """The file of a picture (H, W, 3) as it is, with its `alpha` (H, W)."""
    return Photo(picture, alpha, FileInfo(container="webp", lossless=True)).encode()


def overlay(region: NDArray[np.bool_]) -> bytes:
    """A tint where most of a pixel is in the region, clear elsewhere: laid over the photo by the page."""
    inside = _area_means(region.astype(np.float32)[..., None])[..., 0] >= 0.5
    alpha = np.where(inside, np.uint8(_TINT_ALPHA), np.uint8(0))
    tint = np.broadcast_to(np.array(_TINT, np.uint8), (*alpha.shape, 3)).copy()
    return lossless(tint, alpha)


def _area_means(values: Float32) -> Float32:
    """(H, W, C) numbers at the size of embedded pictures: the mean over each new pixel's area.

    What Photo.small does row by row, to save memory, is done here at once, to save time.
    """
    width, height = size_of(values)
    rows = np.tensordot(_area_weights(values.shape[0], height), values, 1)
    return np.tensordot(_area_weights(values.shape[1], width), rows, (1, 1)).transpose(1, 0, 2)


def _area_weights(old: int, new: int) -> Float32:
    """The share of each of `old` pixels in the mean that is each of `new` ones, (new, old)."""
    edges, pixels = np.linspace(0, old, new + 1), np.arange(old)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (overlap.clip(0) * new / old).astype(np.float32)
