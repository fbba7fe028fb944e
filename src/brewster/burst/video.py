"""Chooses the frames of a burst from a video: sharp ones, at equal distances along the path of the camera.

The video is decoded twice: first for small copies of its frames, which give motion and sharpness, then for the chosen frames.
Therefore the memory does not depend on the length of the video.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.errors import BrewsterError, PhotoTooLarge, UnreadablePhoto
from brewster.files import DEFAULT_MAX_PIXELS
from brewster.photo import Photo

Bytes = NDArray[np.uint8]

_MAX_SECONDS: Final = 20.0
"""Only the beginning of a video is read: a camera move for a burst takes 2 to 5 seconds."""
_THUMBNAIL_PX: Final = 240
_MAX_PATH: Final = 0.3
"""The frames are chosen from a part of the path of this length, as a share of the width: they must overlap."""


def read_video(
    path: str | os.PathLike[str], frames: int, *, max_pixels: int = DEFAULT_MAX_PIXELS
) -> list[Photo]:
    """Returns frames of a video, in the order of time, for `separate_burst`.

    The frames have equal distances along the path of the camera. Of the frames near each place, the sharpest one is taken. A video
    with fewer frames is returned whole. Only the first 20 seconds are used.

    Args:
        path: the file.
        frames: the number of frames.
        max_pixels: videos with larger frames are refused.

    Raises:
        UnreadablePhoto: the file is not a video, is damaged, or has fewer than 2 frames.
        PhotoTooLarge: the frames have more than `max_pixels` pixels.
        BrewsterError: `frames` is less than 2.
    """
    if frames < 2:
        raise BrewsterError(
            f"frames is {frames}", "expected at least 2, because one frame shows no motion", "choose 3 to 9"
        )
    positions, sharpness = [0.0], []
    previous = None
    for frame in _decoded(path, max_pixels):
        height = max(16, round(_THUMBNAIL_PX * frame.height / frame.width))
        grey = frame.to_ndarray(width=_THUMBNAIL_PX, height=height, format="gray").astype(np.float32)
        sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var()))
        if previous is not None:
            (x, y), _ = cv2.phaseCorrelate(
                previous, grey, cv2.createHanningWindow(grey.shape[::-1], cv2.CV_32F)
            )
            positions.append(positions[-1] + float(np.hypot(x, y)) / _THUMBNAIL_PX)
        previous = grey
    if len(sharpness) < 2:
        raise _unreadable(path, f"{len(sharpness)} frames can be decoded")
    chosen = choose_frames(np.array(positions), np.array(sharpness), frames)
    pictures = (_rotated(frame) for index, frame in enumerate(_decoded(path, max_pixels)) if index in chosen)
    return [Photo.from_array(picture, encoding="srgb") for picture in pictures]


def choose_frames(positions: NDArray[np.float64], sharpness: NDArray[np.float64], count: int) -> list[int]:
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
        max((i for i in group if i < len(path)), key=sharpness.__getitem__, default=0) for group in groups
    }
    missing = [i for i in np.linspace(0, len(path) - 1, count).round().astype(int) if i not in chosen]
    return sorted([*chosen, *missing[: count - len(chosen)]])


def _decoded(path: str | os.PathLike[str], max_pixels: int) -> Iterator[av.VideoFrame]:
    """Yields the frames of the first seconds, up to the first damaged one."""
    try:
        with av.open(os.fspath(path)) as container:
            if not container.streams.video:
                raise _unreadable(path, "it has no video stream")
            stream = container.streams.video[0]
            if stream.width * stream.height > max_pixels:
                raise PhotoTooLarge(
                    f"the frames of {path} have {stream.width} x {stream.height} pixels",
                    f"expected at most {max_pixels} pixels",
                    "raise the limit with --max-pixels (in Python max_pixels)",
                )
            with contextlib.suppress(av.FFmpegError):  # a video that was cut off ends here
                start = float((stream.start_time or 0) * (stream.time_base or 0))
                for frame in container.decode(stream):
                    if (frame.time or start) - start > _MAX_SECONDS:
                        return
                    yield frame
    except (av.FFmpegError, OSError) as error:
        raise _unreadable(path, str(error)) from error


def _rotated(frame: av.VideoFrame) -> Bytes:
    """Returns the picture as the player shows it."""
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90)))


def _unreadable(path: str | os.PathLike[str], reason: str) -> UnreadablePhoto:
    return UnreadablePhoto(
        f"{os.fspath(path)} cannot be read as a video ({reason})",
        "expected a video with at least 2 frames",
        "copy or record the video again, or pass photos",
    )
