"""Decodes the frames of a film, with what a player needs to show them."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO, Final, Self, cast, final

import av
import numpy as np
from av.sidedata.sidedata import SideDataContainer
from av.stream import Disposition
from av.video.reformatter import Interpolation, VideoReformatter
from numpy.typing import NDArray

from brewster.errors import PhotoTooLarge, UnreadablePhoto, counted
from brewster.film.video.colour import HDR_NAMES, displayed_size, is_turned, matrix_of, to_picture
from brewster.film.video.container_crop import Crop, clean_aperture, pixel_crop
from brewster.film.video.filters import filtered
from brewster.photo.animation import is_webp, webp_frames
from brewster.photo.blocks.iso_boxes import missing_part

VideoFile = str | os.PathLike[str] | bytes
"""The path of a video, or its bytes."""
MAX_SECONDS: Final = 20
"""Only the beginning of a video is read: a camera move for a burst takes 2 to 5 seconds."""
FRAMES_PER_SECOND: Final = 30
"""The largest number of frames that are compared. Slow motion has up to 240."""
_SRGB: Final = 13
"""The code of the transfer characteristics in H.273."""
_BT709: Final = 1
"""The code of the primaries of sRGB in H.273."""
_MAX_DECODED: Final = 6000
"""For videos with wrong times: 20 seconds at 300 frames per second."""
_THUMBNAIL_PX: Final = 240
_CLOCK_TIME: Final = re.compile(r"(\d+):(\d+):(\d+(?:\.\d+)?)")


@final
@dataclass(frozen=True)
class FilmStream:
    """The description of the frames in a film."""

    codec: str
    rate: Fraction | None
    """The mean number of frames per second."""
    time_base: Fraction
    """The unit of the times in the file, in seconds."""
    duration_s: float | None
    """None if the file does not contain it."""
    pixel_aspect: float
    """The width of a pixel divided by its height."""
    transfer: int
    primaries: int
    """The transfer characteristics and the colour primaries, by their codes in ITU-T H.273."""
    metadata: dict[str, str]
    """Those of the film, by the names of FFmpeg: creation_time, title ..."""

    @classmethod
    def of(cls, stream: av.VideoStream) -> Self:
        """Returns the description of a stream whose first frame is decoded."""
        context = stream.codec_context
        return cls(
            context.name,
            stream.average_rate,
            stream.time_base or Fraction(1, 90_000),
            _duration(stream),
            _pixel_aspect(stream),
            context.color_trc,
            context.color_primaries,
            dict(stream.container.metadata),
        )

    def conversion_note(self) -> str | None:
        """Returns what `FilmFrame.picture` changes, or None."""
        if self.codec == "gif":
            return "a GIF has at most 256 colours: a video gives better layers"
        name = HDR_NAMES.get(self.transfer)
        return f"the HDR video ({name}) was converted to SDR" if name else None


@final
@dataclass(frozen=True)
class FilmFrame:
    """A decoded frame of a film."""

    time_s: float
    """The time in the file, in seconds."""
    stored: av.VideoFrame
    """As it is stored: not turned, with the colours and the pixels of the film."""
    stream: FilmStream
    pixel_aspect: float
    """The width of a pixel of `stored` divided by its height."""
    display_matrix: bytes | None
    """How a player turns or mirrors the frame."""
    is_compared: bool = True
    """Whether it is one of at most `FRAMES_PER_SECOND`: not what slow motion has more."""

    def picture(self) -> NDArray[np.uint8]:
        """Returns the frame as a player shows it, (h, w, 3) sRGB: upright, with square pixels; HDR
        is converted.
        """
        return to_picture(
            self.stored,
            self.pixel_aspect,
            self.stream.transfer,
            self.stream.primaries,
            display_matrix=self.display_matrix,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of `picture`."""
        width, height = displayed_size(self.stored.width, self.stored.height, self.pixel_aspect)
        return (width, height) if is_turned(self.display_matrix) else (height, width)

    def thumbnail(self) -> NDArray[np.uint8]:
        """Returns the stored frame as a grey picture (h, 240), with the pixels of the film."""
        height = round(_THUMBNAIL_PX * self.stored.height / self.stored.width)
        height = min(4 * _THUMBNAIL_PX, max(16, height))
        grey = VideoReformatter().reformat(self.stored, _THUMBNAIL_PX, height, "gray")
        return grey.to_ndarray().astype(np.uint8)

    def reduced(self, long_side_px: int) -> FilmFrame:
        """Returns the frame with square pixels and at most this long side, still in the colours of
        the film, which take half the memory of RGB.
        """
        size = displayed_size(self.stored.width, self.stored.height, self.pixel_aspect)
        scale = long_side_px / max(size)
        if scale >= 1:
            return self
        matrix = matrix_of(self.stored)
        color_range = self.stored.color_range
        stored_format = self.stored.format
        # The memory of a reformatter of its own would last as long as the frame
        small = VideoReformatter().reformat(
            self.stored,
            width=max(1, round(size[0] * scale)),
            height=max(1, round(size[1] * scale)),
            # Colours of a palette have no mean
            format="rgb24" if stored_format.has_palette or stored_format.is_bayer else None,
            src_colorspace=matrix,
            dst_colorspace=matrix,
            src_color_range=color_range,
            dst_color_range=color_range,
            interpolation=Interpolation.AREA,
        )
        small.colorspace = int(matrix)
        small.color_range = color_range
        return replace(self, stored=small, pixel_aspect=1.0)

    @property
    def byte_count(self) -> int:
        """The memory of the pixels."""
        return sum(plane.buffer_size for plane in self.stored.planes)


