"""Candidates for the motion of both layers, from features of the frames and from their spectra.

Each candidate is a guess; the joint optimisation decides. Dense optical flow is no candidate: it
follows strong reflections. All motions are (K, 3, 3) homographies in normalised coordinates, from a
frame to the reference frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.fourier_search import find_translations
from brewster.film.motion.threads import POOL
from brewster.photo.srgb import to_encoded
from brewster.separation.predictor import ProgressCallback

Floats = NDArray[np.float32]
Matrices = NDArray[np.float64]

_FEATURES: Final = 4000
_RATIO: Final = 0.85
_INLIER_PX: Final = 2.0
_REMOVED_PX: Final = 3.0
"""Matches that are nearer to the motion of a layer do not belong to the next layers."""
_MIN_MATCHES: Final = 12
_MIN_SHARED: Final = 8
"""The number of features of a layer that must be found in a frame."""
_MIN_SHARE: Final = 4
"""One in so many of the features of a layer must follow its motion in a frame."""
_MAX_TRACKS: Final = 4
_SHIFTS: Final = (0.015, 0.045, 0.08)
"""Sideways shifts of the reflection at the end of the path, as shares of the width: a safety net
for the other candidates.
"""
_MAX_ZOOM: Final = 0.1
"""The largest logarithm of the scale between two photos of a burst. A hand that moves the camera by
10 cm at a distance of a metre changes it by so much; real films had up to .07.
"""
_ORDER_PX: Final = 80
"""The width at which frames are compared to order them."""
_MIN_FRAMES_FOR_LARGE_SHIFTS: Final = 4
"""With fewer frames, a large shift leaves parts of the reflection in one frame only, where it
explains everything.
"""


@final
@dataclass(frozen=True)
class MotionCandidate:
    """A guess for the motion of both layers."""

    family: str
    """How it was found: candidates of one family compete first with each other."""
    transmission: Matrices
    reflection: Matrices
    is_locked: bool = False
    """Whether both layers are one: the reflection keeps the motion of the transmission. The only
    one of its family.
    """


Features = tuple[Floats, Floats]
"""The places (n, 2) and descriptors (n, 128) of the features of a frame."""
Fit = tuple[Matrices, NDArray[np.bool_]]
"""A homography, and which matches follow it, (n,)."""


@final
@dataclass(frozen=True)
class Matches:
    """Features of the reference frame that were found in another frame."""

    features: NDArray[np.int64]
    """(n,): their indices in the reference frame."""
    points: Floats
    """(n, 4): x, y in the reference frame, and x, y in the other frame."""

    def selected(self, mask: NDArray[np.bool_]) -> Matches:
        """Returns the matches with True in the mask (n,)."""
        return Matches(features=self.features[mask], points=self.points[mask])


@final
@dataclass(frozen=True)
class Track:
    """The motion of one layer in the frames of a burst. Its features in the reference frame move
    together in all of them.
    """

    motions: Sequence[Matrices | None]
    """For each frame, the homography from the reference frame in pixels; None where the layer was
    not found.
    """
    places: NDArray[np.int64]
    """(n, 2): x and y of its features in the reference frame, once for each frame in which one was
    found.
    """

    @property
    def found(self) -> list[int]:
        """The indices of the frames in which the layer was found."""
        return [k for k, matrix in enumerate(self.motions) if matrix is not None]

    def reordered(self, frames: Sequence[int]) -> Track:
        """Returns the track in a burst of these frames."""
        return replace(self, motions=[self.motions[k] for k in frames])

    def resized(self, size: tuple[int, int], to: tuple[int, int]) -> Track:
        """Returns the track in resized frames.

        Args:
            size: height and width of the frames of this track.
            to: those of the resized frames.
        """
        y, x = (new / old for new, old in zip(to, size, strict=True))
        # The centre of the first pixel is at (0, 0)
        resize = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
        inverse = np.linalg.inv(resize)
        return Track(
            motions=[None if each is None else resize @ each @ inverse for each in self.motions],
            places=(self.places * (x, y)).astype(np.int64),
        )


def layer_tracks(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> list[Track]:
    """Returns the motions of the layers that features show: the one that is most likely T is first.

    A layer begins with the homography that has the most matches of all frames (MAGSAC); its
    features are then looked for in the other frames, and its matches are removed.

    Args:
        frames: (h, w, 3) linear light.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo. It decides which of several motions is
            that of T.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the
            work.
    """
    features = []
    for found_in_frame in POOL.map(features_of, frames):
        features.append(found_in_frame)
        on_progress(0.5 * len(features) / len(frames))
    others = [k for k in range(len(frames)) if k != reference]
    found = POOL.map(lambda k: _matches(features[reference], features[k]), others)
    matches = dict(zip(others, found, strict=True))
    tracks: list[Track] = []
    while len(tracks) < _MAX_TRACKS:
        on_progress(0.6 + 0.4 * len(tracks) / _MAX_TRACKS)
        motions = _next_track(matches, len(features[reference][0]), frames[0].shape[:2])
        if not motions:
            break
        places = []
        for k, matrix in motions.items():
            distances = _distances(matrix, matches[k].points)
            places.append(matches[k].points[distances < _INLIER_PX, :2].astype(int))
            matches[k] = matches[k].selected(distances > _REMOVED_PX)
        motions[reference] = np.eye(3)
        in_order = [motions.get(k) for k in range(len(frames))]
        tracks.append(Track(motions=in_order, places=np.concatenate(places)))
    return likeliest_first(tracks, frames[reference], prior)


def likeliest_first(tracks: Sequence[Track], frame: Floats, prior: Floats) -> list[Track]:
    """Returns tracks in the order in which they are likely T: by the number of their matches, each
    with the share of T in the detail around it.

    Args:
        tracks: those of a burst.
        frame: its reference frame, (h, w, 3) linear light.
        prior: T of this frame from a single photo, (h, w, 3).
    """
    share = _transmission_share(frame, prior)
    return sorted(tracks, key=lambda track: -share[track.places[:, 1], track.places[:, 0]].sum())


def _next_track(
    matches: Mapping[int, Matches], count: int, size: tuple[int, ...]
) -> dict[int, Matrices]:
    """Returns the motions (3, 3) of the next layer, by frame.

    Args:
        matches: those of the other frames, without those of earlier layers.
        count: the number of features in the reference frame.
        size: height and width of the frames.
    """
    own = POOL.map(lambda k: _camera_motion(matches[k].points, size, _MIN_MATCHES), matches)
    fits = {k: fit for k, fit in zip(matches, own, strict=True) if fit}
    is_member = np.zeros(count, bool)
    motions: dict[int, Matrices] = {}
    remaining = dict(matches) if fits else {}
    while remaining:
        shared = {k: is_member[there.features] for k, there in remaining.items()}
        if motions:
            k = max(remaining, key=lambda k: int(shared[k].sum()))
        else:
            k = max(fits, key=lambda k: int(fits[k][1].sum()))
        here = remaining.pop(k)
        fit = _extended(here.points, shared[k], size) or fits.get(k)
        if fit:
            motions[k] = fit[0]
            is_member[here.features[fit[1]]] = True
    return motions


def _extended(points: Floats, shared: NDArray[np.bool_], size: tuple[int, ...]) -> Fit | None:
    """Returns the motion that most matches of a layer follow, and all matches that follow it.

    Args:
        points: (n, 4), the matches of a frame.
        shared: (n,), which of them are features of the layer.
        size: height and width of the frames.
    """
    fit = _camera_motion(points[shared], size, max(_MIN_SHARED, shared.sum() // _MIN_SHARE))
    if fit is None:
        return None
    matrix = fit[0]
    for _ in range(2):
        near = _distances(matrix, points) < _INLIER_PX
        better = _camera_motion(points[near], size, _MIN_MATCHES)
        matrix = better[0] if better else matrix
    return matrix, _distances(matrix, points) < _INLIER_PX


@final
@dataclass(frozen=True)
class FrameHomography:
    """How one picture of a scene maps to another one."""

    matrix: Matrices
    """(3, 3), in pixels."""
    distances: Floats
    """(n,): how far the features that follow the homography are from it, in pixels."""


def frame_homography(
    first: Features, second: Features, size: tuple[int, int]
) -> FrameHomography | None:
    """Returns the homography from one picture to another, or None if no motion of a camera explains
    their features.

    Args:
        first: the features of the first picture.
        second: those of the second one, of similar scale.
        size: height and width of the first picture.
    """
    points = _matches(first, second).points
    fit = _camera_motion(points, size, _MIN_MATCHES)
    if fit is None:
        return None
    matrix, is_inlier = fit
    return FrameHomography(matrix, _distances(matrix, points[is_inlier]))


def without_zoom(tracks: Sequence[Track], size: tuple[int, ...]) -> list[Track]:
    """Returns the tracks without the frames whose zoom differs from that of the reference frame,
    as if these showed another scene.

    A zoom is no motion of the camera: it scales both layers alike, so that it separates nothing,
    and a second layer explains what else has changed.

    Args:
        tracks: the motions of the layers, from `layer_tracks`.
        size: height and width of the frames.
    """
    count = len(tracks[0].motions) if tracks else 0
    transmission = [_likeliest(tracks, k) for k in range(count)]
    has_zoom = [
        matrix is not None and abs(_log_scale(matrix, size)) > _MAX_ZOOM for matrix in transmission
    ]
    kept = [
        replace(
            track,
            motions=[
                None if is_left_out else motion
                for motion, is_left_out in zip(track.motions, has_zoom, strict=True)
            ],
        )
        for track in tracks
    ]
    return [track for track in kept if len(track.found) > 1]


def _log_scale(matrix: Matrices, size: tuple[int, ...]) -> float:
    """Returns the logarithm of the scale of a homography in the middle of a frame."""
    height, width = size
    denominator = matrix[2] @ (width / 2, height / 2, 1)
    return float(np.log(abs(np.linalg.det(matrix) / denominator**3))) / 2


def path_order(frames: Sequence[Floats], tracks: Sequence[Track]) -> list[int]:
    """Returns the indices of the frames that show the scene, in their order along the path of the
    camera.

    After the alignment with T, only R moves: the further apart two frames were taken, the more they
    differ. The first coordinate of classical multidimensional scaling puts them on a line, whose
    order is improved to the shortest path. The result does not depend on the order of the frames.

    Args:
        frames: (h, w, 3) linear light.
        tracks: the motions of the layers, from `layer_tracks`; none of them has a motion for a
            frame of another scene.
    """
    transmission = [_likeliest(tracks, k) for k in range(len(frames))]
    used = [k for k, matrix in enumerate(transmission) if matrix is not None]
    height, width = frames[0].shape[:2]
    size = _ORDER_PX, max(8, _ORDER_PX * height // width)
    inner = slice(height // 12, -height // 12), slice(width // 12, -width // 12)
    aligned = [
        _aligned(frame, matrix)[inner]
        for frame, matrix in zip(frames, transmission, strict=True)
        if matrix is not None
    ]
    small = [
        np.sqrt(cv2.resize(frame, size, interpolation=cv2.INTER_AREA) + 0.01) for frame in aligned
    ]
    details = np.stack([image - cv2.GaussianBlur(image, (0, 0), _ORDER_PX / 10) for image in small])
    centred = (details - details.mean(0)).reshape(len(used), -1).astype(np.float64)
    line = np.linalg.eigh(centred @ centred.T)[1][:, -1]
    distances = np.linalg.norm(centred[:, None] - centred, axis=-1)
    order = _shortened(line.argsort().tolist(), distances)
    if small[order[0]].mean() > small[order[-1]].mean():  # the direction is that of the light
        order.reverse()
    return [used[i] for i in order]


def _shortened(path: list[int], distances: Matrices) -> list[int]:
    """Returns the path, with parts of it reversed as long as this makes it shorter."""

    def length(path: list[int]) -> float:
        return float(distances[path[:-1], path[1:]].sum())

    while True:
        ends = combinations(range(len(path) + 1), 2)
        shorter = min((path[:i] + path[i:j][::-1] + path[j:] for i, j in ends), key=length)
        if length(shorter) > length(path) - 1e-9:
            return path
        path = shorter


def motion_candidates(
    frames: Sequence[Floats],
    reference: int,
    tracks: Sequence[Track],
    given: Sequence[int] | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> list[MotionCandidate]:
    """Returns candidates for the motion of both layers. The first one is locked: both layers are
    one.

    Args:
        frames: (h, w, 3) linear light, in the order of `path_order`.
        reference: the index of the reference frame.
        tracks: the motions of the layers, from `layer_tracks`; each frame has at least one.
        given: the place of each frame in the order in which the photos were given, which is often
            that of time; by default as `frames`.
        on_step: called several times a second. An exception raised in it stops the work.
    """
    height, width = frames[0].shape[:2]
    found = [_likeliest(tracks, k) for k in range(len(frames))]
    transmission = np.stack([matrix for matrix in found if matrix is not None])
    times, given_times = (
        (order - order[reference]) / np.abs(order - order[reference]).max()
        for order in (np.arange(len(frames)), np.array(given or range(len(frames))))
    )

    def line(x: float, y: float, times: Matrices = times) -> Matrices:
        """The reflection moves along a line relative to the transmission, in pixels at the end of
        the path.
        """
        return np.stack(
            [
                _translation(x * t, y * t) @ matrix
                for t, matrix in zip(times, transmission, strict=True)
            ]
        )

    def straight(track: Track, times: Matrices) -> Matrices:
        """The line along which a layer moves relative to the transmission in most of the frames
        where it was found.
        """
        slopes = [
            (_centre(matrix, (height, width)) - _centre(transmission[k], (height, width)))
            / times[k]
            for k, matrix in enumerate(track.motions)
            if matrix is not None and k != reference
        ]
        x, y = np.median(slopes, axis=0)
        return line(x, y, times)

    def filled(track: Track) -> Matrices:
        path = straight(track, times)
        return np.stack(
            [path[k] if matrix is None else matrix for k, matrix in enumerate(track.motions)]
        )

    half = len(frames) // 2
    others = [track for track in tracks[1:] if len(track.found) > half][:2]
    pairs = [("one layer", transmission, transmission)]
    pairs += (("features", *pair) for pair in combinations([transmission, *map(filled, others)], 2))
    # In one frame, a track may follow another layer, and the path may be wrong, above all in
    # periodic scenes
    orders = [times] if np.array_equal(np.abs(times), np.abs(given_times)) else [times, given_times]
    pairs += (
        ("shift", transmission, straight(track, order)) for track in others for order in orders
    )
    aligned = [_aligned(frame, matrix) for frame, matrix in zip(frames, transmission, strict=True)]
    for translations in find_translations(aligned, reference, on_step):
        moved = [
            matrix @ _translation(*offset)
            for matrix, offset in zip(transmission, translations.offsets, strict=True)
        ]
        pairs.append(("Fourier", transmission, np.stack(moved)))
    for share in _SHIFTS if len(frames) >= _MIN_FRAMES_FOR_LARGE_SHIFTS else _SHIFTS[:-1]:
        pairs += (("shift", transmission, line(sign * share * width, 0.0)) for sign in (-1, 1))

    def to_reference(motions: Matrices) -> Matrices:
        inverse = np.linalg.inv(motions).astype(np.float64)
        return normalised(inverse, (height, width), (height, width))

    return [
        MotionCandidate(
            family=family,
            transmission=to_reference(first),
            reflection=to_reference(second),
            is_locked=number == 0,
        )
        for number, (family, first, second) in enumerate(pairs)
    ]


def normalised(matrices: Matrices, size: tuple[int, int], to: tuple[int, int]) -> Matrices:
    """Returns homographies (..., 3, 3) from pixels of a picture of the first size (h, w) to pixels
    of a picture of the second size in normalised coordinates: -1 and 1 are the edges.
    """
    scaled: Matrices = _to_normalised(to) @ matrices @ np.linalg.inv(_to_normalised(size))
    return scaled / scaled[..., 2:, 2:]


def _to_normalised(size: tuple[int, int]) -> Matrices:
    height, width = size
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


def features_of(frame: Floats) -> Features:
    """Returns the features of a picture (h, w, 3) in linear light (SIFT, Lowe 2004)."""
    detector = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=0.008)
    keypoints, descriptors = detector.detectAndCompute(_detail_8bit(frame), None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array(cv2.KeyPoint.convert(keypoints), np.float32), np.array(descriptors, np.float32)


def _likeliest(tracks: Sequence[Track], frame: int) -> Matrices | None:
    """Returns the motion of a frame that is most likely that of T."""
    return next(
        (track.motions[frame] for track in tracks if track.motions[frame] is not None), None
    )


def _aligned(frame: Floats, matrix: Matrices) -> Floats:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = frame.shape[1::-1]
    warped: Floats = cv2.warpPerspective(
        frame, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return warped


def _camera_motion(points: Floats, size: tuple[int, ...], least: int) -> Fit | None:
    """Returns the motion of most of the matches, and which follow it; None if there is none of a
    camera.

    Args:
        points: (n, 4), the matches.
        size: height and width of the frames.
        least: the number of matches that must follow it.
    """
    if len(points) < least:
        return None
    matrix, inliers = _fit(points)
    if matrix is None or inliers.sum() < least or not _is_camera_motion(matrix, size):
        return None
    return matrix, inliers


def _distances(matrix: Matrices, points: Floats) -> Floats:
    """Returns the distances in pixels between the second points of matches (n, 4) and the moved
    first ones.
    """
    if not len(points):
        return np.zeros(0, np.float32)
    moved = cv2.perspectiveTransform(points[:, None, :2], matrix)[:, 0]
    return np.asarray(np.linalg.norm(moved - points[:, 2:], axis=1), np.float32)


def _is_camera_motion(matrix: Matrices, size: tuple[int, ...]) -> bool:
    """Returns whether a homography keeps the frame convex and of similar size. Matches of unrelated
    photos do not.
    """
    height, width = size
    corners = np.array([[[0, 0]], [[width, 0]], [[width, height]], [[0, height]]], np.float32)
    moved = cv2.perspectiveTransform(corners, matrix)
    area: float = cv2.contourArea(moved) / (width * height)
    return bool(cv2.isContourConvex(moved)) and 0.5 < area < 2


def _fit(matches: Floats) -> tuple[Matrices | None, NDArray[np.bool_]]:
    """Fits a homography, or to few matches a similarity, which has fewer degrees of freedom."""
    cv2.setRNGSeed(0)
    first, second = (np.ascontiguousarray(points) for points in np.split(matches, 2, axis=1))
    if len(matches) >= 40:
        matrix, inliers = cv2.findHomography(
            first, second, cv2.USAC_MAGSAC, _INLIER_PX, maxIters=5000, confidence=0.9999
        )
    else:
        affine, inliers = cv2.estimateAffinePartial2D(
            first, second, ransacReprojThreshold=_INLIER_PX, maxIters=5000
        )
        matrix = None if affine is None else np.vstack([affine, [0, 0, 1]])
    if matrix is None or inliers is None or abs(np.linalg.det(matrix)) < 1e-3:
        return None, np.zeros(len(matches), bool)
    return matrix, inliers.ravel().astype(bool)


def _matches(first: Features, second: Features) -> Matches:
    """Returns the features of the first frame in the second. A match is clearly nearer than the
    next best (Lowe 2004).
    """
    points, descriptors = first
    others, other_descriptors = second
    if len(points) < 1 or len(others) < 2:
        return Matches(features=np.zeros(0, np.int64), points=np.zeros((0, 4), np.float32))
    distances = np.square(other_descriptors).sum(1) - 2 * (descriptors @ other_descriptors.T)
    best = distances.argmin(1)
    rows = np.arange(len(points))
    nearest = distances[rows, best].copy()
    distances[rows, best] = np.inf
    lengths = np.square(descriptors).sum(1)
    good = nearest + lengths < _RATIO**2 * (distances.min(1) + lengths)
    return Matches(
        features=np.flatnonzero(good),
        points=np.concatenate([points[good], others[best[good]]], 1),
    )


def _transmission_share(reference: Floats, prior: Floats) -> Floats:
    """Returns the share of T in the local detail of the reference frame, (h, w) in 0..1."""
    details = [
        cv2.GaussianBlur(np.abs(_high_pass(layer, 3.0)), (0, 0), 4)
        for layer in (prior, np.maximum(reference - prior, 0))
    ]
    share: Floats = details[0] / (details[0] + details[1] + 1e-4)
    return share


def _high_pass(frame: Floats, sigma: float) -> Floats:
    grey = to_encoded(np.clip(frame, 0, 1)).mean(-1)
    detail: Floats = grey - cv2.GaussianBlur(grey, (0, 0), sigma)
    return detail


def _detail_8bit(frame: Floats) -> NDArray[np.uint8]:
    detail = _high_pass(frame, 20.0)
    scaled: NDArray[np.uint8] = np.clip(
        detail / (3 * detail.std() + 1e-6) * 90 + 128, 0, 255
    ).astype(np.uint8)
    return scaled


def _translation(x: float, y: float) -> Matrices:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def _centre(matrix: Matrices, size: tuple[int, int]) -> Matrices:
    """Returns where the centre of the frame moves."""
    height, width = size
    moved: Matrices = cv2.perspectiveTransform(np.array([[[width / 2, height / 2]]]), matrix)[0, 0]
    return moved
