"""Finds both layers and their motions, from coarse to fine: many candidates on small frames, the
best one on larger frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from brewster.film.motion.learned_light import LIGHT_PX, with_light
from brewster.film.motion.mixed_scenes import MixedScenes, find_mixed_scenes
from brewster.film.motion.model.joint_model import Doubles, Floats, JointModel
from brewster.film.motion.model.levels import (
    ALIGNMENT,
    LEVELS,
    NAMING_PX,
    SEARCH,
    SMALL_SEARCH,
    Level,
    without_enlargement,
)
from brewster.film.motion.naming import (
    brightness_cue,
    detail_cue,
    edge_correlation,
    reflection_share,
)
from brewster.film.motion.objects import (
    FINAL_STEPS,
    FIRST_STEPS,
    OPACITY_STEPS,
    SEARCH_STEPS,
    with_objects,
)
from brewster.film.motion.pane import without_glass
from brewster.film.motion.registration.candidates import MotionCandidate
from brewster.film.motion.resizing import resized
from brewster.film.motion.search import (
    Found,
    compared_small_motion,
    search_candidates,
    search_small_motion,
)
from brewster.film.motion.side_by_side import compare_side_by_side
from brewster.film.motion.small_motions import MIN_EVIDENCE, WEAK_EVIDENCE, SmallMotion
from brewster.film.motion.smooth_light import with_moved_light
from brewster.film.motion.solution import MIN_COMPARED_MOTION, Solution
from brewster.film.motion.stages import (
    MOTION_SAMPLES,
    Explanation,
    Images,
    Progress,
    SolverInput,
    cost_of,
)

FindLight = Callable[[Floats, Floats, Floats], Floats]
"""See `learned_light.find_light`."""
_MAX_NAMING_LOSS: Final = 0.1
"""There are no objects if the layers are told apart less clearly with them by more than this: a
part of T became R.
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
    find_light: FindLight | None = None,
    search: Sequence[Level] = SEARCH,
    levels: Sequence[Level] = LEVELS,
    on_progress: Callable[[float], None] = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> Solution:
    """Returns the layers of the reference frame for the best of the candidates.

    The stages: search (which candidate is best), search for a small motion, refine (the best one,
    at its first level), add objects, name (which layer is T), and refine (at the other levels).
    Before each of these, smooth light moves between the layers of a large motion
    (smooth_light.py), and T becomes its own prior. Once, light moves as a network asks for it
    (learned_light.py).

    Args:
        frames: (h, w, 3) linear light, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        candidates: guesses for the motions. One of them is locked.
        exposures: (K, 3), those of the frames, see `fitted_exposures`; by default, 1.
        refine_prior: returns a better `prior`, given the measured share of R in the light of the
            reference frame, (h, w, 1).
        find_light: returns light that moves from R to T, see `learned_light.find_light`; by
            default, none moves in this way.
        search: the levels that compare the candidates.
        levels: the levels of the best candidate.
        on_progress: called with the completed fraction.
        on_layers: called after each level but the last with T and R of the reference frame so far,
            (2, h, w, 3) linear light.
    """
    search = without_enlargement(search, frames)
    levels = without_enlargement(levels, frames)
    burst = SolverInput(
        frames=frames,
        reference=reference,
        prior=prior,
        exposures=np.ones((len(frames), 3)) if exposures is None else exposures,
        progress=Progress(_total_cost(search, levels), on_progress),
        on_layers=on_layers,
    )
    found = search_candidates(burst, search, candidates)
    small = search_small_motion(burst, found, candidates)
    is_compared = found.best.explained >= _MIN_COMPARED
    if small and small.evidence >= (MIN_EVIDENCE if is_compared else WEAK_EVIDENCE):
        found = compared_small_motion(burst, small, found.best if is_compared else None) or found
    solution = _refined(burst, found, levels, refine_prior, find_light)
    return replace(solution, small_motion_evidence=small.evidence if small else 0.0)


