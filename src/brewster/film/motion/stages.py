"""What the stages of the solver share: the images of a burst at the size of a level, a model and
how well it explains them, and the work that is done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, final

import cv2
import numpy as np

from brewster.film.motion.model.joint_model import Doubles, Floats, JointModel
from brewster.film.motion.model.levels import Level, packed
from brewster.film.motion.model.optimiser import optimise
from brewster.film.motion.registration.candidates import MotionCandidate

_MIN_ERROR: Final = 1e-9
"""The errors of one layer may be 0."""
MOTION_SAMPLES: Final = (9, 12)
"""The rows and columns of places whose relative motion is measured."""


@final
class Progress:
    """Counts the completed work of all stages."""

    def __init__(self, total_cost: float, on_progress: Callable[[float], None]) -> None:
        self._total_cost = total_cost
        self._on_progress = on_progress
        self._done = 0.0

    def complete(self, cost: float) -> None:
        """Reports that work of this cost is completed. See `Level.step_cost`."""
        self._done += cost / self._total_cost
        self._on_progress(min(self._done, 1.0))


@final
@dataclass(frozen=True)
class Images:
    """The frames of a burst and both priors at the size of a level: (h, w) are its height and
    width.
    """

    frames: Floats
    """(K, h, w, 4) linear light."""
    reference: int
    prior: Floats
    """(h, w, 4): T of the reference frame from a single photo. It names the layers."""
    refined_prior: Floats
    """(h, w, 4): the same, after the layers were measured. It pulls T."""

    @property
    def reference_frame(self) -> Floats:
        """(h, w, 4)"""
        reference_frame: Floats = self.frames[self.reference]
        return reference_frame

    def reference_layers(self, model: JointModel) -> Floats:
        """Returns T and R of the reference frame, (2, h, w, 3), for the first candidate."""
        return model.reference_layers(*self.frames.shape[1:3])


@final
@dataclass(frozen=True)
class SolverInput:
    """What all stages of `solve` need. For the fields, see there."""

    frames: Sequence[Floats]
    reference: int
    prior: Floats
    exposures: Doubles
    progress: Progress
    on_layers: Callable[[Floats], None]

    def at(self, level: Level, refined_prior: Floats) -> Images:
        """Returns the images at the size of a level. `refined_prior` is (h, w, 3) of any size."""
        return Images(
            frames=packed(self.frames, level.long_side_px),
            reference=self.reference,
            prior=packed([self.prior], level.long_side_px)[0],
            refined_prior=packed([refined_prior], level.long_side_px)[0],
        )

    def own_prior(self, images: Images, model: JointModel) -> Floats:
        """Returns T of a model, at the size of the frames, so that all levels round their sizes in
        the same way.
        """
        transmission, _ = images.reference_layers(model)
        enlarged: Floats = cv2.resize(transmission, self.frames[0].shape[1::-1])
        return enlarged

    def start(
        self, candidates: Sequence[MotionCandidate], images: Images, density: float
    ) -> JointModel:
        """Returns the model before the first step. See `JointModel.start`."""
        motions = [[candidate.transmission, candidate.reflection] for candidate in candidates]
        return JointModel.start(
            images.frames,
            np.array(motions),
            np.array([candidate.is_locked for candidate in candidates]),
            self.reference,
            density,
            exposures=self.exposures,
        )

    def optimised(self, model: JointModel, level: Level, images: Images) -> JointModel:
        """Returns the model at the size of a level, after its steps."""
        return optimise(
            model.resized(images.frames, level.density, level.spline_size),
            images.frames,
            images.refined_prior,
            level.steps,
            rates=level.rates,
            weights=level.weights,
            every=level.every,
            edges_every=level.edges_every,
            on_step=self.on_step(level),
        )

    def on_step(self, level: Level) -> Callable[[], None]:
        """Returns what is called after each step of a level."""
        return partial(self.progress.complete, level.step_cost)


@final
@dataclass(frozen=True)
class Explanation:
    """A model, and how well it explains the frames: for the errors, see `Solution`."""

    model: JointModel
    """A single candidate."""
    one_layer_error: float
    two_layer_error: float

    @property
    def explained(self) -> float:
        """The share of the errors of one layer that the second one explains."""
        return 1 - self.two_layer_error / max(self.one_layer_error, _MIN_ERROR)

    @property
    def motion(self) -> float:
        """The relative motion, as a share of the width."""
        return float(self.model.relative_motion(*MOTION_SAMPLES)[0])


def cost_of(levels: Sequence[Level]) -> int:
    """Returns the cost of the steps of levels."""
    return sum(level.steps * level.step_cost for level in levels)
