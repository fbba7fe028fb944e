"""Finds the motion of a reflection that moves by 2 to 10 px of 1,000 relative to the transmission,
as in a film of a hand that trembles.

At 80 px such a motion is a fraction of a pixel, and wrong motions win (search.py). Here, the frames
are first aligned with one layer, whose motion may bend. Then every change is removed that a small
motion or another exposure of this layer explains locally, as the parallax of edges in its depth.
What remains is noise, and the change of the second layer, which a search in the spectra explains
(fourier_search.py). In noise, too, the best path explains a part: nearly 1 / sqrt(K - 1) of K
frames (dev/notes/burst.md).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.exposure import CLIPPED_IN_SOME
from brewster.film.motion.model.joint_model import Doubles, Floats, JointModel, pixel_grid
from brewster.film.motion.model.levels import ALIGNMENT, packed
from brewster.film.motion.model.optimiser import optimise
from brewster.film.motion.registration.candidates import MotionCandidate
from brewster.film.motion.registration.fourier_search import (
    SMALL_MOTIONS,
    explained_share,
    find_translations,
    remaining_change,
)
from brewster.film.motion.resizing import resized

MIN_EVIDENCE: Final = 0.12
"""The smallest evidence with which a small motion separates the layers. See dev/notes/burst.md for
that of films of one layer.
"""
WEAK_EVIDENCE: Final = 0.08
"""The smallest evidence with which it gives hints to the model (photo_film.py)."""
_REACH_PX: Final = 2
"""Pixels that are no further from a clipped one are not compared either."""
_CALM_TIMES: Final = 30
_CALMING: Final = 0.02
"""Windows of this standard deviation, as a share of the width, whose change in a frame has more
energy than this often the median hardly count. See dev/notes/burst.md.
"""
_WINDOWS: Final = 3
"""The number of windows along each side, each half as large as the picture."""
_TINY: Final = 1e-12
"""Added to what may be 0: frames of one colour have no slopes, and equal ones no change."""
_INVERSION_STEPS: Final = 4
"""Of the fixed-point iteration that inverts a motion: it bends slowly, so that few steps do."""
_WINDOW: Final = 0.016
"""The standard deviation, as a share of the width, of the windows in which the first layer may move
on its own.
"""
_DAMPING: Final = 0.01
"""Of this local motion, as a share of the mean squared slope: it is 0 where nothing shows it."""


@final
@dataclass(frozen=True)
class SmallMotion:
    """The small motion that explains the frames best."""

    candidate: MotionCandidate
    evidence: float
    """The share of the change between the aligned frames that a second layer with this motion
    explains in most parts of the picture, and neither noise nor a local motion or exposure of the
    first layer does: 0..1.
    """


def find_small_motion(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    transmission: Doubles,
    *,
    exposures: Doubles | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> SmallMotion | None:
    """Returns the small motion that explains the frames best, or None if the frames are equal.

    Args:
        frames: (h, w, 3) linear light.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        transmission: (K, 3, 3), the motion of T from features, see `MotionCandidate`.
        exposures: (K, 3), see `fitted_exposures`; by default, 1.
        on_step: called after each step. An exception raised in it stops the work.
    """
    images = packed(frames, ALIGNMENT.long_side_px)
    one_layer = JointModel.start(
        images,
        np.stack([transmission, transmission])[None],
        np.array([True]),
        reference,
        ALIGNMENT.density,
        exposures=exposures,
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
    aligned, is_known = aligned_frames(frames, one_layer, SMALL_MOTIONS.width_px)
    changes = changes_of(aligned, is_known)
    remaining = without_local_change(aligned, is_known)
    factors = _calming(changes)
    changes, remaining = (
        [factor * change for factor, change in zip(factors, some, strict=True)]
        for some in (changes, remaining)
    )
    found = find_translations(remaining, reference, on_step, SMALL_MOTIONS)
    if not found:
        return None
    height, width = aligned[0].shape[:2]
    homographies = homographies_of(one_layer, layer=0)
    return SmallMotion(
        candidate=MotionCandidate(
            family="small",
            transmission=homographies,
            reflection=_translated(homographies, -found[0].offsets * [2 / width, 2 / height]),
        ),
        evidence=_evidence(changes, remaining, reference, found[0].offsets),
    )


def _evidence(
    changes: Sequence[Floats], remaining: Sequence[Floats], reference: int, offsets: Doubles
) -> float:
    """Returns the evidence of the whole picture: that of the middle third of windows. Somebody who
    passes by, or a single thing in front of others, changes some windows and not most of them.

    Args:
        changes: (h, w, 1), from `changes_of`.
        remaining: (h, w, 1), from `without_local_change`.
        reference: the index of the reference frame.
        offsets: (K, 2), the path of the second layer in pixels.
    """
    by_noise = 1 / math.sqrt(len(changes) - 1)
    height, width = changes[0].shape[:2]
    shape = 2 * height // (_WINDOWS + 1), 2 * width // (_WINDOWS + 1)
    searched = replace(SMALL_MOTIONS, width_px=SMALL_MOTIONS.width_px * shape[1] // width)
    found = []
    for row, column in product(range(_WINDOWS), repeat=2):
        top = row * height // (_WINDOWS + 1)
        left = column * width // (_WINDOWS + 1)
        window = slice(top, top + shape[0]), slice(left, left + shape[1])
        before = [change[window] for change in changes]
        after = [change[window] for change in remaining]
        explained = explained_share(after, reference, offsets, searched)
        explained = max(0.0, (explained - by_noise) / (1 - by_noise + _TINY))
        found.append(explained * remaining_change(before, after, searched))
    third = len(found) // 3
    return float(np.mean(sorted(found)[third:-third]))


def aligned_frames(
    frames: Sequence[Floats], model: JointModel, width_px: int
) -> tuple[list[Floats], NDArray[np.bool_]]:
    """Returns the frames as the reference frame shows the first layer, with its exposure, (h, w, 3)
    linear light, and where all of them show it and none is clipped, (h, w).

    Args:
        frames: (h, w, 3) linear light.
        model: a single candidate.
        width_px: the width of the aligned frames.
    """
    gains = model.fixed_motion()[2][0].astype(np.float32)
    aligned = []
    lost = []
    for k, frame in enumerate(frames):
        small = resized(frame, round(width_px * max(frame.shape) / frame.shape[1]))
        height, width = small.shape[:2]
        grid = pixel_grid(height, width)
        to_px = np.array([width / 2, height / 2])[:, None, None]
        moved = ((model.positions(0, 0, k, height, width) - grid) * to_px).astype(np.float32)
        x, y = _inverted(moved)
        light = cv2.remap(small, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        clipped = (small.max(-1) > CLIPPED_IN_SOME).astype(np.float32)
        lost.append(cv2.remap(clipped, x, y, cv2.INTER_LINEAR, borderValue=1))
        aligned.append(light / gains[k])
    near = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), np.uint8)
    is_known: NDArray[np.bool_] = cv2.dilate(np.max(lost, axis=0), near) == 0
    return aligned, is_known


def changes_of(frames: Sequence[Floats], is_known: NDArray[np.bool_]) -> list[Floats]:
    """Returns grey frames (h, w, 1) without their median, which shows nobody who passes by, 0 where
    they are not known.

    Args:
        frames: (h, w, 3) linear light, aligned with the first layer.
        is_known: (h, w), from `aligned_frames`.
    """
    grey = np.stack([frame.mean(-1) for frame in frames])
    return [*((grey - np.median(grey, axis=0)) * is_known)[..., None]]


def without_local_change(frames: Sequence[Floats], is_known: NDArray[np.bool_]) -> list[Floats]:
    """Returns `changes_of` the frames without what a local motion and exposure of their median
    explain: least squares in windows (Lucas and Kanade 1981).

    The change of a second layer remains, because its edges are not at the places of the first one.

    Args:
        frames: (h, w, 3) linear light, aligned with the first layer.
        is_known: (h, w), from `aligned_frames`.
    """
    median = np.median([frame.mean(-1) for frame in frames], axis=0)
    sigma = _WINDOW * median.shape[1]
    down, across = np.gradient(median)
    causes = np.stack([across, down, median]) * is_known
    products = np.stack(
        [[_windowed(first * second, sigma) for first in causes] for second in causes]
    )
    normal = np.moveaxis(products, (0, 1), (2, 3)).astype(np.float64)
    damping = _DAMPING * float((normal[..., 0, 0] + normal[..., 1, 1]).mean())
    normal += np.diag([damping, damping, 0]) + _TINY * np.eye(3)
    inverse = np.linalg.inv(normal).astype(np.float32)
    remaining = []
    for change in changes_of(frames, is_known):
        sides = np.stack([_windowed(cause * change[..., 0], sigma) for cause in causes], -1)
        amounts = np.einsum("hwij,hwj->ihw", inverse, sides)
        remaining.append(change - (amounts * causes).sum(0)[..., None])
    return remaining


def _calming(changes: Sequence[Floats]) -> list[Floats]:
    """Returns factors (h, w, 1) in 0..1 for the places of each frame with far more change than
    others: somebody who passes by is no reason for a motion of the whole picture.

    Args:
        changes: (h, w, 1), from `changes_of`.
    """
    sigma = _CALMING * changes[0].shape[1]
    energies = [_windowed(np.square(change[..., 0]), sigma) for change in changes]
    limit = _CALM_TIMES * float(np.median(energies)) + _TINY
    return [np.square(np.minimum(1, limit / (energy + _TINY)))[..., None] for energy in energies]


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
