"""Separates a burst: several photos of one window, with the camera moved between them.

    separation = separate_burst(["a.jpg", "b.jpg", "c.jpg"])
    separation.transmission.save("clear.jpg")
    print(separation.burst.message)

The layers of the reference photo are measured from the motion at 640 pixels (solver.py), and
applied to the photo at full size as a prediction of a model is. If the motion does not separate the
layers, the result is that of the single photo.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.errors import PhotoError, error_prefix
from brewster.film.compilation import compile_in_background
from brewster.film.exposure import fitted_exposures
from brewster.film.joint_model import Floats, JointModel
from brewster.film.levels import MIN_SIDE_PX
from brewster.film.naming import hinted_region
from brewster.film.registration import layer_tracks, motion_candidates, path_order
from brewster.film.self_check import burst_report
from brewster.film.separate_light import LightFit, fit_light
from brewster.film.solution import Solution
from brewster.film.solver import solve
from brewster.film.threads import single_opencv_thread
from brewster.film.video import read_video
from brewster.film.video_decoding import VideoFile
from brewster.options import DEFAULT_FRAMES, MAX_BURST_PHOTOS, BurstMethod, Options, Quality
from brewster.photo import Photo, Source
from brewster.separation.assessment import Assessment, Verdict
from brewster.separation.burst_report import BurstReport, burst_photo_name, check_photo_count
from brewster.separation.guided_upsampling import GeneratedOverride
from brewster.separation.predictor import Prediction, Predictor, ProgressCallback
from brewster.separation.separation import Separation
from brewster.separation.separator import Separator, timed, white_level

_WORKING_PX: Final = 1000
"""The long side of the frames from which the motion is estimated; less for more photos than a burst
has, so that 60 need as much memory as 15.
"""
_DETAIL_LIMITS: Final = (0.5, 2.0)
"""The detail of the reference photo changes the sum of the layers by no more than these factors."""


@final
@dataclass(frozen=True)
class FittedBurst:
    """The reference photo of a burst, and its measured layers."""

    photo: Photo
    report: BurstReport
    seconds: dict[str, float]
    """The time of each step."""
    _solution: Solution | None
    _single: Separator
    """Of the single photo."""
    _hints: Source | None
    _requested: BurstMethod = "auto"
    film_hints: NDArray[np.uint8] | None = None
    """Hints for the model where the film of the photo shows a reflection, (H, W, 3), or None."""

    def chosen(self, method: BurstMethod, *, swap: bool) -> FittedBurst:
        """Returns the burst with another method, or with exchanged layers.

        Args:
            method: see `separate_burst`.
            swap: see `separate_burst`.

        Raises:
            PhotoError: the method is "motion", and there are no measured layers.
        """
        report = self.report
        if method == "single":
            message = "The reference photo was separated alone, as requested."
            report = replace(report, method="single photo", message=message, next_step=None)
        elif method == "motion" and report.method != "burst":
            if not report.is_measured or self.is_by_light:
                raise PhotoError(
                    f"no layers were measured: {report.message}",
                    "expected photos that show the motion",
                    "use the method auto or single",
                )
            message = f"The measured layers are used, as requested. {report.message}"
            report = replace(report, method="burst", message=message, next_step=None)
        fitted = replace(self, report=report, _requested=method)
        return fitted._exchanged() if swap and report.method in ("burst", "light") else fitted

    @property
    def is_by_light(self) -> bool:
        """Whether the change of the light was measured, and not the motion."""
        return self.report.light is not None

    @property
    def hints(self) -> Source | None:
        """The hints of the person, or those of the film, if the separator is that of the single
        photo.
        """
        if self.report.method == "hints":
            return self.film_hints
        return self._hints if self.report.method == "single photo" else None

    @property
    def separator(self) -> Separator:
        """The separator that separates the photo by the method of the report."""
        separator = self._single
        method = self.report.method
        if method not in ("single photo", "hints"):
            is_measured = method in ("burst", "light")
            predictor = (
                _FixedPredictor(self._layers())
                if is_measured
                else lambda tile: (tile, np.zeros_like(tile))
            )
            separator = Separator(
                predictor,
                name=separator.name,
                method=method,
                sha256=separator.sha256,
                device=separator.device,
            )
        return separator.for_burst(
            self.report.frames + len(self.report.left_out),
            hints="yes" if self._hints is not None else "no",
            requested=self._requested,
            swapped="yes" if self.report.is_swapped else "no",
            **({"verdict": self._verdict} if self._verdict else {}),
            **({"film": self.report.film.sha256[:12]} if self.report.film else {}),
        )

    @property
    def _verdict(self) -> Verdict | None:
        """The verdict of measured layers, or of a photo that stays as it is; None: the model alone
        separates the photo, and its assessment has the verdict.
        """
        if self.report.method == "unchanged":
            return "doubtful" if self.report.is_side_by_side else "little found"
        return self.report.measured_verdict if self.report.method == "burst" else None

    def assessed(self, assessment: Assessment) -> Assessment:
        """Returns an assessment of the separator with the verdict of the measurement, which knows
        more than the assessment of a single photo. If the strength is 0, little is found.
        """
        is_written = assessment.removed_light > 0 or self.report.method == "unchanged"
        verdict = self._verdict if is_written else None
        return replace(assessment, verdict=verdict) if verdict else assessment

    @property
    def model(self) -> JointModel:
        """The measured layers and motions. Raises ValueError if there are none."""
        model = self._measured.model
        if model is None:
            raise ValueError("the film of a photo has no layers of its own; expected a burst")
        return model

    @property
    def kept(self) -> Floats:
        """Where the frames of a film stay as they are, (h, w, 1) in 0..1 of the reference frame:
        neither layer explains the frames, or there is no glass. Raises ValueError if there are no
        layers.
        """
        layers = self._layers()
        if layers.without_glass is None:
            return layers.unexplained
        return np.maximum(layers.unexplained, layers.without_glass)

    @property
    def _measured(self) -> Solution:
        if self._solution is None:
            raise ValueError(
                "no layers were measured; expected a report with is_measured; check it first"
            )
        return self._solution

    @property
    def nbytes(self) -> int:
        """The memory of the photo, of the measured layers and of the hints. That of the separator
        is not counted, because other bursts share it.
        """
        parts = self.photo.pixels, self._solution, self.film_hints
        files = len(self._hints) if isinstance(self._hints, bytes) else 0
        return files + sum(part.nbytes for part in parts if part is not None)

    def _layers(self) -> Solution:
        return self._measured.swapped() if self.report.is_swapped else self._measured

    def separate(self, on_progress: ProgressCallback, **options: Any) -> Separation:  # noqa: ANN401
        """Computes the layers at full size.

        Args:
            on_progress: called with the completed fraction, 0 to 1.
            options: those of the call of a `Separator`, without hints.
        """
        separation = self.separator(
            self.photo, hints=self.hints, on_progress=on_progress, **options
        )
        seconds = {
            name: self.seconds.get(name, 0.0) + spent for name, spent in separation.seconds.items()
        }
        exchange = None
        if self.report.method in ("burst", "light"):
            exchange = partial(self._exchanged().separate, lambda _fraction: None, **options)
        return replace(
            separation,
            assessment=self.assessed(separation.assessment),
            burst=self.report,
            next_step=self.report.next_step,
            seconds=self.seconds | seconds,
            _exchange=exchange,
        )

    def _exchanged(self) -> FittedBurst:
        is_swapped = not self.report.is_swapped
        report = replace(self.report, is_swapped=is_swapped, are_names_certain=True, next_step=None)
        return replace(self, report=report)


def separate_burst(
    photos: Sequence[Source] | VideoFile,
    *,
    reference: int | None = None,
    separator: Separator | None = None,
    method: BurstMethod = "auto",
    swap: bool = False,
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
        PhotoError: there are fewer than 2 or more than 15 photos, their sizes differ, or one of
            them cannot be read; or the method is "motion" and the layers cannot be measured.
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
    reference: int | None = None,
    separator: Separator | None = None,
    hints: Source | None = Options.hints,
    max_pixels: int = Options.max_pixels,
    method: BurstMethod = "auto",
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
    done = 0.0
    seconds = dict[str, float]()

    def report(fraction: float) -> None:
        """Reports no smaller fraction than before. The network runs twice; the second time, the
        fraction stays the same, but the work can be stopped.
        """
        nonlocal done
        done = max(done, fraction)
        on_progress(done)

    def refine_prior(reflection_share: Floats) -> Floats:
        with timed(seconds, "network"):
            return prior_with_hints(
                separator, frames[reference], reflection_share, lambda _part: report(0)
            )

    with timed(seconds, "frames"):
        photo = _open(photos, reference, max_pixels)
        if method != "single":
            compile_in_background()
        frames, white = _working_frames(
            photos, reference, photo, max_pixels, lambda part: report(0.02 * part)
        )
    solution: Solution | None = None
    left_out: tuple[int, ...] = ()
    verdict: Verdict | None = None
    light: LightFit | None = None
    if method != "single":
        with timed(seconds, "network"):
            upsampler, _, single = separator.fit(
                photo,
                quality="draft",
                hints=hints,
                on_progress=lambda part: report(0.02 + 0.1 * part),
            )
            prior = _applied(upsampler.apply, white * frames[reference]) / white
        report(0.12)
        on_layers(np.stack([prior, np.maximum(frames[reference] - prior, 0)]) * white)
        if method in ("auto", "light"):
            light = fit_light(
                frames,
                reference,
                prior,
                lambda transmission: _single_transmission(separator, transmission, report),
                is_forced=method == "light",
            )
    is_by_light = light is not None and (method == "light" or light.is_certain)
    if method != "single" and not is_by_light:
        # Without hints of a person, who knows better than the measured layers
        refine = refine_prior if separator.takes_hints and hints is None else None
        solution, left_out = measure_layers(
            frames,
            reference,
            prior,
            refine_prior=refine,
            on_progress=lambda part: report(0.12 + 0.88 * part),
            on_layers=lambda layers: on_layers(layers * white),
        )
        verdict = single.verdict
    measured = burst_report(solution, verdict, len(photos), left_out, reference)
    if light is not None and (is_by_light or (light.is_polariser and measured.method != "burst")):
        solution = light.solution
        measured = light.report(reference)
    elif light is not None:
        measured = light.with_hint(measured)
    seconds["motion"] = time.perf_counter() - started - sum(seconds.values())
    return FittedBurst(
        photo=photo,
        report=measured,
        seconds=seconds,
        _solution=solution,
        _single=separator,
        _hints=hints,
    )


def measure_layers(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    *,
    refine_prior: Callable[[Floats], Floats] | None = None,
    on_progress: ProgressCallback = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> tuple[Solution | None, tuple[int, ...]]:
    """Measures the layers of the reference frame from the motion, with one thread.

    Args:
        frames: (h, w, 3) linear light in 0..1, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        refine_prior: see `solve`.
        on_progress: called with the completed fraction, 0 to 1.
        on_layers: see `solve`.

    Returns:
        The solution, or None if no other frame shows the scene of the reference frame or the frames
        are too small; and the indices of the frames that do not show it.
    """
    with single_opencv_thread():
        tracks = layer_tracks(frames, reference, prior, lambda part: on_progress(0.11 * part))
        used = path_order(frames, tracks) if tracks else []
        left_out = tuple(k for k in range(len(frames)) if k not in used and k != reference)
        if len(used) < 2:
            return None, left_out
        if max(frames[reference].shape) < MIN_SIDE_PX:
            return None, ()
        chosen = [frames[k] for k in used]
        middle = used.index(reference)
        in_order = [track.reordered(used) for track in tracks]
        candidates = motion_candidates(chosen, middle, in_order, used, lambda: on_progress(0.11))
        locked = next(candidate for candidate in candidates if candidate.is_locked)
        solution = solve(
            chosen,
            middle,
            prior,
            candidates,
            exposures=fitted_exposures(chosen, middle, locked.transmission),
            refine_prior=refine_prior,
            on_progress=lambda part: on_progress(0.16 + 0.84 * part),
            on_layers=on_layers,
        )
        return solution, left_out


def prior_with_hints(
    separator: Separator,
    frame: Floats,
    reflection_share: Floats,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> Floats:
    """Returns T of the working frame, (h, w, 3), predicted with hints where the measured share of
    the reflection is large. As only its low frequencies are used, a draft does.

    Args:
        separator: separates a single photo.
        frame: (h, w, 3) linear light.
        reflection_share: the share of R in the light, of any size, (h, w, 1).
        on_progress: called with the completed fraction. An exception raised in it stops the work.
    """
    share = cv2.resize(reflection_share, frame.shape[1::-1])
    is_reflection = hinted_region(share)
    hints = np.zeros(frame.shape, np.uint8)
    hints[is_reflection, 0] = 255
    photo = Photo.from_array(frame, encoding="linear")
    upsampler, _, _ = separator.fit(
        photo,
        quality="draft",
        hints=hints if is_reflection.any() else None,
        on_progress=on_progress,
    )
    return _applied(upsampler.apply, frame)


def _single_transmission(
    separator: Separator, light: Floats, on_progress: ProgressCallback
) -> Floats:
    """Returns T of light (h, w, 3) as the model for single photos predicts it."""
    photo = Photo.from_array(light, encoding="linear")
    upsampler, _, _ = separator.fit(photo, on_progress=lambda _part: on_progress(0))
    return _applied(upsampler.apply, light)


def checked_reference(count: int, reference: int | None) -> int:
    """Returns the index of the reference photo of `count` photos, by default the middle one.

    Raises:
        PhotoError: there is no photo with this index.
    """
    reference = count // 2 if reference is None else reference
    if not 0 <= reference < count:
        raise PhotoError(
            f"the reference photo is {reference}",
            f"expected an index from 0 to {count - 1}",
            "correct the reference",
        )
    return reference


def _open(photos: Sequence[Source], index: int, max_pixels: int) -> Photo:
    """Opens a photo of the burst. An error names its number."""
    with error_prefix(burst_photo_name(photos, index)):
        return Photo.open(photos[index], max_pixels=max_pixels)


def _working_frames(
    photos: Sequence[Source],
    reference: int,
    photo: Photo,
    max_pixels: int,
    on_progress: ProgressCallback,
) -> tuple[list[Floats], np.float32]:
    """Returns the photos at the working size, in linear light divided by its white level, 0..1, and
    this level. One photo at a time is in memory at full size.

    Args:
        photos: see `separate_burst`.
        reference: the index of the reference photo.
        photo: the reference photo.
        max_pixels: see `Photo.open`.
        on_progress: called with the completed fraction, 0 to 1.
    """
    long_side_px = _WORKING_PX * min(1.0, MAX_BURST_PHOTOS / len(photos)) ** 0.5
    scale = min(1.0, long_side_px / max(photo.size))
    width, height = (max(8, round(length * scale)) for length in photo.size)
    frames = []
    for k in range(len(photos)):
        on_progress(k / len(photos))
        frame = photo if k == reference else _open(photos, k, max_pixels)
        if frame.size != photo.size:
            raise PhotoError(
                f"{burst_photo_name(photos, k)} has {frame.size[0]} x {frame.size[1]} pixels",
                f"expected {photo.size[0]} x {photo.size[1]}, as "
                f"{burst_photo_name(photos, reference)}",
                "leave one of them out, or pass photos that were taken with the same camera, "
                "orientation and zoom",
            )
        frames.append(frame.resized(width, height))
    if all(np.array_equal(frame, frames[reference]) for frame in frames):
        raise PhotoError(
            f"the {len(frames)} photos of the burst are the same",
            "expected photos of one window from different places or in different light",
            "move the camera by 5 to 10 cm between the photos, change what the glass mirrors, or "
            "separate one of them alone",
        )
    white = np.float32(white_level(frames[reference]))
    return [np.clip(frame / white, 0, 1) for frame in frames], white


def _applied(apply: Callable[[Floats, int, int], tuple[Floats, Floats]], frame: Floats) -> Floats:
    """Returns T of the working frame (h, w, 3). `apply` is that of a `GuidedUpsampler`."""
    transmission, _ = apply(frame, 0, len(frame))
    prior: Floats = np.clip(transmission, 0, frame)
    return prior


@final
class _FixedPredictor(Predictor):
    """Returns the solution of a burst as the prediction for its reference photo."""

    is_measured = True

    def __init__(self, solution: Solution) -> None:
        self._solution = solution

    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:  # noqa: ARG002
        """Returns the size of the solution."""
        height, width = self._solution.measured.shape[1:3]
        return [(width, height)]

    def __call__(
        self,
        inputs: Sequence[Floats],
        quality: Quality,  # noqa: ARG002
        on_progress: ProgressCallback,  # noqa: ARG002
    ) -> Prediction:
        """Returns the layers, with the detail of the reference photo."""
        (photo,) = inputs
        solution = self._solution
        change, reflection, override = measured_change(photo, *solution.layers)
        return Prediction(
            change=change,
            reflection=reflection,
            confidence_map=solution.confidence,
            override=override,
        )


def measured_change(
    photo: Floats, transmission: Floats, reflection: Floats
) -> tuple[Floats, Floats, GeneratedOverride]:
    """Returns measured layers as `GuidedUpsampler.fit` takes them, with the detail of the photo:
    the change of the photo to T, R, and where T takes no detail of the photo.

    Args:
        photo: (h, w, 3) linear light.
        transmission: (h, w, 3), with the exposure of the photo.
        reflection: (h, w, 3), the same.
    """
    total = np.maximum(transmission + reflection, np.float32(1e-4))
    detail = np.clip(photo / total, *_DETAIL_LIMITS)
    # At full size, edges of a strong reflection would remain in the transmission: there it takes no
    # detail of the photo
    override = GeneratedOverride.weighted_by_detail(transmission, reflection)
    return transmission * detail - photo, np.minimum(reflection * detail, photo), override
