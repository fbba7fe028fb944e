"""Candidates for the motion of both layers, from features of the frames and from their spectra.

Each candidate is a guess; the joint optimisation decides. Dense optical flow is no candidate: it follows strong reflections.
All motions are (K, 3, 3) homographies in normalised coordinates, from a frame to the reference frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.burst.fourier_search import find_translations
from brewster.burst.threads import POOL
from brewster.inference.predictor import ProgressCallback
from brewster.srgb import to_encoded

Floats = NDArray[np.float32]
Matrices = NDArray[np.float64]

_FEATURES: Final = 4000
_RATIO: Final = 0.85
_INLIER_PX: Final = 2.0
_MIN_MATCHES: Final = 12
_MAX_MOTIONS: Final = 4
_MIN_DIFFERENCE: Final = 0.007
"""Two motions of a frame are different if they differ by this share of the frame's width."""
_SHIFTS: Final = (0.015, 0.045, 0.08)
"""Sideways shifts of the reflection at the end of the path, as shares of the width: a safety net for the other candidates."""
_ORDER_PX: Final = 80
"""The width at which frames are compared to order them."""
_MIN_FRAMES_FOR_LARGE_SHIFTS: Final = 4
"""With fewer frames, a large shift leaves parts of the reflection in one frame only, where it explains everything."""


@final
@dataclass(frozen=True)
class MotionCandidate:
    """A guess for the motion of both layers."""

    family: str
    """How it was found: candidates of one family compete first with each other."""
    transmission: Matrices
    reflection: Matrices
    is_locked: bool = False
    """Whether both layers are one: the reflection keeps the motion of the transmission. The only one of its family."""


Features = tuple[Floats, Floats]
"""The places (n, 2) and descriptors (n, 128) of the features of a frame."""
Motions = list[tuple[Matrices, float]]
"""The motions of one frame: homographies from the reference frame in pixels, and how likely each is the motion of T."""


def frame_motions(
    frames: Sequence[Floats],
    reference: int,
    prior: Floats,
    on_progress: ProgressCallback = lambda _fraction: None,
) -> list[Motions]:
    """Returns the motions of each frame: those with the most matches first, and none for a frame of another scene.

    A homography is fitted to the matches with MAGSAC, its matches are removed, and the next one is fitted to the rest.
    The likelihood is the number of matches times the mean share of T in the detail at these matches.

    Args:
        frames: (h, w, 3) linear light.
        reference: the index of the reference frame.
        prior: T of the reference frame from a single photo. It decides which of several motions is that of T.
        on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the work.
    """
    share = _transmission_share(frames[reference], prior)
    features = []
    for places in POOL.map(_features, frames):
        features.append(places)
        on_progress(0.5 * len(features) / len(frames))

    def motions(k: int) -> Motions:
        if k == reference:
            return [(np.eye(3), 1.0)]
        return _fitted_motions(_matches(features[reference], features[k]), share)

    found_motions = []
    for found in POOL.map(motions, range(len(frames))):
        found_motions.append(found)
        on_progress(0.5 + 0.5 * len(found_motions) / len(frames))
    return found_motions


def path_order(frames: Sequence[Floats], motions: Sequence[Motions]) -> list[int]:
    """Returns the indices of the frames that show the scene, in their order along the path of the camera.

    After the alignment with T, only R moves: the further apart two frames were taken, the more they differ. The first coordinate of
    classical multidimensional scaling puts them on a line, whose order is improved to the shortest path. The result does not depend on the order of the frames.

    Args:
        frames: (h, w, 3) linear light.
        motions: the motions of each frame, from `frame_motions`; none for a frame of another scene.
    """
    used = [k for k, found in enumerate(motions) if found]
    height, width = frames[0].shape[:2]
    size = _ORDER_PX, max(8, _ORDER_PX * height // width)
    inner = slice(height // 12, -height // 12), slice(width // 12, -width // 12)
    aligned = [_aligned(frames[k], _likeliest(motions[k]))[inner] for k in used]
    small = [np.sqrt(cv2.resize(frame, size, interpolation=cv2.INTER_AREA) + 0.01) for frame in aligned]
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
    motions: Sequence[Motions],
    on_step: Callable[[], None] = lambda: None,
) -> list[MotionCandidate]:
    """Returns candidates for the motion of both layers. The first one is locked: both layers are one.

    Args:
        frames: (h, w, 3) linear light, in the order of `path_order`.
        reference: the index of the reference frame.
        motions: the motions of each frame, from `frame_motions`; each frame has at least one.
        on_step: called several times a second. An exception raised in it stops the work.
    """
    height, width = frames[0].shape[:2]
    transmission = np.stack([_likeliest(found) for found in motions])
    times = np.arange(len(frames)) - reference
    times = times / np.abs(times).max()

    def line(x: float, y: float) -> Matrices:
        """The reflection moves along a line relative to the transmission, in pixels at the end of the path."""
        return np.stack(
            [_translation(x * t, y * t) @ matrix for t, matrix in zip(times, transmission, strict=True)]
        )

    candidates = [("one layer", transmission)]
    aligned = [_aligned(frame, matrix) for frame, matrix in zip(frames, transmission, strict=True)]
    for offsets in find_translations(aligned, reference, on_step):
        found = [matrix @ _translation(*offset) for matrix, offset in zip(transmission, offsets, strict=True)]
        candidates.append(("Fourier", np.stack(found)))
    second = [
        _second_motion(found, matrix, (height, width))
        for found, matrix in zip(motions, transmission, strict=True)
    ]
    slopes = [
        (_centre(matrix, (height, width)) - _centre(transmission[k], (height, width))) / times[k]
        for k, matrix in enumerate(second)
        if matrix is not None and k != reference
    ]
    if slopes:
        path = line(*np.median(slopes, axis=0))
        homographies = [path[k] if matrix is None else matrix for k, matrix in enumerate(second)]
        candidates += ("second homography", np.stack(homographies)), ("second homography", path)
    for share in _SHIFTS if len(frames) >= _MIN_FRAMES_FOR_LARGE_SHIFTS else _SHIFTS[:-1]:
        candidates += (("shift", line(sign * share * width, 0.0)) for sign in (-1, 1))
    scale = np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])

    def normalised(matrices: Matrices) -> Matrices:
        inverse: Matrices = scale @ np.linalg.inv(matrices) @ np.linalg.inv(scale)
        return inverse / inverse[:, 2:, 2:]

    return [
        MotionCandidate(family, normalised(transmission), normalised(reflection), is_locked=number == 0)
        for number, (family, reflection) in enumerate(candidates)
    ]


