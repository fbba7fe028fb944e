"""Tracks: the motions of the layers of a burst, by features that move together in all frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.registration.features import (
    INLIER_PX,
    MIN_MATCHES,
    Fit,
    Matches,
    camera_motion,
    features_of,
    matched_features,
)
from brewster.film.motion.registration.high_pass import grey_high_pass
from brewster.film.motion.registration.homographies import (
    Floats,
    Matrices,
    log_scale,
    transfer_errors,
)
from brewster.film.motion.resizing import resized
from brewster.film.motion.threads import POOL
from brewster.separation.predictor import ProgressCallback

_LONG_SIDE_PX: Final = 640
"""Features of larger frames take more time, and change the motions by less than the optimisation
does.
"""
_REMOVED_PX: Final = 3.0
"""Matches that are nearer to the motion of a layer do not belong to the next layers."""
_MIN_SHARED: Final = 8
"""The number of features of a layer that must be found in a frame."""
_MIN_SHARE: Final = 4
"""One in so many of the features of a layer must follow its motion in a frame."""
_MAX_TRACKS: Final = 4
"""The largest number of layers that are looked for."""
_MAX_ZOOM: Final = 0.1
"""The largest logarithm of the scale between two photos of a burst. A hand that moves the camera by
10 cm at a distance of a metre changes it by so much; real films had up to .07.
"""


@final
@dataclass(frozen=True)
class Track:
    """The motion of one layer in the frames of a burst. Its features in the reference frame move
    together in all of them.
    """

    motions: Sequence[Matrices | None]
    """For each frame, the homography from the reference frame in pixels; None where the layer was
    not found.
    """
    places: NDArray[np.int64]
    """(n, 2): x and y of its features in the reference frame, once for each frame in which one was
    found.
    """

    @property
    def found(self) -> list[int]:
        """The indices of the frames in which the layer was found."""
        return [k for k, matrix in enumerate(self.motions) if matrix is not None]

    def reordered(self, frames: Sequence[int]) -> Track:
        """Returns the track in a burst of these frames."""
        return replace(self, motions=[self.motions[k] for k in frames])

    def resized(self, size: tuple[int, int], to: tuple[int, int]) -> Track:
        """Returns the track in resized frames.

        Args:
            size: height and width of the frames of this track.
            to: those of the resized frames.
        """
        y, x = (new / old for new, old in zip(to, size, strict=True))
        # The centre of the first pixel is at (0, 0)
        resize = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
        inverse = np.linalg.inv(resize)
        return Track(
            motions=[None if each is None else resize @ each @ inverse for each in self.motions],
            places=(self.places * (x, y)).astype(np.int64),
        )


def layer_tracks(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> list[Track]:
    """Returns the motions of the layers that features show: the one that is most likely T is first.

    A layer begins with the homography that has the most matches of all frames (MAGSAC); its
    features are then looked for in the other frames, and its matches are removed. Frames of 640
    pixels do: the motions of larger ones are measured in smaller copies.

    Args:
        frames: (h, w, 3) linear light, of one size.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo. It decides which of several motions is
            that of T.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.
    """
    size = frames[reference].shape[:2]
    if max(size) > _LONG_SIDE_PX:
        small = [resized(frame, _LONG_SIDE_PX) for frame in frames]
        tracks = layer_tracks(small, reference, resized(prior, _LONG_SIDE_PX), on_progress)
        return [track.resized(small[reference].shape[:2], size) for track in tracks]
    features = []
    for found_in_frame in POOL.map(features_of, frames):
        features.append(found_in_frame)
        on_progress(0.5 * len(features) / len(frames))
    others = [k for k in range(len(frames)) if k != reference]
    found = POOL.map(lambda k: matched_features(features[reference], features[k]), others)
    matches = dict(zip(others, found, strict=True))
    tracks = []
    while len(tracks) < _MAX_TRACKS:
        on_progress(0.6 + 0.4 * len(tracks) / _MAX_TRACKS)
        motions = _next_track(matches, len(features[reference][0]), size)
        if not motions:
            break
        places = []
        for k, matrix in motions.items():
            distances = transfer_errors(matrix, matches[k].points)
            places.append(matches[k].points[distances < INLIER_PX, :2].astype(int))
            matches[k] = matches[k].selected(distances > _REMOVED_PX)
        motions[reference] = np.eye(3)
        in_order = [motions.get(k) for k in range(len(frames))]
        tracks.append(Track(motions=in_order, places=np.concatenate(places)))
    return likeliest_first(tracks, frames[reference], prior)


def likeliest_first(tracks: Sequence[Track], frame: Floats, prior: Floats) -> list[Track]:
    """Returns tracks in the order in which they are likely T: by the number of their matches, each
    with the share of T in the detail around it.

    Args:
        tracks: those of a burst.
        frame: its reference frame, (h, w, 3) linear light.
        prior: T of this frame from a single photo, (h, w, 3).
    """
    share = _transmission_share(frame, prior)
    return sorted(tracks, key=lambda track: -share[track.places[:, 1], track.places[:, 0]].sum())


def likeliest_motion(tracks: Sequence[Track], frame: int) -> Matrices | None:
    """Returns the motion of a frame that is most likely that of T."""
    return next(
        (track.motions[frame] for track in tracks if track.motions[frame] is not None), None
    )


def without_zoom(tracks: Sequence[Track], size: tuple[int, ...]) -> list[Track]:
    """Returns the tracks without the frames whose zoom differs from that of the reference frame,
    as if these showed another scene.

    A zoom is no motion of the camera: it scales both layers alike, so that it separates nothing,
    and a second layer explains what else has changed.

    Args:
        tracks: the motions of the layers, from `layer_tracks`.
        size: height and width of the frames.
    """
    count = len(tracks[0].motions) if tracks else 0
    transmission = [likeliest_motion(tracks, k) for k in range(count)]
    has_zoom = [
        matrix is not None and abs(log_scale(matrix, size)) > _MAX_ZOOM for matrix in transmission
    ]
    kept = [
        replace(
            track,
            motions=[
                None if is_left_out else motion
                for motion, is_left_out in zip(track.motions, has_zoom, strict=True)
            ],
        )
        for track in tracks
    ]
    return [track for track in kept if len(track.found) > 1]


def _next_track(
    matches: Mapping[int, Matches], count: int, size: tuple[int, ...]
) -> dict[int, Matrices]:
    """Returns the motions (3, 3) of the next layer, by frame.

    Args:
        matches: those of the other frames, without those of earlier layers.
        count: the number of features in the reference frame.
        size: height and width of the frames.
    """
    own = POOL.map(lambda k: camera_motion(matches[k].points, size, MIN_MATCHES), matches)
    fits = {k: fit for k, fit in zip(matches, own, strict=True) if fit}
    is_member = np.zeros(count, bool)
    motions: dict[int, Matrices] = {}
    remaining = dict(matches) if fits else {}
    while remaining:
        shared = {k: is_member[there.features] for k, there in remaining.items()}
        if motions:
            k = max(remaining, key=lambda k: int(shared[k].sum()))
        else:
            k = max(fits, key=lambda k: int(fits[k][1].sum()))
        here = remaining.pop(k)
        fit = _extended(here.points, shared[k], size) or fits.get(k)
        if fit:
            motions[k] = fit[0]
            is_member[here.features[fit[1]]] = True
    return motions


def _extended(points: Floats, shared: NDArray[np.bool_], size: tuple[int, ...]) -> Fit | None:
    """Returns the motion that most matches of a layer follow, and all matches that follow it.

    Args:
        points: (n, 4), the matches of a frame.
        shared: (n,), which of them are features of the layer.
        size: height and width of the frames.
    """
    fit = camera_motion(points[shared], size, max(_MIN_SHARED, shared.sum() // _MIN_SHARE))
    if fit is None:
        return None
    matrix = fit[0]
    for _ in range(2):
        near = transfer_errors(matrix, points) < INLIER_PX
        better = camera_motion(points[near], size, MIN_MATCHES)
        matrix = better[0] if better else matrix
    return matrix, transfer_errors(matrix, points) < INLIER_PX


def _transmission_share(reference: Floats, prior: Floats) -> Floats:
    """Returns the share of T in the local detail of the reference frame, (h, w) in 0..1."""
    details = [
        cv2.GaussianBlur(np.abs(grey_high_pass(layer, 3.0)), (0, 0), 4)
        for layer in (prior, np.maximum(reference - prior, 0))
    ]
    share: Floats = details[0] / (details[0] + details[1] + 1e-4)
    return share
