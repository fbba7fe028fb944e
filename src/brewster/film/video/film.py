"""Opens a film and reads the frames of a burst from it.

A film is decoded once. Small copies of all frames are measured, from which `film` chooses. The
frames of a short film are kept, reduced, so that the chosen ones are at hand. Those of a longer or
larger film are decoded a second time: the memory does not depend on the length of the film.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Self, final, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.base.files import DEFAULT_MAX_PIXELS
from brewster.errors import BrewsterError
from brewster.film.video.choosing import FilmMeasurements, choose, measure_film
from brewster.film.video.decoding import (
    FRAMES_PER_SECOND,
    MAX_SECONDS,
    FilmFrame,
    VideoFile,
    check_film_length,
    decoded,
)
from brewster.photo import Photo
from brewster.photo.file_info import with_notes
from brewster.separation.predictor import ProgressCallback

WORKING_PX: Final = 1000
"""The long side of the frames that are kept."""
_KEPT_SECONDS: Final = 4
_KEPT_BYTES: Final = 256 * 2**20
"""The frames of longer films, and of those that need more memory, are not kept."""


@final
@dataclass(frozen=True, eq=False)
class Film:
    """The beginning of a film, decoded once.

        film = Film.read("window.mp4")
        indices = film.choose(7)
        small = film.pictures(indices, WORKING_PX)

    The last line decodes nothing if the film is short.
    """

    source: VideoFile = field(repr=False)
    times: list[float]
    """The time of each frame in the file, in seconds."""
    measurements: FilmMeasurements = field(repr=False)
    """Measured in small grey pictures of the frames, `FilmFrame.thumbnail`."""
    size: tuple[int, int]
    """Height and width of the frames, as a player shows them."""
    note: str | None
    """What the conversion to sRGB changes, or None."""
    max_pixels: int
    seconds: float
    is_cropped: bool
    _kept: list[FilmFrame] = field(repr=False)
    """All frames with at most `WORKING_PX`, or none."""

    @classmethod
    def read(
        cls,
        source: VideoFile,
        *,
        seconds: float = MAX_SECONDS,
        is_cropped: bool = True,
        max_pixels: int = DEFAULT_MAX_PIXELS,
        on_frame: Callable[[FilmFrame], None] | None = None,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> Self:
        """Decodes and measures a film.

        Of slow motion, 30 frames for each second are measured.

        Args:
            source: the path of the file, or its bytes.
            seconds: how much of the film is used, from its first frame on.
            is_cropped: whether the border that a player hides is cut off (clean aperture).
            max_pixels: films with larger frames are refused.
            on_frame: called with every frame as it is decoded, also with those of slow motion.
            on_progress: called with the completed fraction, 0 to 1, for each frame. An exception
                raised in it stops the work.

        Raises:
            UnreadablePhoto: the file is not a video, is damaged, or has fewer than 2 frames.
            PhotoTooLarge: the frames have more than `max_pixels` pixels.
        """
        first_pass = _FirstPass()

        def thumbnails() -> Iterator[NDArray[np.uint8]]:
            for frame in decoded(
                source,
                max_pixels,
                seconds=seconds,
                is_complete=on_frame is not None,
                is_cropped=is_cropped,
            ):
                on_progress(min(1, len(first_pass.times) / (seconds * FRAMES_PER_SECOND)))
                if on_frame:
                    on_frame(frame)
                if frame.is_compared:
                    first_pass.add(frame)
                    yield frame.thumbnail()

        measurements = measure_film(thumbnails())
        times = first_pass.times
        check_film_length(source, len(times))
        return cls(
            source=source,
            times=times,
            measurements=measurements,
            size=first_pass.size,
            note=first_pass.note,
            max_pixels=max_pixels,
            seconds=seconds,
            is_cropped=is_cropped,
            _kept=first_pass.kept,
        )

    def choose(self, count: int) -> list[int]:
        """Returns the indices of `count` frames for a burst, or of all frames if there are fewer:
        from the longest part that shows one scene with one zoom, at equal distances along the path
        of the camera, the sharpest near each place.
        """
        return choose(self.measurements, count)

    def pictures(
        self,
        indices: Sequence[int],
        long_side_px: int | None = None,
        *,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> list[NDArray[np.uint8]]:
        """Returns frames as a player shows them, each (h, w, 3) sRGB, in the order of `indices`.

        The film is decoded again if it is long, or if frames larger than `WORKING_PX` are asked
        for.

        Args:
            indices: of the frames, from 0 to `len(times) - 1`.
            long_side_px: the largest long side; larger frames are reduced. None for no limit.
            on_progress: called with the completed fraction, 0 to 1, for each decoded frame.
        """
        limit = max(self.size) if long_side_px is None else long_side_px
        wanted = set(indices)
        pictures = {
            index: _picture(frame, limit)
            for index, frame in enumerate(self._frames(limit, max(wanted), on_progress))
            if index in wanted
        }
        return [pictures[index] for index in indices]

    def photos(
        self,
        count: int,
        *,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> list[Photo]:
        """Returns `count` frames for a burst at full size, or all frames if there are fewer.

        Args:
            count: the number of frames.
            on_progress: see `pictures`.
        """
        pictures = self.pictures(self.choose(count), on_progress=on_progress)
        photos = [Photo.from_array(picture, encoding="srgb") for picture in pictures]
        if self.note:
            photos = [
                replace(photo, file_info=with_notes(photo.file_info, self.note)) for photo in photos
            ]
        return photos

    def all_pictures(self, long_side_px: int) -> Sequence[NDArray[np.uint8]]:
        """Returns all frames as `pictures` does. Each is converted whenever it is asked for, which
        takes half the memory.

        Args:
            long_side_px: the largest long side; larger frames are reduced.
        """
        frames = self._frames(long_side_px, len(self.times) - 1, lambda _fraction: None)
        return _Pictures([frame.reduced(long_side_px) for frame in frames], long_side_px)

    def every_frame(self) -> Iterator[FilmFrame]:
        """Decodes the film once more, and yields all frames at full size, also those of slow
        motion.
        """
        return decoded(
            self.source,
            self.max_pixels,
            seconds=self.seconds,
            is_complete=True,
            is_cropped=self.is_cropped,
        )

    def _frames(self, limit: int, last: int, on_progress: ProgressCallback) -> Iterator[FilmFrame]:
        """Yields the frames up to index `last`, with at least a long side of `limit`."""
        if self._kept and min(limit, max(self.size)) <= WORKING_PX:
            yield from self._kept[: last + 1]
            return
        frames = decoded(
            self.source, self.max_pixels, seconds=self.seconds, is_cropped=self.is_cropped
        )
        for index, frame in zip(range(last + 1), frames, strict=False):
            on_progress(index / max(1, last))
            yield frame


@final
class _FirstPass:
    """What the first pass through a film finds. The reduced frames are kept while they are few."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.size = (0, 0)
        self.note: str | None = None
        self.kept: list[FilmFrame] = []
        self._kept_bytes = 0
        self._is_full = False

    def add(self, frame: FilmFrame) -> None:
        """Adds the next frame."""
        if not self.times:
            self.size = frame.size
            self.note = frame.stream.conversion_note()
        self.times.append(frame.time_s)
        if not self._is_full:
            self._keep(frame.reduced(WORKING_PX))

    def _keep(self, small: FilmFrame) -> None:
        self.kept.append(small)
        self._kept_bytes += small.byte_count
        seconds = small.time_s - self.times[0]
        if seconds > _KEPT_SECONDS or self._kept_bytes > _KEPT_BYTES:
            self._is_full = True
            self.kept.clear()


