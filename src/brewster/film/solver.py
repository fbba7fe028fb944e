"""Finds both layers and their motions, from coarse to fine: many candidates on small frames, the
best one on larger frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, final

import cv2
import numpy as np

from brewster.film.joint_model import Doubles, Floats, JointModel, pixel_grid, project
from brewster.film.levels import (
    ALIGNMENT,
    LEVELS,
    NAMING_PX,
    SEARCH,
    SMALL_LEVELS,
    SMALL_SEARCH,
    Level,
    packed,
    resized,
    without_enlargement,
)
from brewster.film.naming import edge_correlation, naming_of, reflection_share
from brewster.film.objects import (
    FINAL_STEPS,
    FIRST_STEPS,
    OPACITY_STEPS,
    SEARCH_STEPS,
    with_objects,
)
from brewster.film.optimiser import optimise
from brewster.film.pane import without_glass
from brewster.film.registration import MotionCandidate
from brewster.film.side_by_side import compare_side_by_side
from brewster.film.small_motions import (
    MIN_EVIDENCE,
    WEAK_EVIDENCE,
    SmallMotion,
    find_small_motion,
    homographies_of,
)
from brewster.film.smooth_light import with_moved_light
from brewster.film.solution import MIN_COMPARED_MOTION, Solution

MAX_RELATIVE_MOTION: Final = 0.2
"""As a share of the width. With a larger motion, the reflection becomes an offset of each frame,
and explains all but edges.
"""
_MOTION_SAMPLES: Final = (9, 12)
_MAX_NAMING_LOSS: Final = 0.1
"""There are no objects if the layers are told apart less clearly with them by more than this: a
part of T became R.
"""
_MIN_DIFFERENCE: Final = 0.008
"""Two motions are different if they differ by this share of the frame's size."""
_MAX_MOTIONS: Final = 14
_MIN_ERROR: Final = 1e-9
"""The errors of one layer may be 0."""
_CLEAR_MOTION: Final = 0.03
_CLEAR_EXPLAINED: Final = 0.35
"""With a relative motion of this share of the width, which explains this share of the errors of one
layer, no small motion is looked for.
"""
_SMOOTHING: Final = 0.02
"""The standard deviation, as a share of the width, that makes smooth light of the layers of a small
motion. It hardly shows smooth light, so that the layers begin with that of the single photo.
"""
_MIN_COMPARED: Final = 0.12
"""A motion that explains at least this share of the errors of one layer is replaced by a small one
only if the small one has clear evidence and explains the frames better.
"""


