"""Decides whether the measured motion separates the layers of a burst, and reports why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, final

import numpy as np

from brewster.film.motion.model.levels import MIN_SIDE_PX
from brewster.film.motion.small_motions import MIN_EVIDENCE, WEAK_EVIDENCE
from brewster.film.motion.solution import Solution
from brewster.separation.assessment import Verdict, encoded_change
from brewster.separation.burst_report import EXCHANGE_STEP, BurstReport

_MIN_MOTION_PX: Final = 10.0
"""The smallest relative motion that separates the layers by what it explains, in pixels of a photo
that is 1,000 pixels wide. Smaller ones count by their evidence (motion/small_motions.py).
"""
_MIN_SMALL_MOTION_PX: Final = 2.0
"""With a smaller motion, the layers share all structures that frames of 1,000 pixels show."""
_MIN_EXPLAINED: Final = 0.2
_MIN_EXPLAINED_IF_LARGE: Final = 0.12
_FEW_PHOTOS: Final = 4
_MIN_EXPLAINED_OF_FEW: Final = 0.5
"""In fewer photos, a second layer explains a part of the noise: up to .47 in two photos with one
zoom each, .21 in three, .17 in four. See dev/notes/burst.md.
"""
_LARGE_EXPLAINED: Final = 0.0012
"""The smallest share of the errors of one layer that a second motion must explain, or of large
errors: depth behind the glass leaves errors in real photos. See dev/notes/burst.md.
"""
_MIN_ERROR: Final = 1e-9
"""Added to the errors of one layer, which may be 0."""
_USEFUL_MOTION_PX: Final = 16
_MAX_EDGE_CORRELATION: Final = 0.2
"""If the edges of both layers correlate more, they are not two scenes. See dev/notes/burst.md."""
_MAX_EDGE_CORRELATION_IF_SMALL: Final = 0.25
"""The same for a small motion with evidence."""
_MAX_COPY_MOTION_PX: Final = 30.0
"""With a larger motion, the second layer is no copy of the first, whatever the edges."""
_MIN_CERTAIN_NAMING: Final = 0.3
_MIN_CERTAIN_NAMING_IF_SMALL: Final = 0.6
"""Below, the names are asked; for a small motion, the second one. See dev/notes/burst.md and
dev/notes/phone-photos.md.
"""
_CLEAR_EXPLAINED: Final = 0.25
_CLEAR_ERROR: Final = 0.014
_CLEAR_DOUBTFUL_AREA: Final = 0.05
"""Layers that explain this share of the errors of one layer, leave no larger error of the photos in
the median, as a difference of square roots of light, and are not doubtful in a larger area, are
"removed" instead of "partly removed".
"""
_MAX_DOUBTFUL_AREA: Final = 0.25
_MENTIONED_AREA: Final = 0.02
"""A smaller doubtful area is not mentioned in the message."""
_VISIBLE_CHANGE: Final = 0.03
_MIN_CHANGED_AREA: Final = 0.01
"""If a smaller share of the photo changes by this, sRGB-encoded, little was found. See
dev/notes/burst.md.
"""
_ADVICE: Final = "Move the camera by 5 to 10 cm between the photos, best along a circle."
_SIDE_BY_SIDE: Final = (
    "Two scenes lie side by side, as a mirror or a door beside a wall, and two layers do not "
    "explain them: the photo stays as it is."
)

Method = Literal["burst", "hints", "single photo", "unchanged"]
"""See `BurstReport`."""


def burst_report(
    solution: Solution | None,
    verdict: Verdict | None,
    count: int,
    left_out: tuple[int, ...],
    reference: int,
) -> BurstReport:
    """Decides whether the motion separates the layers.

    Args:
        solution: the measured layers, None if there are none.
        verdict: that of the single photo, None if nothing was measured.
        count: the number of photos of the burst.
        left_out: the indices of photos that do not show the scene of the reference photo.
        reference: the index of the reference photo.
    """
    if solution is None:
        return BurstReport(
            method="single photo",
            message=_no_layers(left_out) + _without(left_out),
            frames=count - len(left_out),
            left_out=left_out,
            reference=reference,
            relative_motion_px=0.0,
            explained=0.0,
            edge_correlation=0.0,
        )
    evidence = _Evidence.of(solution, count - len(left_out))
    method, message = _decision(evidence, is_doubted=verdict == "little found")
    is_side_by_side = method == "burst" and solution.is_side_by_side
    is_separated = method == "burst" and not is_side_by_side
    doubtful_area = round(float(solution.doubtful.mean()), 4)
    if is_side_by_side:
        method = "unchanged"
        message = _SIDE_BY_SIDE
    elif is_separated and doubtful_area >= _MENTIONED_AREA:
        message += (
            f" In {100 * doubtful_area:.0f} % of the picture, neither layer explains the photos: "
            "there, the transmission is that of the single photo."
        )
    return BurstReport(
        method=method,
        message=message + _without(left_out),
        frames=count - len(left_out),
        left_out=left_out,
        reference=reference,
        relative_motion_px=round(evidence.motion_px, 2),
        explained=round(evidence.explained, 4),
        edge_correlation=round(solution.edge_correlation, 4),
        next_step=_next_step(method, is_certain=evidence.are_names_certain),
        is_measured=True,
        are_names_certain=evidence.are_names_certain,
        is_second_motion_seen=(evidence.has_two_layers or evidence.is_weak) and not is_side_by_side,
        second_motion=round(solution.small_motion_evidence, 4),
        measured_verdict=_measured_verdict(solution, evidence) if is_separated else "doubtful",
        doubtful_area=doubtful_area,
        is_side_by_side=is_side_by_side,
    )


def _measured_verdict(solution: Solution, evidence: _Evidence) -> Verdict:
    """Returns the verdict of layers that the motion separates."""
    transmission, reflection = solution.layers
    change = encoded_change(transmission + reflection, transmission)
    doubtful_area = solution.doubtful.mean()
    if doubtful_area > _MAX_DOUBTFUL_AREA:
        return "doubtful"
    if np.mean(change > _VISIBLE_CHANGE) < _MIN_CHANGED_AREA:
        return "little found"
    is_clear = (
        evidence.explained >= _CLEAR_EXPLAINED
        and np.median(solution.frame_errors) <= _CLEAR_ERROR
        and doubtful_area <= _CLEAR_DOUBTFUL_AREA
        # A small motion shows the light of large areas less well
        and evidence.motion_px >= _MIN_MOTION_PX
        and not solution.is_small
    )
    return "removed" if is_clear else "partly removed"


@final
@dataclass(frozen=True)
class _Evidence:
    """What a solution says about the layers."""

    motion_px: float
    """See `BurstReport.relative_motion_px`."""
    explained: float
    """See `BurstReport`."""
    has_two_layers: bool
    """Whether a second motion explains enough, and is not that of a copy of the first layer."""
    has_small_motion: bool
    """Whether a small second motion is certain, so that a relative motion of a few pixels does."""
    is_weak: bool
    """Whether they have one that is seen, but too weakly for layers."""
    are_names_certain: bool

    @classmethod
    def of(cls, solution: Solution, count: int) -> _Evidence:
        """Reads it from a solution of so many photos."""
        motion_px = 1000 * solution.relative_motion
        remaining = solution.two_layer_error / (solution.one_layer_error + _MIN_ERROR)
        explained = max(0.0, 1 - remaining)
        is_large = explained * solution.one_layer_error >= _LARGE_EXPLAINED
        if is_large:
            least = _MIN_EXPLAINED_IF_LARGE
        else:
            least = _MIN_EXPLAINED if count >= _FEW_PHOTOS else _MIN_EXPLAINED_OF_FEW
        is_explained = explained >= least
        is_copy = (
            motion_px < _MAX_COPY_MOTION_PX and solution.edge_correlation > _MAX_EDGE_CORRELATION
        )
        has_small_motion = (
            (solution.is_small or motion_px < _USEFUL_MOTION_PX)
            and solution.small_motion_evidence >= MIN_EVIDENCE
            and solution.edge_correlation <= _MAX_EDGE_CORRELATION_IF_SMALL
        )
        has_large_motion = not solution.is_small and is_explained and not is_copy
        least_naming = _MIN_CERTAIN_NAMING_IF_SMALL if solution.is_small else _MIN_CERTAIN_NAMING
        return cls(
            motion_px=motion_px,
            explained=explained,
            has_two_layers=has_small_motion or has_large_motion,
            has_small_motion=has_small_motion,
            is_weak=solution.is_small and solution.small_motion_evidence >= WEAK_EVIDENCE,
            are_names_certain=solution.naming >= least_naming,
        )


def _decision(evidence: _Evidence, *, is_doubted: bool) -> tuple[Method, str]:
    """Returns the method and its reason. `is_doubted`: no reflection was found in the single photo.

    That one layer explains all photos is no sign that there is no reflection: it was so for two
    weak ones, and at equal distances.
    """
    moved = f"The layers moved apart by {evidence.motion_px / 10:.1f} % of the width"
    if evidence.has_small_motion:
        needed_px = _MIN_SMALL_MOTION_PX
    else:
        needed_px = _USEFUL_MOTION_PX if is_doubted else _MIN_MOTION_PX
    if evidence.has_two_layers and evidence.motion_px >= needed_px:
        return "burst", f"{moved}."
    if is_doubted:
        return "unchanged", (
            "Little reflection was found, in the motion and in the reference photo. If there is "
            "one, separate this photo alone."
        )
    if not evidence.has_two_layers:
        return "single photo", f"No relative motion of two layers was found. {_ADVICE}"
    return "single photo", f"{moved}, too little to tell them apart. {_ADVICE}"


def _next_step(method: Method, *, is_certain: bool) -> str | None:
    """Returns the option that shows the other result of a burst with measured layers."""
    if method != "burst":
        return 'The method "motion" uses the measured layers anyway.'
    if not is_certain:
        return EXCHANGE_STEP
    return None


def _no_layers(left_out: tuple[int, ...]) -> str:
    """Returns why there are no measured layers."""
    if left_out:
        return "No other photo shows the same scene as the reference photo with the same zoom."
    return f"Photos with less than {MIN_SIDE_PX} pixels are too small to show the motion."


def _without(left_out: tuple[int, ...]) -> str:
    """Returns the sentence about photos that were left out, after a space, or nothing."""
    if not left_out:
        return ""
    names = ", ".join(str(k + 1) for k in left_out)
    return f" Left out, because their scene or zoom is not that of the reference photo: {names}."