@final
class _Pictures(Sequence[NDArray[np.uint8]]):
    """Frames as pictures, (h, w, 3) sRGB with at most this long side."""

    def __init__(self, frames: Sequence[FilmFrame], long_side_px: int) -> None:
        self._frames = frames
        self._long_side_px = long_side_px

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, index: slice) -> _Pictures: ...

    def __getitem__(self, index: int | slice) -> NDArray[np.uint8] | _Pictures:
        if isinstance(index, slice):
            return _Pictures(self._frames[index], self._long_side_px)
        return _picture(self._frames[index], self._long_side_px)


def _picture(frame: FilmFrame, long_side_px: int) -> NDArray[np.uint8]:
    picture = frame.picture()
    height, width = picture.shape[:2]
    scale = long_side_px / max(height, width)
    if scale >= 1:
        return picture
    size = max(1, round(width * scale)), max(1, round(height * scale))
    reduced: NDArray[np.uint8] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return reduced


def check_frame_count(frames: int) -> None:
    """Checks that a burst has enough frames of a film.

    Args:
        frames: their number.

    Raises:
        BrewsterError: there are fewer than 2.
    """
    if frames < 2:
        raise BrewsterError(
            f"frames is {frames}",
            "expected at least 2, because one frame shows no motion",
            "choose 3 to 9",
        )


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
    check_frame_count(frames)
    film = Film.read(path, max_pixels=max_pixels, on_progress=lambda done: on_progress(0.5 * done))
    return film.photos(frames, on_progress=lambda done: on_progress(0.5 + 0.5 * done))
