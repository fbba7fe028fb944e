"""Leaves clipped light alone or removes it whole: lamps, sky and white things, and the reflections
that are as bright.

A clipped pixel received at least the light of white, so a model that subtracts a part of it turns a
lamp olive and a sky grey. A region of bright pixels that still stands out in the prediction keeps
the photo. If it disappears, the prediction is kept. On the development pairs, the least squares
weight of the predicted change is -.24 to .08 in regions that keep more than .3 of their contrast,
and .98 to 1.28 in the others.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from brewster.photo.mask import label_regions
from brewster.photo.srgb import to_encoded
from brewster.separation.assessment import encoded_change
from brewster.separation.guided_upsampling import Floats, GeneratedOverride, box_mean
from brewster.separation.predictor import Prediction

if TYPE_CHECKING:
    from jaxtyping import Bool, Float32

Labels = NDArray[np.int32]

_BRIGHT: Final = 0.95
"""A pixel with a brighter channel, sRGB-encoded, is bright: the other channels of a coloured lamp
are not clipped.
"""
_WHITES: Final = ((0.93, 1.0), (0.78, 0.05))
"""Pairs: a pixel whose darkest channel is above the first value, sRGB-encoded, is bright, too; the
largest area of a region, divided by that of the photo. A wide area that is not clipped is a wall or
a veil rather than a lamp.
"""
_MIN_CHANGE: Final = 0.02
"""Smaller predicted changes, sRGB-encoded, are not visible. Without them, a reflection on a wall is
its own region.
"""
_MAX_CONTRAST: Final = 0.28
"""A region disappears in the prediction if it keeps at most this fraction of its contrast to its
surroundings, in linear light. Chosen on development pairs, on which .25 to .30 are equal.
"""
_MIN_CONTRAST: Final = 0.02
"""A region with less contrast in the photo, in linear light, has no surroundings in which it could
disappear.
"""
_SURROUNDINGS_PX: Final = (3, 8)
"""The surroundings of a region are the pixels between these distances. The nearer ones have the
glow of a lamp.
"""
_HALO_PX: Final = 3
"""A kept region is enlarged by the radius of the filter that smooths its edges (2 px), so that its
own pixels are kept whole, and by one pixel, because reduced photos have darker pixels at the edges
of a lamp.
"""
_MIN_MARKED: Final = 0.5
"""A clipped region of which a smaller share is marked as reflection is a lamp that a stroke
crosses.
"""
_MAX_GLINT: Final = 0.005
"""The area of the largest glint, divided by that of the photo. Larger clipped regions are lamps,
windows and sky.
"""
_GLINT_HALO_PX: Final = 2
_GLINT_RADII_PX: Final = (4, 8, 16, 32, 64)
"""The windows in which the transmission around a glint is averaged; each has 1/16 of the weight of
the smaller one.
"""
_EDGE_RADIUS_PX: Final = 16
_EDGE_EPSILON: Final = 1e-3
_EDGE_GAIN: Final = 1.5
"""Radius, regularisation and contrast of the guided filter for the edges of kept regions that are
not clipped.
"""


def keep_clipped_light(model_input: Float32[Floats, "h w c"], prediction: Prediction) -> Prediction:
    """Returns the prediction without the changes of bright regions that it does not remove whole,
    except marked ones. Of clipped light, only small glints can be marked. They do not become darker
    than their surroundings.

    Args:
        model_input: the largest input of the model, (h, w, 3) or (h, w, 5), see `Predictor`.
        prediction: the prediction at this input scale.
    """
    photo = model_input[..., :3]
    is_marked = np.asarray((model_input[..., 3:4] > 0.5).any(axis=2))
    transmission = np.clip(photo + prediction.change, 0, 1)
    encoded = to_encoded(photo)
    darkest, brightest = (
        reduce(pick, np.moveaxis(encoded, 2, 0)) for pick in (np.minimum, np.maximum)
    )
    is_changed = encoded_change(photo, transmission) >= _MIN_CHANGE
    is_clipped = (brightest > _BRIGHT) | (darkest > _WHITES[0][0])
    is_glint = _marked_glints(is_clipped, is_marked)
    is_released = is_marked & (is_glint | ~is_clipped)
    is_kept = np.zeros(photo.shape[:2], np.bool_)
    for white, max_share in _WHITES:
        is_bright = (brightest > _BRIGHT) | (darkest > white)
        regions = label_regions(is_bright & is_changed)
        is_half_removed = _is_half_removed(regions, photo, transmission, max_share)
        is_half_removed[regions[is_released]] = False
        is_kept |= is_half_removed[_grow(regions, _HALO_PX)]
    if is_glint.any():
        prediction = _without_pits(photo, prediction, is_glint)
    if not is_kept.any():
        return prediction
    guide = encoded.mean(axis=2, keepdims=True)
    kept = is_kept[..., None].astype(np.float32)
    clipped = _grow((is_kept & (brightest > _BRIGHT)).astype(np.int32), _HALO_PX)[..., None].astype(
        np.float32
    )
    weight = 1 - np.maximum(box_mean(clipped), _with_edges_of(guide, kept))
    override = prediction.override
    return replace(
        prediction,
        change=prediction.change * weight,
        reflection=prediction.reflection * weight,
        override=override and replace(override, weight=override.weight * weight),
    )


def _marked_glints(
    is_clipped: Bool[NDArray[np.bool_], "h w"], is_marked: Bool[NDArray[np.bool_], "h w"]
) -> Bool[NDArray[np.bool_], "h w"]:
    """Returns the small clipped regions of which the larger part is marked as reflection."""
    if not is_marked.any():
        return is_marked
    regions = label_regions(is_clipped)
    areas = np.bincount(regions.ravel())
    marked = np.bincount(regions[is_marked], minlength=len(areas))
    is_glint = (marked > _MIN_MARKED * areas) & (areas <= _MAX_GLINT * regions.size)
    is_glint[0] = False
    return is_glint[regions]


def _without_pits(
    photo: Floats, prediction: Prediction, is_glint: Bool[NDArray[np.bool_], "h w"]
) -> Prediction:
    """Returns the prediction with glints that are at least as bright as the mean transmission
    around them.

    There, the low-resolution transmission replaces the result of guided upsampling, which gives
    glints dark rims.
    """
    grown = _grow(is_glint.astype(np.int32), _GLINT_HALO_PX)[..., None]
    weight = box_mean(grown.astype(np.float32), 1)
    transmission = np.clip(photo + prediction.change, 0, 1)
    is_outside = (weight == 0).astype(np.float32)
    light = np.zeros_like(photo)
    share = np.full_like(weight, np.finfo(np.float32).tiny)
    for step, radius in enumerate(_GLINT_RADII_PX):
        scale = np.float32(16.0**-step)
        light += scale * box_mean(transmission * is_outside, radius)
        share += scale * box_mean(is_outside, radius)
    transmission = np.maximum(transmission, np.minimum(photo, light / share))
    change = transmission - photo
    reflection = photo - transmission
    return replace(
        prediction,
        change=prediction.change + weight * (change - prediction.change),
        reflection=prediction.reflection + weight * (reflection - prediction.reflection),
        override=GeneratedOverride(transmission, weight),
    )


def _with_edges_of(guide: Floats, mask: Floats) -> Floats:
    """Returns the mask in 0..1 as a local linear function of the guide, (h, w, 1): a guided filter
    (He et al. 2013).

    A region that ends within a bright veil, where the photo has no edge, ends gradually, so that it
    has no outline.
    """
    radius = _EDGE_RADIUS_PX
    mean = box_mean(guide, radius)
    variance = box_mean(guide * guide, radius) - mean**2 + np.float32(_EDGE_EPSILON)
    slope = (box_mean(guide * mask, radius) - mean * box_mean(mask, radius)) / variance
    offset = box_mean(mask, radius) - slope * mean
    filtered = box_mean(slope, radius) * guide + box_mean(offset, radius)
    edged: Floats = np.clip(0.5 + _EDGE_GAIN * (filtered - np.float32(0.5)), 0, 1)
    return edged


def _is_half_removed(
    regions: Labels, photo: Floats, transmission: Floats, max_share: float
) -> Bool[NDArray[np.bool_], " labels"]:
    """Returns for each label whether the region stands out in the photo and in the transmission."""
    near, far = (_grow(regions, distance) for distance in _SURROUNDINGS_PX)
    surroundings = np.where(near == 0, far, 0)
    count = int(regions.max()) + 1
    areas = np.bincount(regions.ravel())

    def contrast(image: Floats) -> NDArray[np.float64]:
        light = reduce(np.maximum, np.moveaxis(image, 2, 0))
        inside, around = (
            np.bincount(labels.ravel(), light.ravel(), count)
            / np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
            for labels in (regions, surroundings)
        )
        return inside - around

    before = contrast(photo)
    after = contrast(transmission)
    is_half_removed = (before < _MIN_CONTRAST) | (after > _MAX_CONTRAST * before)
    is_half_removed &= areas <= max_share * regions.size
    is_half_removed[0] = False
    return is_half_removed


def _grow(regions: Labels, radius: int) -> Labels:
    """Returns the labels with each region enlarged by a number of pixels; where two regions meet,
    the larger label.
    """
    rows, columns = regions.shape
    padded = np.pad(regions, radius)
    wide = reduce(np.maximum, (padded[:, i : i + columns] for i in range(2 * radius + 1)))
    grown = reduce(np.maximum, (wide[i : i + rows] for i in range(2 * radius + 1)))
    return np.where(regions > 0, regions, grown)
