"""The levels at which a burst is solved, from coarse to fine, and its images at their sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from brewster.film.motion.model.joint_model import Floats, with_fourth_channel
from brewster.film.motion.model.optimiser import Rates, Weights
from brewster.film.motion.resizing import resized

_FOR_MOTION: Final = Weights(common_edges=0.01, prior=0.02)
"""Two layers with edges at the same places explain too much of any motion."""
_FOR_LAYERS: Final = Weights(common_edges=0.005, prior=0.01)
"""With the motion known, a larger penalty of common edges, or a stronger prior, would shift light
between the layers.
"""
_CANDIDATES_COST: Final = 3
"""The time of a step of the search, which has several candidates, relative to one of the best."""
_FULL_RATE_PX: Final = 80
"""The long side of the frames up to which the motion has its full learning rates."""


@final
@dataclass(frozen=True)
class Level:
    """A step from coarse to fine."""

    long_side_px: int
    steps: int
    spline_size: tuple[int, int] | None
    """Rows and columns of the splines; None: the motion is a homography."""
    weights: Weights = _FOR_LAYERS
    density: float = 1.0
    """Pixels of the layers per pixel of a frame, along each axis."""
    kept: int = 1
    """How many candidates of each family are kept after this level of the search."""
    every: int = 1
    """See `optimise`."""
    edges_every: int = 1
    """See `optimise`. While candidates are compared, each step counts: otherwise, a second layer
    explains more of films that have only one.
    """
    layer_rate: float = 1.0
    """Multiplies the learning rate of the layers."""

    @property
    def step_cost(self) -> int:
        """The time of a step relative to that of others, for the progress."""
        return self.long_side_px * (_CANDIDATES_COST if self.weights is _FOR_MOTION else 1)

    @property
    def rates(self) -> Rates:
        """The learning rates: the motion is slower in larger frames."""
        rates = Rates(layers=self.layer_rate * Rates.layers)
        if not self.spline_size:
            return replace(rates, splines=0)
        return rates.scaled(min(1.0, _FULL_RATE_PX / self.long_side_px))


_MAX_ENLARGEMENT: Final = 1.3
"""Levels that would enlarge the frames by more than this factor are left out."""
_DENSITY: Final = 1.5
"""Of the levels that find the motion. With 1, interpolation blurs T differently in each frame, and
a copy of T that is moved by a pixel explains this better than the true reflection explains its
light.
"""
_FEW_STEPS_RATE: Final = 1.6
"""The layer rate with which 90, 110, 55 and 55 steps at 160 px do as well as 110, 120, 60, 60."""
SEARCH: Final = (
    Level(80, steps=20, spline_size=None, weights=_FOR_MOTION, density=_DENSITY, kept=2),
    Level(80, steps=20, spline_size=None, weights=_FOR_MOTION, density=_DENSITY),
    Level(160, steps=45, spline_size=(4, 6), weights=_FOR_MOTION, density=_DENSITY),
)
"""The levels that find the motion, with many candidates."""
_MOVED_LIGHT: Final = Level(
    160,
    steps=55,
    spline_size=(4, 6),
    density=_DENSITY,
    edges_every=2,
    layer_rate=_FEW_STEPS_RATE,
)
"""The level after smooth light has moved between the layers."""
LEVELS: Final = (
    replace(_MOVED_LIGHT, steps=90),
    # Smooth light moves between the layers before each of the next levels
    _MOVED_LIGHT,
    _MOVED_LIGHT,
    Level(320, steps=70, spline_size=(6, 8), every=2, edges_every=2),
    Level(640, steps=35, spline_size=(8, 12), every=4, edges_every=2),
)
"""The levels of the best candidate. Smooth light moves between its layers before each but the
first.
"""
ALIGNMENT: Final = Level(320, steps=30, spline_size=(4, 6), weights=_FOR_MOTION)
"""The level that aligns the frames with one layer, before a small motion is looked for."""
SMALL_SEARCH: Final = Level(
    320, steps=30, spline_size=(4, 6), weights=_FOR_MOTION, density=_DENSITY
)
"""The level that compares a small motion with the best of the other candidates."""
NAMING_PX: Final = 160
"""The long side of the layers by which T and R are told apart."""
MIN_SIDE_PX: Final = math.ceil(LEVELS[0].long_side_px / _MAX_ENLARGEMENT)
"""The smallest long side of frames that have the levels at which candidates are compared and named:
without these, wrong motions win.
"""


def without_enlargement(
    levels: Sequence[Level], frames: Sequence[Floats], least: int = 1
) -> Sequence[Level]:
    """Returns the levels that do not enlarge the frames much, at least the first ones."""
    largest = _MAX_ENLARGEMENT * max(frames[0].shape)
    return [level for level in levels if level.long_side_px <= largest] or levels[:least]


def packed(images: Sequence[Floats], long_side_px: int) -> Floats:
    """Returns resized images, (K, h, w, 4)."""
    return with_fourth_channel(np.stack([resized(image, long_side_px) for image in images]))
