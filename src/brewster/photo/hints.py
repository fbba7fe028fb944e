"""Hints: an image of the size of a photo, on which a person has painted where there is reflection, and where only the
scene.

hints = Hints.open("hints.png", photo.size)
hints.sampled(516, 387)  # (387, 516, 2) float32: reflection (red), scene (green); 0 is no hint"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Final, Self, final

import numpy as np
from numpy.typing import NDArray

from brewster.errors import MaskError
from brewster.photo.colour import LINEAR_REC709, SRGB
from brewster.photo.in_memory import WHITE_LEVELS
from brewster.photo.mask import open_painted, sampled
from brewster.photo.photo import Float32, Source

_MIN_PURITY: Final = 0.8
"""The smallest distance of red from the larger of green and blue, as a share of red, and the same for green."""


@final
@dataclass(frozen=True, eq=False)
class Hints:
    """Two soft masks of a photo. Immutable and thread-safe."""

    values: NDArray[np.uint8]
    """(H, W, 2): 255 where the image is pure red (reflection here), and where it is pure green (only the scene here)."""

    @classmethod
    def open(cls, source: Source, size: tuple[int, int]) -> Self:
        """Opens hints for a photo. Black, white, grey and transparent pixels are no hint. Red and green are those of sRGB; an image
        with another profile is converted.

        Args:
            source: a path, the bytes of a file, a PIL image, or an array (H, W, 3) of uint8, uint16, or floats in 0..1.
            size: the (width, height) of the photo, with its EXIF orientation applied.

        Raises:
            MaskError: the source cannot be read, has neither red nor green pixels, or does not have the size of the photo.
        """
        name = f"the hints {source}" if isinstance(source, str | os.PathLike) else "the hints"
        photo = open_painted(source, size, name)
        has_own_colours = photo.colour_space() not in (SRGB, LINEAR_REC709)
        pixels = photo.srgb_8bit() if has_own_colours else photo.pixels
        alpha = 1.0 if photo.alpha is None else photo.alpha / WHITE_LEVELS[photo.alpha.dtype.name]
        scale = 255 * alpha / WHITE_LEVELS[pixels.dtype.name]
        red, green, blue = np.moveaxis(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), 2, 0).astype(
            np.float32
        )
        values = np.stack([red - np.maximum(green, blue), green - np.maximum(red, blue)], axis=2)
        # The strokes may be painted over a copy of the photo, whose colours are not as pure
        is_pure = values >= _MIN_PURITY * np.stack([red, green], axis=2)
        values = np.clip(values * is_pure * np.atleast_3d(scale), 0, 255).astype(np.uint8)
        if not values.any():
            raise MaskError(
                f"{name} have neither red nor green pixels",
                "expected red where there is reflection, or green where there is only the scene",
                "paint with pure red and pure green, or leave the hints out",
            )
        return cls(values)

    def sampled(self, width: int, height: int) -> Float32:
        """Returns the hints in a grid of `width` x `height` cells that covers the photo: (height, width, 2) in 0..1."""
        return sampled(self.values, width, height).astype(np.float32) / np.float32(255)
