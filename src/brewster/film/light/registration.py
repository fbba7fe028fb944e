"""Aligns photos of one scene whose light changes: a tripod that was touched, or a hand.

T has one motion; that of R is of no importance here, because R changes anyway. A photo of another
scene, zoom or focus is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np

from brewster.film.light.gains import Floats
from brewster.film.motion.registration.high_pass import root_high_pass
from brewster.film.motion.registration.homographies import Matrices, warped
from brewster.film.motion.registration.tracks import Track, likeliest_motion
from brewster.film.video.choosing import show_one_scene
from brewster.photo.srgb import to_encoded

_STILL_PX: Final = 3.0
"""If a photo that is 1,000 px wide moves by less on average, the camera stood; in smaller photos,
one pixel.
"""
_GRID: Final = 5
"""Rows and columns of the points whose motion is that of a photo."""
_DETAIL_PX: Final = 2.0
_MIN_GAIN: Final = 0.02
"""A motion counts if the details of two photos agree better by this share with it."""
_OTHER_MOTION_PX: Final = 10.0
"""Another layer that moves by more is R. Repeated patterns give smaller motions by chance."""
_MIN_AGREEMENT: Final = 0.1
"""The least correlation of the details that change, moved by the motion of R. In simulations, true
motions had .13 to .63, and those of a few features by chance up to .07.
"""
_ALIGNED_PX: Final = 0.25
"""A smaller motion is left as it is: resampling blurs more."""
_MAX_ZOOM: Final = 0.05
"""The largest relative change of the scale."""
_MIN_SHARPNESS: Final = 0.35
"""A photo with a smaller part of the sharpness of the typical photo has another focus."""
_INSIDE: Final = 0.99
"""A moved pixel with less of it in the frame is outside."""
_THUMBNAIL_PX: Final = 240
_SHARED: Final = 0.7
"""The quantile of the details above which they count for the sharpness."""


@final
@dataclass(frozen=True)
class AlignedPhotos:
    """Photos of one scene, aligned with the reference."""

    frames: Floats
    """(K, h, w, 3) linear light."""
    reference: int
    """The index of the reference in `frames`."""
    left_out: tuple[int, ...]
    """The indices of the given photos that show another scene, zoom or focus."""
    travel_px: float
    """The largest mean motion of a photo, in pixels of a photo that is 1,000 px wide."""
    is_still: bool
    """Whether the camera stood."""
    has_other_motion: bool
    """Whether another layer moved in all photos of a camera that stood, as R does if T is far away.
    What changed between the photos agrees with that.
    """


def align(frames: Sequence[Floats], reference: int, tracks: Sequence[Track]) -> AlignedPhotos:
    """Aligns frames with the reference.

    Args:
        frames: (h, w, 3) linear light each, 0..1.
        reference: the index of the reference frame.
        tracks: the motions of the layers in these frames, from `layer_tracks`.
    """
    size = frames[reference].shape[:2]
    used: list[int] = []
    aligned: list[Floats] = []
    travel = 0.0
    for k, frame in enumerate(frames):
        motion = likeliest_motion(tracks, k)
        if motion is None and not _shows_scene(frames[reference], frame):
            continue
        if motion is None or _is_better_still(frames[reference], frame, motion):
            motion = np.eye(3)
        if abs(_zoom(motion)) > _MAX_ZOOM:
            continue
        moved = _travel(motion, size)
        travel = max(travel, moved)
        is_moved = moved > _ALIGNED_PX and k != reference
        aligned.append(_warped(frame, motion) if is_moved else frame)
        used.append(k)
    stack = np.stack(aligned)
    is_sharp = _are_sharp(stack)
    has_focus = is_sharp == is_sharp[used.index(reference)]
    used = [k for k, is_used in zip(used, has_focus, strict=True) if is_used]
    is_still = travel < max(_STILL_PX, 1000 / size[1])
    return AlignedPhotos(
        frames=stack[has_focus],
        reference=used.index(reference),
        left_out=tuple(k for k in range(len(frames)) if k not in used),
        travel_px=travel,
        is_still=is_still,
        has_other_motion=is_still and _has_other_motion(frames, reference, tracks[1:]),
    )


def _has_other_motion(frames: Sequence[Floats], reference: int, others: Sequence[Track]) -> bool:
    """Returns whether one of the other tracks is a layer that moved in all frames.

    A few features may move together by chance. What changes between the frames, the details without
    those of T, agrees only with the motion of a layer.
    """
    size = frames[reference].shape[:2]
    moved = [
        {k: each for k, each in enumerate(track.motions) if each is not None and k != reference}
        for track in others
        if len(track.found) == len(frames)
    ]
    moved = [
        motions
        for motions in moved
        if max(_travel(each, size) for each in motions.values()) > _OTHER_MOTION_PX
    ]
    if not moved:
        return False
    changes = _changing_details(frames)
    agreements = [
        np.mean([_agreement(changes[reference], changes[k], each) for k, each in motions.items()])
        for motions in moved
    ]
    return bool(max(agreements) > _MIN_AGREEMENT)


def _changing_details(frames: Sequence[Floats]) -> Floats:
    """Returns the details of the frames without those that they share, (K, h, w)."""
    details = np.stack([root_high_pass(frame, _DETAIL_PX) for frame in frames])
    shared = np.median(details, axis=0)
    gains = (details * shared).sum((1, 2)) / max(float(np.square(shared).sum()), 1e-9)
    changing: Floats = details - gains[:, None, None] * shared
    return changing


def _agreement(reference: Floats, details: Floats, motion: Matrices) -> float:
    """Returns the correlation of details (h, w) with those of the reference, after a motion."""
    moved, is_inside = (
        cv2.warpPerspective(
            each, motion, each.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        for each in (details, np.ones_like(details))
    )
    is_inside = (is_inside > _INSIDE).astype(np.float32)
    return _correlation(is_inside * reference, is_inside * moved)


def _shows_scene(reference: Floats, frame: Floats) -> bool:
    """Returns whether a frame without common features shows the scene of the reference."""
    height, width = frame.shape[:2]
    size = _THUMBNAIL_PX, max(8, round(_THUMBNAIL_PX * height / width))
    thumbnails = [
        (255 * to_encoded(np.clip(cv2.resize(each, size, interpolation=cv2.INTER_AREA), 0, 1)))
        .mean(-1)
        .astype(np.uint8)
        for each in (reference, frame)
    ]
    return show_one_scene(thumbnails)


def _is_better_still(reference: Floats, frame: Floats, motion: Matrices) -> bool:
    """Returns whether the details of a frame agree with those of the reference as well without its
    motion, which few features do not determine.
    """
    template = root_high_pass(reference, _DETAIL_PX)
    still, moved = (
        _correlation(template, root_high_pass(each, _DETAIL_PX))
        for each in (frame, _warped(frame, motion))
    )
    return still > moved - _MIN_GAIN * abs(moved)


def _correlation(first: Floats, second: Floats) -> float:
    norm = float(np.sqrt(np.square(first).sum() * np.square(second).sum()))
    return float((first * second).sum()) / max(norm, 1e-9)


def _zoom(motion: Matrices) -> float:
    """Returns the logarithm of the scale of a homography."""
    return float(np.log(abs(np.linalg.det(motion[:2, :2] / motion[2, 2])))) / 2


def _travel(motion: Matrices, size: tuple[int, ...]) -> float:
    """Returns the mean motion of the points of a grid, in pixels of a photo that is 1,000 px wide.
    Few features leave corners uncertain.
    """
    height, width = size
    x, y = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
    points = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    moved = cv2.perspectiveTransform(points, motion)
    return float(np.linalg.norm(moved - points, axis=-1).mean()) * 1000 / width


def _warped(frame: Floats, motion: Matrices) -> Floats:
    return np.clip(warped(frame, motion, cv2.INTER_CUBIC), 0, 1)


def _are_sharp(stack: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Returns which of the aligned frames are not much softer than most, (K,)."""
    details = np.stack([_details(frame) for frame in stack])
    shared = np.median(details, axis=0)
    is_strong = shared > np.quantile(shared, _SHARED)
    if not is_strong.any():  # a white wall has no details
        return np.ones(len(stack), np.bool_)
    sharpness = np.median(details[:, is_strong] / (shared[is_strong] + 1e-6), axis=1)
    is_sharp: np.ndarray[tuple[int], np.dtype[np.bool_]] = sharpness > _MIN_SHARPNESS
    return is_sharp


def _details(frame: Floats) -> Floats:
    """Returns the strength of the details of a frame relative to its light, (h, w)."""
    grey = frame.mean(-1)
    details: Floats = np.abs(cv2.Laplacian(grey, -1)) / (cv2.blur(grey, (31, 31)) + 0.01)
    smooth: Floats = cv2.blur(details, (9, 9))
    return smooth
