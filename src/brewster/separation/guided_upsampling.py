"""Upsamples a separation from the resolution of the network to that of the photo, with the detail
of the photo.

The change, transmission - photo, is about as smooth as the reflection. At low resolution, it is a
local linear function of the photo, change = slope * photo + offset, with the slopes of the guided
filter (He et al. 2013, eq. 5). Slope and offset are upsampled and applied to the full photo (He &
Sun 2015). The offset contains the error of the fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.photo import Mask, Photo

if TYPE_CHECKING:
    from jaxtyping import Float32

Floats = NDArray[np.float32]
Means = Callable[[Floats], Floats]
"""Returns the means of a map (h, w, C) over windows of 5 x 5 pixels, as `box_mean`."""

RADIUS: Final = 2
"""Radius of the windows in pixels: windows have 5 x 5 pixels."""
_EPSILON: Final = 4e-3
"""The regularisation epsilon of the guided filter (He et al. 2013, eq. 5), in linear light squared.
"""
_DETAIL_EPSILON: Final = 1e-6
"""Added to the denominator of the weight of the generated transmission, so that it is 0 without
detail.
"""


@final
@dataclass(frozen=True)
class _LocalLinearModel:
    """A layer as a local linear function of the photo: layer = slope * photo + offset, at low
    resolution.
    """

    slope: Float32[Floats, "h w 3"]
    offset: Float32[Floats, "h w 3"]

    def apply(self, photo: Floats, top: int, height: int) -> Floats:
        """Returns the layer for n rows of the full photo, from the row `top`. `photo` and the
        result are (n, W, 3).
        """
        rows, width, _ = photo.shape
        layer = upsample_rows(self.slope, top, rows, (height, width))
        layer *= photo
        layer += upsample_rows(self.offset, top, rows, (height, width))
        return layer


@final
@dataclass(frozen=True)
class GeneratedOverride:
    """A generated transmission at low resolution, and its weight against the result of the guided
    upsampling.

    Where the reflection has more fine detail than the background, it is softer, but closer to the
    ground truth.
    """

    transmission: Float32[Floats, "h w 3"]
    weight: Float32[Floats, "h w 1"]
    """0: guided upsampling with the detail of the photo. 1: the upsampled generated transmission.
    """
    strength: float = 1.0
    """The strength of the separation: at weight 1, 0 gives the photo and 1 the generated
    transmission.
    """

    @classmethod
    def weighted_by_detail(
        cls, transmission: Floats, reflection: Floats, means: Means | None = None
    ) -> GeneratedOverride:
        """Returns an override with weight = var(R) / (var(R) + var(T)), for layers (h, w, 3) in
        linear light.

        var is the local variance: the mean over channels and windows of the squared difference to
        the window mean.

        Args:
            transmission: T.
            reflection: R.
            means: computes the means of windows; by default `box_mean`.
        """
        means = means or box_mean
        reflection_variance, transmission_variance = (
            means(np.square(layer - means(layer)).mean(axis=2, keepdims=True))
            for layer in (reflection, transmission)
        )
        weight: Floats = reflection_variance / (
            reflection_variance + transmission_variance + np.float32(_DETAIL_EPSILON)
        )
        return cls(transmission, weight)


@final
@dataclass(frozen=True)
class GuidedUpsampler:
    """A separation fitted at low resolution. It is applied to the full photo in strips of rows."""

    change: _LocalLinearModel
    reflection: _LocalLinearModel | None
    """None: the reflection is photo - transmission."""
    override: GeneratedOverride | None = None

    @classmethod
    def fit(
        cls,
        photo: Floats,
        change: Floats,
        reflection: Floats | None,
        override: GeneratedOverride | None = None,
        means: Means | None = None,
    ) -> GuidedUpsampler:
        """Fits `change` (transmission - photo) and the reflection as local linear functions of the
        photo.

        Args:
            photo: (h, w, 3) linear light, at low resolution.
            change: (h, w, 3), the same.
            reflection: (h, w, 3), or None: it is photo - transmission.
            override: where the transmission has no detail of the photo.
            means: computes the means of windows; by default `box_mean`.
        """
        means = means or box_mean
        mean = means(photo)
        variance = means(photo * photo) - mean**2 + _EPSILON

        def fit_layer(layer: Floats) -> _LocalLinearModel:
            """Fits a slope to each window and averages the slopes. The offset makes the fit exact
            at low resolution.
            """
            slope = means((means(photo * layer) - mean * means(layer)) / variance)
            return _LocalLinearModel(slope, layer - slope * photo)

        return cls(
            fit_layer(change), None if reflection is None else fit_layer(reflection), override
        )

    def apply(
        self, photo: Floats, top: int, height: int, strength_mask: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Returns transmission and reflection, (n, W, 3), for n rows of the full photo of `height`
        rows, from `top`.

        `photo` (n, W, 3) are these rows in linear light. `strength_mask` (n, W, 1), 0..1, scales
        the strength. The transmission is at least min(photo, 0), as colours outside Rec.709 are
        negative; the reflection in 0..max(photo, 0).
        """
        transmission = self.change.apply(photo, top, height)
        if self.override:
            size = height, photo.shape[1]
            generated, weight = (
                upsample_rows(map_, top, len(photo), size)
                for map_ in (self.override.transmission, self.override.weight)
            )
            transmission += weight * (
                np.float32(self.override.strength) * (generated - photo) - transmission
            )
        if strength_mask is not None:
            transmission *= strength_mask
        transmission += photo
        np.maximum(transmission, np.minimum(photo, 0), out=transmission)
        if self.reflection is None:
            reflection = photo - transmission
        else:
            reflection = self.reflection.apply(photo, top, height)
            if strength_mask is not None:
                reflection *= strength_mask
        return transmission, np.clip(reflection, 0, np.maximum(photo, 0), out=reflection)

    def as_linear(self, mask: Floats) -> list[tuple[Floats, Floats]]:
        """Returns (slope, offset) of transmission and reflection at low resolution: layer = slope *
        photo + offset. Enlarged, they give the layers of a photo of any size, up to rounding as
        `apply` does, without its limits.

        `mask` (h, w, 1) in 0..1 scales the strength, also at low resolution. Raises ValueError if R
        is derived.
        """
        if self.reflection is None:
            raise ValueError("the reflection is derived; expected a reflection; use apply")
        slope = self.change.slope
        offset = self.change.offset
        if self.override:
            weight = self.override.weight
            slope = slope - weight * (slope + np.float32(self.override.strength))
            offset = offset + weight * (
                np.float32(self.override.strength) * self.override.transmission - offset
            )
        return [
            (1 + mask * slope, mask * offset),
            (mask * self.reflection.slope, mask * self.reflection.offset),
        ]