def decoded(
    path: VideoFile,
    max_pixels: int,
    *,
    seconds: float = MAX_SECONDS,
    is_complete: bool = False,
    is_cropped: bool = True,
) -> Iterator[FilmFrame]:
    """Yields the frames of the first `seconds`, without the damaged ones.

    There are at most 30 frames for each second, unless `is_complete`. The border that a player
    hides is cut off, if `is_cropped`. If the size changes, only the frames of the first size are
    yielded. For the errors, see `Film.read`.
    """
    try:
        if is_webp(path):
            yield from _webp_frames(path, max_pixels, seconds)
            return
        file = io.BytesIO(path) if isinstance(path, bytes) else os.fspath(path)
        with av.open(file, "r") as container:
            stream = _video_stream(path, container)
            _check_size(
                path, displayed_size(stream.width, stream.height, _pixel_aspect(stream)), max_pixels
            )
            start = None
            film_stream = None
            compared = 0
            for index, (time, frame) in enumerate(
                _timed(_frames(path, container, stream, is_cropped=is_cropped), stream)
            ):
                start = time if start is None else start
                if time - start > seconds or index >= _MAX_DECODED:
                    return
                is_compared = compared <= FRAMES_PER_SECOND * (time - start) + 0.5
                if not is_complete and not is_compared:
                    continue
                if film_stream is None:
                    film_stream = FilmStream.of(stream)
                    size = displayed_size(frame.width, frame.height, film_stream.pixel_aspect)
                    _check_size(path, size, max_pixels)
                compared += is_compared
                yield FilmFrame(
                    time,
                    frame,
                    film_stream,
                    film_stream.pixel_aspect,
                    _display_matrix(frame),
                    is_compared,
                )
    except (av.FFmpegError, OSError) as error:
        raise unreadable(path, error.strerror or str(error)) from error


def check_readable_film(path: VideoFile, max_pixels: int) -> None:
    """Checks the beginning of a film, as `Film.read` does. Two frames are decoded.

    Args:
        path: the path of the film, or its bytes.
        max_pixels: films with larger frames are refused.

    Raises:
        UnreadablePhoto: the file is not a video, is damaged, or has fewer than 2 frames.
        PhotoTooLarge: the frames have more than `max_pixels` pixels.
    """
    check_film_length(path, sum(1 for _ in islice(decoded(path, max_pixels), 2)))


def _webp_frames(path: VideoFile, max_pixels: int, seconds: float) -> Iterator[FilmFrame]:
    stream = FilmStream("webp", None, Fraction(1, 1000), None, 1.0, _SRGB, _BT709, {})
    for time, picture in webp_frames(path):
        _check_size(path, picture.shape[1::-1], max_pixels)
        if time > seconds:
            return
        yield FilmFrame(time, av.VideoFrame.from_ndarray(picture, "rgb24"), stream, 1.0, None)


def _video_stream(path: VideoFile, container: av.container.InputContainer) -> av.VideoStream:
    """Returns the default stream, or the largest one that moves.

    The cover picture of an audio file is a video stream, too, and so is the large picture in the
    motion photo of a phone.
    """
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        raise unreadable(path, "it has no video stream")
    known = [stream for stream in streams if getattr(stream, "codec_context", None)]
    if not known:
        raise unreadable(path, "its codec is unknown, or it is encrypted")

    def rank(stream: av.VideoStream) -> tuple[bool, bool, int]:
        is_default = bool(stream.disposition & Disposition.default)
        # 0 frames if the container does not tell
        return stream.frames != 1, is_default, stream.width * stream.height

    return max(known, key=rank)


