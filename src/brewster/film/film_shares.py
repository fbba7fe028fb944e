"""Carries the measured layers of a frame to the still: as shares of the light.

The still has another tone than the film, and is merged from several exposures. Therefore the layers
themselves would not fit it, but their shares of its light do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import (
    Doubles,
    Floats,
    pixel_grid,
    to_pixels,
    transformed,
)
from brewster.film.motion.naming import hinted_region
from brewster.film.motion.solution import Solution

_MIN_LIGHT: Final = 2e-3
"""Where both measured layers together have less light, their shares are noise."""
_BORDER: Final = 0.02
"""Outside of the frame, its shares fade over this share of its size to those of the photo alone."""
_SMOOTH_HINTS_PX: Final = 4


def carried(solution: Solution, homography: Doubles, still: Floats, prior: Floats) -> Solution:
    """Returns the solution of a frame of the film for the still, which has the same shares of both
    layers in its light.

    Args:
        solution: the layers of the frame, (2, h, w, 3) linear light.
        homography: (3, 3), from the still to the frame, in normalised coordinates.
        still: (H, W, 3) linear light.
        prior: T of the still from the model alone, (H, W, 3).

    Returns:
        The layers at the size (h, w). What the frame does not show is that of the prior.
    """
    width = solution.measured.shape[2]
    size = max(8, round(width * still.shape[0] / still.shape[1])), width
    still, prior = (
        cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA) for image in (still, prior)
    )
    prior_share = np.clip(prior / np.maximum(still, _MIN_LIGHT), 0, 1)
    frame_share = moved(transmission_share(solution.measured), homography, size)
    known = coverage(homography, size) * moved(_is_lit(solution.measured), homography, size)
    share = prior_share + known * (frame_share - prior_share)
    errors = moved(solution.frame_errors[..., None], homography, size)[..., 0]
    return replace(
        solution,
        measured=np.stack([share * still, (1 - share) * still]),
        predicted=np.stack([prior_share * still, (1 - prior_share) * still]),
        frame_errors=errors,
        without_glass=None,
        model=None,
    )


def transmission_share(layers: Floats) -> Floats:
    """Returns the share of T in the light of both layers (2, h, w, 3): (h, w, 3) in 0..1."""
    share: Floats = layers[0] / np.maximum(layers.sum(0), _MIN_LIGHT)
    return share


def moved(image: Floats, homography: Doubles, size: tuple[int, int]) -> Floats:
    """Returns an image (h, w, C) as another picture of this size shows it, from which the
    homography leads to the image. Outside, the nearest pixel counts.
    """
    x, y = to_pixels(projected(homography, size), image.shape)
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    reshaped: Floats = sampled.reshape(*size, image.shape[2])
    return reshaped


def coverage(homography: Doubles, size: tuple[int, int]) -> Floats:
    """Returns where the frame shows the still, (h, w, 1): 1, with a fade to 0 outside of it, so
    that no border is seen where the frame shows the whole still.
    """
    positions = projected(homography, size)
    distance = 1 + (1 - np.abs(positions).max(0)) / (2 * _BORDER)
    covered: Floats = np.clip(distance, 0, 1).astype(np.float32)[..., None]
    return covered


def projected(homography: Doubles, size: tuple[int, int]) -> Doubles:
    """Returns where a homography moves the pixels of a picture of this size, (2, h, w)."""
    return transformed(homography, pixel_grid(*size))


def _is_lit(layers: Floats) -> Floats:
    lit: Floats = np.clip(layers.sum(0).mean(-1, keepdims=True) / _MIN_LIGHT, 0, 1)
    return lit


def hint_strokes(solution: Solution, size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """Returns hints for the model, (H, W, 3) at this (width, height): red where the measured
    reflection has a large share of the light, or None if it has not anywhere.
    """
    share = 1 - transmission_share(solution.layers).mean(-1)
    share = cv2.GaussianBlur(share, (0, 0), _SMOOTH_HINTS_PX)
    is_reflection = hinted_region(share)
    if not is_reflection.any():
        return None
    enlarged = cv2.resize(is_reflection.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    strokes = np.zeros((*enlarged.shape, 3), np.uint8)
    strokes[..., 0] = 255 * enlarged
    return strokes


def moved_share(prior: Floats, still: Floats, homography: Doubles, size: tuple[int, int]) -> Floats:
    """Returns the share of T in the light of the still, as the frame of this size (h, w) shows it:
    (h, w, 3) in 0..1.
    """
    share = np.clip(prior / np.maximum(still, _MIN_LIGHT), 0, 1)
    inverse = np.linalg.inv(homography).astype(np.float64)
    return moved(share.astype(np.float32), inverse, size)
