"""Separates a photo with the help of another one with a flash, which lights T and not R.

    ambient = T + R
    flash = e (T (1 + 1 / S) + R)

S is smooth: the light of the scene divided by that of the flash, which depends on the distance.
Flash / e - ambient = T / S holds the structure of T without a mirrored scene (Agrawal et al. 2005;
Lei and Chen 2021).

1. Exposure e: the most frequent ratio of edges of R, and at most the least ratio of both photos,
   because no light becomes darker. It is rather too large; EXIF knows better, but not the white
   balance.
2. S: a spline in log(S) that makes the edges of T / S those of the ambient photo, with T of the
   single photo as a weak reference and the ambient photo as a bound.
3. T / S is noise where the flash is weak. Therefore T is that of the single photo with the
   difference to it, as far as this difference is more than noise, band by band (Wiener).
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.light.changing_light import (
    MIN_CHANGED_AREA,
    LightSolution,
    changed_places,
    expected_errors,
)
from brewster.film.light.gains import CLIPPED, DARK, LAPLACIAN_NOISE, Doubles, Floats, fit_gains

_EDGE_PX: Final = ((1.0, 2.0), (2.0, 4.0))
"""The standard deviations of the blurs whose differences are edges."""
_CERTAIN: Final = 5.0
"""Edges and light that are larger than noise by this factor count."""
_FULL_WEIGHT: Final = 20.0
"""Edges that are larger than noise by this factor have the full weight."""
_RATIO_PX: Final = 3.0
_LEAST: Final = 0.02
"""The quantile of the ratios of light that counts as the least."""
_RATIO_STEP: Final = 0.01
_RATIO_WIDTH: Final = 0.04
_RATIO_RANGE: Final = 1.5
_CHANNEL_WIDTHS: Final = (0.08, 0.06, 0.04, 0.04, 0.04)
"""Of the kernels that compare logarithms of ratios."""
_EXIF_RANGE: Final = (0.7, 1.1)
"""The exposure of EXIF is used if it is this part of the fitted one. It does not know tone curves.
"""
_EXPOSURE_ERROR: Final = np.float32(0.03)
"""The relative error of the exposure, which is a smooth error of T where the flash is weak."""
_KNOTS: Final = 8
"""The intervals of the spline along the width, minus 1."""
_EDGE_SAMPLES: Final = 5_000
_LIGHT_SAMPLES: Final = 2_500
_LIGHT_PX: Final = 4.0
_SINGLE_WEIGHT: Final = 1.0
_BOUND_WEIGHT: Final = 0.3
"""Relative to an edge with full weight."""
_SINGLE_WIDTH: Final = 0.3
_WIDTHS: Final = (0.6, 0.4, 0.25, 0.15, 0.15)
"""The errors of log(S) at which an edge has a weight of exp(-1/2), from step to step."""
_STEPS: Final = 4
_SMOOTH: Final = 1e-4
"""The weight of squared second differences of the spline, for each unit of weight of the data."""
_MAX_LOG: Final = 3.0
_COARSEST: Final = 0.1
"""The standard deviation of the coarsest band, as a share of the width."""
_ABOVE: Final = 1.05
"""T / S may be brighter than the photos by this factor, because of noise."""
_TINY: Final = 1e-12


def solve_flash(
    frames: Floats,
    reference: int,
    flash: int,
    single: Floats,
    exposure: float | None = None,
) -> LightSolution | None:
    """Returns the layers of the reference frame, or None if the flash changed nothing.

    Args:
        frames: two aligned photos, (2, h, w, 3) linear light, 0..1.
        reference: the index of the frame whose layers are returned, with or without flash.
        flash: the index of the frame with flash.
        single: T of the frame without flash from a single photo, (h, w, 3).
        exposure: that of the frame with flash relative to the other, as EXIF says; None: unknown.
    """
    ambient, lit = frames[1 - flash], frames[flash]
    gains = fit_gains(frames, reference)
    scaled = (frames / gains[:, None, None]).astype(np.float32)
    noise = float(np.mean([_noise(frame) for frame in frames]))
    changed = changed_places(scaled, frames, noise)
    area = float((changed > 0.5).mean())
    if area < MIN_CHANGED_AREA:
        return None
    exposures = _exposures(ambient, lit, single, exposure)
    transmission = np.clip(flash_transmission(ambient, lit, exposures, single), 0, ambient)
    reflection = ambient - transmission
    if reference == flash:
        reflection = np.minimum(reflection * exposures.astype(np.float32), lit)
        transmission = lit - reflection
    return LightSolution(
        layers=np.stack([transmission, reflection]).astype(np.float32),
        kind="flash",
        changed_area=area,
        errors=expected_errors(changed, noise),
        explained=0.0,
        contrast=1.0,
    )


def flash_transmission(ambient: Floats, lit: Floats, exposures: Doubles, single: Floats) -> Floats:
    """Returns T of the photo without flash, (h, w, 3).

    Args:
        ambient: the photo without flash, (h, w, 3) linear light.
        lit: the photo with flash, aligned.
        exposures: those of the photo with flash relative to the other, (3,).
        single: T from the photo without flash alone.
    """
    relit = (lit / exposures).astype(np.float32)
    own = relit - ambient
    variance = _variance(ambient)
    of_own = variance + (_variance(lit) / np.square(exposures)).astype(np.float32)
    ratio = _light_ratio(ambient, own, single, np.sqrt(variance), np.sqrt(of_own))
    bound = np.minimum(ambient, relit)
    difference = np.clip(ratio * own, 0, _ABOVE * bound) - single
    of_exposure = np.square(_EXPOSURE_ERROR * ratio * relit)
    change = _without_noise(difference, of_own * np.square(ratio), of_exposure)
    is_clipped = np.maximum(ambient, lit).max(-1) > CLIPPED
    is_known = 1 - cv2.dilate(is_clipped.astype(np.float32), np.ones((5, 5), np.uint8))
    return single + change * _blurred(is_known, 1)[..., None]


def _noise(frame: Floats) -> float:
    """Returns the standard deviation of the noise of the square root of light, at most."""
    details = cv2.Laplacian(np.sqrt(np.maximum(frame, 0) + DARK), -1)
    return float(np.median(np.abs(details))) / LAPLACIAN_NOISE + 1e-4


def _variance(frame: Floats) -> Floats:
    """Returns that of the noise of light, (h, w, 3)."""
    variance: Floats = 4 * np.float32(_noise(frame)) ** 2 * (np.maximum(frame, 0) + DARK)
    return variance


def _blurred(image: Floats, sigma: float) -> Floats:
    blurred: Floats = cv2.GaussianBlur(image, (0, 0), sigma)
    return blurred


def _edges(image: Floats, scale: tuple[float, float]) -> Floats:
    edges: Floats = _blurred(image, scale[0]) - _blurred(image, scale[1])
    return edges


def _noise_share(sigma: float) -> float:
    """Returns the share of the standard deviation of white noise that a blur leaves."""
    return 1 / (2 * float(np.sqrt(np.pi)) * sigma)


def _exposures(ambient: Floats, lit: Floats, single: Floats, known: float | None) -> Doubles:
    """Returns the exposures of the photo with flash relative to the other, (3,)."""
    fitted = _fitted_exposures(ambient, lit, single)
    mean = float(np.exp(np.log(fitted).mean()))
    is_plausible = known is not None and _EXIF_RANGE[0] < known / mean < _EXIF_RANGE[1]
    return fitted * (known / mean) if known is not None and is_plausible else fitted


def _fitted_exposures(ambient: Floats, lit: Floats, single: Floats) -> Doubles:
    """Returns the exposures as both photos tell them, (3,)."""
    mirrored = np.maximum(ambient - single, 0)
    deviation = np.sqrt(_variance(ambient))
    ratios, weights, channels = [], [], []
    for scale in _EDGE_PX:
        noise = deviation * np.float32(_noise_share(scale[0]))
        edges, of_lit, of_mirrored, of_single = (
            _edges(image, scale) for image in (ambient, lit, mirrored, single)
        )
        share = np.square(of_mirrored)
        share /= share + np.square(of_single) + np.square(noise)
        strength = np.abs(edges) / noise
        chosen = np.flatnonzero((strength > _CERTAIN) & (edges * of_lit > 0))
        ratios.append(np.log(of_lit.ravel()[chosen] / edges.ravel()[chosen]))
        weight = share * np.square(np.minimum(strength / _FULL_WEIGHT, 1))
        weights.append(weight.ravel()[chosen])
        channels.append(chosen % 3)
    ratio, weight, channel = map(np.concatenate, (ratios, weights, channels))
    least = _least_ratios(ambient, lit, deviation)
    grid = np.arange(-_RATIO_RANGE, _RATIO_RANGE, _RATIO_STEP)
    limits = np.append(grid - _RATIO_STEP / 2, grid[-1] + _RATIO_STEP / 2)
    counts, _ = np.histogram(ratio, bins=limits, weights=weight)
    reach = np.arange(-0.12, 0.125, _RATIO_STEP)
    counts = np.convolve(counts, np.exp(-np.square(reach / _RATIO_WIDTH) / 2), "same")
    counts[grid > np.log(least.max()) + 0.05] = -1
    mode = float(grid[np.argmax(counts)])
    exposures = np.empty(3)
    for c in range(3):
        of_channel = mode
        for width in _CHANNEL_WIDTHS:
            near = np.exp(-np.square((ratio - of_channel) / width) / 2) * weight * (channel == c)
            if near.sum() > _TINY:
                of_channel = float((near * ratio).sum() / near.sum())
        exposures[c] = min(np.exp(of_channel), least[c])
    return exposures


def _least_ratios(ambient: Floats, lit: Floats, deviation: Floats) -> Doubles:
    """Returns the least ratio of the light of both photos, (3,)."""
    of_ambient, of_lit = _blurred(ambient, _RATIO_PX), _blurred(lit, _RATIO_PX)
    is_certain = of_ambient > _CERTAIN * deviation * np.float32(_noise_share(_RATIO_PX))
    ratios = np.maximum(of_lit, 1e-6) / np.maximum(of_ambient, 1e-6)
    least = [
        np.quantile(ratios[..., c][is_certain[..., c]], _LEAST) if is_certain[..., c].any() else 1
        for c in range(3)
    ]
    return np.array(least, np.float64)


def _light_ratio(
    ambient: Floats, own: Floats, single: Floats, of_ambient: Floats, of_own: Floats
) -> Floats:
    """Returns S, (h, w, 3).

    Args:
        ambient: the photo without flash.
        own: the light of the flash alone.
        single: T from the photo without flash alone.
        of_ambient: the standard deviation of the noise of `ambient`.
        of_own: that of `own`.
    """
    spline = _Spline(*ambient.shape[:2])
    rows: list[Doubles] = []
    logs: list[Floats] = []
    weights: list[Floats] = []
    for scale in _EDGE_PX:
        edges, own_edges = _edges(ambient, scale), _edges(own, scale)
        share = np.float32(_noise_share(scale[0]))
        strength = np.minimum(np.abs(own_edges) / of_own, np.abs(edges) / of_ambient) / share
        chosen = _sampled((strength > _CERTAIN) & (edges * own_edges > 0), _EDGE_SAMPLES)
        rows.append(spline.rows(chosen))
        logs.append(np.log(edges.ravel()[chosen] / own_edges.ravel()[chosen]))
        weights.append(np.square(np.minimum(strength.ravel()[chosen] / _FULL_WEIGHT, 1)))
    light = _blurred(own, _LIGHT_PX)
    chosen = _sampled(light > _CERTAIN * of_own * _noise_share(_LIGHT_PX), _LIGHT_SAMPLES)
    of_light = np.maximum(light.ravel()[chosen], 1e-6)
    at_light = spline.rows(chosen)
    of_single, bound = (
        np.log(np.maximum(_blurred(image, _LIGHT_PX).ravel()[chosen], 1e-4) / of_light)
        for image in (single, ambient)
    )
    kinds = np.repeat([0, 1, 2], [sum(map(len, logs)), len(chosen), len(chosen)])
    matrix = np.vstack([*rows, at_light, at_light])
    side = np.concatenate([*logs, of_single, bound])
    weight = np.concatenate(
        [
            *weights,
            np.full(len(chosen), _SINGLE_WEIGHT, np.float32),
            np.full(len(chosen), _BOUND_WEIGHT, np.float32),
        ]
    )
    total = float(weight[kinds < 2].sum()) + 1
    penalty = total * (_SMOOTH * spline.roughness + 1e-9 * np.eye(matrix.shape[1]))
    factors = spline.constant(float(np.median(of_single)) if len(chosen) else 0.0)
    for width in np.repeat(_WIDTHS, _STEPS):
        errors = side - matrix @ factors
        robust = np.where(
            kinds == 0,
            np.exp(-np.square(errors / width) / 2),
            np.where(
                kinds == 1,
                1 / (1 + np.square(errors / max(width, _SINGLE_WIDTH))),
                errors < 0,
            ),
        )
        weighted = matrix * (robust * weight)[:, None]
        factors = np.linalg.solve(weighted.T @ matrix + penalty, weighted.T @ side)
    ratio: Floats = np.exp(np.clip(spline.image(factors), -_MAX_LOG, _MAX_LOG))
    return ratio


def _sampled(is_chosen: NDArray[np.bool_], count: int) -> NDArray[np.intp]:
    """Returns the flat indices of at most about `count` of the chosen values."""
    chosen = np.flatnonzero(is_chosen)
    return chosen[:: len(chosen) // count + 1]


class _Spline:
    """A smooth field with an offset for each channel: bicubic splines."""

    def __init__(self, height: int, width: int) -> None:
        self._y = _basis(height, max(3, round(_KNOTS * height / width)))
        self._x = _basis(width, _KNOTS)

    @property
    def _shape(self) -> tuple[int, int]:
        return self._y.shape[1], self._x.shape[1]

    def rows(self, chosen: NDArray[np.intp]) -> Doubles:
        """Returns the weights of the factors (n, m) at flat indices of an image (h, w, 3)."""
        y, x = np.divmod(chosen // 3, len(self._x))
        field = (self._y[y][:, :, None] * self._x[x][:, None, :]).reshape(len(chosen), -1)
        offsets = np.eye(3, 2)[chosen % 3] - 1 / 3
        return np.hstack([field, offsets])

    @property
    def roughness(self) -> Doubles:
        """The matrix of the sum of squared second differences, (m, m)."""
        rows, columns = (np.diff(np.eye(count), 2, axis=0) for count in self._shape)
        count = self._shape[0] * self._shape[1]
        matrix = np.diag(np.append(np.zeros(count), (0.1, 0.1)))
        matrix[:count, :count] = np.kron(rows.T @ rows, np.eye(self._shape[1])) + np.kron(
            np.eye(self._shape[0]), columns.T @ columns
        )
        return matrix

    def constant(self, value: float) -> Doubles:
        """Returns the factors of a constant field."""
        return np.append(np.full(self._shape[0] * self._shape[1], value), (0.0, 0.0))

    def image(self, factors: Doubles) -> Floats:
        """Returns the field, (h, w, 3)."""
        field = self._y @ factors[:-2].reshape(self._shape) @ self._x.T
        offsets = np.append(factors[-2:], 0) - factors[-2:].sum() / 3
        image: Floats = (field[..., None] + offsets).astype(np.float32)
        return image


def _basis(length: int, knots: int) -> Doubles:
    """Returns the cubic B-splines of a line, (length, knots + 2)."""
    places = np.linspace(0, knots - 1, length)[:, None]
    distance = np.abs(places - np.arange(-1, knots + 1))
    inner = 2 / 3 - distance**2 + distance**3 / 2
    outer = np.maximum(2 - distance, 0) ** 3 / 6
    return np.where(distance < 1, inner, outer)


def _without_noise(image: Floats, variance: Floats, of_smooth: Floats) -> Floats:
    """Returns an image (h, w, 3) without errors: each band has the share of its local power that is
    more than that of the errors.

    Args:
        image: the image.
        variance: that of white noise, (h, w, 3).
        of_smooth: that of smooth errors, which are in the coarsest band alone.
    """
    left = image
    result: Floats = np.zeros_like(image, np.float32)
    before = 0.0
    sigma = 1.0
    while sigma <= max(1.0, _COARSEST * image.shape[1]):
        smooth = _blurred(image, sigma)
        window = max(2 * sigma, 4.0)
        noise = _blurred(variance, window) * np.float32(_band_share(before, sigma))
        result += _certain_part(left - smooth, noise, window)
        left, before, sigma = smooth, sigma, 2 * sigma
    result += _certain_part(left, _blurred(of_smooth, before), before)
    return result


def _certain_part(band: Floats, noise: Floats, window: float) -> Floats:
    power = np.maximum(_blurred(np.square(band), window), np.float32(_TINY))
    share: Floats = np.maximum(1 - noise / power, np.float32(0))
    return share * band


def _band_share(fine: float, coarse: float) -> float:
    """Returns the share of the variance of white noise in the difference of two blurs; fine: 0 for
    no blur.
    """
    of_fine = _noise_share(fine) ** 2 if fine else 1.0
    common = 1 / (2 * np.pi * (fine**2 + coarse**2))
    return float(of_fine + _noise_share(coarse) ** 2 - 2 * common)
