"""Tells two scenes side by side, as a mirror beside a wall, from a reflection over a scene.

Two layers whose light is added also explain two scenes of which each place shows only one: each
layer is smooth where the other one is seen. Such smooth light is invented, and as a transmission it
is a smear. If the frames are explained nearly as well by two images side by side, whose border
moves with one of them, no place shows both layers, and there is nothing to separate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import Floats, JointModel, data_errors, to_pixels
from brewster.film.motion.model.kernels import OFFSET, sampling
from brewster.film.motion.resizing import resized

_SIDE_PX: Final = 160
"""The long side of the frames that are compared."""
_REGION_BLUR_PX: Final = 2.0
_BORDER_BLUR_PX: Final = 1.0
"""Of the changes whose comparison gives the region of each image, and of its border."""
_ERROR_BLUR_PX: Final = 1.5
"""Of the errors, with their signs: interpolation blurs the images side by side more than the
layers, which are optimised.
"""
_CROPPED: Final = 0.1
"""What few frames show, as a share of each side at each of its ends."""
_MIN_SEEN: Final = 0.5
"""Where fewer frames show a place of an image, the other image counts."""
_UNSEEN_ERROR: Final = 0.2
_MIN_WEIGHT: Final = 1e-3
_ROUNDS: Final = 2
"""In the second one, the places go to the image that explains them better."""
_MIN_AREA: Final = 0.1
_MAX_RATIO: Final = 1.33
"""Both scenes must have this share of the picture, and an error that is at most so many times that
of the layers. See dev/notes/burst.md.
"""
_MAX_RATIO_WITH_BORDER: Final = 1.6
_MIN_BORDER_RATIO: Final = 1.5
"""The same if the layers have errors near the border that are so many times those further away:
there, one scene hides the other.
"""
_NEAR_PX: Final = 9
_FAR_PX: Final = 21
"""The sides of the squares that widen the border."""
_PHOTO_BORDER: Final = 1 / 12
_TINY: Final = 1e-6

_Places = tuple[Floats, Floats]
"""Where each pixel of a frame lies in an image, in pixels: x and y, (h, w)."""


@final
@dataclass(frozen=True)
class SideBySide:
    """How well two images side by side explain the frames."""

    region: Floats
    """Where the second layer is seen alone, (h, w) in 0..1."""
    error: float
    """The mean error of the frames, as a difference of square roots of light."""
    layers_error: float
    """The same with both layers at each place."""
    border_ratio: float
    """The mean error of the layers near the border of the region, divided by that around it."""

    @property
    def nbytes(self) -> int:
        """The memory of its array."""
        return self.region.nbytes

    @property
    def is_likely(self) -> bool:
        """Whether no place shows both layers."""
        share = float(self.region.mean())
        is_divided = _MIN_AREA <= share <= 1 - _MIN_AREA
        has_border = self.border_ratio >= _MIN_BORDER_RATIO
        ratio = self.error / max(self.layers_error, _TINY)
        return is_divided and ratio <= (_MAX_RATIO_WITH_BORDER if has_border else _MAX_RATIO)


def compare_side_by_side(model: JointModel, frames: Floats, errors: Floats) -> SideBySide:
    """Compares two layers whose light is added with two images side by side, which have the motions
    of the layers.

    Args:
        model: one candidate with two layers.
        frames: (K, h, w, 4) linear light.
        errors: those of the layers, collected in the reference frame, (h, w).
    """
    gains = model.fixed_motion()[2][0].astype(np.float32)
    roots = np.stack(
        [
            np.sqrt(resized(frame[..., :3], _SIDE_PX) / gain + np.float32(OFFSET))
            for frame, gain in zip(frames, gains, strict=True)
        ]
    )
    size = roots.shape[1:3]
    motions = [
        [to_pixels(model.positions(0, layer, k, *size), size) for k in range(len(frames))]
        for layer in (0, 1)
    ]
    changes = [_blurred(_change(roots, motion), _REGION_BLUR_PX) for motion in motions]
    found = [_divided(roots, motions, border, changes[1] < changes[0]) for border in motions]
    error, region = min(found, key=lambda each: each[0])
    return SideBySide(
        region=region,
        error=error,
        layers_error=_layers_error(model, frames, size),
        border_ratio=_border_ratio(region, resized(errors, _SIDE_PX)),
    )


def _change(roots: Floats, motion: Sequence[_Places]) -> Floats:
    """Returns the mean absolute deviation of the frames, aligned by a motion, from their mean, (h,
    w).
    """
    ones = np.ones(roots.shape[1:3], np.float32)
    moved = [_collected(root, ones, [places]) for root, places in zip(roots, motion, strict=True)]
    images = np.stack([image for image, _ in moved])
    seen = np.stack([np.minimum(weight, 1) for _, weight in moved])[..., None]
    total = np.maximum(seen.sum(0), _MIN_WEIGHT)
    mean = (images * seen).sum(0) / total
    change: Floats = ((np.abs(images - mean) * seen).sum(0) / total).mean(-1)
    return change


def _collected(images: Floats, weights: Floats, places: Sequence[_Places]) -> tuple[Floats, Floats]:
    """Returns the weighted mean of images (K, h, w, 3) at their places, (h, w, 3), and the sum of
    their weights (K, h, w), (h, w).
    """
    images = images.reshape(-1, *images.shape[-3:])
    weights = weights.reshape(-1, *weights.shape[-2:])
    sums = np.zeros((4, *images.shape[1:3], 2), np.float32)
    for image, weight, (x, y) in zip(images, weights, places, strict=True):
        planes = [*np.moveaxis(image * weight[..., None], -1, 0), weight]
        for plane, out in zip(planes, sums, strict=True):
            sampling.collect(np.ascontiguousarray(plane), x, y, out)
    total = sums[3, ..., 0]
    mean = (sums[:3, ..., 0] / np.maximum(total, _MIN_WEIGHT)).astype(np.float32)
    return np.moveaxis(mean, 0, -1), total


def _divided(
    roots: Floats,
    motions: Sequence[Sequence[_Places]],
    border: Sequence[_Places],
    second: NDArray[np.bool_],
) -> tuple[float, Floats]:
    """Returns the error of two images side by side, and the region of the second one, (h, w).

    Args:
        roots: (K, h, w, 3), the square roots of the frames.
        motions: those of both images.
        border: that of the border between them.
        second: (h, w), where the second image is seen at the start.
    """
    for _ in range(_ROUNDS):
        region = _blurred(second.astype(np.float32), _BORDER_BLUR_PX)
        shares = np.stack([_moved(region, places) for places in border])
        pictures = []
        errors = []
        for motion, weights in zip(motions, (1 - shares, shares), strict=True):
            image, seen = _collected(roots, weights, motion)
            picture = np.stack([_moved(image, places) for places in motion])
            is_seen = np.stack([_moved(seen, places) for places in motion]) >= _MIN_SEEN
            error = np.where(is_seen, np.abs(picture - roots).mean(-1), _UNSEEN_ERROR)
            pictures.append((picture, is_seen[..., None]))
            errors.append(_collected(np.repeat(error[..., None], 3, -1), 0 * shares + 1, border)[0])
        first, other = (_blurred(error[..., 0], _REGION_BLUR_PX) for error in errors)
        second = other < first
    (one, is_one_seen), (two, is_two_seen) = pictures
    share = shares[..., None]
    predicted = (1 - share) * np.where(is_one_seen, one, two)
    predicted += share * np.where(is_two_seen, two, one)
    return _mean_error(predicted - roots), region


def _layers_error(model: JointModel, frames: Floats, size: tuple[int, int]) -> float:
    """Returns the mean error of the frames, which are compared at this size, with both layers."""
    gains = model.fixed_motion()[2][0].astype(np.float32)
    errors = [
        data_errors(model.frame_layers(k, *frame.shape[:2]).sum(0) * gains[k], frame[..., :3])
        for k, frame in enumerate(frames)
    ]
    return _mean_error(
        np.stack([cv2.resize(each, size[::-1], interpolation=cv2.INTER_AREA) for each in errors])
    )


def _border_ratio(region: Floats, errors: Floats) -> float:
    """Returns the mean error (h, w) near the border of a region, (h, w) in 0..1, divided by that in
    a wider band around it; 1 if there is no border.
    """
    near, far = (_border_band(region, side_px) for side_px in (_NEAR_PX, _FAR_PX))
    around = far & ~near
    if not near.any() or not around.any():
        return 1.0
    return float(errors[near].mean() / max(errors[around].mean(), _TINY))


def _border_band(region: Floats, side_px: int) -> NDArray[np.bool_]:
    """Returns a band around the border of a region, (h, w), without the border of the photo."""
    mask = (region > 0.5).astype(np.uint8)
    square = np.ones((side_px, side_px), np.uint8)
    band = np.zeros(mask.shape, bool)
    down, across = (round(_PHOTO_BORDER * side) for side in mask.shape)
    inner = slice(down, mask.shape[0] - down), slice(across, mask.shape[1] - across)
    band[inner] = (cv2.dilate(mask, square) != cv2.erode(mask, square))[inner]
    return band


def _mean_error(errors: Floats) -> float:
    """Returns the mean absolute error, from errors (K, h, w, 3) with signs."""
    down, across = (round(_CROPPED * side) for side in errors.shape[1:3])
    smooth = np.stack([_blurred(error, _ERROR_BLUR_PX) for error in errors])
    inner = smooth[:, down : len(smooth[0]) - down, across : smooth.shape[2] - across]
    return float(np.abs(inner).mean())


def _moved(image: Floats, places: _Places) -> Floats:
    moved: Floats = cv2.remap(image, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return moved


def _blurred(image: Floats, sigma_px: float) -> Floats:
    blurred: Floats = cv2.GaussianBlur(image, (0, 0), sigma_px)
    return blurred
