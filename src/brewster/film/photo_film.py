"""Separates a photo by the film that a phone recorded around it.

- A few frames show whether a second layer moves in the film at all (motion/small_motions.py): most
  films end here.
- The frame that shows the view of the still is found, and its homography (still_registration.py).
- The layers of this frame are measured from the small motion of the hand; the prior is that of the
  still, which is sharper than a frame.
- The shares of both layers in the light of the frame are carried to the still, and applied to it at
  full size, as a prediction of a model is. The layers themselves would not fit: the still has
  another tone, and is merged from several exposures.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Self, final

import numpy as np
from numpy.typing import NDArray

from brewster.errors import error_prefix
from brewster.film.film_shares import carried, hint_strokes, moved_share
from brewster.film.fitted_burst import FittedBurst
from brewster.film.measuring import prior_with_hints, single_photo
from brewster.film.motion.compilation import compile_in_background
from brewster.film.motion.learned_light import find_light
from brewster.film.motion.model.exposure import fitted_exposures
from brewster.film.motion.model.joint_model import Doubles, Floats
from brewster.film.motion.registration.homographies import normalised
from brewster.film.motion.registration.tracks import (
    Track,
    layer_tracks,
    likeliest_first,
    without_zoom,
)
from brewster.film.motion.resizing import resized
from brewster.film.motion.small_motions import WEAK_EVIDENCE, SmallMotion, find_small_motion
from brewster.film.motion.solution import Solution
from brewster.film.motion.solver import solve_small_motion
from brewster.film.motion.threads import single_opencv_thread
from brewster.film.self_check import burst_report
from brewster.film.still_registration import StillMatch, match_still
from brewster.film.tracking import linear_light
from brewster.film.video.choosing import FilmMeasurements, choose
from brewster.film.video.film import WORKING_PX, Film
from brewster.options import DEFAULT_FRAMES, Options
from brewster.photo import Photo, Source
from brewster.photo.phone_films.motion_photo import PhotoFilm
from brewster.photo.srgb import to_8bit
from brewster.separation.assessment import Verdict
from brewster.separation.burst_report import BurstReport, PhotoFilmReport
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separator import Separator, timed
from brewster.separation.used_film import MAX_FILM_S

_READ: Final = 0.15
_SEARCHED: Final = 0.3
_MATCHED: Final = 0.45
"""The completed fractions after the film was read, searched for a motion, and compared with the
still.
"""
_SEARCH_PX: Final = 500
"""The long side of the frames whose features are compared to align the scene."""
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
        film: the film of the photo, from `brewster.photo.phone_films.motion_photo`.
        separator: separates the still alone; by default, the compact model.
        hints: strokes of a person on the still, for the photo alone; see the call of a `Separator`.
        max_pixels: films with larger frames are refused.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.
        on_layers: called with the layers so far, see `brewster.film.motion.solver.solve`.

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
        compile_in_background()
        pictures, times, path = _decoded(
            film, data, max_pixels, lambda done: on_progress(_READ * done)
        )
    size = pictures[0].shape[:2]
    with timed(seconds, "network"):
        height = max(8, round(size[1] * photo.size[1] / photo.size[0]))
        still = photo.resized(size[1], height)
        prior, verdict = single_photo(separator, photo, still, hints)
    nearest = _stated_frame(film, times)
    with timed(seconds, "motion"):
        moving = _Moving.find(pictures, choose_around(path, nearest), nearest)
    on_progress(_SEARCHED)
    match: StillMatch | None = None
    if moving.is_seen:
        with timed(seconds, "matching"):
            match = match_still(to_8bit(still), pictures, nearest)
        on_progress(_MATCHED)
    solution: Solution | None = None
    if match:
        with timed(seconds, "motion"):
            share = moved_share(prior, still, match.homography, size)
            moving = moving.around_match(pictures, path, match.frame, share)
            del pictures  # not needed in memory any more
            solution = moving.solved(
                share,
                separator if separator.takes_hints and hints is None else None,
                on_progress=lambda done: on_progress(_MATCHED + (1 - _MATCHED) * done),
                on_layers=on_layers,
            )
            solution = solution and carried(solution, match.homography, still, prior)
    takes_hints = separator.takes_hints
    report, strokes = _decision(solution, moving, verdict, photo.size if takes_hints else None)
    report = replace(
        report,
        message=_message(report, is_other_scene=moving.is_seen and not match),
        next_step=_next_step(report),
        film=_film_report(film, data, times, match),
    )
    return FittedBurst(photo, report, seconds, solution, separator, hints, film_hints=strokes)


def _decoded(
    film: PhotoFilm, data: bytes, max_pixels: int, on_progress: ProgressCallback
) -> tuple[Sequence[NDArray[np.uint8]], list[float], FilmMeasurements]:
    """Returns all frames of the film of a photo at the working size, their times in seconds, and
    their measurements.

    Args:
        film: the film of the photo.
        data: its bytes.
        max_pixels: films with larger frames are refused.
        on_progress: called with the completed fraction, 0 to 1.
    """
    with error_prefix(film.path if film.layout == "given" else None):
        frames = Film.read(
            data,
            seconds=MAX_FILM_S,
            is_cropped=False,  # what players hide of a Live Photo shows the border of the still
            max_pixels=max_pixels,
            on_progress=on_progress,
        )
        return frames.all_pictures(WORKING_PX), frames.times, frames.measurements


def _decision(
    solution: Solution | None,
    moving: _Moving,
    verdict: Verdict | None,
    hinted_size: tuple[int, int] | None,
) -> tuple[BurstReport, NDArray[np.uint8] | None]:
    """Decides whether the photo is separated by its film, with hints from it, or alone, or is left
    unchanged. Returns the report, and the hints where the film shows a second layer.

    Args:
        solution: the measured layers, if there are any.
        moving: the frames of the film, and the motion in them.
        verdict: that of the photo alone.
        hinted_size: width and height of the hints; None for a model that takes none.
    """
    reference = moving.frames.index(moving.reference)
    report = burst_report(solution, verdict, len(moving.frames), (), reference)
    report = replace(report, second_motion=round(moving.evidence, 4))
    if verdict == "little found" and report.method == "single photo" and not moving.is_seen:
        return replace(report, method="unchanged"), None
    if solution is None or hinted_size is None or not report.is_second_motion_seen:
        return report, None
    strokes = hint_strokes(solution, hinted_size)
    if report.method != "burst" and strokes is not None:
        report = replace(report, method="hints")
    return report, strokes


def _stated_frame(film: PhotoFilm, times: Sequence[float]) -> int:
    """Returns the index of the frame at the stated time of the still, or of the middle one."""
    if film.still_time_s is None:
        return len(times) // 2
    return int(np.abs(np.array(times) - times[0] - film.still_time_s).argmin())


def _film_report(
    film: PhotoFilm, data: bytes, times: Sequence[float], match: StillMatch | None
) -> PhotoFilmReport:
    """Describes the film that was used.

    Args:
        film: the film of the photo.
        data: its bytes.
        times: the time of each frame in seconds.
        match: the frame that shows the view of the still, if it was looked for and found.
    """
    return PhotoFilmReport(
        layout=film.layout,
        seconds=round(times[-1] - times[0], 3),
        frames=len(times),
        sha256=hashlib.sha256(data).hexdigest(),
        nearest_frame=match.frame if match else None,
    )


def _message(report: BurstReport, *, is_other_scene: bool) -> str:
    """Returns what was used, and why."""
    moved = f"{report.relative_motion_px / 10:.1f} % of the width"
    if is_other_scene:
        reason = "No frame of its film shows the scene of the photo."
    elif report.is_side_by_side:
        reason = "In its film, two scenes lie side by side, as a mirror or a door beside a wall."
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


@final
@dataclass(frozen=True)
class _Moving:
    """Frames of a film, and the small motion of a second layer in them."""

    frames: list[int]
    """The indices of the frames in the film."""
    reference: int
    """One of them."""
    light: list[Floats]
    """(h, w, 3) linear light of each."""
    exposures: Doubles
    """(K, 3)"""
    small: SmallMotion | None
    """None if no other frame shows the scene of the reference frame, or the frames are equal."""
    tracks: list[Track]
    """The motions that features show; the first one was taken for that of T."""

    @classmethod
    def find(
        cls,
        pictures: Sequence[NDArray[np.uint8]],
        frames: list[int],
        reference: int,
        prior_share: Floats | None = None,
    ) -> Self:
        """Looks for the motion.

        Args:
            pictures: (h, w, 3), all frames of the film.
            frames: the indices of those that are compared.
            reference: the index of the reference frame, one of them.
            prior_share: the share of T in its light, (h, w, 3). It decides which of several motions
                is that of T; without it, the one with most features is.
        """
        with single_opencv_thread():
            all_light = [linear_light(pictures[k]) for k in frames]
            small = [resized(light, _SEARCH_PX) for light in all_light]
            place = frames.index(reference)
            prior = small[place]
            if prior_share is not None:
                prior = prior * resized(prior_share, _SEARCH_PX)
            tracks = without_zoom(layer_tracks(small, place, prior), prior.shape[:2])
            found = tracks[0].found if tracks else [place]
            used = [frames[k] for k in found]
            place = used.index(reference)
            light = [all_light[k] for k in found]
            exposures = np.ones((len(used), 3))
            motion = None
            if len(used) > 1:
                size = small[0].shape[:2]
                shown = [matrix for matrix in tracks[0].motions if matrix is not None]
                transmission = normalised(np.linalg.inv(np.stack(shown)), size, size)
                exposures = fitted_exposures(light, place, transmission)
                motion = find_small_motion(
                    light, place, light[place], transmission, exposures=exposures
                )
        return cls(
            frames=used,
            reference=reference,
            light=light,
            exposures=exposures,
            small=motion,
            tracks=tracks,
        )

    @property
    def evidence(self) -> float:
        """See `SmallMotion`."""
        return self.small.evidence if self.small else 0.0

    @property
    def is_seen(self) -> bool:
        """Whether the film shows a second layer."""
        return self.evidence >= WEAK_EVIDENCE

    def is_other_scene(self, prior_share: Floats) -> bool:
        """Returns whether the motion that was taken for that of T is likely that of the mirrored
        scene.

        Args:
            prior_share: the share of T in the light of the reference frame, (h, w, 3).
        """
        if len(self.tracks) < 2:
            return False
        frame = resized(self.light[self.frames.index(self.reference)], _SEARCH_PX)
        prior = frame * resized(prior_share, _SEARCH_PX)
        return likeliest_first(self.tracks, frame, prior)[0] is not self.tracks[0]

    def around_match(
        self,
        pictures: Sequence[NDArray[np.uint8]],
        path: FilmMeasurements,
        matched: int,
        prior_share: Floats,
    ) -> _Moving:
        """Looks for the motion again if another frame is that of the still, or if the motion was
        likely that of the mirrored scene.

        Args:
            pictures: (h, w, 3), all frames of the film.
            path: the measurements of all frames.
            matched: the index of the frame that shows the view of the still.
            prior_share: see `find`.
        """
        if matched == self.reference and not self.is_other_scene(prior_share):
            return self
        return _Moving.find(pictures, choose_around(path, matched), matched, prior_share)

    def solved(
        self,
        prior_share: Floats,
        hinted: Separator | None,
        *,
        on_progress: ProgressCallback,
        on_layers: Callable[[Floats], None],
    ) -> Solution | None:
        """Measures the layers of the reference frame, if the film shows a second layer.

        Args:
            prior_share: the share of T in its light, (h, w, 3).
            hinted: refines the prior with hints, if it is not None.
            on_progress: called with the completed fraction.
            on_layers: see `solve`.
        """
        if not self.small or not self.is_seen:
            return None
        place = self.frames.index(self.reference)
        frame = self.light[place]
        with single_opencv_thread():
            return solve_small_motion(
                self.light,
                place,
                prior_share * frame,
                self.small,
                exposures=self.exposures,
                refine_prior=partial(prior_with_hints, hinted, frame) if hinted else None,
                find_light=find_light,
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
