"""Finds where the glass ends: beyond a straight border, the reflection has no detail at all.

The optimisation gives each place some reflection, because motion does not show smooth light. Where
there is no glass, the photo is the transmission.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import Floats
from brewster.film.motion.model.kernels import OFFSET
from brewster.film.motion.registration.high_pass import high_pass
from brewster.film.motion.resizing import resized

_LONG_SIDE_PX: Final = 160
_DETAIL_PX: Final = 4.8
_BLUR_PX: Final = 1.3
_ANGLES: Final = np.radians(np.arange(-15, 16, 3))
"""Of a border, from upright or level."""
_PLACES: Final = np.arange(-0.45, 0.45, 0.01)
"""The distances of a border from the centre, as shares of the long side."""
_MIN_AREA: Final = 0.08
_MAX_AREA: Final = 0.85
"""Of what lies beyond the border, as shares of the photo."""
_GAP: Final = 0.015
_STRIP: Final = 0.005, 0.05
"""Beyond the border and a gap, the reflection has no detail; in a strip before it, it has."""
_BIN: Final = 0.03
_MIN_BINS: Final = 8
"""The strip has at least so many pieces of this length."""
_WITHOUT: Final = 0.95
_WITH: Final = 0.3
_MIN_CONTRAST: Final = 3.2
"""The detail that 70 % of the pieces of the strip exceed is so many times that which 95 % of the
pixels beyond the border do not exceed.
"""
_MAX_DETAIL: Final = 0.009
"""Of the pixels beyond the border, as a difference of square roots of light. See
dev/notes/burst.md.
"""
_LEAST_DETAIL: Final = 1e-3
_MAX_SHARE: Final = 0.1
"""If the measured reflection has a larger share of the light beyond the border, it is one without
detail, such as a sky.
"""
_FADE: Final = 0.005


def without_glass(layers: Floats) -> Floats:
    """Returns where the photo shows no glass, (h, w, 1) in 0..1.

    Args:
        layers: T and R of the reference frame, (2, h, w, 3) linear light.
    """
    small = np.stack([resized(layer, _LONG_SIDE_PX) for layer in layers])
    detail = _detail(small)
    height, width = detail.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    long_side = max(height, width)
    place = np.stack([columns - (width - 1) / 2, rows - (height - 1) / 2]) / long_side
    outside = np.zeros((height, width), bool)
    light = small.mean(-1)
    for side in range(4):
        beyond = _beyond(detail, place, side * np.pi / 2)
        if light[1][beyond].sum() <= _MAX_SHARE * light[:, beyond].sum():
            outside |= beyond
    faded = cv2.GaussianBlur(outside.astype(np.float32), (0, 0), _FADE * long_side)
    enlarged: Floats = cv2.resize(faded, layers.shape[2:0:-1])[..., None]
    return enlarged


def _detail(layers: Floats) -> Floats:
    """Returns the strength of the detail of R in the root of the light of both layers, (h, w)."""
    detail = high_pass(layers[1], _DETAIL_PX)
    energy = (np.square(detail) / (4 * (layers.sum(0) + np.float32(OFFSET)))).mean(-1)
    strength: Floats = np.sqrt(cv2.GaussianBlur(energy, (0, 0), _BLUR_PX))
    return strength


def _beyond(detail: Floats, place: Floats, direction: float) -> NDArray[np.bool_]:
    """Returns what lies beyond the clearest border on one side of the photo, (h, w).

    Args:
        detail: (h, w).
        place: the coordinates x and y of the pixels, (2, h, w).
        direction: that in which the outside lies, as an angle.
    """
    clearest = 0.0
    found = np.zeros(detail.shape, bool)
    has_detail = detail > _MAX_DETAIL
    for angle in direction + _ANGLES:
        across = np.cos(angle) * place[0] + np.sin(angle) * place[1]
        along = np.floor((np.cos(angle) * place[1] - np.sin(angle) * place[0]) / _BIN)
        pieces = (along - along.min()).astype(int)
        for border in _PLACES:
            beyond = across > border + _GAP
            count = np.count_nonzero(beyond)
            if not _MIN_AREA <= count / beyond.size <= _MAX_AREA:
                continue
            if np.count_nonzero(has_detail & beyond) > (1 - _WITHOUT) * count + 1:
                continue  # the quantile below takes longer, and would say the same
            without = max(float(np.quantile(detail[beyond], _WITHOUT)), _LEAST_DETAIL)
            if without > _MAX_DETAIL:
                continue
            near, far = _STRIP
            strip = (across < border - near) & (across > border - far)
            strongest = np.full(pieces.max() + 1, -1.0)
            np.maximum.at(strongest, pieces[strip], detail[strip])
            in_strip = strongest[strongest >= 0]
            if len(in_strip) < _MIN_BINS:
                continue
            contrast = float(np.quantile(in_strip, _WITH)) / without
            if contrast > max(clearest, _MIN_CONTRAST):
                clearest = contrast
                found = beyond
    return found
