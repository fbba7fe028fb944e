"""Separates a burst: several photos of one window, with the camera moved between them.

    separation = separate_burst(["a.jpg", "b.jpg", "c.jpg"])
    separation.transmission.save("clear.jpg")
    print(separation.burst.message)

The layers of the reference photo are measured from the motion at 640 pixels (motion/solver.py), and
applied to the photo at full size as a prediction of a model is. If the motion does not separate the
layers, the result is that of the single photo.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from brewster.base.memory import give_back_memory
from brewster.film.fitted_burst import FittedBurst
from brewster.film.light.fit import LightFit, aligned_photos, fit_light
from brewster.film.light.registration import AlignedPhotos
from brewster.film.measuring import (
    measure_layers,
    prior_with_hints,
    single_photo,
    single_transmission,
)
from brewster.film.motion.compilation import compile_in_background
from brewster.film.motion.model.joint_model import Floats
from brewster.film.motion.registration.tracks import Track, layer_tracks
from brewster.film.motion.solution import Solution
from brewster.film.motion.threads import single_opencv_thread
from brewster.film.self_check import burst_report
from brewster.film.standing import seem_to_stand
from brewster.film.video.decoding import VideoFile
from brewster.film.video.film import read_video
from brewster.film.working_frames import checked_reference, open_photo, working_frames
from brewster.options import DEFAULT_FRAMES, BurstMethod, Options, Quality
from brewster.photo import Source
from brewster.photo.camera_settings import CameraSettings
from brewster.separation.assessment import Verdict
from brewster.separation.burst_report import BurstReport, check_photo_count
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separation import Separation
from brewster.separation.separator import Separator, timed


def separate_burst(
    photos: Sequence[Source] | VideoFile,
    *,
    reference: int | None = Options.reference,
    separator: Separator | None = None,
    method: BurstMethod = Options.method,
    swap: bool = Options.swap,
    strength: float = Options.strength,
    quality: Quality = Options.quality,
    mask: Source | None = Options.mask,
    hints: Source | None = Options.hints,
    additive: bool = Options.additive,
    max_pixels: int = Options.max_pixels,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> Separation:
    """Separates one of several photos of the same window, by the motion of the layers between the
    photos.

    Args:
        photos: 2 to 15 photos of one size, in the order in which they were taken; see `Photo.open`.
            For the method "light", up to 60.
            Or a film, a path or the bytes of its file, from which 7 frames are chosen; see
            `read_video`.
        reference: the index of the photo to separate, by default the middle one.
        separator: separates the single photo. Its result is the start, and the result if the motion
            is not enough. By default, the compact model.
        method: "auto" separates by the motion of the layers, or by the change of the light if the
            camera stood, if the measurement agrees with the photos; "motion" separates by the
            motion in any case, "light" by the light; "single" separates the photo alone.
        swap: whether the measured layers are exchanged: which of them is behind the glass is not
            always certain.
        strength: see the call of a `Separator`.
        quality: see the call of a `Separator`; it is that of the single photo.
        mask: see the call of a `Separator`.
        hints: see the call of a `Separator`; they are for the single photo.
        additive: see the call of a `Separator`.
        max_pixels: see the call of a `Separator`.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.

    Returns:
        The separation of the reference photo. `burst` reports the method and the reason.

    Raises:
        PhotoError: there are too few or too many photos for the method, their sizes differ, or one
            of them cannot be read; or the method is "motion" and the layers cannot be measured.
        BrewsterError: see the call of a `Separator`.
    """
    fitted = fit_burst(
        photos,
        reference=reference,
        separator=separator,
        hints=hints,
        max_pixels=max_pixels,
        method=method,
        on_progress=lambda done: on_progress(0.9 * done),
    )
    return fitted.chosen(method, swap=swap).separate(
        lambda done: on_progress(0.9 + 0.1 * done),
        strength=strength,
        quality=quality,
        mask=mask,
        additive=additive,
    )


def fit_burst(
    photos: Sequence[Source] | VideoFile,
    *,
    reference: int | None = Options.reference,
    separator: Separator | None = None,
    hints: Source | None = Options.hints,
    max_pixels: int = Options.max_pixels,
    method: BurstMethod = Options.method,
    on_progress: ProgressCallback = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> FittedBurst:
    """Measures the layers of a burst, but does not compute them at full size.

    Args:
        photos: see `separate_burst`.
        reference: see `separate_burst`.
        separator: see `separate_burst`.
        hints: see `separate_burst`.
        max_pixels: see `separate_burst`.
        method: what is measured; nothing for "single". See `separate_burst`.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.
        on_layers: see `solve`; the layers have the exposure of the photo. The first ones are those
            of the single photo.

    Raises:
        PhotoError: see `separate_burst`.
    """
    if isinstance(photos, str | os.PathLike | bytes):
        photos = read_video(photos, DEFAULT_FRAMES, max_pixels=max_pixels)
    check_photo_count(len(photos), method)
    reference = checked_reference(len(photos), reference)
    separator = separator or Separator.load()
    started = time.perf_counter()
    seconds = dict[str, float]()
    report = _rising(on_progress)
    with timed(seconds, "frames"):
        photo = open_photo(photos, reference, max_pixels)
        if method == "motion":
            compile_in_background()
        frames, white, settings = working_frames(
            photos, reference, photo, max_pixels, lambda part: report(0.02 * part)
        )
        if method == "auto" and not seem_to_stand(frames, reference):
            compile_in_background()
    solution: Solution | None = None
    measured = burst_report(None, None, len(photos), (), reference)
    if method != "single":
        with timed(seconds, "network"):
            light, verdict = single_photo(
                separator,
                photo,
                white * frames[reference],
                hints,
                lambda part: report(0.02 + 0.1 * part),
            )
            prior = light / white
        report(0.12)
        on_layers(np.stack([prior, np.maximum(frames[reference] - prior, 0)]) * white)
        solution, measured = _Measurement(
            frames=frames,
            reference=reference,
            prior=prior,
            verdict=verdict,
            settings=settings,
            separator=separator,
            has_hints=hints is not None,
            seconds=seconds,
            report=report,
            on_layers=lambda layers: on_layers(layers * white),
        ).layers(method)
    seconds["motion"] = time.perf_counter() - started - sum(seconds.values())
    return FittedBurst(
        photo=photo,
        report=measured,
        seconds=seconds,
        _solution=solution,
        _single=separator,
        _hints=hints,
    )


def _rising(on_progress: ProgressCallback) -> ProgressCallback:
    """Returns a callback that reports no smaller fraction than before. The network runs twice; the
    second time, the fraction stays the same, but the work can be stopped.
    """
    done = 0.0

    def report(fraction: float) -> None:
        nonlocal done
        done = max(done, fraction)
        on_progress(done)

    return report


@final
@dataclass(frozen=True)
class _Measurement:
    """Measures the layers of a burst by the motion or by the light."""

    frames: Sequence[Floats]
    """(h, w, 3) linear light each, 0..1, of one size."""
    reference: int
    """The index of the reference frame."""
    prior: Floats
    """T of the reference frame from the single photo, (h, w, 3)."""
    verdict: Verdict | None
    """That of the single photo."""
    settings: Sequence[CameraSettings]
    """Those of each frame."""
    separator: Separator
    """Separates single photos."""
    has_hints: bool
    """Whether a person gave hints."""
    seconds: dict[str, float]
    """The time of each step, to which that of the network is added."""
    report: ProgressCallback
    """Called with the completed fraction, which never falls."""
    on_layers: Callable[[Floats], None]
    """See `solve`."""

    def layers(self, method: BurstMethod) -> tuple[Solution | None, BurstReport]:
        """Returns the layers by the motion or the light, and the report.

        Of a camera that moved, the light is measured only if the motion does not separate the
        layers: it takes a quarter of the time.

        Args:
            method: "auto", "motion" or "light".
        """
        with single_opencv_thread():
            tracks = layer_tracks(
                self.frames,
                self.reference,
                self.prior,
                lambda part: self.report(0.12 + 0.1 * part),
            )
        give_back_memory()  # the search for features needs the most
        is_forced = method == "light"
        aligned = None
        if method != "motion":
            aligned = aligned_photos(self.frames, self.reference, tracks)
        light: LightFit | None = None
        if aligned is not None and (is_forced or aligned.is_still):
            light = self._by_light(aligned, is_forced=is_forced)
            if is_forced or light.is_certain:
                return light.solution, light.report(self.reference)
        solution, left_out = self._by_motion(tracks)
        report = burst_report(solution, self.verdict, len(self.frames), left_out, self.reference)
        if aligned is None or report.method == "burst":
            return solution, report
        light = light or self._by_light(aligned, is_forced=is_forced)
        if light.is_one_change:
            return light.solution, light.report(self.reference)
        return solution, light.with_hint(report)

    def _by_motion(self, tracks: Sequence[Track]) -> tuple[Solution | None, tuple[int, ...]]:
        compile_in_background()
        # Without hints of a person, who knows better than the measured layers
        is_refined = self.separator.takes_hints and not self.has_hints
        return measure_layers(
            self.frames,
            self.reference,
            self.prior,
            tracks=tracks,
            refine_prior=self._refined_prior if is_refined else None,
            on_progress=lambda part: self.report(0.12 + 0.88 * part),
            on_layers=self.on_layers,
        )

    def _refined_prior(self, reflection_share: Floats) -> Floats:
        with timed(self.seconds, "network"):
            return prior_with_hints(
                self.separator,
                self.frames[self.reference],
                reflection_share,
                lambda _part: self.report(0),
            )

    def _by_light(self, aligned: AlignedPhotos, *, is_forced: bool) -> LightFit:
        return fit_light(
            aligned,
            lambda transmission: single_transmission(self.separator, transmission, self.report),
            single=self.prior,
            settings=self.settings,
            is_forced=is_forced,
        )
