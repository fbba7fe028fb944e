"""Writes a layer of a film as a video: H.264 with the times of the film, and with its sound, whose
packets are copied unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self, final

import av
import numpy as np
from av.container import InputContainer
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from brewster.burst.video_decoding import FilmStream
from brewster.errors import OutputError
from brewster.image_formats import WRITABLE_VIDEOS

_BT709: Final = 1
"""The code of BT.709 in H.273: primaries, transfer and matrix."""
_CONTAINER_OPTIONS: Final = {"movflags": "+faststart"}
_OPTIONS: Final = {"crf": "16", "preset": "veryfast"}


@final
class VideoWriter:
    """Writes 8-bit sRGB pictures of one size. A context manager.

    Args:
        path: the file to write; its name needs no suffix.
        suffix: that of the video, from `WRITABLE_VIDEOS`.
        source: the film, whose first sound track is copied.
        stream: the video stream of the film.
        start_s: the time of the first picture of the film in seconds, which is 0 in the new video.
            size: height and width of the pictures. Odd sides lose a row or a column, because H.264
            with yuv420p has even sizes.

    Raises:
        OutputError: the video cannot be written.
    """

    def __init__(
        self,
        path: Path,
        suffix: str,
        source: str | os.PathLike[str],
        *,
        stream: FilmStream,
        start_s: float,
        size: tuple[int, int],
    ) -> None:
        self._stack = ExitStack()
        self._start_s = start_s
        self._height, self._width = (side // 2 * 2 for side in size)
        self._container = self._stack.enter_context(
            av.open(
                str(path), "w", format=WRITABLE_VIDEOS[suffix], container_options=_CONTAINER_OPTIONS
            )
        )
        try:
            self._video = self._container.add_stream(
                "libx264", rate=stream.rate or 30, options=_OPTIONS
            )
        except av.codec.codec.UnknownCodecError as error:
            raise OutputError(
                "PyAV has no encoder for H.264 (libx264)",
                "expected the PyAV of the Python package index, which contains it",
                "install the package av again with pip",
            ) from error
        self._time_base = stream.time_base
        self._last = -1
        context = self._video.codec_context
        context.width = self._width
        context.height = self._height
        context.pix_fmt = "yuv420p"
        context.time_base = self._time_base
        context.color_primaries = context.color_trc = context.colorspace = _BT709
        context.color_range = ColorRange.MPEG
        self.note: str | None = None
        """What is missing in the video, or None."""
        sound = self._stack.enter_context(av.open(os.fspath(source)))
        track = next(iter(sound.streams.audio), None)
        self._packets = _packets(sound, track)
        self._packet = next(self._packets, None)
        if track and self._packet:
            name = track.codec_context.name if track.codec_context else "an unknown codec"
            if name in self._container.supported_codecs:
                self._audio = self._container.add_stream_from_template(track)
            else:
                self.note = f"the sound ({name}) was left out, because {suffix} cannot contain it"
                self._packet = None

    def __enter__(self) -> Self:
        """Returns the writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Completes the file if there was no error."""
        with self._stack:
            if kind is None:
                self._container.mux(self._video.encode())

    def write(self, picture: NDArray[np.uint8], time_s: float, duration_s: float) -> None:
        """Appends a picture (h, w, 3), and the sound up to its end. `time_s` and `duration_s` are
        those of the frame of the film.
        """
        even = np.ascontiguousarray(picture[: self._height, : self._width])
        frame = av.VideoFrame.from_ndarray(even, format="rgb24")
        frame = frame.reformat(
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
        )
        self._last = max(self._last + 1, round((time_s - self._start_s) / self._time_base))
        frame.pts = self._last
        frame.time_base = self._time_base
        frame.duration = round(duration_s / self._time_base)
        self._container.mux(self._video.encode(frame))
        self._copy_sound(time_s + duration_s)

    def _copy_sound(self, end_s: float) -> None:
        """Copies the packets that begin before a time of the film."""
        while (packet := self._packet) and (dts := packet.dts or 0) * packet.time_base < end_s:
            shift = round(self._start_s / packet.time_base)
            packet.pts = (dts if packet.pts is None else packet.pts) - shift
            packet.dts = dts - shift
            packet.stream = self._audio
            self._container.mux(packet)
            self._packet = next(self._packets, None)


def _packets(
    container: InputContainer, track: av.AudioStream | None
) -> Iterator[av.Packet[av.AudioStream]]:
    """Yields the packets of a sound track, up to the first damaged one."""
    with suppress(av.FFmpegError):
        for packet in container.demux(track) if track else ():
            if packet.dts is not None:
                yield packet
