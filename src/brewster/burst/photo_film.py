"""Separates a photo by the film that a phone recorded around it.

1. The frame of the film that shows the view of the still is found, and its homography
(still_registration.py). 2. The layers of this frame are measured from the motion in the film, as in
a burst (separate.py); the prior is that of the still, which is sharper than a frame. 3. The shares
of both layers in the light of the frame are carried to the still, and applied to it at full size,
as a prediction of a model is. The layers themselves would not fit: the still has another tone, and
is merged from several exposures.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from brewster.burst.film import FilmMeasurements, choose
from brewster.burst.film_shares import carried, hint_strokes, moved_share
from brewster.burst.joint_model import Floats
from brewster.burst.self_check import burst_report
from brewster.burst.separate import FittedBurst, measure_layers, prior_with_hints
from brewster.burst.solution import Solution
from brewster.burst.still_registration import encoded, match_still
from brewster.burst.tracking import linear_light
from brewster.burst.video import WORKING_PX, Film
from brewster.inference.assessment import Verdict
from brewster.inference.burst_report import BurstReport, PhotoFilmReport
from brewster.inference.predictor import ProgressCallback
from brewster.inference.separator import Separator, timed
from brewster.inference.used_film import MAX_FILM_S
from brewster.options import DEFAULT_FRAMES, Options
from brewster.photo import Photo, Source
from brewster.photo.motion_photo import PhotoFilm

_READ: Final = 0.15
_MATCHED: Final = 0.3
"""The completed fractions after the film was read, and its frames compared with the still."""
_MAX_MOTION: Final = 0.03
"""A larger relative motion, as a share of the width, is none of a hand that holds a phone for a
second or three: a tremor moves the layers by .002 to .03 against each other.
"""
_CLEAR_MOTION_PX: Final = 16.0
"""Where the model finds little in the still, its film must show a larger motion than this, in
pixels of a photo that is 1,000 pixels wide. Films of most photos are looked at, and few photos were
taken through glass: a false separation is worse than a weak reflection that stays.
"""
_JUMP: Final = 0.05
"""A larger motion between two frames, as a share of the width, is no tremor of the hand."""
_USES: Final = {
    "burst": "Separated by its own film.",
    "hints": "Separated with hints from its film.",
    "single photo": "Separated as a photo alone.",
    "unchanged": "Left unchanged.",
}
"""Method of the report -> what it means for a photo with a film."""
_OPTIONS: Final = {
    "exchange": "The layers may have the wrong names: brewster burst PHOTO --swap exchanges them.",
    "measured": "brewster burst PHOTO --method motion uses the measured layers anyway.",
}
"""What shows the other result of a photo with measured layers."""


def fit_photo_film(
    photo: Photo,
    film: PhotoFilm,
    *,
    separator: Separator | None = None,
    hints: Source | None = Options.hints,
    max_pixels: int = Options.max_pixels,
    on_progress: ProgressCallback = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> FittedBurst:
    """Measures the layers of a photo by its film, but does not compute them at full size.

    Args:
        photo: the still.
        film: the film of the photo, from `brewster.photo.motion_photo`.
        separator: separates the still alone; by default, the compact model.
        hints: strokes of a person on the still, for the photo alone; see the call of a `Separator`.
        max_pixels: films with larger frames are refused.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.
        on_layers: called with the layers so far, see `brewster.burst.solver.solve`.

    Returns:
        The photo with its layers and a report. Its method is "burst" if the layers are measured,
        "hints" if the film only shows where the photo has a reflection, "single photo" if it helps
        in no way, and "unchanged" if neither film nor photo show a reflection.

    Raises:
        UnreadablePhoto: the film cannot be decoded, or has fewer than 2 frames.
        PhotoTooLarge: the frames have more than `max_pixels` pixels.
    """
    separator = separator or Separator.load()
    seconds = dict[str, float]()
    with timed(seconds, "film"):
        data = film.read()
        frames = Film.read(
            data,
            seconds=MAX_FILM_S,
            is_cropped=False,  # what players hide of a Live Photo shows the border of the still
            max_pixels=max_pixels,
            on_progress=lambda done: on_progress(_READ * done),
        )
        pictures = frames.pictures(range(len(frames.times)), WORKING_PX)
    size = pictures[0].shape[:2]
    with timed(seconds, "network"):
        still, prior, verdict = _single_photo(separator, photo, hints, size[1])
    with timed(seconds, "matching"):
        match = match_still(encoded(still), pictures, _stated_frame(film, frames.times))
    on_progress(_MATCHED)
    solution: Solution | None = None
    chosen: list[int] = []
    left_out: tuple[int, ...] = ()
    if match:
        chosen = choose_around(frames.measurements, match.frame)
        with timed(seconds, "motion"):
            solution, left_out = _measured(
                [linear_light(pictures[k]) for k in chosen],
                chosen.index(match.frame),
                moved_share(prior, still, match.homography, size),
                separator if separator.takes_hints and hints is None else None,
                on_progress=lambda done: on_progress(_MATCHED + (1 - _MATCHED) * done),
                on_layers=on_layers,
            )
        if solution:
            solution = carried(solution, match.homography, still, prior)
    report = burst_report(
        solution, verdict, len(chosen), left_out, chosen.index(match.frame) if match else 0
    )
    if verdict == "little found" and report.relative_motion_px < _CLEAR_MOTION_PX:
        report = replace(report, method="unchanged", is_second_motion_seen=False)
    strokes = None
    if solution and report.is_second_motion_seen and separator.takes_hints:
        strokes = hint_strokes(solution, photo.size)
    if report.method != "burst" and strokes is not None:
        report = replace(report, method="hints")
    report = replace(
        report,
        message=_message(report, has_match=match is not None),
        next_step=_next_step(report),
        film=PhotoFilmReport(
            layout=film.layout,
            seconds=round(frames.times[-1] - frames.times[0], 3),
            frames=len(pictures),
            sha256=hashlib.sha256(data).hexdigest(),
            nearest_frame=match.frame if match else None,
        ),
    )
    return FittedBurst(photo, report, seconds, solution, separator, hints, film_hints=strokes)


def _stated_frame(film: PhotoFilm, times: Sequence[float]) -> int | None:
    """Returns the index of the frame at the stated time of the still, or None."""
    if film.still_time_s is None:
        return None
    return int(np.abs(np.array(times) - times[0] - film.still_time_s).argmin())


def _message(report: BurstReport, *, has_match: bool) -> str:
    """Returns what was used, and why."""
    moved = f"{report.relative_motion_px / 10:.1f} % of the width"
    if not has_match:
        reason = "No frame of its film shows the scene of the photo."
    elif report.method == "unchanged":
        reason = "Neither its film nor the photo itself shows a reflection."
    elif not report.is_second_motion_seen:
        reason = "In its film, no reflection moves against the scene."
    elif report.method == "burst":
        reason = f"The layers moved apart by {moved}."
    else:
        reason = f"The layers moved apart by only {moved}, too little to measure them."
    return f"{_USES[report.method]} {reason}"


def _next_step(report: BurstReport) -> str | None:
    """Returns the command that shows the other result, or None."""
    if report.method == "burst":
        return None if report.are_names_certain else _OPTIONS["exchange"]
    return _OPTIONS["measured"] if report.is_second_motion_seen else None


def _single_photo(
    separator: Separator, photo: Photo, hints: Source | None, width: int
) -> tuple[Floats, Floats, Verdict]:
    """Returns the still at this width, (h, w, 3) linear light, T of it by the model alone, and the
    verdict about it.
    """
    height = max(8, round(width * photo.size[1] / photo.size[0]))
    still = photo.resized(width, height)
    upsampler, _, assessment = separator.fit(photo, quality="draft", hints=hints)
    transmission, _ = upsampler.apply(still, 0, height)
    return still, np.clip(transmission, 0, still), assessment.verdict


def _measured(
    frames: Sequence[Floats],
    reference: int,
    prior_share: Floats,
    hinted: Separator | None,
    *,
    on_progress: ProgressCallback,
    on_layers: Callable[[Floats], None],
) -> tuple[Solution | None, tuple[int, ...]]:
    """Measures the layers of the reference frame, see `measure_layers`. `hinted` refines the prior
    with hints, if it is not None.
    """
    frame = frames[reference]
    refine = partial(prior_with_hints, hinted, frame) if hinted else None
    return measure_layers(
        frames,
        reference,
        prior_share * frame,
        refine_prior=refine,
        max_motion=_MAX_MOTION,
        on_progress=on_progress,
        on_layers=on_layers,
    )


def choose_around(path: FilmMeasurements, nearest: int, count: int = DEFAULT_FRAMES) -> list[int]:
    """Returns the indices of `count` frames along the path of the camera, one of which is the frame
    that is nearest to the still.

    Phones are lowered at the end of a film, which moves the view by 75 to 100 px of 1,000 from one
    frame to the next: only frames without such a jump between them and the still are chosen.

    Args:
        path: the measurements of all frames.
        nearest: the index of the frame that is nearest to the still.
        count: the number of frames.
    """
    jumps = np.flatnonzero(np.diff(path.positions) > _JUMP) + 1
    first = max((int(k) for k in jumps if k <= nearest), default=0)
    last = min((int(k) for k in jumps if k > nearest), default=len(path.positions))
    chosen = {first + k for k in choose(path.part(first, last), count)}
    if nearest not in chosen and len(chosen) >= count:
        chosen.remove(min(chosen, key=lambda k: abs(k - nearest)))
    return sorted(chosen | {nearest})