def solve_small_motion(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    small: SmallMotion,
    *,
    exposures: Doubles,
    refine_prior: Callable[[Floats], Floats] | None = None,
    find_light: FindLight | None = None,
    levels: Sequence[Level] = LEVELS,
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
        find_light: see `solve`.
        levels: see `solve`.
        on_progress: see `solve`.
        on_layers: see `solve`.
    """
    levels = without_enlargement(levels, frames)
    burst = SolverInput(
        frames=frames,
        reference=reference,
        prior=prior,
        exposures=exposures,
        progress=Progress(_total_cost([], levels), on_progress),
        on_layers=on_layers,
    )
    found = compared_small_motion(burst, small)
    assert found  # without a rival
    solution = _refined(burst, found, levels, refine_prior, find_light)
    return replace(solution, small_motion_evidence=small.evidence)


def _total_cost(search: Sequence[Level], levels: Sequence[Level]) -> float:
    """Returns the cost of all steps, those of the objects and of a small motion included."""
    objects = (OPACITY_STEPS + FIRST_STEPS + SEARCH_STEPS + FINAL_STEPS) * levels[0].step_cost
    compared = cost_of([*search, ALIGNMENT, SMALL_SEARCH])
    return compared + cost_of(levels) + objects


def _refined(
    burst: SolverInput,
    found: Found,
    levels: Sequence[Level],
    refine_prior: Callable[[Floats], Floats] | None,
    find_light: FindLight | None = None,
) -> Solution:
    """Refines the best candidate: all stages after the search. For the arguments, see `solve`."""
    refined_prior = refine_prior or (lambda _share: burst.prior)
    first, *others = levels
    prior_of_level = refined_prior(found.reflection_share)
    images = burst.at(first, prior_of_level)
    model = burst.optimised(found.best.model, first, images)
    named = _name(*_add_objects(burst, found, first, images, model), images)
    if named.is_exchanged:  # the prior has pulled the other layer so far
        prior_of_level = refined_prior(reflection_share(named.layers))
    model = named.explanation.model
    coarse = model, images
    predicted = prior_of_level
    for number, level in enumerate(others):
        burst.on_layers(images.reference_layers(model))
        is_movable = len(model.layers[0]) == 2
        is_size_of_network = max(images.frames.shape[1:3]) == LIGHT_PX < level.long_side_px
        if find_light and is_movable and is_size_of_network:
            light = find_light(
                images.reference_layers(model),
                images.reference_frame[..., :3],
                resized(predicted, LIGHT_PX),
            )
            model = with_light(model, light)
            prior_of_level = burst.own_prior(images, model)
        moved = with_moved_light(model, images.frames) if is_movable else None
        if moved:
            model = moved
            if number or not named.is_exchanged:
                prior_of_level = burst.own_prior(images, model)
        images = burst.at(level, prior_of_level)
        model = burst.optimised(model, level, images)
        if level.long_side_px <= NAMING_PX:
            coarse = model, images
    mixed_scenes = None if found.is_small else _mixed_scenes(*coarse)
    return _solution(model, images, named, mixed_scenes, is_small=found.is_small)


def _add_objects(
    burst: SolverInput, found: Found, level: Level, images: Images, model: JointModel
) -> tuple[Explanation, Explanation | None]:
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
    return without, Explanation(
        model=opaque,
        one_layer_error=error_without_reflection,
        two_layer_error=float(opaque.data_losses[0]),
    )


@final
@dataclass(frozen=True)
class _Named:
    """The model whose first layers are T, and whose last layer is R."""

    explanation: Explanation
    layers: Floats
    """T and R of the reference frame, (2, h, w, 3)."""
    naming: float
    """How much more clearly the first layer is T than the second: see `detail_cue` and
    `brightness_cue`.
    """
    is_exchanged: bool = False
    """Whether the layers had each other's names before."""


def _name(transparent: Explanation, opaque: Explanation | None, images: Images) -> _Named:
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


def _named(explanation: Explanation, images: Images) -> _Named:
    """Returns a model with the names that it has."""
    layers, (frame, prior) = (
        np.stack([resized(image, NAMING_PX) for image in some])
        for some in (
            images.reference_layers(explanation.model),
            (images.reference_frame, images.prior),
        )
    )
    return _Named(
        explanation=explanation,
        layers=layers,
        naming=detail_cue(layers, frame, prior) + brightness_cue(layers),
    )


def _mixed_scenes(model: JointModel, images: Images) -> MixedScenes:
    """Returns whether two scenes became one layer, from the level at which the layers were named:
    at the next ones, the errors are those of fine detail.
    """
    errors = model.collected_errors(images.frames, layer=0)
    return find_mixed_scenes(model, images.frames, errors)


def _solution(
    model: JointModel,
    images: Images,
    named: _Named,
    mixed_scenes: MixedScenes | None,
    *,
    is_small: bool,
) -> Solution:
    """Returns the solution: the model after the last level, whose images these are. In a small
    motion, two scenes side by side or the border of the glass do not show.
    """
    prior = images.prior[..., :3]
    frame = images.reference_frame[..., :3]
    measured = images.reference_layers(model)
    motion = float(model.relative_motion(*MOTION_SAMPLES)[0])
    errors = model.collected_errors(images.frames, layer=0)
    is_compared = len(model.layers[0]) == 2 and not is_small
    is_large = motion >= MIN_COMPARED_MOTION and not is_small
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
        mixed_scenes=mixed_scenes,
        without_glass=without_glass(measured) if is_large else None,
        is_small=is_small,
        model=model,
    )
