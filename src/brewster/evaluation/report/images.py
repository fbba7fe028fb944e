"""Makes the images of a case for the HTML report: downscaled layers, error maps, and the region as
a tint.
"""

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.evaluation.methods import BASELINE, MethodOutput
from brewster.evaluation.scoring import GroundTruth
from brewster.metrics import Region
from brewster.photo import FileInfo, Photo

Pixels = NDArray[np.uint8]

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
    [[rgb >> shift & 255 for shift in (16, 8, 0)] for rgb in _INFERNO], np.uint8
)
"""Colours of error maps, sRGB uint8 (16, 3), from "inferno" of matplotlib (CC0). The lightness
increases evenly, so that a grey print is readable. Each colour covers MAX_ERROR / 16. 16 colours
give small lossless files.
"""

_REGION_COLOUR: Final = np.array([255, 40, 150], np.uint16)

Thumbnail = tuple[str, str, str]
"""The caption of an embedded image, the URL of its file at full size ("" if there is none), and its
data as a URL.
"""


@final
@dataclass(frozen=True)
class CaseThumbnails:
    """The embedded images of a case, by method; the photo and the ground truth are those of the
    baseline. Sizes are (width, height) in px: that of the photo, and that of the embedded images.
    """

    benchmark: str
    name: str
    size: tuple[int, int]
    embedded_size: tuple[int, int]
    methods: Mapping[str, Sequence[Thumbnail]]


def to_thumbnails(
    truth: GroundTruth,
    predictions: Mapping[str, MethodOutput],
    region: Region,
    link: Callable[[str, str, Photo], str],
) -> CaseThumbnails:
    """Downscales and encodes all images of a case. `predictions` has no baseline. `link` returns
    the URL of an image at full size for a method, "" for the benchmark, a layer (photo,
    transmission or reflection) and the image.
    """
    photo = truth.images["photo"]
    ground_truth = truth.images["transmission"]

    def plain(caption: str, data: bytes, url: str = "") -> Thumbnail:
        media_type = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
        return caption, url, f"data:{media_type};base64,{base64.b64encode(data).decode()}"

    def linked(caption: str, image: Photo, layer: str, method: str = "") -> Thumbnail:
        return plain(caption, encode_photo(image.srgb_8bit()), link(method, layer, image))

    def error(caption: str, image: Pixels) -> Thumbnail:
        colours = Photo(error_map(image, ground_truth), None, FileInfo(format_name="png"))
        return plain(f"error of {caption}", colours.encode())

    layers = {
        layer: Photo.from_array(image, encoding="srgb") for layer, image in truth.images.items()
    }
    tinted = np.where(region[..., None], (photo.astype(np.uint16) + _REGION_COLOUR) // 2, photo)
    methods = {
        BASELINE: [
            linked("photo", layers["photo"], "photo"),
            error("the photo", photo),
            linked("ground truth", layers["transmission"], "transmission"),
            plain("reflection region", encode_photo(tinted.astype(np.uint8))),
        ]
    }
    if "reflection" in layers:
        caption = "ground truth of the reflection"
        methods[BASELINE].append(linked(caption, layers["reflection"], "reflection"))
    for name, output in predictions.items():
        transmission = output.transmission
        reflection = output.reflection
        methods[name] = [
            linked(name, transmission, "transmission", name),
            error(name, transmission.srgb_8bit()),
        ]
        if reflection:
            methods[name].append(linked(f"reflection by {name}", reflection, "reflection", name))
    case = truth.case
    size = photo.shape[1::-1]
    return CaseThumbnails(case.benchmark, case.name, size, embedded_size(photo), methods)


def embedded_size(image: NDArray[Any]) -> tuple[int, int]:
    """Returns the (width, height) of the embedded version of an image."""
    height, width = image.shape[:2]
    scale = min(1, MAX_SIDE_PX / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def encode_photo(image: Pixels) -> bytes:
    """Downscales an sRGB image (H, W, 3) to its embedded size by area means in linear light;
    returns a JPEG file. WebP files are 1/8 smaller, but their encoder takes seven times as long.
    """
    if embedded_size(image) != image.shape[1::-1]:
        light = Photo.from_array(image, encoding="srgb").resized(*embedded_size(image))
        image = Photo.from_array(light, encoding="linear").srgb_8bit()
    return Photo(image, None, FileInfo(format_name="jpeg", jpeg_quality=_JPEG_QUALITY)).encode()


def error_map(prediction: Pixels, truth: Pixels) -> Pixels:
    """Returns the error of a prediction (H, W, 3) in colours of COLOUR_MAP, uint8 (h, w, 3), at the
    embedded size. The error is max over channels |prediction - truth|, averaged over the area of
    each new pixel.
    """
    red, green, blue = np.moveaxis(np.abs(prediction.astype(np.int16) - truth), 2, 0)
    largest = np.maximum(np.maximum(red, green), blue).astype(
        np.float32
    )  # much faster than max(axis=2)
    photo = Photo.from_array(largest[..., None].repeat(3, axis=2), encoding="linear")
    means = photo.resized(*embedded_size(largest))[..., 0]
    indices = (means / MAX_ERROR * len(COLOUR_MAP)).astype(int).clip(0, len(COLOUR_MAP) - 1)
    colours: Pixels = COLOUR_MAP[indices]
    return colours