def _frames(
    path: VideoFile,
    container: av.container.InputContainer,
    stream: av.VideoStream,
    *,
    is_cropped: bool,
) -> Iterator[av.VideoFrame]:
    """Yields the frames of the first size, as a player shows them but not yet turned."""
    frames = _undamaged(container, stream)
    first = next(frames, None)
    if first is None:
        return
    size = (first.width, first.height)
    crop = _crop(path, container, stream, size) if is_cropped else None
    same = (frame for frame in chain([first], frames) if (frame.width, frame.height) == size)
    yield from filtered(same, stream, crop)


def _undamaged(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[av.VideoFrame]:
    """Yields the frames that can be decoded. A film that was cut off ends there."""
    with suppress(av.FFmpegError):
        for packet in container.demux(stream):
            yield from _decoded_packet(packet)


def _decoded_packet(packet: av.Packet[av.VideoStream]) -> list[av.VideoFrame]:
    """Returns the frames that a packet completes, none if it is damaged."""
    try:
        return [frame for frame in packet.decode() if not frame.is_corrupt]
    except av.FFmpegError:
        return []


def _crop(
    path: VideoFile,
    container: av.container.InputContainer,
    stream: av.VideoStream,
    size: tuple[int, int],
) -> Crop | None:
    """Returns what a player hides of the stored frames of this size."""
    with _opened(path) as file:
        if "mp4" in container.format.name:
            return clean_aperture(file, stream.id, size)
        if "matroska" in container.format.name:
            return pixel_crop(file, container.streams.video.index(stream), size)
    return None


def _timed(
    frames: Iterable[av.VideoFrame], stream: av.VideoStream
) -> Iterator[tuple[float, av.VideoFrame]]:
    """Yields the frames with their time in seconds."""
    for index, frame in enumerate(frames):
        yield (
            index / float(stream.average_rate or FRAMES_PER_SECOND)
            if frame.time is None
            else frame.time,
            frame,
        )


def _display_matrix(frame: av.VideoFrame) -> bytes | None:
    """Returns how a player turns or mirrors a frame, see `to_picture`.

    `frame.side_data` would refer to the frame, which refers to it: frames at full size would stay
    in memory until Python looks for such cycles.
    """
    side_data = SideDataContainer(frame)  # type: ignore[call-arg]
    return bytes(side_data["DISPLAYMATRIX"]) if "DISPLAYMATRIX" in side_data else None


def _pixel_aspect(stream: av.VideoStream) -> float:
    """Returns the width of a pixel divided by its height."""
    return float(stream.sample_aspect_ratio or 1)


def _duration(stream: av.VideoStream) -> float | None:
    """Returns the duration of a video in seconds, if its file contains it.

    Matroska files contain it as a tag, such as 00:00:02.007000000.
    """
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    for key, text in stream.metadata.items():
        if key.startswith("DURATION") and (match := _CLOCK_TIME.fullmatch(text.strip())):
            hours, minutes, seconds = map(float, match.groups())
            return 3600 * hours + 60 * minutes + seconds
    container = cast("av.container.InputContainer", stream.container)
    # Sound may be longer
    is_alone = len(container.streams) == 1
    return container.duration / av.time_base if container.duration and is_alone else None


def _check_size(path: VideoFile, size: tuple[int, int], max_pixels: int) -> None:
    if size[0] * size[1] > max_pixels:
        raise PhotoTooLarge(
            f"the frames of {_name(path)} have {size[0]} x {size[1]} pixels",
            f"expected at most {max_pixels} pixels",
            "raise the limit with --max-pixels (in Python max_pixels)",
        )


def _name(path: VideoFile) -> str:
    return "the video" if isinstance(path, bytes) else os.fspath(path)


def _opened(path: VideoFile) -> BinaryIO:
    return io.BytesIO(path) if isinstance(path, bytes) else Path(path).open("rb")


def check_film_length(path: VideoFile, frames: int) -> None:
    """Checks that a film has enough frames to show a motion.

    Args:
        path: the path of the film, or its bytes.
        frames: the number of frames that were decoded.

    Raises:
        UnreadablePhoto: there are fewer than 2.
    """
    if frames < 2:
        raise unreadable(path, f"{counted(frames, 'frame')} can be decoded")


def unreadable(path: VideoFile, reason: str) -> UnreadablePhoto:
    """Returns the error for a film that cannot be read. What a film lacks that was cut off is a
    better reason than the one of the decoder.
    """
    with suppress(OSError), _opened(path) as file:
        reason = missing_part(file, file.seek(0, io.SEEK_END)) or reason
    return UnreadablePhoto(
        f"{_name(path)} cannot be read as a video ({reason})",
        "expected a video with at least 2 frames",
        "copy or record the video again, or pass photos",
    )
