"""Separates aligned photos of one scene in changing light.

    photo_k = g_k (T + R_k)     linear light; T is the same in all photos, R_k >= 0 changes

1. Gains: the most frequent ratio of edges is that of T (gains.py).
2. Evidence: without a change beyond noise, there is nothing to measure.
3. Two layers: R_k = m_k R with smooth m_k, a polariser (layers.py). T is what the photos
   share after the regression of its edges on those of R.
4. Otherwise, a cloth, people, other scenes: T is the least light of all photos, of which noise
   makes no minimum. It is an upper bound of T in any case.
5. What no photo shows without reflection is in the result of 3 or 4 as in a single photo, and the
   model for single photos removes it from there, but no more than a small part of R where light
   changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import cv2
import numpy as np

from brewster.film.light.gains import CLIPPED, DARK, Doubles, Floats, fit_gains, noise_level
from brewster.film.light.layers import WAYS, TwoLayers, two_layers
from brewster.film.motion.resizing import resized
from brewster.film.motion.threads import POOL
from brewster.photo.srgb import to_encoded
from brewster.separation.burst_report import LightKind

_MIN_PHOTOS: Final = 3
"""Two layers explain any two photos."""
_MIN_EXPLAINED: Final = 0.58
"""The smallest share of the changes that two layers must explain."""
_CONTRASTS: Final = 0.36, 1.02
"""How much the strength of one reflection may change, as a share of its largest one. Less is seen
where the fit is wrong, and more is negative light.
"""
_MAX_NEGATIVE: Final = 0.05
"""The largest share of negative light in the second layer: noise of JPEG leaves up to .04."""
_MAX_EXCESS: Final = 0.02
"""The largest share of the light of T above its bound. Of the simulations by which these limits
were chosen, a polariser leaves at most 0.016, and changing scenes at least 0.023.
"""
_MAX_VARIATION: Final = 0.6
"""The largest change of the light of T, the standard deviation of its logarithm: an automatic
exposure follows R.
"""
_STEADY: Final = 0.2
"""The layer whose light changes less is T, unless both change less than this: at small angles, the
exposure changes them more than the polariser does. Exposures of EXIF are taken out.
"""
_FARTHER: Final = 5 / 3
"""If one layer is farther than the other from T of the single photo by this factor, it is R: an
automatic exposure that follows bright light of R makes T change more. It was never less than 1.75
where the names by the light were wrong, and never more than 1.56 where they were right.
"""
_CLEARLY: Final = 1.5
"""Relative to the exposures of EXIF, the light of R changes more by this factor if the names are
certain.
"""
_CHANGE_PX: Final = 3.0
"""The blur after which a change is compared with noise."""
_CHANGED: Final = 5.0
"""A visible change, in units of the noise that the blur leaves."""
_VISIBLE: Final = 0.008
"""A visible change, as a difference of square roots of light."""
MIN_CHANGED_AREA: Final = 0.025
"""A smaller changed area is the work of JPEG."""
_UNCHANGED_ERROR: Final = 0.01
"""Where no light changes, T is that of a single photo."""
_HDR_STOPS: Final = 0.8
"""Gains that differ by this many stops are a series of exposures."""
_MAX_LEFT: Final = 0.1
"""The largest part of R that all photos share where light changed. Of .07 to .5, about the best for
14 cloths and 12 scenes, with little between .07 and .2.
"""
_LITTLE: Final = 0.1, 0.2
"""If less light changes than the first share of all, most of R is in all photos, and the model for
single photos removes it as from one. From the second share on, it is limited.
"""
_AROUND: Final = 0.05
"""The standard deviation of the blur of R, as a share of the width."""
_CHOICE_PX: Final = 320
"""The long side of the photos in which the start of the fit is chosen."""
_DARK_LIGHT: Final = 1e-6
"""Added to mean light, which may be 0."""
_BLUR_PX: Final = 0.7
"""Of the photos whose light is compared for the minimum."""


@final
@dataclass(frozen=True)
class LightSolution:
    """The layers of the reference photo, measured from the change of the light."""

    layers: Floats
    """T and R, (2, h, w, 3) linear light, with the exposure of the reference."""
    kind: LightKind
    changed_area: float
    """The share of the photo in which light changed, 0..1."""
    errors: Floats
    """(h, w): of the photos, as differences of square roots of light: their noise, and more where
    no light changed.
    """
    explained: float
    """The share of the changes that one mirrored scene explains, 0..1."""
    contrast: float
    """How much the strength of R changes, as a share of its largest one, 0..1. Of a changing
    reflection, 0 if it changes little and 1 if it seems to vanish.
    """
    are_names_certain: bool = True
    """Whether it is certain which of two layers is T."""


def solve_light(
    frames: Floats,
    reference: int,
    *,
    single: Floats | None = None,
    exposures: Doubles | None = None,
    refine: Callable[[Floats], Floats] = lambda light: light,
) -> LightSolution:
    """Returns the layers of the reference frame.

    Args:
        frames: (K, h, w, 3) aligned linear light, 0..1.
        reference: the index of the reference frame.
        single: T of the reference frame from the model for single photos, (h, w, 3), by which the
            layers of one reflection are named; None: only by how their light changes.
        exposures: see `fit_gains`.
        refine: returns T of light (h, w, 3) as the model for single photos predicts it.
    """
    gains = fit_gains(frames, reference, exposures)
    names = _Names(single, exposures)
    scaled = (frames / gains[:, None, None]).astype(np.float32)
    scaled = _without_clipped(frames, scaled)
    noise = noise_level(scaled)
    changed = changed_places(scaled, frames, noise)
    area = float((changed > 0.5).mean())
    photo = frames[reference]
    if area < MIN_CHANGED_AREA:
        spread = float(np.ptp(np.log2(gains.mean(1))))
        kind: LightKind = "exposure" if spread > _HDR_STOPS else "nothing"
        layers = np.stack([photo, np.zeros_like(photo)])
        return LightSolution(layers, kind, area, expected_errors(changed, noise), 0.0, 0.0)
    pair = None
    if len(frames) >= _MIN_PHOTOS:
        pair = _one_reflection(frames, gains, reference, noise, names)
    if pair:
        scaled = _scaled_by(pair, frames)
        measured = np.clip(pair.constant, 0, 1)
        contrast = pair.contrast
        known = changed
    else:
        measured = shared_light(scaled, noise)
        contrast = _vanishing(measured, scaled)
        known = changed * np.float32(contrast)
    most_left = _most_left(measured, scaled, known)
    transmission = measured - np.minimum(measured - refine(measured), most_left)
    transmission = np.minimum(transmission, _bound(scaled, noise))
    transmission = _with_clipped(transmission, frames, reference)
    transmission = np.clip(transmission, 0, None).astype(np.float32)
    layers = np.stack([transmission, np.maximum(photo - transmission, 0)])
    return LightSolution(
        layers=layers,
        kind="one reflection" if pair else "changing reflection",
        changed_area=area,
        errors=expected_errors(changed, noise),
        explained=pair.explained if pair else 0.0,
        contrast=contrast,
        are_names_certain=pair is None or names.are_certain(pair),
    )


def shared_light(scaled: Floats, noise: float) -> Floats:
    """Returns the least light of all photos, (h, w, 3): the mean of the photos that have it.

    Args:
        scaled: (K, h, w, 3), the photos divided by their gains.
        noise: see `noise_level`.
    """
    smooth = np.stack([cv2.GaussianBlur(frame, (0, 0), _BLUR_PX) for frame in scaled])
    least = smooth.min(0)
    deviation = np.float32(noise) * np.sqrt(np.maximum(least, 0) + DARK)
    excess = ((smooth - least) / deviation).mean(-1, keepdims=True)
    squares = np.square(excess)
    weights = np.exp((squares.min(0) - squares) / 2)
    light: Floats = (weights * scaled).sum(0) / weights.sum(0)
    return light


def _vanishing(measured: Floats, scaled: Floats) -> float:
    """Returns whether R is not in all photos, 0..1: only then the least light is T.

    Args:
        measured: the least light, (h, w, 3).
        scaled: (K, h, w, 3), the photos divided by their gains.
    """
    share = float((scaled.max(0) - measured).mean() / (measured.mean() + _DARK_LIGHT))
    return float(np.interp(share, _LITTLE, (0, 1)))


def _most_left(measured: Floats, scaled: Floats, changed: Floats) -> Floats:
    """Returns the most light of R that the measured T may still hold, (h, w, 3): a small part of
    what was seen of R around it, so that the model takes no haze from a T that has none. Where no
    light changed, nothing is known of R: all of it.

    Args:
        measured: T, (h, w, 3).
        scaled: (K, h, w, 3), the photos divided by the light of T.
        changed: (h, w, 1), 0..1: where light changed of which something is known of R.
    """
    sigma = _AROUND * measured.shape[1]
    seen = np.maximum(scaled.max(0) - measured, 0).mean(-1)
    known = cv2.GaussianBlur(changed[..., 0], (0, 0), sigma)[..., None]
    part = np.float32(_MAX_LEFT) * cv2.GaussianBlur(seen, (0, 0), sigma)[..., None]
    most: Floats = known * part + (1 - known) * measured
    return most


def _with_clipped(transmission: Floats, frames: Floats, reference: int) -> Floats:
    """Returns T with the light of the reference photo where all photos are clipped: its true light,
    and by how much it changed, is unknown.
    """
    is_unknown = (frames > CLIPPED).any(-1).all(0).astype(np.float32)
    weight = cv2.GaussianBlur(is_unknown, (0, 0), 1)[..., None]
    light: Floats = transmission + weight * (frames[reference] - transmission)
    return light


@final
@dataclass(frozen=True)
class _Names:
    """What tells which of two layers is T."""

    single: Floats | None
    """T of the reference photo from the model for single photos, (h, w, 3); None: unknown."""
    exposures: Doubles | None
    """Those of EXIF, (K,); None: unknown."""

    def resized(self, side: int) -> _Names:
        """Returns the same for photos with this long side in px."""
        single = None if self.single is None else resized(self.single, side)
        return replace(self, single=single)

    def distance(self, layer: Floats) -> float:
        """Returns that of a layer (h, w, 3) to T of the single photo; 0 if that is unknown."""
        return 0.0 if self.single is None else _distance(layer, self.single)

    def named(self, pair: TwoLayers, reference: int) -> TwoLayers:
        """Returns the layers, of which the first one is T.

        Relative to the exposures of EXIF, the light of T is the same in all photos. Without them,
        T is the layer that is much nearer to T of the single photo; if none is, the one whose light
        changes less.
        """
        return pair.exchanged(reference) if self._are_wrong(pair) else pair

    def _are_wrong(self, pair: TwoLayers) -> bool:
        """Returns whether the first layer is R."""
        of_constant, of_changing = pair.variation(self.exposures)
        if self.exposures is not None:
            return of_constant > of_changing
        distance, other = self.distance(pair.constant), self.distance(pair.changing)
        if max(distance, other) > _FARTHER * min(distance, other):
            return distance > other
        return of_constant > max(of_changing, _STEADY)

    def are_certain(self, pair: TwoLayers) -> bool:
        """Returns whether all that is known agrees with the names of two layers, or the one cue
        that is decisive.
        """
        of_transmission, of_reflection = pair.variation(self.exposures)
        if self.exposures is not None:
            return of_reflection > _CLEARLY * of_transmission
        distance, other = self.distance(pair.constant), self.distance(pair.changing)
        if other > _FARTHER * distance:
            return True
        return distance <= other and of_transmission < of_reflection


def _one_reflection(
    frames: Floats, gains: Doubles, reference: int, noise: float, names: _Names
) -> TwoLayers | None:
    """Returns the two layers, or None if the strength of one mirrored scene does not explain the
    photos.

    The strongest edges may be those of R. Therefore the fit also starts with equal gains, and in
    two ways. Of the results that are possible, the best one violates the bounds of light least, and
    is near T of the single photo. It is chosen in reduced photos.
    """
    side = min(_CHOICE_PX, max(frames.shape[1:3]))
    small = np.stack([resized(frame, side) for frame in frames])
    small_names = names.resized(side)
    equal = np.ones_like(gains)
    starts = [(equal, WAYS[0]), (gains, WAYS[0]), (equal, WAYS[1])]

    def cost(start: tuple[Doubles, Sequence[Sequence[int]]]) -> float:
        own_gains, way = start
        pair = small_names.named(two_layers(small, own_gains, reference, noise, way), reference)
        violation = _violation(pair, small, noise, names.exposures)
        return violation + small_names.distance(pair.constant)

    costs = list(POOL.map(cost, starts))
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    own_gains, way = starts[best]
    return names.named(two_layers(frames, own_gains, reference, noise, way), reference)


def _distance(light: Floats, single: Floats) -> float:
    """Returns the root mean square difference of light (h, w, 3) to T of the single photo, encoded,
    after a gain for each channel.
    """
    light = np.clip(light, 0, 1)
    gains = (light * single).sum((0, 1)) / np.maximum((light * light).sum((0, 1)), _DARK_LIGHT)
    difference = to_encoded(np.clip(gains * light, 0, 1)) - to_encoded(np.clip(single, 0, 1))
    return float(np.sqrt(np.square(difference).mean()))


def _violation(pair: TwoLayers, frames: Floats, noise: float, exposures: Doubles | None) -> float:
    """Returns the share of impossible light in two layers, infinite if there is too much of it or
    they do not explain the photos.
    """
    transmission = np.clip(pair.constant, 0, 1)
    above = np.maximum(transmission - _bound(_scaled_by(pair, frames), noise), 0)
    excess = float(above.mean() / (transmission.mean() + _DARK_LIGHT))
    is_possible = (
        pair.explained >= _MIN_EXPLAINED
        and pair.negative <= _MAX_NEGATIVE
        and pair.variation(exposures)[0] <= _MAX_VARIATION
        and _CONTRASTS[0] <= pair.contrast <= _CONTRASTS[1]
        and excess <= _MAX_EXCESS
    )
    return excess + pair.negative if is_possible else np.inf


def _scaled_by(pair: TwoLayers, frames: Floats) -> Floats:
    """Returns the photos divided by the light of T, if that changes as the light of A does."""
    return _without_clipped(frames, frames / pair.constant_strength)


def _without_clipped(frames: Floats, scaled: Floats) -> Floats:
    """Returns scaled photos in which clipped light, which may have been more, is never the least
    if another photo is not clipped there.
    """
    is_clipped = (frames > CLIPPED).any(-1, keepdims=True)
    brightest = scaled.max(0)
    is_replaced = is_clipped & ~is_clipped.all(0)
    return np.where(is_replaced, np.maximum(scaled, brightest), scaled)


def _bound(scaled: Floats, noise: float) -> Floats:
    """Returns the most light that T can have: that of each photo, up to noise."""
    least = scaled.min(0)
    bound: Floats = least + 4 * np.float32(noise) * np.sqrt(np.maximum(least, 0) + DARK)
    return bound


def changed_places(scaled: Floats, frames: Floats, noise: float) -> Floats:
    """Returns where the light changes beyond noise, (h, w, 1) in 0..1. Clipped light does not
    count, nor does light near it, into which it is blurred.
    """
    margin = 2 * round(_CHANGE_PX) + 1
    brightest = cv2.dilate(frames.max((0, -1)), np.ones((margin, margin), np.uint8))
    is_valid = (brightest < CLIPPED)[..., None]
    roots = np.stack(
        [
            cv2.GaussianBlur(np.sqrt(np.maximum(frame, 0) + DARK), (0, 0), _CHANGE_PX)
            for frame in scaled
        ]
    )
    change = (roots.max(0) - roots.min(0)).max(-1, keepdims=True) * is_valid
    limit = max(_CHANGED * noise / (2 * _CHANGE_PX * np.sqrt(np.pi)), _VISIBLE)
    changed: Floats = np.clip(change / limit - 1, 0, 1)
    return changed


def expected_errors(changed: Floats, noise: float) -> Floats:
    """Returns the expected errors of T, see `LightSolution`."""
    errors: Floats = np.float32(noise) + (1 - changed[..., 0]) * np.float32(_UNCHANGED_ERROR)
    return errors
