"""Copies the sound of a film into a new video, packet by packet: all tracks that its container
takes, with their languages.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Self, final

import av
from av.container import OutputContainer

from brewster.base.image_formats import WRITABLE_VIDEOS

_PREROLL_S: Final = 0.05
"""An encoder of sound needs a packet before the first one that is heard. Players of MP4 and
QuickTime files do not play it; those of Matroska files would.
"""
_QUICKTIME_LANGUAGES: Final = {
    "bod": "tib",
    "ces": "cze",
    "cym": "wel",
    "deu": "ger",
    "ell": "gre",
    "eus": "baq",
    "fas": "per",
    "fra": "fre",
    "hye": "arm",
    "isl": "ice",
    "kat": "geo",
    "mkd": "mac",
    "mri": "mao",
    "msa": "may",
    "mya": "bur",
    "nld": "dut",
    "ron": "rum",
    "slk": "slo",
    "sqi": "alb",
    "zho": "chi",
}
"""The bibliographic codes of ISO 639-2 for its terminological ones. FFmpeg writes no language into
QuickTime files for the second ones, without a message.
"""


@final
@dataclass(frozen=True)
class SoundTracks:
    """The sound tracks of a film that a container takes."""

    source: str | os.PathLike[str]
    suffix: str
    """Of the new video, from `WRITABLE_VIDEOS`."""
    indices: list[int]
    """The places of the tracks among the streams of the film."""
    note: str | None
    """What is left out, or None."""

    @classmethod
    def that_fit(cls, source: str | os.PathLike[str], suffix: str) -> Self:
        """Returns the tracks whose header and first packet can be written."""
        indices = []
        refused = []
        with av.open(os.fspath(source)) as container:
            for track in container.streams.audio:
                codec = track.codec_context.name if track.codec_context else "an unknown codec"
                first = next(_packets(container, track), None)
                if first is None:  # it is silent
                    continue
                if _fits(track, first, suffix):
                    indices.append(track.index)
                else:
                    refused.append(codec)
                container.seek(0)
        names = ", ".join(refused)
        note = f"the sound ({names}) was left out, because {suffix} cannot contain it"
        return cls(source, suffix, indices, note if refused else None)


@final
class SoundCopy:
    """Copies one sound track. A context manager, which keeps the film open.

    Args:
        tracks: those of the film.
        index: the place of the track among the streams of the film.
        output: the new video, before its first packet.
        start_s: the time of the film that is 0 in the new video, in seconds.
    """

    def __init__(
        self, tracks: SoundTracks, index: int, output: OutputContainer, start_s: float
    ) -> None:
        self._start_s = start_s
        self._output = output
        self._container = av.open(os.fspath(tracks.source))
        track = self._container.streams[index]
        assert isinstance(track, av.AudioStream)
        self._stream = output.add_stream_from_template(track)
        container_format = WRITABLE_VIDEOS[tracks.suffix]
        if language := track.language:
            is_quicktime = container_format == "mov"
            self._stream.metadata["language"] = (
                _QUICKTIME_LANGUAGES.get(language, language) if is_quicktime else language
            )
        if title := track.metadata.get("title"):
            self._stream.metadata["title"] = title
        self._stream.disposition = track.disposition
        is_preroll_hidden = container_format != "matroska"
        self._first_s = start_s - (_PREROLL_S if is_preroll_hidden else 0)
        self._packets = _packets(self._container, track)
        self._packet = next(self._packets, None)

    def __enter__(self) -> Self:
        """Returns the copy itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Closes the film."""
        self._container.close()

    def copy_until(self, end_s: float) -> None:
        """Copies the packets that begin before a time of the film, and are heard after its first
        frame.
        """
        while (packet := self._packet) and (dts := packet.dts or 0) * packet.time_base < end_s:
            pts = dts if packet.pts is None else packet.pts
            if (pts + (packet.duration or 0)) * packet.time_base > self._first_s:
                shift = round(self._start_s / packet.time_base)
                packet.pts = pts - shift
                packet.dts = dts - shift
                packet.stream = self._stream
                self._output.mux(packet)
            self._packet = next(self._packets, None)


def _packets(
    container: av.container.InputContainer, track: av.AudioStream
) -> Iterator[av.Packet[av.AudioStream]]:
    """Yields the packets of a track, up to the first damaged one, without those that were cut away
    from the film (an edit list).
    """
    with suppress(av.FFmpegError):
        for packet in container.demux(track):
            if packet.dts is not None and not packet.is_discard:
                yield packet


def _fits(track: av.AudioStream, first: av.Packet[av.AudioStream], suffix: str) -> bool:
    """Tries to write the header and the first packet: the codecs that PyAV lists for a format
    contain some that it refuses.
    """
    try:
        with av.open(io.BytesIO(), "w", format=WRITABLE_VIDEOS[suffix]) as trial:
            first.stream = trial.add_stream_from_template(track)
            trial.mux(first)
    except (av.FFmpegError, ValueError):
        return False
    return True
