"""Two layers of photos in which one mirrored scene becomes brighter and darker as a whole.

    photo_k = g_k A + h_k B

g and h are smooth: polynomials of the place. This is a polariser that is turned (A is T, B is R), a
lamp of the room that is switched (the same), or a flash (A is R, B is T). What is open is how much
of one layer is in the other. Edges of two scenes are rarely at the same place. Therefore the
regression of the edges of A on those of B, robust against all edges of A, tells how much of B is
still in A.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.light.gains import CLIPPED, DARK, Doubles, Floats, gradients

_DEGREE: Final = 2
"""Of the polynomials: angles of incidence differ within a photo."""
WAYS: Final = (((1,), (1,), (1,), (1, 2)), ((0,), (0, 1), (1,), (1, 2)))
"""The degrees of the polynomials that separate the edges, from round to round. With the second
degree from the beginning, many end at a wrong place. The second way starts with the most frequent
ratio of edges.
"""
_BLUR_PX: Final = 0.8
"""Of the photos whose edges are compared."""
_STEPS: Final = 6
"""Of the iteratively reweighted least squares."""
_SAMPLES: Final = 15_000
_MIN_SAMPLES: Final = 200
_SPARSE: Final = 0.3
"""The exponent of the errors where the edges of a layer are the errors, which are sparse."""
_FLOORS: Final = (6.0, 4.0, 2.0, 2.0, 2.0)
"""Smaller errors, in units of noise, have the weight of these, from step to step."""
_VISIBLE: Final = 1.5
_CLEAR: Final = 4.0
"""Edges that are stronger than noise by this factor count. Noise in weaker ones makes the ratio to
them too small.
"""
_MAX_RATIO: Final = 2.0
_RATIO_STEP: Final = 0.025
_RATIO_SAMPLES: Final = 4_000
_RIDGE: Final = 1e-3
_LEAST_LIGHT: Final = 0.02
"""The least light of a layer in a photo, as a share of its largest one: a polariser may leave
none.
"""
_TINY: Final = 1e-6
_MAX_OUTLIER: Final = 200.0
"""Larger differences, in units of noise, count as this: a lamp is no scene."""

Integers = NDArray[np.int_]


@final
@dataclass(frozen=True)
class TwoLayers:
    """Two layers, and how well they explain the photos."""

    constant: Floats
    """A in the reference photo, (h, w, 3)."""
    changing: Floats
    """B in the reference photo, (h, w, 3)."""
    strength: Floats
    """(K, h, w): h_k / g_k, divided by its largest mean of a photo."""
    constant_strength: Floats
    """(K, h, w, 3): the light of A in each photo, divided by that in the reference."""
    explained: float
    """The share of the changes between the photos that the second layer explains, 0..1."""
    negative: float
    """The share of the light of B that is negative, which no light is."""
    light: Doubles
    """The light of A and of B in each photo, of any unit, (2, K)."""
    contrast: float
    """How much h_k changes between the photos, divided by its largest value, 0..1."""

    def variation(self, exposures: Doubles | None) -> tuple[float, float]:
        """Returns how much the light of A and that of B changes: the standard deviations of the
        logarithms of their light, divided by the exposures.

        Args:
            exposures: those of EXIF, (K,); None: unknown.
        """
        light = self.light if exposures is None else self.light / exposures
        of_constant, of_changing = np.log(light).std(1)
        return float(of_constant), float(of_changing)

    def exchanged(self, reference: int) -> TwoLayers:
        """Returns the layers with each other's names.

        Args:
            reference: the index of the reference photo.
        """
        of_reference = np.maximum(self.strength[reference], np.float32(0.02))
        of_changing = (self.strength / of_reference)[..., None] * self.constant_strength
        return replace(
            self,
            constant=self.changing,
            changing=self.constant,
            constant_strength=np.maximum(of_changing, np.float32(0.05)),
            light=self.light[::-1],
        )


def two_layers(
    frames: Floats,
    gains: Doubles,
    reference: int,
    noise: float,
    way: Sequence[Sequence[int]] = WAYS[0],
) -> TwoLayers:
    """Returns the two layers of photos.

    Args:
        frames: (K, h, w, 3) aligned linear light.
        gains: (K, 3), those of T, from `fit_gains`.
        reference: the index of the reference frame.
        noise: see `noise_level`.
        way: one of `WAYS`.
    """
    fit = _Fit.of(frames, gains, noise)
    smooth = fit.smooth
    weights = _main_change(smooth, fit)
    changing = np.tensordot(weights, smooth, 1)
    constant = smooth.mean(0)
    for _ in range(2):
        changing = changing - fit.part_of(constant, changing, way[0]) * constant
        constant = constant - fit.part_of(changing, constant, way[0]) * changing
    for degrees in way[1:]:
        of_constant, of_changing = fit.strengths(constant, changing)
        constant, changing = _solved(smooth, of_constant, of_changing, reference)
        constant = constant - fit.part_of(changing, constant, degrees) * changing
        changing = changing - fit.part_of(constant, changing, degrees) * constant
    of_constant, of_changing = fit.strengths(constant, changing)
    explained = fit.explained(constant, changing, of_constant, of_changing)
    constant, changing = _solved(fit.sharp, of_constant, of_changing, reference)
    if of_changing.mean() < 0:
        of_changing, changing = -of_changing, -changing
    strength = (of_changing / np.maximum(of_constant, 0.05)).astype(np.float32)
    means = strength.mean((1, 2))
    strength = strength / np.float32(max(float(np.abs(means).max()), _TINY))
    means = strength.mean((1, 2))
    brightest = changing * of_changing.max(0)[..., None]
    of_light = gains.mean(1) * np.abs([of_constant.mean((1, 2)), of_changing.mean((1, 2))])
    return TwoLayers(
        light=np.maximum(of_light, _LEAST_LIGHT * of_light.max(1, keepdims=True)),
        constant=constant,
        changing=changing * of_changing[reference][..., None],
        strength=strength,
        constant_strength=_relative(of_constant, gains, reference),
        explained=explained,
        negative=float(
            np.maximum(-brightest - 2 * fit.noise, 0).sum() / (np.abs(brightest).sum() + _TINY)
        ),
        contrast=float((means.max() - means.min()) / max(means.max(), _TINY)),
    )


def _relative(of_constant: Floats, gains: Doubles, reference: int) -> Floats:
    relative = np.maximum(of_constant / of_constant[reference], np.float32(0.05))
    strength: Floats = (relative[..., None] * gains[:, None, None]).astype(np.float32)
    return strength


def _main_change(smooth: Floats, fit: _Fit) -> Floats:
    """Returns the weights of the photos (K,) whose sum shows most of the changes."""
    differences = ((smooth - smooth.mean(0)) / fit.noise)[:, fit.is_valid]
    differences = np.clip(differences, -_MAX_OUTLIER, _MAX_OUTLIER).astype(np.float64)
    weights: Floats = np.linalg.eigh(differences @ differences.T)[1][:, -1].astype(np.float32)
    is_bright = float(weights @ smooth.mean((1, 2, 3))) >= 0
    return weights if is_bright else -weights


def _solved(
    frames: Floats, of_constant: Floats, of_changing: Floats, reference: int
) -> tuple[Floats, Floats]:
    """Returns the layers that explain frames best, with the first one as in the reference frame."""
    a, b = of_constant[..., None], of_changing[..., None]
    aa, ab, bb = (a * a).sum(0), (a * b).sum(0), (b * b).sum(0)
    first, second = (a * frames).sum(0), (b * frames).sum(0)
    determinant = aa * bb - ab * ab + _TINY
    constant = (bb * first - ab * second) / determinant * a[reference]
    changing = (aa * second - ab * first) / determinant
    return constant.astype(np.float32), changing.astype(np.float32)


@final
@dataclass(frozen=True)
class _Fit:
    """What the regressions need."""

    sharp: Floats
    """(K, h, w, 3): the photos divided by their gains."""
    smooth: Floats
    """The same, blurred."""
    noise: Floats
    """(h, w, 3): of the blurred ones."""
    is_valid: NDArray[np.bool_]
    """(h, w, 3): not clipped."""
    terms: Floats
    """(h, w, n): those of the polynomials."""

    @classmethod
    def of(cls, frames: Floats, gains: Doubles, noise: float) -> _Fit:
        sharp = (frames / gains[:, None, None]).astype(np.float32)
        smooth = np.stack([cv2.GaussianBlur(frame, (0, 0), _BLUR_PX) for frame in sharp])
        return cls(
            sharp=sharp,
            smooth=smooth,
            noise=np.float32(noise) * np.sqrt(np.maximum(sharp.min(0), 0) + DARK),
            is_valid=frames.max(0) < CLIPPED,
            terms=_polynomial(*frames.shape[1:3]),
        )

    def part_of(self, layer: Floats, image: Floats, degrees: Sequence[int]) -> Floats:
        """Returns how much of the layer is in the image, (h, w, 1).

        Edges that disagree with the polynomial lose their weight: they are those of the image.

        Args:
            layer: (h, w, 3).
            image: (h, w, 3).
            degrees: those of the polynomials, from step to step. Before the degree 0, the start is
                the most frequent ratio of edges.
        """
        of_layer, of_image = gradients(layer), gradients(image)
        chosen = self._chosen(np.abs(of_layer), _CLEAR)
        scale = self._noise_at(chosen)
        known, wanted = (edges.ravel()[chosen] / scale for edges in (of_layer, of_image))
        matrix = known[:, None] * self._terms_at(chosen)
        of_terms = _degrees()
        factors = np.zeros(len(of_terms))
        if degrees[0] == 0:
            factors[0] = _frequent_ratio(known, wanted)
        for degree in degrees:
            used = np.flatnonzero(of_terms <= degree)
            for floor in _FLOORS:
                errors = np.abs(wanted - matrix @ factors)
                weights = 1 / np.maximum(errors, floor) ** (2 - _SPARSE)
                factors = np.zeros(len(of_terms))
                factors[used] = _solution(matrix[:, used], wanted, weights, of_terms[used])
        part: Floats = self.terms @ factors.astype(np.float32)
        return part[..., None]

    def strengths(self, constant: Floats, changing: Floats) -> tuple[Floats, Floats]:
        """Returns g and h, (K, h, w) each."""
        layers = [gradients(constant), gradients(changing)]
        found = [self.regression(gradients(frame), layers) for frame in self.smooth]
        return np.stack([each[0] for each in found]), np.stack([each[1] for each in found])

    def regression(self, edges: Floats, layers: Sequence[Floats]) -> list[Floats]:
        """Returns the smooth factors (h, w) of the edges of layers whose sum is these edges, with
        the least sum of absolute errors.

        Args:
            edges: (2, h, w, 3).
            layers: of the same shape each.
        """
        chosen = self._chosen(np.max([np.abs(layer) for layer in layers], axis=0), _VISIBLE)
        terms = self._terms_at(chosen)
        scale = self._noise_at(chosen)
        matrix = np.hstack([(layer.ravel()[chosen] / scale)[:, None] * terms for layer in layers])
        side = edges.ravel()[chosen] / scale
        degrees = np.tile(_degrees(), len(layers))
        weights = np.ones(len(side))
        factors = np.zeros(matrix.shape[1])
        for _ in range(_STEPS):
            factors = _solution(matrix, side, weights, degrees)
            weights = 1 / np.maximum(np.abs(side - matrix @ factors), 1)
        return [(self.terms @ part.astype(np.float32)) for part in factors.reshape(len(layers), -1)]

    def _chosen(self, strength: Floats, least: float) -> NDArray[np.intp]:
        """Returns the flat indices of edges that are stronger than noise by the factor `least`;
        those of weaker ones if they are too few. `strength` is (2, h, w, 3).
        """
        for factor in (least, _VISIBLE, -1.0):
            chosen = np.flatnonzero(self.is_valid[None] & (strength > factor * self.noise))
            if len(chosen) >= _MIN_SAMPLES:
                break
        return chosen[:: max(1, len(chosen) // _SAMPLES)]

    def _noise_at(self, chosen: NDArray[np.intp]) -> Doubles:
        """Returns the noise (n,) of edges at flat indices."""
        return self.noise.ravel()[chosen % self.noise.size].astype(np.float64)

    def _terms_at(self, chosen: NDArray[np.intp]) -> Doubles:
        """Returns the terms (n, m) of the polynomials at flat indices of edges."""
        place = chosen // 3 % (self.noise.size // 3)
        return self.terms.reshape(-1, self.terms.shape[-1])[place].astype(np.float64)

    def explained(
        self, constant: Floats, changing: Floats, of_constant: Floats, of_changing: Floats
    ) -> float:
        """Returns the share of the changes that the layers explain, 0..1."""
        mean = self.smooth.mean(0)
        before = after = 0.0
        for frame, a, b in zip(self.smooth, of_constant, of_changing, strict=True):
            left = frame - a[..., None] * constant - b[..., None] * changing
            for error, is_left in ((frame - mean, False), (left, True)):
                relative = (gradients(error) / self.noise)[:, self.is_valid]
                energy = float(np.minimum(np.square(relative), _MAX_OUTLIER).mean())
                after, before = (after + energy, before) if is_left else (after, before + energy)
        return max(0.0, 1 - after / (before + _TINY))


def _frequent_ratio(known: Doubles, wanted: Doubles) -> float:
    """Returns the most frequent ratio of edges (n,), given in units of noise."""
    step = max(1, len(known) // _RATIO_SAMPLES)
    known, wanted = known[::step], wanted[::step]
    width = np.maximum(_FLOORS[-1], _RATIO_STEP * np.abs(known))
    ratios = np.arange(-_MAX_RATIO, _MAX_RATIO, _RATIO_STEP)
    scores = [
        float((1 / (1 + np.square((wanted - ratio * known) / width))).sum()) for ratio in ratios
    ]
    return float(ratios[int(np.argmax(scores))])


def _solution(matrix: Doubles, side: Doubles, weights: Doubles, degrees: Integers) -> Doubles:
    """Returns the weighted least squares, with a small penalty for all terms of the polynomials but
    constant ones.
    """
    weighted = matrix * weights[:, None]
    normal = weighted.T @ matrix
    level = np.trace(normal) / len(normal) + _TINY
    normal += np.diag(level * (_RIDGE * (degrees > 0) + 1e-9))
    return np.asarray(np.linalg.solve(normal, weighted.T @ side), np.float64)


def _powers() -> list[tuple[int, int]]:
    """Returns the exponents of x and y in the terms of a polynomial."""
    return [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]


def _degrees() -> Integers:
    return np.array([i + j for i, j in _powers()])


def _polynomial(height: int, width: int) -> Floats:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = (2 * x + 1) / width - 1, (2 * y + 1) / height - 1
    terms: Floats = np.stack([x**i * y**j for i, j in _powers()], axis=-1)
    return terms
