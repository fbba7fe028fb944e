"""Measures the layers of a burst at the working size, by the motion and by the single photo."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from brewster.film.motion.learned_light import find_light
from brewster.film.motion.model.exposure import fitted_exposures
from brewster.film.motion.model.joint_model import Floats
from brewster.film.motion.model.levels import MIN_SIDE_PX
from brewster.film.motion.naming import hinted_region
from brewster.film.motion.registration.camera_path import path_order
from brewster.film.motion.registration.candidates import motion_candidates
from brewster.film.motion.registration.tracks import Track, layer_tracks, without_zoom
from brewster.film.motion.solution import Solution
from brewster.film.motion.solver import FindLight, solve
from brewster.film.motion.threads import single_opencv_thread
from brewster.photo import Photo, Source
from brewster.separation.assessment import Verdict
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separator import Separator


def measure_layers(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    *,
    tracks: Sequence[Track] | None = None,
    refine_prior: Callable[[Floats], Floats] | None = None,
    find_light: FindLight | None = find_light,
    on_progress: ProgressCallback = lambda _fraction: None,
    on_layers: Callable[[Floats], None] = lambda _layers: None,
) -> tuple[Solution | None, tuple[int, ...]]:
    """Measures the layers of the reference frame from the motion, with one thread.

    Args:
        frames: (h, w, 3) linear light in 0..1, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo, (h, w, 3).
        tracks: the motions of the layers, from `layer_tracks`, by which they are measured if they
            are not given.
        refine_prior: see `solve`.
        find_light: see `solve`; by default, with the shipped network.
        on_progress: called with the completed fraction, 0 to 1.
        on_layers: see `solve`.

    Returns:
        The solution, or None if no other frame shows the scene of the reference frame or the frames
        are too small; and the indices of the frames that do not show it, or with another zoom.
    """
    with single_opencv_thread():
        if tracks is None:
            tracks = layer_tracks(frames, reference, prior, lambda part: on_progress(0.11 * part))
        tracks = without_zoom(tracks, frames[reference].shape[:2])
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
            find_light=find_light,
            on_progress=lambda part: on_progress(0.16 + 0.84 * part),
            on_layers=on_layers,
        )
        return solution, left_out


def single_photo(
    separator: Separator,
    photo: Photo,
    frame: Floats,
    hints: Source | None = None,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> tuple[Floats, Verdict]:
    """Returns T of a photo by the model alone, (h, w, 3) linear light, and the verdict about the
    photo. As only the low frequencies of T are used, a draft does.

    Args:
        separator: runs on the photo.
        photo: the photo, of any size.
        frame: its light at the working size, (h, w, 3), to which the result is applied.
        hints: strokes on the photo, see the call of a `Separator`.
        on_progress: called with the completed fraction. An exception raised in it stops the work.
    """
    upsampler, _, assessment = separator.fit(
        photo, quality="draft", hints=hints, on_progress=on_progress
    )
    return applied(upsampler.apply, frame), assessment.verdict


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
    strokes = hints if is_reflection.any() else None
    transmission, _ = single_photo(separator, photo, frame, strokes, on_progress)
    return transmission


def single_transmission(
    separator: Separator, light: Floats, on_progress: ProgressCallback
) -> Floats:
    """Returns T of light (h, w, 3) as the model for single photos predicts it."""
    photo = Photo.from_array(light, encoding="linear")
    upsampler, _, _ = separator.fit(photo, on_progress=lambda _part: on_progress(0))
    return applied(upsampler.apply, light)


def applied(apply: Callable[[Floats, int, int], tuple[Floats, Floats]], frame: Floats) -> Floats:
    """Returns T of the working frame (h, w, 3). `apply` is that of a `GuidedUpsampler`."""
    transmission, _ = apply(frame, 0, len(frame))
    prior: Floats = np.clip(transmission, 0, frame)
    return prior