def upsample_rows(map_: Floats, top: int, rows: int, size: tuple[int, int]) -> Floats:
    """Returns `rows` rows, from the row `top`, of `map_` (h, w, C), bilinearly upsampled to `size`
    (H, W).
    """
    above, fraction = _positions(map_.shape[0], top, rows, size[0])
    first = above[0]
    wide = _widened(map_[first : above[-1] + 2], size[1])
    steps = np.diff(wide, axis=0, append=wide[-1:])
    upsampled = np.empty((rows, *wide.shape[1:]), np.float32)
    # Few low rows are widened, and rows between the same two of them are one product: this takes a
    # third of the time of an interpolation of each full row along both axes
    starts = np.flatnonzero(np.diff(above, prepend=-1))
    for start, end in pairwise([*starts.tolist(), rows]):
        low = above[start] - first
        np.multiply(steps[low], fraction[start:end, None, None], out=upsampled[start:end])
        upsampled[start:end] += wide[low]
    return upsampled


def _positions(small: int, first: int, count: int, large: int) -> tuple[NDArray[np.intp], Floats]:
    """The integer and the fractional parts of positions on an axis of length `small`."""
    centres = (np.arange(first, first + count) + 0.5) * (small / large) - 0.5
    centres = np.clip(centres, 0, small - 1)
    lower = np.minimum(centres.astype(np.intp), max(small - 2, 0))
    return lower, (centres - lower).astype(np.float32)


