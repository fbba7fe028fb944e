"""Makes the images of a case for the HTML report: downscaled layers, error maps, and the region as an overlay."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.evaluate.methods import BASELINE
from brewster.photo import FileInfo, Photo

Pixels = NDArray[np.uint8]
Float32 = NDArray[np.float32]

MAX_SIDE_PX: Final = 480
"""The maximum of the longer side of an embedded image, in px."""

_JPEG_QUALITY: Final = 90

MAX_ERROR: Final = 96
"""Errors from this value up, of 255, have the last colour of the map."""

_INFERNO: Final = (
    0x000004, 0x100729, 0x240C49, 0x410C63, 0x5C126C, 0x781C6D, 0x932665, 0xAD315B,
    0xC73F4B, 0xDB5339, 0xED6925, 0xF58712, 0xFAA611, 0xF8C632, 0xF9E366, 0xFCFFA4,
)  # fmt: skip
COLOUR_MAP: Final = np.array(
    [[colour >> shift & 255 for shift in (16, 8, 0)] for colour in _INFERNO], np.uint8
)
"""Colours of error maps, sRGB uint8 (16, 3), from "inferno" of matplotlib (CC0). The lightness increases evenly, so that a
grey print is readable. Each colour covers MAX_ERROR / 16. Images with only 16 colours give small lossless files."""

_OVERLAY_COLOUR: Final = (255, 40, 150)
_OVERLAY_ALPHA: Final = 115


@final
@dataclass(frozen=True, eq=False)
class CaseImages:
    """The images of a case at full size, uint8 sRGB (H, W, 3), and the reflection region, bool (H, W).

    `predictions` is method -> transmission, without the baseline. `reflections` is method -> reflection, for the methods
    that predict it; the method "" has the ground truth. `links` is (layer, method) -> URL of the image at full size, relative to the page; the method is "" for
    the layers "photo", "transmission" and "reflection" of the benchmark.
    """

    benchmark: str
    name: str
    photo: Pixels
    ground_truth: Pixels
    region: NDArray[np.bool_]
    predictions: Mapping[str, Pixels]
    reflections: Mapping[str, Pixels] = field(default_factory=dict)
    links: Mapping[tuple[str, str], str] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class CaseThumbnails:
    """The images of a case as HTML with embedded files, by method; the photo and the ground truth are those of the baseline.

    `size` is that of the photo, (width, height) in px.
    """

    benchmark: str
    name: str
    size: tuple[int, int]
    methods: Mapping[str, str]


def to_thumbnails(case: CaseImages) -> CaseThumbnails:
    """Downscales and encodes all images of a case."""
    height, width = case.photo.shape[:2]
    figures = {BASELINE: _layer(case, "photo", ("photo", ""), case.photo)}
    figures[BASELINE] += [
        _thumbnail(case, "picture", "ground truth", encode_photo(case.ground_truth), ("transmission", "")),
        _thumbnail(case, "region", "reflection region", overlay(case.region)),
    ]
    figures |= {
        name: _layer(case, name, ("transmission", name), image) for name, image in case.predictions.items()
    }
    for name, reflection in case.reflections.items():
        caption = f"reflection by {name}" if name else "ground truth of the reflection"
        data = encode_photo(reflection)
        figures[name or BASELINE].append(_thumbnail(case, "reflection", caption, data, ("reflection", name)))
    methods = {name: "".join(parts) for name, parts in figures.items()}
    return CaseThumbnails(case.benchmark, case.name, (width, height), methods)


def _layer(case: CaseImages, name: str, source: tuple[str, str], image: Pixels) -> list[str]:
    error = encode_lossless(error_map(image, case.ground_truth))
    return [
        _thumbnail(case, "picture", name, encode_photo(image), source),
        _thumbnail(case, "error", f"error of {'the photo' if source[0] == 'photo' else name}", error),
    ]


def _thumbnail(
    case: CaseImages, kind: str, caption: str, data: bytes, full: tuple[str, str] | None = None
) -> str:
    """Returns HTML: an image as a button that opens the viewer, and a link to the file at full size, if there is one."""
    width, height = embedded_size(case.photo)
    media_type = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
    url = escape(case.links.get(full, "") if full else "")
    title = f'<a href="{url}">{escape(caption)}</a>' if url else escape(caption)
    return (
        f'<figure><button type=button data-kind={kind} data-full="{url}"><img width={width} height={height} loading=lazy '
        f'alt="{escape(caption)}, {escape(case.name)}" src="data:{media_type};base64,{base64.b64encode(data).decode()}">'
        f"</button><figcaption>{title}</figcaption></figure>"
    )


def embedded_size(image: NDArray[Any]) -> tuple[int, int]:
    """Returns the (width, height) of the embedded version of an image."""
    height, width = image.shape[:2]
    scale = min(1, MAX_SIDE_PX / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def encode_photo(image: Pixels) -> bytes:
    """Downscales an sRGB image (H, W, 3) to its embedded size by area means in linear light; returns a JPEG file.

    WebP files are 1/8 smaller, but their encoder takes seven times as long.
    """
    if embedded_size(image) != image.shape[1::-1]:
        light = Photo.from_array(image, encoding="srgb").resized(*embedded_size(image))
        image = Photo.from_array(light, encoding="linear").srgb_8bit()
    return Photo(image, None, FileInfo(format_name="jpeg", jpeg_quality=_JPEG_QUALITY)).encode()


def error_map(prediction: Pixels, truth: Pixels) -> Pixels:
    """Returns the error of a prediction (H, W, 3) in colours of COLOUR_MAP, uint8 (h, w, 3), at the embedded size.

    The error is max over channels |prediction - truth|, averaged over the area of each new pixel.
    """
    red, green, blue = np.moveaxis(np.abs(prediction.astype(np.int16) - truth), 2, 0)
    means = _area_means(np.maximum(np.maximum(red, green), blue))  # much faster than max(axis=2)
    colours: Pixels = COLOUR_MAP[
        (means / MAX_ERROR * len(COLOUR_MAP)).astype(int).clip(0, len(COLOUR_MAP) - 1)
    ]
    return colours


def encode_lossless(image: Pixels, alpha: Pixels | None = None) -> bytes:
    """Returns an image (H, W, 3) with its `alpha` (H, W) as a PNG file."""
    return Photo(image, alpha, FileInfo(format_name="png")).encode()


def overlay(region: NDArray[np.bool_]) -> bytes:
    """Returns a PNG file to draw over the photo: coloured inside the region, transparent outside.

    A new pixel is inside if at least half of its area is in the region.
    """
    inside = _area_means(region) >= 0.5
    alpha = np.where(inside, np.uint8(_OVERLAY_ALPHA), np.uint8(0))
    colour = np.broadcast_to(np.array(_OVERLAY_COLOUR, np.uint8), (*alpha.shape, 3)).copy()
    return encode_lossless(colour, alpha)


def _area_means(values: NDArray[Any]) -> Float32:
    """Downscales (H, W) to the embedded size. Each new pixel is the mean over its area."""
    photo = Photo.from_array(values.astype(np.float32)[..., None].repeat(3, axis=2), encoding="linear")
    return photo.resized(*embedded_size(values))[..., 0]
