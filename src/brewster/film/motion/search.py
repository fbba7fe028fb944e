"""Searches the motions that explain a burst best: many candidates on small frames, and small
motions on larger ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from brewster.film.motion.model.joint_model import Doubles, Floats, JointModel, pixel_grid, project
from brewster.film.motion.model.levels import ALIGNMENT, SMALL_SEARCH, Level, without_enlargement
from brewster.film.motion.naming import reflection_share
from brewster.film.motion.registration.candidates import MotionCandidate
from brewster.film.motion.small_motions import SmallMotion, find_small_motion, homographies_of
from brewster.film.motion.stages import MOTION_SAMPLES, Explanation, SolverInput

MAX_RELATIVE_MOTION: Final = 0.2
"""As a share of the width. With a larger motion, the reflection becomes an offset of each frame,
and explains all but edges.
"""
_MIN_DIFFERENCE: Final = 0.008
"""Two motions are different if they differ by this share of the frame's size."""
_MAX_MOTIONS: Final = 14
_CLEAR_MOTION: Final = 0.03
_CLEAR_EXPLAINED: Final = 0.35
"""With a relative motion of this share of the width, which explains this share of the errors of one
layer, no small motion is looked for.
"""


@final
@dataclass(frozen=True)
class Found:
    """The result of the search."""

    best: Explanation
    """The best candidate with two layers."""
    reflection_share: Floats
    """(h, w, 1): see `solve`."""
    other_motions: Sequence[Doubles]
    """(K, 3, 3) each: those that objects, or the reflection in front of them, may have."""
    is_small: bool = False
    """Whether the best candidate is a small motion."""


def search_candidates(
    burst: SolverInput, levels: Sequence[Level], candidates: Sequence[MotionCandidate]
) -> Found:
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
    explanation = Explanation(
        model=model.selected([best]),
        one_layer_error=float(model.data_losses[one_layer]),
        two_layer_error=float(model.data_losses[best]),
    )
    return Found(
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
    return model.losses + (model.relative_motion(*MOTION_SAMPLES) > MAX_RELATIVE_MOTION)


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


def search_small_motion(
    burst: SolverInput, found: Found, candidates: Sequence[MotionCandidate]
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


def compared_small_motion(
    burst: SolverInput, small: SmallMotion, rival: Explanation | None = None
) -> Found | None:
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
    return Found(
        best=Explanation(
            model=best,
            one_layer_error=float(model.data_losses[0]),
            two_layer_error=float(model.data_losses[1]),
        ),
        reflection_share=reflection_share(images.reference_layers(best)),
        other_motions=(),
        is_small=True,
    )
