"""Tells two scenes that became one layer, as a wall and what a door or a mirror beside it shows.

Such scenes have three motions, which two layers do not explain: the largest scene and another one
become T, and their motion is a compromise. Where the reflection has more detail than T, the errors
are larger then, and the frames ask T for another motion, but not the reflection. Where T is one
scene, either both motions are right, or both are uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import (
    Doubles,
    Floats,
    JointModel,
    data_errors,
    to_pixels,
)
from brewster.film.motion.model.kernels import OFFSET
from brewster.film.motion.registration.high_pass import high_pass
from brewster.film.motion.resizing import resized

_SIDE_PX: Final = 160
"""The long side of the frames that are compared."""
_DETAIL_BLUR_PX: Final = 3.0
"""Of the smooth light; the rest is detail."""
_ENERGY_BLUR_PX: Final = 4.0
_MIN_DETAIL: Final = 0.006
"""Of a reflection, as a difference of square roots of light."""
_PHOTO_BORDER: Final = 1 / 12
_MIN_AREA: Final = 0.02
"""Of the region, as a share of the picture without its border: fewer pixels show no motion."""
_MIN_SHIFT_PX: Final = 0.015
_MIN_RATIO: Final = 2.5
_MIN_DEVIATIONS: Final = 4.0
_MIN_ERROR_RATIO: Final = 1.35
"""In this region, the frames move T by this length, by so many times that of R, and by so many of
its standard deviations; and their errors are so many times those elsewhere. See dev/notes/burst.md.
"""
_NOISE: Final = 0.01
"""Larger errors of a frame count less."""
_TINY: Final = 1e-6


@final
@dataclass(frozen=True)
class MixedScenes:
    """How the frames would move the layers where the reflection has more detail than T."""

    area: float
    """The share of this region in the picture, without its border."""
    shift_px: float
    """How far they would move T, on average over the frames, in pixels of a frame that is 160
    pixels wide.
    """
    reflection_shift_px: float
    """The same for the reflection."""
    deviations: float
    """The shift of T in standard deviations, on average over the frames."""
    error_ratio: float
    """The median error of the frames in this region, divided by that elsewhere."""

    @property
    def is_likely(self) -> bool:
        """Whether T mixes two scenes."""
        return (
            self.area >= _MIN_AREA
            and self.shift_px >= _MIN_SHIFT_PX
            and self.shift_px >= _MIN_RATIO * self.reflection_shift_px
            and self.deviations >= _MIN_DEVIATIONS
            and self.error_ratio >= _MIN_ERROR_RATIO
        )


def find_mixed_scenes(model: JointModel, frames: Floats, errors: Floats) -> MixedScenes:
    """Measures how the frames would move the layers.

    Args:
        model: a single candidate, T first and the reflection last.
        frames: (K, h, w, 4) linear light.
        errors: those of the frames, collected in the reference frame, (h, w).
    """
    gains = model.fixed_motion()[2][0].astype(np.float32)
    region = _region(_small_layers(model, model.reference, frames))
    inner = _inner(region.shape)
    area = float(region[inner].mean())
    if not _MIN_AREA <= area < 1:
        return MixedScenes(area, 0.0, 0.0, deviations=0.0, error_ratio=1.0)
    small = resized(errors, _SIDE_PX)[inner]
    elsewhere = float(np.median(small[~region[inner]]))
    error_ratio = float(np.median(small[region[inner]])) / max(elsewhere, _TINY)
    size = region.shape
    found = []
    for k, frame in enumerate(frames):
        if k == model.reference:
            continue
        layers = _small_layers(model, k, frames) * gains[k]
        x, y = to_pixels(model.positions(0, 0, k, *size), size)
        moved = cv2.remap(region.astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.5
        found.append(_shifts(layers, resized(frame[..., :3], _SIDE_PX), moved))
    shift_px, reflection_shift_px, deviations = np.mean(found, axis=0).tolist()
    return MixedScenes(area, shift_px, reflection_shift_px, deviations, error_ratio)


def _small_layers(model: JointModel, k: int, frames: Floats) -> Floats:
    """Returns the layers as a frame shows them, T and R (2, h, w, 3), small."""
    layers = model.frame_layers(k, *frames.shape[1:3])
    return np.stack([resized(layer, _SIDE_PX) for layer in layers])


def _region(layers: Floats) -> NDArray[np.bool_]:
    """Returns where the reflection has more detail than T, (h, w), without the border.

    Args:
        layers: T and R of the reference frame, (2, h, w, 3).
    """
    light = layers.mean(-1)
    root = np.sqrt(light.sum(0) + OFFSET)
    energies = []
    for layer in light:
        detail = high_pass(layer, _DETAIL_BLUR_PX) / (2 * root)
        energies.append(np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), _ENERGY_BLUR_PX)))
    is_stronger = (energies[1] > energies[0]) & (energies[1] > _MIN_DETAIL)
    region: NDArray[np.bool_] = np.zeros_like(is_stronger)
    inner = _inner(region.shape)
    region[inner] = is_stronger[inner]
    return region


def _inner(size: tuple[int, ...]) -> tuple[slice, slice]:
    """Returns the rows and the columns of a picture (h, w) without its border."""
    down, across = (round(_PHOTO_BORDER * side) for side in size)
    return slice(down, size[0] - down), slice(across, size[1] - across)


def _shifts(layers: Floats, frame: Floats, region: NDArray[np.bool_]) -> Sequence[float]:
    """Returns the lengths of the shifts of T and of R in a region, in pixels, which explain the
    frame best, and that of T in standard deviations.

    Args:
        layers: T and R as the frame shows them, with its gain, (2, h, w, 3).
        frame: (h, w, 3) linear light.
        region: (h, w).
    """
    total = layers.sum(0)
    errors = data_errors(total, frame)[region].ravel().astype(np.float64)
    weights = 1 / np.sqrt(np.square(errors) + _NOISE**2)
    variance = float(np.mean(weights * np.square(errors))) if len(errors) else 0.0
    root = np.sqrt(total + OFFSET)
    lengths = []
    for layer in layers:
        down, across = (
            (slope / (2 * root))[region].ravel() for slope in np.gradient(layer, axis=(0, 1))
        )
        slopes: Doubles = np.stack([across, down]).astype(np.float64)
        matrix = np.einsum("in,n,jn->ij", slopes, weights, slopes) + _TINY * np.eye(2)
        shift = np.linalg.solve(matrix, np.einsum("in,n,n->i", slopes, weights, errors))
        # The three channels of a pixel have one error
        deviations = np.sqrt(shift @ matrix @ shift / (3 * variance + _TINY))
        lengths.append((float(np.linalg.norm(shift)), float(deviations)))
    (shift_px, deviations), (reflection_shift_px, _) = lengths
    return shift_px, reflection_shift_px, deviations