def _widened(map_: Floats, width: int) -> Floats:
    """Returns a map (h, w, C), linearly interpolated along its rows to this width."""
    left, fraction = _positions(map_.shape[1], 0, width, width)
    # A fraction for each channel: numpy then multiplies whole rows at a time
    fractions = np.repeat(fraction[:, None], map_.shape[2], axis=1)
    low = np.take(map_, left, axis=1)
    wide: Floats = np.take(map_, np.minimum(left + 1, map_.shape[1] - 1), axis=1)
    wide -= low
    wide *= fractions
    wide += low
    return wide


def box_mean(map_: Floats, radius: int = RADIUS) -> Floats:
    """Returns the means of a map (h, w, C) over square windows. Outside, the nearest pixel
    counts.
    """
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (radius, radius)
        padded = np.moveaxis(np.pad(map_, padding, mode="edge"), axis, 0)
        length = map_.shape[axis]
        total = padded[:length].copy(order="K")
        for i in range(1, 2 * radius + 1):
            total += padded[i : i + length]
        total /= np.float32(2 * radius + 1)
        map_ = np.moveaxis(total, 0, axis)
    return np.ascontiguousarray(map_)


# --- the layers at full size, in strips, with few threads and little memory


_WORKERS: Final = 2


def upsample_layers(
    photo: Photo,
    upsampler: GuidedUpsampler,
    mask: Mask | None,
    *,
    additive: bool,
    on_progress: Callable[[float], None],
) -> tuple[Photo, Photo, float]:
    """Returns transmission, reflection and the mean residual. The layers are encoded like the
    photo.

    If `additive` is true, the layers are 32-bit floats in linear light, and their sum is exactly
    the photo.
    """
    template = _float_template(photo) if additive else photo
    canvases = [np.empty(template.pixels.shape, template.pixels.dtype) for _ in range(2)]

    def fill(rows: slice) -> float:
        linear = photo.linear_rows(rows.start, rows.stop)
        strength_mask = None if mask is None else mask.rows(rows.start, rows.stop)
        layers = upsampler.apply(linear, rows.start, photo.size[1], strength_mask)
        stored = [template.stored_rows(layer, rows.start) for layer in layers]
        if additive:
            # At least one of the two differences is exact (Sterbenz 1974), which makes the sum
            # exact.
            whole = template.stored_rows(linear, rows.start)
            remainder = whole - np.minimum(stored[0], whole)
            stored = [whole - remainder, remainder]
        for canvas, layer in zip(canvases, stored, strict=True):
            canvas[rows] = layer
        return (
            0.0 if additive else float(np.abs(linear - layers[0] - layers[1]).sum(dtype=np.float64))
        )

    strips = list(photo.strips())
    residual_sum = 0.0
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done, strip_residual in enumerate(pool.map(fill, strips), 1):
            residual_sum += strip_residual
            on_progress(done / len(strips))
    transmission, reflection = (template.with_pixels(canvas) for canvas in canvases)
    return transmission, reflection, residual_sum / (math.prod(photo.size) * 3)


def _float_template(photo: Photo) -> Photo:
    """Returns a black photo of the same size, 32-bit floats in linear light, with the alpha and
    EXIF of the photo.
    """
    file_info = replace(
        photo.file_info,
        format_name="tiff",
        bits=32,
        compression=None,
        icc=None,
        primaries=None,
        header=None,
    )
    alpha = photo.alpha
    if alpha is not None and alpha.dtype.kind == "u":
        alpha = alpha / np.float32(np.iinfo(alpha.dtype).max)
    black = np.broadcast_to(np.float32(0), photo.pixels.shape)
    return Photo(black, alpha, file_info)
