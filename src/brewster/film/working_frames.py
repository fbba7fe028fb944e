"""The photos of a burst at the size at which its motion is measured."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np

from brewster.errors import PhotoError, error_prefix
from brewster.film.motion.model.joint_model import Floats
from brewster.options import MAX_BURST_PHOTOS
from brewster.photo import Photo, Source
from brewster.photo.camera_settings import CameraSettings, camera_settings
from brewster.separation.burst_report import burst_photo_name
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separator import white_level

_WORKING_PX: Final = 1000
"""The long side of the frames from which the motion is estimated; less for more photos than a burst
has, so that 60 need as much memory as 15.
"""

_READERS: Final = 2
"""The photos that are read at the same time."""


def checked_reference(count: int, reference: int | None) -> int:
    """Returns the index of the reference photo of `count` photos, by default the middle one.

    Raises:
        PhotoError: there is no photo with this index.
    """
    reference = count // 2 if reference is None else reference
    if not 0 <= reference < count:
        raise PhotoError(
            f"the reference photo is {reference}",
            f"expected an index from 0 to {count - 1}",
            "correct the reference",
        )
    return reference


def open_photo(photos: Sequence[Source], index: int, max_pixels: int) -> Photo:
    """Opens a photo of the burst. An error names its number."""
    with error_prefix(burst_photo_name(photos, index)):
        return Photo.open(photos[index], max_pixels=max_pixels)


def working_frames(
    photos: Sequence[Source],
    reference: int,
    photo: Photo,
    max_pixels: int,
    on_progress: ProgressCallback,
) -> tuple[list[Floats], np.float32, list[CameraSettings]]:
    """Returns the photos at the working size, in linear light divided by its white level, 0..1;
    this level; and the settings of the camera for each photo. Besides the reference photo, two at a
    time are in memory at full size.

    Args:
        photos: see `separate_burst`.
        reference: the index of the reference photo.
        photo: the reference photo.
        max_pixels: see `Photo.open`.
        on_progress: called with the completed fraction, 0 to 1.
    """
    long_side_px = _WORKING_PX * min(1.0, MAX_BURST_PHOTOS / len(photos)) ** 0.5
    scale = min(1.0, long_side_px / max(photo.size))
    width, height = (max(8, round(length * scale)) for length in photo.size)

    def read(index: int) -> tuple[Floats, CameraSettings]:
        frame = photo if index == reference else open_photo(photos, index, max_pixels)
        if frame.size != photo.size:
            raise PhotoError(
                f"{burst_photo_name(photos, index)} has {frame.size[0]} x {frame.size[1]} pixels",
                f"expected {photo.size[0]} x {photo.size[1]}, as "
                f"{burst_photo_name(photos, reference)}",
                "leave one of them out, or pass photos that were taken with the same camera, "
                "orientation and zoom",
            )
        return frame.resized(width, height), camera_settings(frame.file_info.exif)

    frames = []
    settings = []
    on_progress(0.0)
    with ThreadPoolExecutor(_READERS) as pool:
        running = [pool.submit(read, index) for index in range(len(photos))]
        try:
            for done, future in enumerate(running, 1):
                frame, setting = future.result()
                frames.append(frame)
                settings.append(setting)
                on_progress(done / len(photos))
        finally:
            for future in running:
                future.cancel()
    if all(np.array_equal(frame, frames[reference]) for frame in frames):
        raise PhotoError(
            f"the {len(frames)} photos of the burst are the same",
            "expected photos of one window from different places or in different light",
            "move the camera by 5 to 10 cm between the photos, change what the glass mirrors, or "
            "separate one of them alone",
        )
    white = np.float32(white_level(frames[reference]))
    return [np.clip(frame / white, 0, 1) for frame in frames], white, settings
