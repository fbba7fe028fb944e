"""What a person paints for a photo, as images of its size.

    mask = Mask.open("mask.png", photo.size)
    mask.rows(0, 64)  # (64, W, 1) float32: 1 where the mask is white, 0 where it is black
    hints = Hints.open("hints.png", photo.size)
    hints.sampled(516, 387)  # (387, 516, 2) float32: reflection (red), scene (green); 0 is no hint

A mask is grey, and scales the strength of the separation in each pixel. Hints mark where there is
reflection, and where only the scene. The stored values are weights, not light: they are not
converted by a transfer curve or a profile.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any, Final, Self, final

import numpy as np
import pyvips
from numpy.typing import NDArray

from brewster.base.files import DEFAULT_MAX_PIXELS
from brewster.errors import MaskError, PhotoError
from brewster.photo.colour.spaces import LINEAR_REC709, SRGB
from brewster.photo.file_info import WHITE_LEVELS
from brewster.photo.photo import Float32, Photo, Source, Stored


@final
@dataclass(frozen=True, eq=False)
class Mask:
    """The weights of the pixels of a photo. Immutable and thread-safe."""

    values: Stored
    """The stored values, (H, W) uint8, uint16 or float32; white is 255, 65535 or 1."""

    @classmethod
    def open(cls, source: Source, size: tuple[int, int]) -> Mask:
        """Opens a mask for a photo.

        Args:
            source: a path, the bytes of a file, a PIL image, or an array (H, W): bool, uint8,
                uint16, floats in 0..1.
            size: the (width, height) of the photo, with its EXIF orientation applied.

        Raises:
            MaskError: the source cannot be read, has colours, transparent pixels or values outside
                0..1, or does not have the size of the photo.
        """
        mask = f"the mask {source}" if isinstance(source, str | os.PathLike) else "the mask"
        photo = open_painted(source, size, mask)
        pixels = photo.pixels
        if (pixels != pixels[..., :1]).any():
            raise MaskError(
                f"{mask} has colours", "expected grey values", "convert the mask to grey"
            )
        if photo.alpha is not None and (photo.alpha != WHITE_LEVELS[photo.alpha.dtype.name]).any():
            raise MaskError(
                f"{mask} has transparent pixels",
                "expected white pixels where the photo is to be separated, and black pixels "
                "elsewhere",
                "flatten the layers of the mask",
            )
        values = np.ascontiguousarray(pixels[..., 0])
        if values.dtype.kind == "f" and not (values.min() >= 0 and values.max() <= 1):
            happened = f"{mask} has values from {values.min():g} to {values.max():g}"
            raise MaskError(happened, "expected values from 0 to 1", "scale the mask")
        return cls(values)

    def rows(self, top: int, bottom: int) -> Float32:
        """Returns the weights of the rows `top` to `bottom` (exclusive): (n, W, 1) in 0..1.

        Args:
            top: the first row, counted from 0.
            bottom: the row after the last one.
        """
        return _weights(self.values[top:bottom])

    def sampled(self, width: int, height: int) -> Float32:
        """Returns the weights at the centres of `width` x `height` cells that cover the mask:
        (height, width, 1).

        Args:
            width: the number of cells in a row.
            height: the number of rows.
        """
        return _weights(sampled(self.values, width, height))


def _weights(values: Stored) -> Float32:
    weights: NDArray[Any] = values[..., None] / np.float32(WHITE_LEVELS[values.dtype.name])
    return weights.astype(np.float32, copy=False)


def sampled(values: Stored, width: int, height: int) -> Stored:
    """Returns the values (H, W, ...) at the centres of a grid of `width` x `height` cells: (height,
    width, ...).
    """
    rows, columns = (
        (2 * np.arange(cells) + 1) * side // (2 * cells)
        for cells, side in zip((height, width), values.shape[:2], strict=True)
    )
    return values[np.ix_(rows, columns)]


def open_painted(source: Source, size: tuple[int, int], name: str) -> Photo:
    """Opens an image that was painted for a photo of this (width, height). `name` is its name in
    messages. Raises MaskError if the source cannot be read, or has another size.
    """
    try:
        if isinstance(source, np.ndarray):
            array = np.uint8(255) * source if source.dtype == np.bool_ else source
            # Integers with the encoding "srgb" and floats with the encoding "linear" are stored
            # unchanged.
            photo = Photo.from_array(
                array, encoding="linear" if array.dtype.kind == "f" else "srgb"
            )
        else:
            photo = Photo.open(source, max_pixels=max(DEFAULT_MAX_PIXELS, math.prod(size)))
    except PhotoError as error:
        raise MaskError(
            f"{name} cannot be read: {error.happened}", error.expected, error.cure
        ) from error
    if photo.size != size:
        raise MaskError(
            f"the size of {name} is {' x '.join(map(str, photo.size))} pixels",
            f"expected {' x '.join(map(str, size))}, the size of the photo",
            "resize the image, or leave it out for this photo",
        )
    return photo


def label_regions(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Returns a number for the connected region of each pixel of a mask (H, W), in the order of
    rows, and 0 outside the mask. Edges connect, corners do not. Numbers may be missing, because the
    regions outside are counted, too.
    """
    numbers = pyvips.Image.new_from_array(mask).labelregions().numpy()
    labels: NDArray[np.int32] = np.where(mask, numbers + 1, 0)
    return labels


