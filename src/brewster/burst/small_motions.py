"""Finds the motion of a reflection that moves by 2 to 10 px of 1,000 relative to the transmission,
as in a film of a hand that trembles.

At 80 px such a motion is a fraction of a pixel, and wrong motions win (solver.py). Here, the frames
are first aligned with one layer, whose motion may bend. Then every change is removed that a small
motion of this layer explains locally, as the parallax of edges in its depth. What remains is noise,
and the change of the second layer, which a search in the spectra explains (fourier_search.py).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np

from brewster.burst.fourier_search import SMALL_MOTIONS, find_translations, remaining_change
from brewster.burst.joint_model import Doubles, Floats, JointModel, pixel_grid
from brewster.burst.levels import ALIGNMENT, packed, resized
from brewster.burst.optimiser import optimise
from brewster.burst.registration import MotionCandidate

MIN_EVIDENCE: Final = 0.34
"""The smallest evidence with which a small motion separates the layers. See dev/notes/burst.md for
that of films of one layer.
"""
WEAK_EVIDENCE: Final = 0.28
"""The smallest evidence with which it gives hints to the model (photo_film.py)."""
_INVERSION_STEPS: Final = 4
"""Of the fixed-point iteration that inverts a motion: it bends slowly, so that few steps do."""
_WINDOW: Final = 0.016
"""The standard deviation, as a share of the width, of the windows in which the first layer may move
on its own.
"""
_DAMPING: Final = 0.01
"""Of this local motion, as a share of the mean squared slope: it is 0 where nothing shows it."""
_MIN_SLOPE: Final = 1e-12
"""Added to the damping: frames of one colour have no slopes."""


@final
@dataclass(frozen=True)
class SmallMotion:
    """The small motion that explains the frames best."""

    candidate: MotionCandidate
    evidence: float
    """The share of the change between the aligned frames that a second layer with this motion
    explains, and a local motion of the first layer does not: 0..1.
    """


def find_small_motion(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    transmission: Doubles,
    on_step: Callable[[], None] = lambda: None,
) -> SmallMotion | None:
    """Returns the small motion that explains the frames best, or None if the frames are equal.

    Args:
        frames: (h, w, 3) linear light.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        transmission: (K, 3, 3), the motion of T from features, see `MotionCandidate`.
        on_step: called after each step. An exception raised in it stops the work.
    """
    images = packed(frames, ALIGNMENT.long_side_px)
    one_layer = JointModel.start(
        images,
        np.stack([transmission, transmission])[None],
        np.array([True]),
        reference,
        ALIGNMENT.density,
    )
    one_layer = optimise(
        one_layer.resized(images, ALIGNMENT.density, ALIGNMENT.spline_size),
        images,
        packed([prior], ALIGNMENT.long_side_px)[0],
        ALIGNMENT.steps,
        rates=ALIGNMENT.rates,
        weights=ALIGNMENT.weights,
        on_step=on_step,
    )
    aligned = aligned_frames(frames, one_layer, SMALL_MOTIONS.width_px)
    changes = without_local_motion(aligned)
    found = find_translations(changes, reference, on_step, SMALL_MOTIONS)
    if not found:
        return None
    remaining = remaining_change(aligned, changes, SMALL_MOTIONS)
    height, width = aligned[0].shape[:2]
    homographies = homographies_of(one_layer, layer=0)
    return SmallMotion(
        candidate=MotionCandidate(
            family="small",
            transmission=homographies,
            reflection=_translated(homographies, -found[0].offsets * [2 / width, 2 / height]),
        ),
        evidence=found[0].explained * remaining,
    )


def aligned_frames(frames: Sequence[Floats], model: JointModel, width_px: int) -> list[Floats]:
    """Returns the frames as the reference frame shows the first layer, with its exposure, (h, w, 3)
    linear light.

    Args:
        frames: (h, w, 3) linear light.
        model: a single candidate.
        width_px: the width of the aligned frames.
    """
    gains = model.fixed_motion()[2][0].astype(np.float32)
    aligned = []
    for k, frame in enumerate(frames):
        small = resized(frame, round(width_px * max(frame.shape) / frame.shape[1]))
        height, width = small.shape[:2]
        grid = pixel_grid(height, width)
        to_px = np.array([width / 2, height / 2])[:, None, None]
        moved = ((model.positions(0, 0, k, height, width) - grid) * to_px).astype(np.float32)
        x, y = _inverted(moved)
        light = cv2.remap(small, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        aligned.append(light / gains[k])
    return aligned


def without_local_motion(frames: Sequence[Floats]) -> list[Floats]:
    """Returns grey frames, (h, w, 1), without what a local motion of their mean explains: least
    squares in windows (Lucas and Kanade 1981).

    The change of a second layer remains, because its edges are not at the places of the first one.

    Args:
        frames: (h, w, 3) linear light, aligned with the first layer.
    """
    grey = np.stack([frame.mean(-1) for frame in frames])
    mean = grey.mean(0)
    sigma = _WINDOW * mean.shape[1]
    down, across = np.gradient(mean)
    squares = _windowed(across * across, sigma), _windowed(down * down, sigma)
    damping = _DAMPING * float(sum(square.mean() for square in squares)) + _MIN_SLOPE
    first, second = (square + damping for square in squares)
    mixed = _windowed(across * down, sigma)
    determinant = first * second - mixed * mixed
    remaining = []
    for frame in grey:
        along_x, along_y = (_windowed(slope * (frame - mean), sigma) for slope in (across, down))
        x = (second * along_x - mixed * along_y) / determinant
        y = (first * along_y - mixed * along_x) / determinant
        remaining.append((frame - x * across - y * down)[..., None].astype(np.float32))
    return remaining


def _windowed(image: Floats, sigma: float) -> Floats:
    """Returns the mean in Gaussian windows."""
    smooth: Floats = cv2.GaussianBlur(image, (0, 0), sigma)
    return smooth


def _inverted(moved: Floats) -> tuple[Floats, Floats]:
    """Returns the places (h, w) in pixels that a motion moves to the pixels of a grid.

    Args:
        moved: (2, h, w), how far each pixel moves.
    """
    rows, columns = np.mgrid[: moved.shape[1], : moved.shape[2]].astype(np.float32)
    x = columns - moved[0]
    y = rows - moved[1]
    for _ in range(_INVERSION_STEPS):
        across, down = (
            cv2.remap(axis, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for axis in moved
        )
        x = columns - across
        y = rows - down
    return x, y


def homographies_of(model: JointModel, layer: int) -> Doubles:
    """Returns the homographies (K, 3, 3) of a layer of the first candidate."""
    values = model.fixed_motion()[0][0, layer]
    matrices: Doubles = np.concatenate([values, np.ones_like(values[:, :1])], 1).reshape(-1, 3, 3)
    return matrices


def _translated(homographies: Doubles, offsets: Doubles) -> Doubles:
    """Returns the homographies (K, 3, 3), followed by translations (K, 2) in normalised
    coordinates.
    """
    translations = np.tile(np.eye(3), (len(offsets), 1, 1))
    translations[:, :2, 2] = offsets
    translated: Doubles = translations @ homographies
    return translated
