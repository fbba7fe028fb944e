"""Chooses the frames of a film for a burst: one scene, one zoom, sharp frames, at equal distances
along the path of the camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MAX_PATH: Final = 0.3
"""The frames are chosen from a part of the path of this length, as a share of the width: they must
overlap.
"""
_MIN_RESPONSE: Final = 0.13
"""A smaller response of the phase correlation means that two frames show different scenes. Of
1,500 unrelated pairs of photos, 98 % (240 x 135), 99 % (240 x 180) and 99.7 % or more (upright)
have less. All pairs of frames in nine films of phones have at least 0.17, and those of twelve real
bursts, which move much more, 0.138.
"""
_MIN_CORRELATION: Final = 0.7
"""Frames with a larger correlation show one scene, even if two strong layers that move apart give a
small response.
"""
_MIN_CONTRAST: Final = 4.0
"""Frames with a smaller standard deviation, of 255 levels, show a covered lens."""
_MAX_ZOOM: Final = 0.008
"""The largest change of the scale between two frames that is not a zoom: the median of nine frames
is at most 0.0072 in eight of nine films of phones, and 0.018 in the last two frames of the other.
"""
_CALM: Final = 1.6
"""A frame whose difference to its neighbours is this multiple of the median shows something that
passes. In nine films of phones in which nothing passes, 6 % of the frames have more, where the
motion is fast.
"""


@final
@dataclass(frozen=True)
class FilmMeasurements:
    """Measurements of each frame. Those of two frames belong to the second one; they are 0 for the
    first frame.
    """

    positions: Floats
    """The length of the path of the camera up to each frame, as a share of the width."""
    sharpness: Floats
    """The variance of the Laplacian."""
    contrast: Floats
    """The standard deviation of the levels."""
    response: Floats
    """How alike two aligned frames are: the response of the phase correlation."""
    correlation: Floats
    """The correlation of two frames of a few pixels, without alignment."""
    difference: Floats
    """The mean difference of two aligned frames, of 255 levels."""
    zoom: Floats
    """The relative change of the scale."""

    def part(self, first: int, last: int) -> FilmMeasurements:
        """Returns the measurements of the frames from `first` to before `last`."""
        return FilmMeasurements(
            *(getattr(self, column.name)[first:last] for column in fields(self))
        )


def measure_film(thumbnails: Iterable[NDArray[np.uint8]]) -> FilmMeasurements:
    """Measures the grey thumbnails of the frames, all of one size."""
    rows = []
    position = 0.0
    previous = None
    for thumbnail in thumbnails:
        grey = thumbnail.astype(np.float32)
        response = correlation = difference = zoom = 0.0
        if previous is not None:
            (x, y), response = shift_between(previous, grey)
            position += float(np.hypot(x, y)) / grey.shape[1]
            correlation = _correlation(previous, grey)
            difference = _aligned_difference(previous, grey, x, y)
            zoom = _zoom(previous, grey)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        rows.append(
            (position, sharpness, float(grey.std()), response, correlation, difference, zoom)
        )
        previous = grey
    return FilmMeasurements(*np.array(rows, np.float64).reshape(-1, 7).T)


def show_one_scene(thumbnails: Sequence[NDArray[np.uint8]]) -> bool:
    """Returns whether each of the grey thumbnails, (h, w) of one size, shows the scene of the one
    before.
    """
    return bool(_is_same_scene(measure_film(thumbnails))[1:].all())


def choose(film: FilmMeasurements, count: int) -> list[int]:
    """Returns the indices of `count` frames of the best part of a film, or of all frames if there
    are fewer.

    Frames in which something passes are avoided if another frame is near.
    """
    part = best_part(film, count)
    if part.stop - part.start <= count:
        return list(range(part.start, part.stop))
    # A frame between two with a person is like neither; a frame next to one is like its other
    # neighbour
    after = film.difference[part][1:]
    least = np.minimum(np.append(after[:1], after), np.append(after, after[-1:]))
    calm = least <= _CALM * np.median(least) + 0.5
    scores = film.sharpness[part] * np.where(calm, 1, 1e-6)
    return [
        part.start + i
        for i in choose_frames(film.positions[part] - film.positions[part][0], scores, count)
    ]


def best_part(film: FilmMeasurements, count: int) -> slice:
    """Returns the longest part of the film that shows one scene with one zoom, or the whole film if
    no part has `count` frames.
    """
    covered = film.contrast < _MIN_CONTRAST
    # A few wrong measurements are no zoom: the median of nine
    padded = np.pad(film.zoom, 4, mode="edge")
    zoom = np.median(np.lib.stride_tricks.sliding_window_view(padded, 9), axis=1)
    begins = ~_is_same_scene(film)
    begins |= np.abs(zoom) > _MAX_ZOOM
    # A covered frame is a part of its own
    begins |= covered | np.append(False, covered[:-1])
    borders = [0, *(np.flatnonzero(begins[1:]) + 1).tolist(), len(begins)]
    first, last = max(pairwise(borders), key=lambda part: part[1] - part[0])
    return slice(first, last) if last - first >= count else slice(0, len(begins))


def _is_same_scene(film: FilmMeasurements) -> NDArray[np.bool_]:
    return (film.response >= _MIN_RESPONSE) | (film.correlation >= _MIN_CORRELATION)


def choose_frames(positions: Floats, sharpness: Floats, count: int) -> list[int]:
    """Returns the indices of `count` frames, or of all frames if there are fewer.

    Args:
        positions: the length of the camera's path up to each frame, as a share of the width.
        sharpness: the variance of the Laplacian of each frame.
        count: the number of frames.
    """
    if len(positions) <= count:
        return list(range(len(positions)))
    length = positions[-1]
    half = min(length, _MAX_PATH) / 2
    places = np.linspace(length / 2 - half, length / 2 + half, count)
    # A camera that stands still gives many frames at one place: they are ordered by time
    path = positions + np.linspace(0, 1e-3, len(positions))
    borders = np.searchsorted(path, [-1, *((places[1:] + places[:-1]) / 2), length + 1])
    groups = [range(first, max(first + 1, last)) for first, last in pairwise(borders)]
    chosen = {
        max((i for i in group if i < len(path)), key=sharpness.__getitem__, default=0)
        for group in groups
    }
    missing = [
        i for i in np.linspace(0, len(path) - 1, count).round().astype(int) if i not in chosen
    ]
    return sorted(int(i) for i in [*chosen, *missing[: count - len(chosen)]])


def shift_between(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[tuple[float, float], float]:
    """Returns the motion (x, y) from the first picture to the second one in pixels, and the
    response.

    `cv2.phaseCorrelate` pads both sides to `getOptimalDFTSize`. Where that is odd, such as 135, it
    returns half a pixel too much. Therefore the pictures are padded to even sizes before.
    """
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    bottom, right = (2 * cv2.getOptimalDFTSize((side + 1) // 2) - side for side in first.shape)
    (x, y), response = cv2.phaseCorrelate(
        *(
            cv2.copyMakeBorder(image * window, 0, bottom, 0, right, cv2.BORDER_CONSTANT)
            for image in (first, second)
        )
    )
    return (x, y), response


def _correlation(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    small, other = (
        cv2.resize(grey, (24, 16), interpolation=cv2.INTER_AREA) for grey in (first, second)
    )
    return float(cv2.matchTemplate(small, other, cv2.TM_CCOEFF_NORMED)[0, 0])


def _aligned_difference(
    first: NDArray[np.float32], second: NDArray[np.float32], x: float, y: float
) -> float:
    motion = np.array([[1, 0, x], [0, 1, y]], np.float32)
    aligned = cv2.warpAffine(first, motion, first.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return float(np.abs(aligned - second).mean())


def _zoom(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Returns the relative change of the scale: how far the halves move apart, horizontally and
    vertically.

    Parallax moves them apart in one direction only; therefore the smaller value counts.
    """
    height, width = (side // 2 for side in first.shape)
    left, right = (
        shift_between(first[:, part], second[:, part])[0]
        for part in (slice(width), slice(-width, None))
    )
    upper, lower = (
        shift_between(first[part], second[part])[0]
        for part in (slice(height), slice(-height, None))
    )
    horizontal = (right[0] - left[0]) / width
    vertical = (lower[1] - upper[1]) / height
    return float(min(horizontal, vertical, key=abs)) if horizontal * vertical > 0 else 0.0