_MIN_PURITY: Final = 0.8
"""The smallest distance of red from the larger of green and blue, as a share of red, and the same
for green.
"""
_PAINTED_LEVEL: Final = 230
_OTHER_LEVEL: Final = 25
"""Paint has at least the first level in red or green, and at most the second one in both others, in
8 bits.
"""
_MIN_PAINTED: Final = 0.3
"""The smallest share of paint in what is red or green. Of 1294 photos, one has a larger share."""
_COPY_TOLERANCE: Final = 48
"""How much a copy of the photo may differ from it, by a lossy format, in levels of 8 bits."""
_MIN_EMPTY: Final = 0.98
"""The share of black or transparent pixels in an image of strokes only, without the strokes."""


@final
@dataclass(frozen=True, eq=False)
class Hints:
    """Two soft masks of a photo. Immutable and thread-safe."""

    values: NDArray[np.uint8]
    """(H, W, 2): 255 where the image is pure red (reflection here), and where it is pure green
    (only the scene).
    """

    @classmethod
    def open(cls, source: Source, size: tuple[int, int], photo: Photo | None = None) -> Self:
        """Opens hints for a photo. Black, white, grey and transparent pixels are no hint. Red and
        green are those of sRGB; an image with another profile is converted.

        Args:
            source: a path, the bytes of a file, a PIL image, or an array (H, W, 3) of uint8,
                uint16, or floats in 0..1.
            size: the (width, height) of the photo, with its EXIF orientation applied.
            photo: the photo, if the strokes may be painted over a copy of it: what is red or green
                in both is no hint.

        Raises:
            MaskError: the source cannot be read, has neither red nor green strokes, or another size
                than the photo.
        """
        name = f"the hints {source}" if isinstance(source, str | os.PathLike) else "the hints"
        image = open_painted(source, size, name)
        has_own_colours = image.colour_space() not in (SRGB, LINEAR_REC709)
        pixels = image.srgb_8bit() if has_own_colours else image.pixels
        alpha = 1.0 if image.alpha is None else image.alpha / WHITE_LEVELS[image.alpha.dtype.name]
        colours = np.broadcast_to(pixels, (*pixels.shape[:2], 3)).astype(np.float32)
        colours *= 255 / WHITE_LEVELS[pixels.dtype.name]
        red, green, blue = np.moveaxis(colours, 2, 0)
        values = np.stack([red - np.maximum(green, blue), green - np.maximum(red, blue)], axis=2)
        # The strokes may be painted over a copy of the photo, whose colours are not as pure
        is_pure = values >= _MIN_PURITY * np.stack([red, green], axis=2)
        values = np.clip(values * is_pure * np.atleast_3d(alpha), 0, 255).astype(np.uint8)
        if photo is not None:
            difference = np.abs(colours - photo.srgb_8bit()).max(axis=2)
            values[difference <= _COPY_TOLERANCE] = 0
        if not values.any():
            raise MaskError(
                f"{name} have neither red nor green pixels",
                "expected red where there is reflection, or green where there is only the scene",
                "paint with pure red and pure green, or leave the hints out",
            )
        if not _has_strokes(colours, np.atleast_3d(alpha)[..., 0], values.any(axis=2)):
            raise MaskError(
                f"{name} look like a photo with red or green things, not like strokes",
                "expected strokes in pure red or green, on black or transparent pixels, or on a "
                "copy of the photo",
                "paint with (255, 0, 0) and (0, 255, 0), or leave the hints out",
            )
        return cls(values)

    def sampled(self, width: int, height: int) -> Float32:
        """Returns the hints in a grid of `width` x `height` cells that covers the photo: (height,
        width, 2) in 0..1.
        """
        return sampled(self.values, width, height).astype(np.float32) / np.float32(255)


def _has_strokes(colours: Float32, alpha: NDArray[Any], is_hint: NDArray[np.bool_]) -> bool:
    """Returns whether the red and green pixels of an image, `is_hint`, are painted.

    Args:
        colours: (H, W, 3), 0..255.
        alpha: (H, W), or (1, 1) for an opaque image, 0..1.
        is_hint: (H, W).
    """
    low, _, high = np.moveaxis(np.sort(colours[is_hint], axis=1), 1, 0)
    second = colours[is_hint].sum(axis=1) - low - high
    is_painted = (high >= _PAINTED_LEVEL) & (second <= _OTHER_LEVEL)
    is_empty = (colours.max(axis=2) * alpha)[~is_hint] <= _OTHER_LEVEL
    return bool(is_painted.mean() >= _MIN_PAINTED or is_empty.mean() >= _MIN_EMPTY)