def solve(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    candidates: Sequence[MotionCandidate],
    *,
    exposures: Doubles | None = None,
    refine_prior: Callable[[Floats], Floats] | None = None,
    search: Sequence[Level] = SEARCH,
    levels: Sequence[Level] = LEVELS,
    small_levels: Sequence[Level] = SMALL_LEVELS,
    on_progress: Callable[[float], None] = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> Solution:
    """Returns the layers of the reference frame for the best of the candidates.

    The stages: search (which candidate is best), search for a small motion, refine (the best one,
    at its first level), add objects, name (which layer is T), and refine (at the other levels).
    Before each of these, smooth light moves between the layers of a large motion
    (smooth_light.py), and T becomes its own prior.

    Args:
        frames: (h, w, 3) linear light, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        candidates: guesses for the motions. One of them is locked.
        exposures: (K, 3), those of the frames, see `fitted_exposures`; by default, 1.
        refine_prior: returns a better `prior`, given the measured share of R in the light of the
            reference frame, (h, w, 1).
        search: the levels that compare the candidates.
        levels: the levels of the best candidate.
        small_levels: its levels if its motion is small.
        on_progress: called with the completed fraction.
        on_layers: called after each level but the last with T and R of the reference frame so far,
            (2, h, w, 3) linear light.
    """
    search = without_enlargement(search, frames)
    levels = without_enlargement(levels, frames)
    small_levels = without_enlargement(small_levels, frames)
    burst = _Burst(
        frames=frames,
        reference=reference,
        prior=prior,
        exposures=np.ones((len(frames), 3)) if exposures is None else exposures,
        progress=_Progress(_total_cost(search, levels, small_levels), on_progress),
        on_layers=on_layers,
    )
    found = _search(burst, search, candidates)
    small = _small_motion(burst, found, candidates)
    is_compared = found.best.explained >= _MIN_COMPARED
    if small and small.evidence >= (MIN_EVIDENCE if is_compared else WEAK_EVIDENCE):
        found = _of_small_motion(burst, small, found.best if is_compared else None) or found
    solution = _refined(burst, found, small_levels if found.is_small else levels, refine_prior)
    return replace(solution, small_motion_evidence=small.evidence if small else 0.0)


def solve_small_motion(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    small: SmallMotion,
    *,
    exposures: Doubles,
    refine_prior: Callable[[Floats], Floats] | None = None,
    levels: Sequence[Level] = SMALL_LEVELS,
    on_progress: Callable[[float], None] = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> Solution:
    """Returns the layers of the reference frame for a small motion, without a search for others.

    Args:
        frames: see `solve`.
        reference: see `solve`.
        prior: see `solve`.
        small: the motion, from `find_small_motion`.
        exposures: see `solve`.
        refine_prior: see `solve`.
        levels: its levels.
        on_progress: see `solve`.
        on_layers: see `solve`.
    """
    levels = without_enlargement(levels, frames)
    burst = _Burst(
        frames=frames,
        reference=reference,
        prior=prior,
        exposures=exposures,
        progress=_Progress(_cost([SMALL_SEARCH, *levels]), on_progress),
        on_layers=on_layers,
    )
    found = _of_small_motion(burst, small)
    assert found  # without a rival
    solution = _refined(burst, found, levels, refine_prior)
    return replace(solution, small_motion_evidence=small.evidence)


def _refined(
    burst: _Burst,
    found: _Found,
    levels: Sequence[Level],
    refine_prior: Callable[[Floats], Floats] | None,
) -> Solution:
    """Refines the best candidate: all stages after the search. For the arguments, see `solve`."""
    refined_prior = refine_prior or (lambda _share: burst.prior)
    first, *others = levels
    prior_of_level = refined_prior(found.reflection_share)
    images = burst.at(first, prior_of_level)
    if found.is_small:
        start = found.best.model.with_smooth_light(images.predicted_layers, _SMOOTHING)
        named = _name(
            replace(found.best, model=burst.optimised(start, first, images)), None, images
        )
    else:
        model = burst.optimised(found.best.model, first, images)
        named = _name(*_add_objects(burst, found, first, images, model), images)
    if named.is_exchanged:  # the prior has pulled the other layer so far
        prior_of_level = refined_prior(reflection_share(named.layers))
    model = named.explanation.model
    for number, level in enumerate(others):
        burst.on_layers(images.reference_layers(model))
        is_movable = not found.is_small and len(model.layers[0]) == 2
        moved = with_moved_light(model, images.frames) if is_movable else None
        if moved:
            model = moved
            if number or not named.is_exchanged:
                # at the size of the frames, so that all levels round their sizes in the same way
                transmission, _ = images.reference_layers(model)
                prior_of_level = cv2.resize(transmission, burst.frames[0].shape[1::-1])
        images = burst.at(level, prior_of_level)
        model = burst.optimised(model, level, images)
    return _solution(model, images, named, is_small=found.is_small)


@final
class _Progress:
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
class _Images:
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

    @property
    def predicted_layers(self) -> Floats:
        """T and R of the reference frame by the refined prior, (2, h, w, 3)."""
        transmission = self.refined_prior[..., :3]
        reflection = np.maximum(self.reference_frame[..., :3] - transmission, 0)
        return np.stack([transmission, reflection])

    def reference_layers(self, model: JointModel) -> Floats:
        """Returns T and R of the reference frame, (2, h, w, 3), for the first candidate."""
        return model.reference_layers(*self.frames.shape[1:3])


@final
@dataclass(frozen=True)
class _Burst:
    """What all stages of `solve` need. For the fields, see there."""

    frames: Sequence[Floats]
    reference: int
    prior: Floats
    exposures: Doubles
    progress: _Progress
    on_layers: Callable[[Floats], None]

    def at(self, level: Level, refined_prior: Floats) -> _Images:
        """Returns the images at the size of a level. `refined_prior` is (h, w, 3) of any size."""
        return _Images(
            frames=packed(self.frames, level.long_side_px),
            reference=self.reference,
            prior=packed([self.prior], level.long_side_px)[0],
            refined_prior=packed([refined_prior], level.long_side_px)[0],
        )

    def start(
        self, candidates: Sequence[MotionCandidate], images: _Images, density: float
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

    def optimised(self, model: JointModel, level: Level, images: _Images) -> JointModel:
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


def _total_cost(
    search: Sequence[Level], levels: Sequence[Level], small_levels: Sequence[Level]
) -> float:
    """Returns the cost of all steps, those of the objects and of a small motion included."""
    objects = (OPACITY_STEPS + FIRST_STEPS + SEARCH_STEPS + FINAL_STEPS) * levels[0].step_cost
    compared = _cost([*search, ALIGNMENT, SMALL_SEARCH])
    return compared + max(_cost(levels) + objects, _cost(small_levels))


def _cost(levels: Sequence[Level]) -> int:
    """Returns the cost of the steps of levels."""
    return sum(level.steps * level.step_cost for level in levels)


# --- search


@final
@dataclass(frozen=True)
class _Explanation:
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
        return float(self.model.relative_motion(*_MOTION_SAMPLES)[0])


@final
@dataclass(frozen=True)
class _Found:
    """The result of the search."""

    best: _Explanation
    """The best candidate with two layers."""
    reflection_share: Floats
    """(h, w, 1): see `solve`."""
    other_motions: Sequence[Doubles]
    """(K, 3, 3) each: those that objects, or the reflection in front of them, may have."""
    is_small: bool = False
    """Whether the best candidate is a small motion."""


def _search(
    burst: _Burst, levels: Sequence[Level], candidates: Sequence[MotionCandidate]
) -> _Found:
    """Optimises all candidates, and keeps fewer of them from level to level.

    Args:
        burst: what all stages need.
        levels: the levels that compare the candidates.
        candidates: guesses for the motions.
    """
    images = burst.at(levels[0], burst.prior)
    model = burst.start(candidates, images, levels[0].density)
    families = [candidate.family for candidate in candidates]
    for level in levels:
        images = burst.at(level, burst.prior)
        model = burst.optimised(model, level, images)
        kept = _best_of_families(_selection_losses(model), families, level.kept)
        model = model.selected(kept)
        families = [families[candidate] for candidate in kept]
        best = _best(model)
        burst.on_layers(images.reference_layers(model.selected([best])))
    one_layer = model.is_locked.argmax()
    explanation = _Explanation(
        model=model.selected([best]),
        one_layer_error=float(model.data_losses[one_layer]),
        two_layer_error=float(model.data_losses[best]),
    )
    return _Found(
        best=explanation,
        reflection_share=reflection_share(images.reference_layers(explanation.model)),
        other_motions=_other_motions(model, best, candidates),
    )


def _best_of_families(losses: Doubles, families: Sequence[str], count: int) -> list[int]:
    """Returns the indices of the best candidates of each family, `count` of each.

    On very small frames, a wrong motion may be better than a true motion of a pixel. Therefore none
    of the families is left out.

    Args:
        losses: (C,), see `_selection_losses`.
        families: that of each candidate.
        count: the number of candidates that are kept of each family.
    """
    counts = Counter[str]()
    best = []
    for candidate in sorted(range(len(families)), key=losses.__getitem__):
        family = families[candidate]
        if counts[family] < count:
            best.append(candidate)
        counts[family] += 1
    return best


def _best(model: JointModel) -> int:
    """Returns the index of the best candidate with two layers."""
    losses = _selection_losses(model)
    return int(np.where(model.is_locked, np.inf, losses).argmin())


def _selection_losses(model: JointModel) -> Doubles:
    """Returns the losses (C,), larger by 1 for implausible motions."""
    return model.losses + (model.relative_motion(*_MOTION_SAMPLES) > MAX_RELATIVE_MOTION)


def _other_motions(
    model: JointModel, best: int, candidates: Sequence[MotionCandidate]
) -> list[Doubles]:
    """Returns the motions (K, 3, 3) that differ from both motions of the best candidate, and from
    each other: those of features first.

    Args:
        model: the candidates that the search kept.
        best: the index of the best one of them.
        candidates: those with which the search began.
    """
    matrices = np.concatenate([model.homographies, np.ones_like(model.homographies[..., :1])], -1)
    fitted = matrices.reshape(*matrices.shape[:3], 3, 3)
    measured = [each for each in candidates if each.family in ("features", "Fourier")]
    lines = [each for each in candidates if each.family == "shift"]
    known = [_moved_grid(motion) for motion in fitted[best]]
    found: list[Doubles] = []
    for motion in [
        *(each.transmission for each in measured),
        *(each.reflection for each in measured),
        *fitted[:, -1],
        *(each.reflection for each in lines),
    ]:
        places = _moved_grid(motion)
        difference = min(_largest_distance(places, other) for other in known)
        if difference > _MIN_DIFFERENCE and len(found) < _MAX_MOTIONS:
            known.append(places)
            found.append(motion)
    return found


def _moved_grid(motion: Doubles) -> Doubles:
    """Returns where a motion (K, 3, 3) moves nine places of a frame: (K, 2, 3, 3)."""
    grid = pixel_grid(3, 3)
    return np.stack([project(matrix.ravel()[:8], grid) for matrix in motion])


def _largest_distance(places: Doubles, others: Doubles) -> float:
    """Returns the mean distance of the places (K, 2, 3, 3) in the frame where it is largest, as a
    share of the frame's size: coordinates are normalised, so that this size is 2.
    """
    return float(np.linalg.norm(places - others, axis=1).mean((1, 2)).max() / 2)


# --- search for a small motion


def _small_motion(
    burst: _Burst, found: _Found, candidates: Sequence[MotionCandidate]
) -> SmallMotion | None:
    """Returns a small motion that may explain the frames better than the best candidate, or None.

    Args:
        burst: what all stages need.
        found: the result of the search.
        candidates: those with which it began.
    """
    is_clear = found.best.motion >= _CLEAR_MOTION and found.best.explained >= _CLEAR_EXPLAINED
    if is_clear or not without_enlargement([ALIGNMENT], burst.frames, least=0):
        return None
    (one_layer,) = (each for each in candidates if each.is_locked)
    return find_small_motion(
        burst.frames,
        burst.reference,
        burst.prior,
        one_layer.transmission,
        exposures=burst.exposures,
        on_step=burst.on_step(ALIGNMENT),
    )


def _of_small_motion(
    burst: _Burst, small: SmallMotion, rival: _Explanation | None = None
) -> _Found | None:
    """Returns the small motion in place of the result of the search, or None if its rival explains
    the frames better. Both begin with the same images, and have the same number of steps.

    Args:
        burst: what all stages need.
        small: a small motion.
        rival: the best candidate of the search, if they are compared.
    """
    images = burst.at(SMALL_SEARCH, burst.prior)
    size = images.frames, SMALL_SEARCH.density, SMALL_SEARCH.spline_size
    one_layer = replace(small.candidate, reflection=small.candidate.transmission, is_locked=True)
    candidates = [one_layer, small.candidate]
    if rival:
        before = MotionCandidate(
            family="before",
            transmission=homographies_of(rival.model, layer=0),
            reflection=homographies_of(rival.model, layer=-1),
        )
        candidates.append(before)
    model = burst.start(candidates, images, SMALL_SEARCH.density).resized(*size)
    if rival:
        model.splines[-1] = rival.model.resized(*size).splines[0]
    model = burst.optimised(model, SMALL_SEARCH, images)
    if rival and _best(model) != 1:
        return None
    best = model.selected([1])
    return _Found(
        best=_Explanation(
            model=best,
            one_layer_error=float(model.data_losses[0]),
            two_layer_error=float(model.data_losses[1]),
        ),
        reflection_share=reflection_share(images.reference_layers(best)),
        other_motions=(),
        is_small=True,
    )


# --- add objects


def _add_objects(
    burst: _Burst, found: _Found, level: Level, images: _Images, model: JointModel
) -> tuple[_Explanation, _Explanation | None]:
    """Returns `model` after more steps, and one with opaque objects in front of the wall
    (objects.py); None if there are none.
    """
    transparent, objects = with_objects(
        model,
        images.frames,
        images.refined_prior,
        found.other_motions,
        density=level.density,
        rates=level.rates,
        weights=level.weights,
        edges_every=level.edges_every,
        on_step=burst.on_step(level),
    )
    without = replace(found.best, model=transparent)
    if objects is None:
        return without, None
    opaque, error_without_reflection = objects
    return without, _Explanation(
        model=opaque,
        one_layer_error=error_without_reflection,
        two_layer_error=float(opaque.data_losses[0]),
    )


# --- name


@final
@dataclass(frozen=True)
class _Named:
    """The model whose first layers are T, and whose last layer is R."""

    explanation: _Explanation
    layers: Floats
    """T and R of the reference frame, (2, h, w, 3)."""
    naming: float
    """See `naming_of`."""
    is_exchanged: bool = False
    """Whether the layers had each other's names before."""


def _name(transparent: _Explanation, opaque: _Explanation | None, images: _Images) -> _Named:
    """Chooses whether there are objects, and which layer is T."""
    named = _named(transparent, images)
    if opaque:
        with_them = _named(opaque, images)
        if with_them.naming > abs(named.naming) - _MAX_NAMING_LOSS:
            return with_them  # never exchanged: what hides the wall is no reflection
    if named.naming < 0:
        return _Named(
            explanation=replace(transparent, model=transparent.model.exchanged()),
            layers=named.layers[::-1],
            naming=-named.naming,
            is_exchanged=True,
        )
    return named


def _named(explanation: _Explanation, images: _Images) -> _Named:
    """Returns a model with the names that it has."""
    layers, (frame, prior) = (
        np.stack([resized(image, NAMING_PX) for image in some])
        for some in (
            images.reference_layers(explanation.model),
            (images.reference_frame, images.prior),
        )
    )
    naming = naming_of(layers, frame, prior)
    return _Named(explanation=explanation, layers=layers, naming=naming)


def _solution(model: JointModel, images: _Images, named: _Named, *, is_small: bool) -> Solution:
    """Returns the solution: the model after the last level, whose images these are. In a small
    motion, two scenes side by side or the border of the glass do not show.
    """
    prior = images.prior[..., :3]
    frame = images.reference_frame[..., :3]
    measured = images.reference_layers(model)
    motion = float(model.relative_motion(*_MOTION_SAMPLES)[0])
    errors = model.collected_errors(images.frames, layer=0)
    is_compared = len(model.layers[0]) == 2 and not is_small
    has_border = motion >= MIN_COMPARED_MOTION and not is_small
    return Solution(
        measured=measured,
        predicted=np.stack([prior, frame - prior]).clip(0),
        frame_errors=errors,
        relative_motion=motion,
        naming=named.naming,
        edge_correlation=edge_correlation(named.layers),
        one_layer_error=named.explanation.one_layer_error,
        two_layer_error=named.explanation.two_layer_error,
        side_by_side=compare_side_by_side(model, images.frames, errors) if is_compared else None,
        without_glass=without_glass(measured) if has_border else None,
        is_small=is_small,
        model=model,
    )
