"""Converts numpy arrays and PIL images to stored pixels, and stored pixels to PIL images."""

from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from brewster.base.image_formats import WRITABLE
from brewster.errors import MissingExtra, PhotoError, UnsupportedPhoto
from brewster.photo import srgb
from brewster.photo.blocks import tiff_tags
from brewster.photo.decode import apply_orientation, split_alpha
from brewster.photo.file_info import WHITE_LEVELS, Decoded, FileInfo

Stored = NDArray[Any]
Encoding = Literal["srgb", "linear"]
_GREY = ("L", "LA")
_COLOUR = ("RGB", "RGBA")
_PIL_CONVERSIONS = {"1": _GREY, "L": _GREY, "P": _COLOUR, "PA": ("RGBA", "RGBA"), "RGB": _COLOUR}
"""The modes of Pillow to which a mode is converted: without and with a transparent colour in
`info`.
"""
_ROUNDING = 1e-3
"""Floats may be outside 0..1 by this amount because of rounding. It is less than half a level of 8
bits.
"""


@runtime_checkable
class BinaryFile(Protocol):
    """A file opened for reading in binary mode."""

    def read(self) -> bytes:
        """Returns all bytes."""


@runtime_checkable
class WritableFile(Protocol):
    """A file opened for writing in binary mode."""

    def write(self, data: bytes, /) -> object:
        """Writes all bytes."""


@runtime_checkable
class PilImage(Protocol):
    """An image of the package Pillow. brewster does not import Pillow to read such an image."""

    width: int
    height: int
    mode: str
    format: str | None
    info: dict[Any, Any]

    def getbands(self) -> tuple[str, ...]:
        """Returns the names of the channels."""

    def convert(self, mode: str, /) -> Any:  # noqa: ANN401
        """Returns a converted image."""


def decode_array(array: Stored, encoding: Encoding | None) -> Decoded:
    """Converts an array; see `Photo.from_array`."""
    array = np.array(array)[..., None] if np.ndim(array) == 2 else np.array(array)
    encoding = encoding or ("srgb" if array.dtype.kind == "u" else None)
    _check_array(array, encoding)
    decoded = split_alpha(array, FileInfo())
    pixels = decoded.pixels
    alpha = decoded.alpha
    if encoding == "linear" or array.dtype.kind == "f":
        white = np.float32(WHITE_LEVELS[array.dtype.name])
        pixels = pixels / white
        pixels = srgb.to_linear(pixels) if encoding == "srgb" else pixels
        alpha = None if alpha is None else alpha / white
    dtype = np.dtype(np.float32) if pixels.dtype.kind == "f" else array.dtype
    return Decoded(
        np.ascontiguousarray(pixels, dtype),
        None if alpha is None else np.ascontiguousarray(alpha, dtype),
        FileInfo(bits=8 * dtype.itemsize),
    )


def _check_array(array: Stored, encoding: Encoding | None) -> None:
    is_image = array.ndim == 3 and array.shape[2] in (1, 3, 4) and array.size > 0
    if not is_image or array.dtype.name not in WHITE_LEVELS:
        advice = "reshape or convert the array"
        if array.ndim == 4:
            advice = "pass the images one by one, for example with Separator.many"
        elif not is_image and array.ndim == 3 and array.shape[0] in (1, 3, 4) and array.size > 0:
            advice = "pass array.transpose(1, 2, 0)"
        raise UnsupportedPhoto(
            f"the array has the shape {array.shape} and the dtype {array.dtype}",
            "expected (H, W) or (H, W, 1|3|4) of uint8, uint16 or float, with at least one pixel",
            advice,
        )
    if encoding not in get_args(Encoding):
        raise PhotoError(
            f"the encoding of the array of {array.dtype} is {encoding!r}",
            'expected "srgb" or "linear"; only uint8 and uint16 need none: they are sRGB-encoded '
            "by default",
            'pass encoding="srgb" or encoding="linear"',
        )
    if not np.isfinite(array).all():
        happened = "the array contains infinity or NaN"
        raise UnsupportedPhoto(happened, "expected finite values", "replace these values first")
    if array.dtype.kind != "f":
        return
    bounded = (
        array if encoding == "srgb" else array[..., 3:]
    )  # linear light has no limits; alpha has
    low, high = (float(bounded.min()), float(bounded.max())) if bounded.size else (0.0, 1.0)
    if low < -_ROUNDING or high > 1 + _ROUNDING:
        what = "sRGB-encoded floats" if encoding == "srgb" else "alpha values"
        raise UnsupportedPhoto(
            f"the {what} of the array are in {low:g}..{high:g}",
            "expected 0..1, because 1.0 is white",
            "divide 8-bit values by 255, clip values outside 0..1, or pass linear light",
        )


def decode_pil(image: Any) -> Decoded:  # noqa: ANN401  (Pillow is optional, so its types cannot be named)
    """Converts a PIL image; see `Photo.from_pil`."""
    if (
        getattr(image, "n_frames", 1) > 1 and image.format != "MPO"
    ):  # an MPO is a JPEG followed by previews
        raise UnsupportedPhoto(
            f"the PIL image has {image.n_frames} frames",
            "expected a single image",
            "select a frame with image.seek, and pass image.copy()",
        )
    # of a PNG or GIF: one transparent colour, or alpha per entry
    transparency = image.info.get("transparency")
    opaque_mode, alpha_mode = _PIL_CONVERSIONS.get(image.mode, (image.mode, image.mode))
    mode = opaque_mode if transparency is None else alpha_mode
    if mode != image.mode:
        image = image.convert(mode)
    if image.mode not in ("L", "LA", "RGB", "RGBA", "I;16"):
        raise UnsupportedPhoto(
            f"the PIL image has mode {image.mode}",
            "expected RGB or grey, with or without alpha",
            'use image.convert("RGB")',
        )
    exif = image.info.get("exif")
    icc = image.info.get("icc_profile")
    format_name = (image.format or "png").lower()
    array = np.asarray(image).reshape(image.height, image.width, -1)
    if (
        image.mode == "I;16" and transparency is not None
    ):  # Pillow has no mode for 16-bit grey with alpha
        array = np.concatenate(
            [array, np.where(array == transparency, 0, 65535).astype(array.dtype)], axis=2
        )
    array = apply_orientation(array, tiff_tags.orientation_of(exif or b""))
    file_info = FileInfo(
        format_name=format_name if format_name in WRITABLE else "png",
        bits=16 if image.mode == "I;16" else 8,
        icc=icc or None,
        exif=tiff_tags.upright_exif(exif, (array.shape[1], array.shape[0])) if exif else None,
    )
    return split_alpha(array, file_info)


def pil_image(pixels: Stored, alpha: Stored | None, file_info: FileInfo) -> Any:  # noqa: ANN401
    """Returns a PIL image of stored pixels (H, W, 1|3), uint8, or uint16 for grey without alpha.
    Raises MissingExtra if Pillow is not installed.
    """
    try:
        from PIL import Image  # noqa: PLC0415  (optional: only for users of Pillow)
    except ImportError as error:
        raise MissingExtra(
            "the Pillow package is not installed",
            "expected it to be installed, because to_pil returns an image of Pillow",
            "run: pip install pillow",
        ) from error
    array = pixels if alpha is None else np.concatenate([pixels, alpha[..., None]], axis=2)
    image = Image.fromarray(array[..., 0] if array.shape[2] == 1 else array)
    blocks = {"icc_profile": file_info.icc, "exif": file_info.exif and b"Exif\0\0" + file_info.exif}
    image.info.update({name: block for name, block in blocks.items() if block})
    return image
