"""Candidates for the motion of both layers, from the tracks of features and from the spectra of the
frames.

Each candidate is a guess; the joint optimisation decides. Dense optical flow is no candidate: it
follows strong reflections. All motions are (K, 3, 3) homographies in normalised coordinates, from a
frame to the reference frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, final

import numpy as np

from brewster.film.motion.fourier_search import find_translations
from brewster.film.motion.homographies import (
    Floats,
    Matrices,
    moved_centre,
    normalised,
    translation,
    warped,
)
from brewster.film.motion.tracks import Track, likeliest_motion

_SHIFTS: Final = (0.015, 0.045, 0.08)
"""Sideways shifts of the reflection at the end of the path, as shares of the width: a safety net
for the other candidates.
"""
_MIN_FRAMES_FOR_LARGE_SHIFTS: Final = 4
"""With fewer frames, a large shift leaves parts of the reflection in one frame only, where it
explains everything.
"""


@final
@dataclass(frozen=True)
class MotionCandidate:
    """A guess for the motion of both layers."""

    family: str
    """How it was found: candidates of one family compete first with each other."""
    transmission: Matrices
    reflection: Matrices
    is_locked: bool = False
    """Whether both layers are one: the reflection keeps the motion of the transmission. The only
    one of its family.
    """


def motion_candidates(
    frames: Sequence[Floats],
    reference: int,
    tracks: Sequence[Track],
    given: Sequence[int] | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> list[MotionCandidate]:
    """Returns candidates for the motion of both layers. The first one is locked: both layers are
    one.

    Args:
        frames: (h, w, 3) linear light, in the order of `path_order`.
        reference: the index of the reference frame.
        tracks: the motions of the layers, from `layer_tracks`; each frame has at least one.
        given: the place of each frame in the order in which the photos were given, which is often
            that of time; by default as `frames`.
        on_step: called several times a second. An exception raised in it stops the work.
    """
    height, width = frames[0].shape[:2]
    found = [likeliest_motion(tracks, k) for k in range(len(frames))]
    transmission = np.stack([matrix for matrix in found if matrix is not None])
    times, given_times = (
        (order - order[reference]) / np.abs(order - order[reference]).max()
        for order in (np.arange(len(frames)), np.array(given or range(len(frames))))
    )

    def line(x: float, y: float, times: Matrices = times) -> Matrices:
        """The reflection moves along a line relative to the transmission, in pixels at the end of
        the path.
        """
        return np.stack(
            [
                translation(x * t, y * t) @ matrix
                for t, matrix in zip(times, transmission, strict=True)
            ]
        )

    def straight(track: Track, times: Matrices) -> Matrices:
        """The line along which a layer moves relative to the transmission in most of the frames
        where it was found.
        """
        slopes = [
            (moved_centre(matrix, (height, width)) - moved_centre(transmission[k], (height, width)))
            / times[k]
            for k, matrix in enumerate(track.motions)
            if matrix is not None and k != reference
        ]
        x, y = np.median(slopes, axis=0)
        return line(x, y, times)

    def filled(track: Track) -> Matrices:
        path = straight(track, times)
        return np.stack(
            [path[k] if matrix is None else matrix for k, matrix in enumerate(track.motions)]
        )

    half = len(frames) // 2
    others = [track for track in tracks[1:] if len(track.found) > half][:2]
    pairs = [("one layer", transmission, transmission)]
    pairs += (("features", *pair) for pair in combinations([transmission, *map(filled, others)], 2))
    # In one frame, a track may follow another layer, and the path may be wrong, above all in
    # periodic scenes
    orders = [times] if np.array_equal(np.abs(times), np.abs(given_times)) else [times, given_times]
    pairs += (
        ("shift", transmission, straight(track, order)) for track in others for order in orders
    )
    aligned = [warped(frame, matrix) for frame, matrix in zip(frames, transmission, strict=True)]
    for translations in find_translations(aligned, reference, on_step):
        moved = [
            matrix @ translation(*offset)
            for matrix, offset in zip(transmission, translations.offsets, strict=True)
        ]
        pairs.append(("Fourier", transmission, np.stack(moved)))
    for share in _SHIFTS if len(frames) >= _MIN_FRAMES_FOR_LARGE_SHIFTS else _SHIFTS[:-1]:
        pairs += (("shift", transmission, line(sign * share * width, 0.0)) for sign in (-1, 1))

    def to_reference(motions: Matrices) -> Matrices:
        inverse = np.linalg.inv(motions).astype(np.float64)
        return normalised(inverse, (height, width), (height, width))

    return [
        MotionCandidate(
            family=family,
            transmission=to_reference(first),
            reflection=to_reference(second),
            is_locked=number == 0,
        )
        for number, (family, first, second) in enumerate(pairs)
    ]