def _features(frame: Floats) -> Features:
    detector = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=0.008)
    keypoints, descriptors = detector.detectAndCompute(_detail_8bit(frame), None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array(cv2.KeyPoint.convert(keypoints), np.float32), np.array(descriptors, np.float32)


def _likeliest(motions: Motions) -> Matrices:
    """Returns the motion that is most likely that of T."""
    return max(motions, key=lambda motion: motion[1])[0]


def _aligned(frame: Floats, matrix: Matrices) -> Floats:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = frame.shape[1::-1]
    warped: Floats = cv2.warpPerspective(frame, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return warped


def _fitted_motions(matches: Floats, share: Floats) -> Motions:
    motions: Motions = []
    while len(motions) < _MAX_MOTIONS and len(matches) >= _MIN_MATCHES:
        matrix, inliers = _fit(matches)
        if matrix is None or inliers.sum() < _MIN_MATCHES or not _is_camera_motion(matrix, share.shape):
            break
        x, y = matches[inliers, :2].astype(int).T
        motions.append((matrix, float(share[y, x].sum())))
        matches = matches[~inliers]
    return motions


def _is_camera_motion(matrix: Matrices, size: tuple[int, ...]) -> bool:
    """Returns whether a homography keeps the frame convex and of similar size. Matches of unrelated photos do not."""
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


def _matches(first: Features, second: Features) -> Floats:
    """Returns matching points (n, 4): x, y in the first frame, and x, y in the second. A match is clearly nearer than the next best."""
    points, descriptors = first
    others, other_descriptors = second
    if len(points) < 1 or len(others) < 2:
        return np.zeros((0, 4), np.float32)
    distances = np.square(other_descriptors).sum(1) - 2 * (descriptors @ other_descriptors.T)
    best = distances.argmin(1)
    rows = np.arange(len(points))
    nearest = distances[rows, best].copy()
    distances[rows, best] = np.inf
    lengths = np.square(descriptors).sum(1)
    good = nearest + lengths < _RATIO**2 * (distances.min(1) + lengths)
    return np.concatenate([points[good], others[best[good]]], 1)


def _second_motion(motions: Motions, transmission: Matrices, size: tuple[int, int]) -> Matrices | None:
    """Returns the motion, other than that of T, with the most matches."""
    height, width = size
    y, x = np.mgrid[0:height:40, 0:width:40]
    points = np.stack([x, y], -1).reshape(-1, 1, 2).astype(np.float64)

    def distance(first: Matrices, second: Matrices) -> float:
        moved = [cv2.perspectiveTransform(points, matrix) for matrix in (first, second)]
        return float(np.linalg.norm(moved[0] - moved[1], axis=-1).mean()) / width

    for matrix, _ in motions:  # those with the most matches are first
        if distance(matrix, transmission) > _MIN_DIFFERENCE and distance(matrix, np.eye(3)) < 0.5:
            return matrix
    return None


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
    scaled: NDArray[np.uint8] = np.clip(detail / (3 * detail.std() + 1e-6) * 90 + 128, 0, 255).astype(
        np.uint8
    )
    return scaled


def _translation(x: float, y: float) -> Matrices:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def _centre(matrix: Matrices, size: tuple[int, int]) -> Matrices:
    """Returns where the centre of the frame moves."""
    height, width = size
    moved: Matrices = cv2.perspectiveTransform(np.array([[[width / 2, height / 2]]]), matrix)[0, 0]
    return moved
