"""Separates every frame of a film with the layers of one solution.

    separate_video("window.mp4", "clear.mp4", "clear.reflection.mp4")

- A first pass chooses the frames of a burst, and makes small copies of all frames (video/film.py).
- The layers are measured in the frames of the burst (separate.py), which are decoded again if
  they are large.
- The motions of the layers are followed through the small copies (tracking.py).
- The last pass moves the layers into each frame. Their shares of its light are applied to the
  frame at full size, as in a single photo.
- Both layers are encoded as they come, with the sound of the film (video/writer.py). A few frames
  at full size are in memory.

Where the layers are not known, or do not explain the frame, or the frames of the burst, the
transmission fades to the frame itself.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.base.files import atomic_path
from brewster.base.image_formats import WRITABLE_VIDEOS
from brewster.base.memory import give_back_memory
from brewster.errors import OutputError, PhotoError
from brewster.film.fitted_burst import FittedBurst, measured_change, window_means
from brewster.film.motion.model.joint_model import Doubles, Floats, compose
from brewster.film.motion.model.kernels import sampling
from brewster.film.motion.solution import unexplained_share
from brewster.film.motion.threads import POOL, THREADS, single_opencv_thread
from brewster.film.separate import fit_burst
from brewster.film.tracking import LINEAR_LIGHT, Tracker, coverage, followed, linear_light
from brewster.film.video.decoding import MAX_SECONDS, FilmFrame, FilmStream
from brewster.film.video.film import Film, check_frame_count
from brewster.film.video.sound import SoundTracks
from brewster.film.video.writer import VideoWriter
from brewster.options import BurstMethod, Options
from brewster.photo import Photo, Source
from brewster.photo.srgb import to_encoded
from brewster.separation.burst_report import BurstReport
from brewster.separation.guided_upsampling import GuidedUpsampler
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separator import Separator, timed

_TRACKED_PX: Final = 160
"""The long side of the copies in which the motion is followed."""
_TRACKED_SCALE: Final = 2
"""They are reduced to this often their size in the colours of the film, the rest in sRGB."""
_LAYER_PX: Final = 640
"""The largest long side at which the shares of the layers are computed."""
_ERRORS: Final = 0.06, 0.12
"""Where the layers explain a frame with the first error, they are used; with the second one, not at
all. They are not used either where the error is much larger than elsewhere in the frame.
"""
_ERROR_BLUR_PX: Final = 4
_CORRELATIONS: Final = 0.2, 0.5
"""A frame that correlates with the sum of the layers by the first value shows something else, as a
covered lens; by the second one, the window.
"""
_BANDS: Final = 24
"""A multiple of the number of bands in which a frame is reduced. It has many divisors: a band ends
where a reduced row ends.
"""
_AT_ONCE: Final = max(1, min(3, THREADS - 1))
"""The number of frames whose layers are computed at once, each with about 80 MiB in 1080p. Another
thread decodes and encodes.
"""
_ENCODED: Final = np.rint(255 * to_encoded(np.arange(16_385) / 16_384)).astype(np.uint8)
_MEASURED = 0.3
_FOLLOWED = 0.5
"""The completed fractions after these steps."""


@final
@dataclass(frozen=True)
class VideoSeparation:
    """What `separate_video` wrote."""

    burst: BurstReport
    frames: int
    """The number of frames of each video."""
    note: str | None
    """What was changed or left out, or None."""
    seconds: dict[str, float]
    """The wall time of each step."""


def separate_video(
    video: str | os.PathLike[str],
    transmission: str | os.PathLike[str] | None,
    reflection: str | os.PathLike[str] | None = None,
    *,
    frames: int = Options.frames,
    reference: int | None = Options.reference,
    separator: Separator | None = None,
    method: BurstMethod = Options.method,
    swap: bool = Options.swap,
    strength: float = Options.strength,
    hints: Source | None = Options.hints,
    max_pixels: int = Options.max_pixels,
    overwrite: bool = False,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> VideoSeparation:
    """Separates every frame of a film of one window, and writes the layers as videos.

    The videos are H.264 (.mp4, .m4v, .mov or .mkv), with the size, the orientation and the times of
    the frames of the film, its sound, and its date, make and title. HDR becomes SDR. The first 20
    seconds are used. Where the layers are not known, as outside of the view of the frames from
    which they were measured, the transmission is the film itself.

    Args:
        video: the film.
        transmission: the video to write; None for none.
        reflection: likewise.
        frames: the number of frames from which the layers are measured, 2 to 15.
        reference: one of the `frames`; see `separate_burst`, also for the next arguments.
        separator: for what neither layer explains.
        method: "motion" accepts layers that are not certain.
        swap: exchanges the layers.
        strength: how much of the reflection is removed, 0 to 1.
        hints: strokes on the reference frame.
        max_pixels: films with larger frames are refused.
        overwrite: whether files that exist are replaced.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.

    Raises:
        PhotoError: the film cannot be read, or the motion in it does not separate the layers.
        OutputError: a video exists or cannot be written, or has another suffix.
        BrewsterError: see `separate_burst`.
    """
    outputs = _outputs(transmission, reflection, overwrite=overwrite)
    strength = Options(strength=strength).strength
    seconds = dict[str, float]()
    with timed(seconds, "motion"):
        check_frame_count(frames)
        small = _SmallCopies()
        film = Film.read(
            video,
            max_pixels=max_pixels,
            on_frame=small.add,
            on_progress=lambda _done: on_progress(0.0),
        )
        sounds = _sounds(video, outputs)
        fitted = fit_burst(
            _burst(film, frames, on_progress),
            reference=reference,
            separator=separator,
            hints=hints,
            max_pixels=max_pixels,
            on_progress=lambda done: on_progress(_MEASURED * done),
        ).chosen(method, swap=swap)
    _check_method(video, fitted.report)
    give_back_memory()
    with single_opencv_thread():
        with timed(seconds, "following"):
            motions = followed(
                fitted.model,
                small.pictures,
                lambda done: on_progress(_MEASURED + (_FOLLOWED - _MEASURED) * done),
            )
        report = fitted.report
        layers = _FrameLayers(fitted, film.size, strength, list(outputs))
        # The model, the photo and the network are not needed in memory any more
        del fitted, separator
        give_back_memory()
        with timed(seconds, "frames"):
            _write(
                film,
                layers,
                motions,
                times=small.times,
                outputs=outputs,
                sounds=sounds,
                on_progress=lambda done: on_progress(_FOLLOWED + (1 - _FOLLOWED) * done),
            )
    notes = [*small.notes(film), *(sound.note for sound in sounds.values() if sound.note)]
    return VideoSeparation(
        burst=report,
        frames=len(small.times),
        note="; ".join(dict.fromkeys(notes)) or None,
        seconds=seconds,
    )


def _outputs(*paths: str | os.PathLike[str] | None, overwrite: bool) -> dict[int, Path]:
    """Returns the videos to write by their layer, 0 for T and 1 for R.

    Raises:
        OutputError: the suffix of a video is none of `WRITABLE_VIDEOS`, or the file exists.
    """
    outputs = {layer: Path(path) for layer, path in enumerate(paths) if path is not None}
    for path in outputs.values():
        _check_output(path, overwrite=overwrite)
    return outputs


def _check_output(path: Path, *, overwrite: bool) -> None:
    if path.suffix.lower() not in WRITABLE_VIDEOS:
        raise OutputError(
            f"{path} ends in {path.suffix or 'no suffix'}",
            f"expected a video: {', '.join(WRITABLE_VIDEOS)}",
            "choose another name, such as clear.mp4",
        )
    if path.exists() and not overwrite:
        raise OutputError(
            f"{path} exists",
            "expected a path that does not exist",
            "pass overwrite=True, or choose another name",
        )


def _sounds(video: str | os.PathLike[str], outputs: Mapping[int, Path]) -> dict[int, SoundTracks]:
    """Returns the sound of a film that fits into the video of each layer."""
    suffixes = {layer: path.suffix.lower() for layer, path in outputs.items()}
    fitting = {suffix: SoundTracks.that_fit(video, suffix) for suffix in set(suffixes.values())}
    return {layer: fitting[suffix] for layer, suffix in suffixes.items()}


def _burst(film: Film, frames: int, on_progress: ProgressCallback) -> list[Photo]:
    """Returns the frames from which the layers are measured."""
    photos = film.photos(frames, on_progress=lambda _done: on_progress(0.0))
    give_back_memory()
    return photos


def _check_method(video: str | os.PathLike[str], report: BurstReport) -> None:
    if report.method == "burst":
        return
    again = "film the window again while the camera moves along a circle of 5 to 10 cm"
    raise PhotoError(
        f"the motion does not separate the layers of {os.fspath(video)}: "
        f"{report.message.removesuffix('.')}",
        "expected a film in which the transmission and the reflection move differently",
        'use the measured layers anyway with --method motion (in Python method="motion"), or '
        f"{again}"
        if report.is_measured
        else again,
    )


@final
class _SmallCopies:
    """Small copies of all frames of a film, in which the motion is followed, and their times."""

    def __init__(self) -> None:
        self.pictures: list[NDArray[np.uint8]] = []
        self.times: list[float] = []
        self._duration_s: float | None = None

    def add(self, frame: FilmFrame) -> None:
        """Adds a copy of a frame."""
        small = frame.reduced(_TRACKED_SCALE * _TRACKED_PX).picture()
        self.pictures.append(_shrunk(small, _scaled(frame.size, _TRACKED_PX)))
        self.times.append(frame.time_s)
        self._duration_s = frame.stream.duration_s

    def notes(self, film: Film) -> list[str]:
        """Returns what a video of all frames changes or leaves out.

        Args:
            film: the film of these frames.
        """
        notes = [film.note] if film.note else []
        length = self.times[-1] - self.times[0]
        if self._duration_s and length < self._duration_s - 0.5:
            notes.append(
                f"only the first {length:.1f} of {self._duration_s:.1f} seconds were written"
            )
        elif not self._duration_s and length > MAX_SECONDS - 1:
            notes.append(f"only the first {length:.1f} seconds were written")
        height, width = film.size
        if height % 2 or width % 2:
            notes.append(
                f"the film has {width} x {height} pixels, and the videos have even sizes, as "
                "H.264 needs"
            )
        return notes


def _write(
    film: Film,
    layers: _FrameLayers,
    motions: Sequence[Doubles],
    *,
    times: Sequence[float],
    outputs: Mapping[int, Path],
    sounds: Mapping[int, SoundTracks],
    on_progress: ProgressCallback,
) -> None:
    """Writes the videos of the layers.

    Args:
        film: it is decoded once more.
        layers: computes the layers of a frame.
        motions: those of the layers in each frame.
        times: that of each frame in seconds.
        outputs: the path of each layer, 0 for T and 1 for R.
        sounds: the sound of each of them.
        on_progress: called with the completed fraction, 0 to 1.
    """
    ends = [*times[1:], 2 * times[-1] - times[-2]]
    writers: dict[int, VideoWriter] = {}
    with ExitStack() as stack:
        parts = {layer: stack.enter_context(atomic_path(path)) for layer, path in outputs.items()}
        for k, (stream, pictures) in enumerate(_separated(film, layers, motions)):
            for layer in outputs.keys() - writers.keys():
                writer = VideoWriter(
                    parts[layer],
                    sounds[layer],
                    stream=stream,
                    start_s=times[0],
                    size=film.size,
                )
                writers[layer] = stack.enter_context(writer)
            for layer, picture in zip(outputs, pictures, strict=True):
                writers[layer].write(picture, times[k], ends[k] - times[k])
            on_progress((k + 1) / len(times))


def _separated(
    film: Film, layers: _FrameLayers, motions: Sequence[Doubles]
) -> Iterator[tuple[FilmStream, list[NDArray[np.uint8]]]]:
    """Yields the layers of each frame. The next ones are computed meanwhile, by other threads, but
    no more than `_AT_ONCE`.

    Args:
        film: it is decoded once more.
        layers: computes the layers of a frame.
        motions: those of the layers in each frame.
    """
    waiting = deque[tuple[FilmStream, Future[list[NDArray[np.uint8]]]]]()
    for k, frame in enumerate(film.every_frame()):
        picture = frame.picture()
        computed = None
        if len(waiting) == _AT_ONCE:
            stream, future = waiting.popleft()
            computed = stream, future.result()
        waiting.append((frame.stream, POOL.submit(layers.of, picture, motions[k])))
        if computed:
            yield computed
    while waiting:
        stream, future = waiting.popleft()
        yield stream, future.result()


@final
class _FrameLayers:
    """Moves the measured layers into frames, and applies their shares of the light to the frames at
    full size.

    Args:
        fitted: the measured layers.
        size: height and width of the frames.
        strength: how much of the reflection is removed, 0 to 1.
        wanted: the layers that are computed, in this order: 0 for T and 1 for R.
    """

    def __init__(
        self,
        fitted: FittedBurst,
        size: tuple[int, int],
        strength: float,
        wanted: Sequence[int] = (0, 1),
    ) -> None:
        model = fitted.model
        self._wanted = wanted
        self._coarse, self._fine = (
            Tracker(model, _scaled(size, side)) for side in (_TRACKED_PX, _LAYER_PX)
        )
        self._coverage = coverage(model)
        self._changed = model.on_canvas(1 - fitted.kept)
        self._is_swapped = fitted.report.is_swapped
        self._strength = np.float32(strength)

    def of(self, picture: NDArray[np.uint8], motion: Doubles) -> list[NDArray[np.uint8]]:
        """Returns the wanted layers of a frame (h, w, 3), in 8-bit sRGB. Thread-safe.

        Args:
            picture: (h, w, 3), the frame.
            motion: (L, 2, r, c), see `Tracker`.
        """
        small = _shrunk_light(picture, self._fine.size)
        gains, errors = self._coarse.fit(_shrunk(small, self._coarse.size), motion)
        places = self._fine.places(motion)
        layers = compose(self._fine.samples(places)) * gains
        covered = self._fine.samples(places, self._coverage)
        known = np.stack([covered[:-1].min(0), covered[-1]])[..., None]
        errors *= _shrunk(known.min(0), self._coarse.size)
        if self._is_swapped:
            layers = layers[::-1]
            known = known[::-1]
        mask = self._strength * self._agreement(errors) * _likeness(small, layers.sum(0))
        # What stays as it is moves with the first layer, as in `Solution`
        mask *= self._fine.samples(places[:1], [self._changed])[0][..., None]
        # An unknown layer is what the other one leaves of the frame; if both are unknown, the frame
        # is T
        others = [np.maximum(small - known[1 - n] * layers[1 - n], 0) for n in (0, 1)]
        others[1] *= known[0]
        layers = known * layers + (1 - known) * np.stack(others)
        change, reflection, override = measured_change(small, *layers)
        fitted = GuidedUpsampler.fit(small, change, reflection, override, window_means)
        lines = fitted.as_linear(mask)
        return [self._applied(picture, *lines[layer]) for layer in self._wanted]

    def _agreement(self, errors: Floats) -> Floats:
        """Returns how far the layers are used, (h, w, 1) in 0..1: where they explain the frame."""
        first, last = _ERRORS
        agreement = np.clip(
            (last - cv2.GaussianBlur(errors, (0, 0), _ERROR_BLUR_PX)) / (last - first), 0, 1
        )
        agreement *= 1 - unexplained_share(errors)[..., 0]
        enlarged: Floats = cv2.resize(agreement, self._fine.size[::-1])[..., None]
        return enlarged

    @staticmethod
    def _applied(picture: NDArray[np.uint8], slope: Floats, offset: Floats) -> NDArray[np.uint8]:
        layer = np.empty_like(picture)
        sampling.apply_linear(picture, LINEAR_LIGHT, slope, offset, _ENCODED, layer)
        return layer


def _likeness(frame: Floats, total: Floats) -> np.float32:
    """Returns how surely a frame shows the sum of the layers, 0..1."""
    first, last = _CORRELATIONS
    values = [np.sqrt(image[::4, ::4]).ravel() for image in (frame, total)]
    correlation = np.corrcoef(values)[0, 1] if min(map(np.ptp, values)) else 0.0
    return np.float32(np.clip((correlation - first) / (last - first), 0, 1))


def _scaled(size: tuple[int, int], long_side_px: int) -> tuple[int, int]:
    """Returns a height and width with this long side. Smaller sizes are not enlarged."""
    scale = min(1.0, long_side_px / max(size))
    return max(8, round(size[0] * scale)), max(8, round(size[1] * scale))


def _shrunk_light(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats:
    """Returns the light of an 8-bit sRGB picture, (h, w, 3), reduced to a size.

    If the sizes allow it, the picture is converted in bands of some rows: as a whole, its light
    would be the largest array of all.
    """
    height = len(picture)
    bands = math.gcd(height, size[0], _BANDS)
    rows = size[0] // bands, size[1]
    return np.concatenate([_shrunk(linear_light(band), rows) for band in np.split(picture, bands)])


def _shrunk(image: Any, size: tuple[int, int]) -> Any:  # noqa: ANN401  (of floats or integers)
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
