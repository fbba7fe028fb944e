"""Reads the frames of a burst from a video file.

The video is decoded twice: first for small copies of its frames, from which `film` chooses, then
for the chosen frames. Therefore the memory does not depend on the length of the video.
"""

import contextlib
import io
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import av
import numpy as np
from av.stream import Disposition
from numpy.typing import NDArray

from brewster.burst.film import choose, measure_film
from brewster.burst.video_colour import HDR_NAMES, displayed_size, to_picture
from brewster.errors import BrewsterError, PhotoTooLarge, UnreadablePhoto, counted
from brewster.files import DEFAULT_MAX_PIXELS
from brewster.inference.predictor import ProgressCallback
from brewster.photo import Photo
from brewster.photo.file_info import with_notes

VideoFile = str | os.PathLike[str] | bytes
"""The path of a video, or its bytes."""
_MAX_SECONDS: Final = 20
"""Only the beginning of a video is read: a camera move for a burst takes 2 to 5 seconds."""
_FRAMES_PER_SECOND: Final = 30
"""The largest number of frames that are compared. Slow motion has up to 240."""
_MAX_DECODED: Final = 6000
"""For videos with wrong times: 20 seconds at 300 frames per second."""
_THUMBNAIL_PX: Final = 240


def read_video(
    path: VideoFile,
    frames: int,
    *,
    max_pixels: int = DEFAULT_MAX_PIXELS,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> list[Photo]:
    """Returns frames of a video, in the order of time, for `separate_burst`.

    The frames are 8-bit sRGB, as a player shows them: upright, with square pixels; HDR is
    converted. They are from the longest part that shows one scene with one zoom, and have equal
    distances along the path of the camera. Of the frames near each place, the sharpest one is
    taken. A video with fewer frames is returned whole. Only the first 20 seconds are used.

    Args:
        path: the path of the file, or its bytes.
        frames: the number of frames.
        max_pixels: videos with larger frames are refused.
        on_progress: called with the completed fraction, 0 to 1, for each frame. An exception raised
            in it stops the work.

    Raises:
        UnreadablePhoto: the file is not a video, is damaged, or has fewer than 2 frames.
        PhotoTooLarge: the frames have more than `max_pixels` pixels.
        BrewsterError: `frames` is less than 2.
    """
    if frames < 2:
        raise BrewsterError(
            f"frames is {frames}",
            "expected at least 2, because one frame shows no motion",
            "choose 3 to 9",
        )

    def thumbnails() -> Iterator[NDArray[np.uint8]]:
        for index, (_, frame, _) in enumerate(decoded(path, max_pixels)):
            on_progress(0.5 * min(1, index / (_MAX_SECONDS * _FRAMES_PER_SECOND)))
            height = min(
                4 * _THUMBNAIL_PX, max(16, round(_THUMBNAIL_PX * frame.height / frame.width))
            )
            yield frame.to_ndarray(width=_THUMBNAIL_PX, height=height, format="gray").astype(
                np.uint8
            )

    film = measure_film(thumbnails())
    if len(film.positions) < 2:
        raise _unreadable(path, f"{counted(len(film.positions), 'frame')} can be decoded")
    chosen = choose(film, frames)
    photos = []
    for index, (_, frame, stream) in enumerate(decoded(path, max_pixels)):
        on_progress(0.5 + 0.5 * index / chosen[-1])
        if index in chosen:
            photo = Photo.from_array(displayed(frame, stream), encoding="srgb")
            if note := conversion_note(stream):
                photo = replace(photo, file_info=with_notes(photo.file_info, note))
            photos.append(photo)
        if index >= chosen[-1]:
            break
    return photos


def displayed(frame: av.VideoFrame, stream: av.VideoStream) -> NDArray[np.uint8]:
    """Returns a frame as a player shows it, (h, w, 3) sRGB: upright, with square pixels; HDR is
    converted.
    """
    context = stream.codec_context
    return to_picture(frame, _pixel_aspect(stream), context.color_trc, context.color_primaries)


def conversion_note(stream: av.VideoStream) -> str | None:
    """Returns what `displayed` changes, or None."""
    name = HDR_NAMES.get(stream.codec_context.color_trc)
    if stream.codec_context.name == "gif":
        return "a GIF has at most 256 colours: a video gives better layers"
    return f"the HDR video ({name}) was converted to SDR" if name else None


def decoded(
    path: VideoFile, max_pixels: int, *, is_complete: bool = False
) -> Iterator[tuple[float, av.VideoFrame, av.VideoStream]]:
    """Yields the frames of the first 20 seconds with their time in seconds and their stream, up to
    the first damaged one.

    There are at most 30 frames for each second, unless `is_complete`. If the size changes, only the
    frames of the first size are yielded. For the errors, see `read_video`.
    """
    try:
        file = io.BytesIO(path) if isinstance(path, bytes) else os.fspath(path)
        with av.open(file, "r") as container:
            stream = _video_stream(path, container)
            _check_size(
                path, displayed_size(stream.width, stream.height, _pixel_aspect(stream)), max_pixels
            )
            start = None
            size = None
            yielded = 0
            with contextlib.suppress(av.FFmpegError):  # a video that was cut off ends here
                for index, (time, frame) in enumerate(_timed(container, stream)):
                    start = time if start is None else start
                    if time - start > _MAX_SECONDS or index >= _MAX_DECODED:
                        return
                    size = size or (frame.width, frame.height)
                    is_due = is_complete or yielded <= _FRAMES_PER_SECOND * (time - start) + 0.5
                    if is_due and (frame.width, frame.height) == size:
                        _check_size(path, displayed_size(*size, _pixel_aspect(stream)), max_pixels)
                        yielded += 1
                        yield time, frame, stream
    except (av.FFmpegError, OSError) as error:
        raise _unreadable(path, str(error)) from error


def _video_stream(path: VideoFile, container: av.container.InputContainer) -> av.VideoStream:
    """Returns the first stream that is a film. The cover picture of an audio file is a video
    stream, too.
    """
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        raise _unreadable(path, "it has no video stream")
    if not getattr(streams[0], "codec_context", None):
        raise _unreadable(path, "its codec is unknown, or it is encrypted")
    return streams[0]


def _timed(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[tuple[float, av.VideoFrame]]:
    """Yields the frames with their time in seconds."""
    for index, frame in enumerate(container.decode(stream)):
        yield (
            index / float(stream.average_rate or _FRAMES_PER_SECOND)
            if frame.time is None
            else frame.time,
            frame,
        )


def _pixel_aspect(stream: av.VideoStream) -> float:
    """Returns the width of a pixel divided by its height."""
    return float(stream.sample_aspect_ratio or 1)


def _check_size(path: VideoFile, size: tuple[int, int], max_pixels: int) -> None:
    if size[0] * size[1] > max_pixels:
        raise PhotoTooLarge(
            f"the frames of {_name(path)} have {size[0]} x {size[1]} pixels",
            f"expected at most {max_pixels} pixels",
            "raise the limit with --max-pixels (in Python max_pixels)",
        )


def _name(path: VideoFile) -> str:
    return "the video" if isinstance(path, bytes) else os.fspath(path)


def _unreadable(path: VideoFile, reason: str) -> UnreadablePhoto:
    return UnreadablePhoto(
        f"{_name(path)} cannot be read as a video ({reason})",
        "expected a video with at least 2 frames",
        "copy or record the video again, or pass photos",
    )
