"""Candidates for the motion of both layers, from the tracks of features and from the spectra of the
frames.

Each candidate is a guess; the joint optimisation decides. Dense optical flow is no candidate: it
follows strong reflections. All motions are (K, 3, 3) homographies in normalised coordinates, from a
frame to the reference frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, final

import numpy as np

from brewster.film.motion.registration.fourier_search import find_translations
from brewster.film.motion.registration.homographies import (
    Doubles,
    Floats,
    Matrices,
    moved_centre,
    normalised,
    translation,
    warped,
)
from brewster.film.motion.registration.tracks import Track, likeliest_motion

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
    motions = [likeliest_motion(tracks, k) for k in range(len(frames))]
    path = _CameraPath(
        transmission=np.stack([matrix for matrix in motions if matrix is not None]),
        times=_relative_times(range(len(frames)), reference),
        reference=reference,
        size=frames[0].shape[:2],
    )
    given_path = replace(path, times=_relative_times(given or range(len(frames)), reference))
    others = [track for track in tracks[1:] if len(track.found) > len(frames) // 2][:2]
    return [
        path.candidate("one layer", path.transmission, is_locked=True),
        *_along_tracks(path, others),
        *_along_lines(path, given_path, others),
        *_by_spectra(path, frames, on_step),
        *_sideways(path),
    ]


@final
@dataclass(frozen=True)
class _CameraPath:
    """The path of the camera, by the motion of T, and guesses for the motion of R along it. All of
    them are (K, 3, 3) homographies from the reference frame to the frames, in pixels.
    """

    transmission: Matrices
    """The motion of T."""
    times: Doubles
    """(K,), in -1..1, and 0 of the reference frame: how far along the path each frame was taken."""
    reference: int
    """The index of the reference frame."""
    size: tuple[int, int]
    """Height and width of the frames."""

    def candidate(
        self,
        family: str,
        reflection: Matrices,
        *,
        transmission: Matrices | None = None,
        is_locked: bool = False,
    ) -> MotionCandidate:
        """Returns a candidate, whose T moves along the path by default."""
        return MotionCandidate(
            family=family,
            transmission=self._to_reference(
                self.transmission if transmission is None else transmission
            ),
            reflection=self._to_reference(reflection),
            is_locked=is_locked,
        )

    def line(self, x: float, y: float) -> Matrices:
        """R moves along a line relative to T, by x and y pixels at the end of the path."""
        return np.stack(
            [
                translation(x * time, y * time) @ matrix
                for time, matrix in zip(self.times, self.transmission, strict=True)
            ]
        )

    def straight(self, track: Track) -> Matrices:
        """The line along which a layer moves relative to T in most of the frames where it was
        found.
        """
        slopes = [
            (moved_centre(matrix, self.size) - moved_centre(self.transmission[k], self.size))
            / self.times[k]
            for k, matrix in enumerate(track.motions)
            if matrix is not None and k != self.reference
        ]
        x, y = np.median(slopes, axis=0)
        return self.line(x, y)

    def filled(self, track: Track) -> Matrices:
        """The motion of a track; on its line where it was not found."""
        path = self.straight(track)
        return np.stack(
            [path[k] if matrix is None else matrix for k, matrix in enumerate(track.motions)]
        )

    def _to_reference(self, motions: Matrices) -> Matrices:
        inverse = np.linalg.inv(motions).astype(np.float64)
        return normalised(inverse, self.size, self.size)


def _relative_times(order: Sequence[int], reference: int) -> Doubles:
    """Returns the times (K,) of frames at equal distances, see `_CameraPath`.

    Args:
        order: the place of each frame in the order of time.
        reference: the index of the reference frame.
    """
    times = np.array(order) - order[reference]
    relative: Doubles = times / np.abs(times).max()
    return relative


def _along_tracks(path: _CameraPath, others: Sequence[Track]) -> Iterator[MotionCandidate]:
    """Yields candidates whose layers are two of the tracks."""
    motions = [path.transmission, *map(path.filled, others)]
    for transmission, reflection in combinations(motions, 2):
        yield path.candidate("features", reflection, transmission=transmission)


def _along_lines(
    path: _CameraPath, given_path: _CameraPath, others: Sequence[Track]
) -> Iterator[MotionCandidate]:
    """Yields candidates whose R moves along the line of a track. In one frame, a track may follow
    another layer, and the path may be wrong, above all in periodic scenes.

    Args:
        path: in the order of `path_order`.
        given_path: in the order in which the photos were given.
        others: the tracks of layers that may be R.
    """
    is_one_order = np.array_equal(np.abs(path.times), np.abs(given_path.times))
    paths = [path] if is_one_order else [path, given_path]
    for track in others:
        for each in paths:
            yield path.candidate("shift", each.straight(track))


def _by_spectra(
    path: _CameraPath, frames: Sequence[Floats], on_step: Callable[[], None]
) -> Iterator[MotionCandidate]:
    """Yields candidates whose R moves as the spectra of the frames show, aligned by T."""
    aligned = [
        warped(frame, matrix) for frame, matrix in zip(frames, path.transmission, strict=True)
    ]
    for translations in find_translations(aligned, path.reference, on_step):
        moved = [
            matrix @ translation(*offset)
            for matrix, offset in zip(path.transmission, translations.offsets, strict=True)
        ]
        yield path.candidate("Fourier", np.stack(moved))


def _sideways(path: _CameraPath) -> Iterator[MotionCandidate]:
    """Yields candidates whose R moves to the left or to the right."""
    width = path.size[1]
    has_large = len(path.times) >= _MIN_FRAMES_FOR_LARGE_SHIFTS
    for share in _SHIFTS if has_large else _SHIFTS[:-1]:
        for sign in (-1, 1):
            yield path.candidate("shift", path.line(sign * share * width, 0.0))
