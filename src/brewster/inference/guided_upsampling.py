"""Upsamples a separation from the resolution of the network to that of the photo, and keeps the photo's detail.

Reflection adds to light, so in linear light the change from photo to transmission is about as smooth as the
reflection itself, whatever detail is behind the glass. At low resolution the change is modelled as a local linear
function of the photo, change = slope * photo + offset (slopes: guided filter, He et al. 2013, eq. 5; upsampling:
fast guided filter, He & Sun 2015). The upsampled slope and offset are applied to the full photo. Without
upsampling, the result is exactly the input.
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
_EPSILON: Final = 4e-3
_DETAIL_EPSILON: Final = 1e-6
"""Detail energy, in linear light squared, below which the photo's detail is kept."""


@final
@dataclass(frozen=True)
class _LocalLinearMap:
    """A layer as a local linear function of the photo: layer = slope * photo + offset, at low resolution."""

    slope: Float32[Floats, "h w 3"]
    offset: Float32[Floats, "h w 3"]

    def apply(self, photo: Floats, top: int, height: int) -> Floats:
        """Returns the layer for the rows top..top+n of the full photo: `photo` and the result are (n, W, 3)."""
        rows, width, _ = photo.shape
        layer = upsample_rows(self.slope, top, rows, (height, width))
        layer *= photo
        layer += upsample_rows(self.offset, top, rows, (height, width))
        return layer


@final
@dataclass(frozen=True)
class GeneratedOverride:
    """A generated transmission at low resolution, and where it replaces the result of the guided filter.

    Where the reflection has sharp detail and the background has little, the detail of the photo belongs to the
    reflection. The generated transmission is softer, but closer to the ground truth there.
    """

    transmission: Float32[Floats, "h w 3"]
    weight: Float32[Floats, "h w 1"]
    """0: guided upsampling with the photo's detail; 1: the enlarged generated transmission."""
    strength: float = 1.0
    """The strength of the separation: 0 is the photo, 1 the generated transmission."""

    @classmethod
    def weighted_by_detail(cls, transmission: Floats, reflection: Floats) -> GeneratedOverride:
        """Weighs by the share of the reflection in the detail energy: the local variance of both layers."""
        reflected, transmitted = (
            _box_mean(np.square(layer - _box_mean(layer)).mean(axis=2, keepdims=True))
            for layer in (reflection, transmission)
        )
        weight: Floats = reflected / (reflected + transmitted + np.float32(_DETAIL_EPSILON))
        return cls(transmission, weight)


@final
@dataclass(frozen=True)
class GuidedUpsampler:
    """A separation at low resolution that can be applied to the rows of the full photo."""

    change: _LocalLinearMap
    reflection: _LocalLinearMap
    override: GeneratedOverride | None = None

    @classmethod
    def fit(
        cls, photo: Floats, change: Floats, reflection: Floats, override: GeneratedOverride | None = None
    ) -> GuidedUpsampler:
        """Fits to the photo, transmission - photo, and reflection at low resolution, (h, w, 3) each, linear light."""
        mean = _box_mean(photo)
        variance = _box_mean(photo * photo) - mean**2 + _EPSILON

        def fit(layer: Floats) -> _LocalLinearMap:
            """Smoothed window slopes; the offset makes the model exact at low resolution."""
            slope = _box_mean((_box_mean(photo * layer) - mean * _box_mean(layer)) / variance)
            return _LocalLinearMap(slope, layer - slope * photo)

        return cls(fit(change), fit(reflection), override)

    def apply(self, photo: Floats, top: int, height: int) -> tuple[Floats, Floats]:
        """Returns transmission and reflection of the rows top..top+n of a photo `height` rows high, each (n, W, 3).

        The transmission is not negative where the photo is not (wide-gamut photos have negative values). The
        reflection is never brighter than the photo.
        """
        transmission = self.change.apply(photo, top, height)
        if self.override:
            size = height, photo.shape[1]
            generated, weight = (
                upsample_rows(map_, top, len(photo), size)
                for map_ in (self.override.transmission, self.override.weight)
            )
            transmission += weight * (np.float32(self.override.strength) * (generated - photo) - transmission)
        transmission += photo
        np.maximum(transmission, np.minimum(photo, 0), out=transmission)
        reflection = self.reflection.apply(photo, top, height)
        return transmission, np.clip(reflection, 0, np.maximum(photo, 0), out=reflection)


def upsample_rows(map_: Floats, top: int, rows: int, size: tuple[int, int]) -> Floats:
    """Returns the rows top..top+rows of `map_` (h, w, C) enlarged to `size` (H, W) by bilinear interpolation."""
    vertical = _interpolate(map_, *_positions(map_.shape[0], top, rows, size[0]), axis=0)
    return _interpolate(vertical, *_positions(map_.shape[1], 0, size[1], size[1]), axis=1)


def _positions(small: int, first: int, count: int, large: int) -> tuple[NDArray[np.intp], Floats]:
    """Returns, for the large pixels first..first+count, the index of the small pixel before it and the fraction past it."""
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
    """Returns means over windows of 2 r + 1 pixels a side of a map (h, w, C), with repeated edges."""
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (_RADIUS, _RADIUS)
        padded = np.pad(map_, padding, mode="edge")
        shifted = [np.take(padded, range(i, i + map_.shape[axis]), axis=axis) for i in range(2 * _RADIUS + 1)]
        map_ = np.mean(shifted, axis=0, dtype=np.float32)
    return map_
