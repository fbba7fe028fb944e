"""Writes a layer of a film as a video: H.264 with the times of the film, its sound, and its date,
make and title.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Final, Self, final

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from brewster.base.image_formats import WRITABLE_VIDEOS
from brewster.errors import OutputError
from brewster.film.video.decoding import FilmStream
from brewster.film.video.sound import SoundCopy, SoundTracks

_BT709: Final = 1
"""The code of BT.709 in H.273: primaries, transfer and matrix."""
_TECHNICAL: Final = frozenset(
    {"major_brand", "minor_version", "compatible_brands", "encoder", "duration"}
)
"""The metadata that describes the file of the film, and not the film."""
_OPTIONS: Final = {"crf": "18", "preset": "superfast"}


@final
class VideoWriter:
    """Writes 8-bit sRGB pictures of one size. A context manager.

    Args:
        path: the file to write; its name needs no suffix.
        sound: the tracks that are copied, for the suffix of the new video.
        stream: the video stream of the film.
        start_s: the time of the first picture of the film in seconds, which is 0 in the new video.
        size: height and width of the pictures. Odd sides lose a row or a column, because H.264 with
            yuv420p has even sizes.

    Raises:
        OutputError: the video cannot be written.
    """

    def __init__(
        self,
        path: Path,
        sound: SoundTracks,
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
                str(path),
                "w",
                format=WRITABLE_VIDEOS[sound.suffix],
                container_options={"movflags": _movflags(stream.metadata)},
            )
        )
        self._container.metadata.update(
            {key: text for key, text in stream.metadata.items() if key not in _TECHNICAL}
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
        self._sounds = [
            self._stack.enter_context(SoundCopy(sound, index, self._container, start_s))
            for index in sound.indices
        ]

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
        for sound in self._sounds:
            sound.copy_until(time_s + duration_s)


def _movflags(metadata: Mapping[str, str]) -> str:
    """Returns the options for MP4 and QuickTime. The metadata of iTunes contain a title and a date.
    Make and model, and the names of Apple and Android, such as com.apple.quicktime.make, need
    metadata with free names.
    """
    has_other_names = any("." in key or key in ("make", "model") for key in metadata)
    return "+faststart+use_metadata_tags" if has_other_names else "+faststart"
