"""Carries a separation made at work resolution to the photo's full resolution, without blurring the photo.

Reflection adds to light, so in linear light the change from photo to transmission is about as smooth as the
reflection itself, whatever detail lies behind the glass. The change is described at work resolution by local
lines, change = slope * photo + offset (slopes as in the guided filter: He et al. 2013, eq. 5; enlarged as in the
fast guided filter: He & Sun 2015), and applied to the full photo: its own detail stays. At the same size the
lines give back exactly what they were learned from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Float32

Floats = NDArray[np.float32]

_RADIUS: Final = 2
_VARIANCE_FLOOR: Final = 4e-3
_MIN_DETAIL_ENERGY: Final = 1e-6
"""Energy of detail, linear light squared, below which it is nobody's."""


@final
@dataclass(frozen=True)
class _LocalLinearMap:
    """A picture as local lines over the photo, picture = slope * photo + offset, maps of work resolution."""

    slope: Float32[Floats, "h w 3"]
    offset: Float32[Floats, "h w 3"]

    def apply(self, photo: Floats, top: int, height: int) -> Floats:
        """The picture over rows top..top+n of the full photo, (n, W, 3)."""
        rows, width, _ = photo.shape
        picture = enlarge_rows(self.slope, top, rows, (height, width))
        picture *= photo
        picture += enlarge_rows(self.offset, top, rows, (height, width))
        return picture


@final
@dataclass(frozen=True)
class GeneratedOverride:
    """A transmission that a model drew at work resolution, and where it is to be taken as it is, merely enlarged.

    Where sharp detail is mirrored and little lies behind it, the photo's detail is the mirror's: the drawn picture,
    though softer, is nearer to the truth there.
    """

    transmission: Float32[Floats, "h w 3"]
    weight: Float32[Floats, "h w 1"]
    """0: the photo's own detail; 1: the drawn picture."""
    strength: float = 1.0
    """How much of the way from the photo to the drawn picture is gone."""

    @classmethod
    def weighted_by_detail(cls, transmission: Floats, reflection: Floats) -> GeneratedOverride:
        """Taken as far as the fine detail is the reflection's: its share of the energy above the windows' means."""
        reflected, transmitted = (
            _box_mean(np.square(layer - _box_mean(layer)).mean(axis=2, keepdims=True))
            for layer in (reflection, transmission)
        )
        weight: Floats = reflected / (reflected + transmitted + np.float32(_MIN_DETAIL_ENERGY))
        return cls(transmission, weight)


@final
@dataclass(frozen=True)
class GuidedUpsampler:
    """A separation at work resolution, ready to be read at the photo's, row by row."""

    change: _LocalLinearMap
    reflection: _LocalLinearMap
    override: GeneratedOverride | None = None

    @classmethod
    def fit(
        cls, photo: Floats, change: Floats, reflection: Floats, override: GeneratedOverride | None = None
    ) -> GuidedUpsampler:
        """From a photo, transmission - photo, and the reflection at work resolution, (h, w, 3), linear light."""
        mean = _box_mean(photo)
        variance = _box_mean(photo * photo) - mean**2 + _VARIANCE_FLOOR

        def fit(picture: Floats) -> _LocalLinearMap:
            """Slopes from windows, smoothed; offsets that make the lines meet the picture exactly."""
            slope = _box_mean((_box_mean(photo * picture) - mean * _box_mean(picture)) / variance)
            return _LocalLinearMap(slope, picture - slope * photo)

        return cls(fit(change), fit(reflection), override)

    def apply(self, photo: Floats, top: int, height: int) -> tuple[Floats, Floats]:
        """Transmission and reflection of rows top..top+n of a photo `height` rows high, each (n, W, 3).

        Light is not negative, except where a wide-gamut photo's own values are, and no reflection is brighter
        than the photo it is part of.
        """
        transmission = self.change.apply(photo, top, height)
        if self.override:
            size = height, photo.shape[1]
            generated, weight = (
                enlarge_rows(map_, top, len(photo), size)
                for map_ in (self.override.transmission, self.override.weight)
            )
            transmission += weight * (np.float32(self.override.strength) * (generated - photo) - transmission)
        transmission += photo
        np.maximum(transmission, np.minimum(photo, 0), out=transmission)
        reflection = self.reflection.apply(photo, top, height)
        return transmission, np.clip(reflection, 0, np.maximum(photo, 0), out=reflection)


def enlarge_rows(map_: Floats, top: int, rows: int, size: tuple[int, int]) -> Floats:
    """Rows top..top+rows of `map_` (h, w, C) enlarged to `size` (H, W), linearly between pixel centres."""
    vertical = _interpolate(map_, *_positions(map_.shape[0], top, rows, size[0]), axis=0)
    return _interpolate(vertical, *_positions(map_.shape[1], 0, size[1], size[1]), axis=1)


def _positions(small: int, first: int, count: int, large: int) -> tuple[NDArray[np.intp], Floats]:
    """For large pixels first..first+count: the small pixel before each centre, and how far past it."""
    centres = (np.arange(first, first + count) + 0.5) * (small / large) - 0.5
    centres = np.clip(centres, 0, small - 1)
    lower = np.minimum(centres.astype(np.intp), max(small - 2, 0))
    return lower, (centres - lower).astype(np.float32)


def _interpolate(map_: Floats, lower: NDArray[np.intp], fraction: Floats, *, axis: int) -> Floats:
    shape = [1] * map_.ndim
    shape[axis] = -1
    low = np.take(map_, lower, axis=axis)
    high: Floats = np.take(map_, np.minimum(lower + 1, map_.shape[axis] - 1), axis=axis)
    high -= low
    high *= fraction.reshape(shape)
    high += low
    return high


def _box_mean(map_: Floats) -> Floats:
    """Means over windows of 2 r + 1 pixels a side, edges repeated, (h, w, C)."""
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (_RADIUS, _RADIUS)
        padded = np.pad(map_, padding, mode="edge")
        shifted = [np.take(padded, range(i, i + map_.shape[axis]), axis=axis) for i in range(2 * _RADIUS + 1)]
        map_ = np.mean(shifted, axis=0, dtype=np.float32)
    return map_
