"""Features of frames, which of them are found in another frame, and the homography that they agree
about.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.registration.high_pass import grey_high_pass
from brewster.film.motion.registration.homographies import (
    Floats,
    Matrices,
    is_camera_motion,
    transfer_errors,
)

_FEATURES: Final = 4000
"""The largest number of features of a frame."""
_RATIO: Final = 0.85
"""A match is nearer than the next best one by this factor."""
INLIER_PX: Final = 2.0
"""A match that is nearer to a homography follows it."""
MIN_MATCHES: Final = 12
"""Fewer matches that follow a homography do not show the motion of a camera."""

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
class FrameHomography:
    """How one picture of a scene maps to another one."""

    matrix: Matrices
    """(3, 3), in pixels."""
    distances: Floats
    """(n,): how far the features that follow the homography are from it, in pixels."""


def features_of(frame: Floats) -> Features:
    """Returns the features of a picture (h, w, 3) in linear light (SIFT, Lowe 2004)."""
    detector = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=0.008)
    keypoints, descriptors = detector.detectAndCompute(_detail_8bit(frame), None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array(cv2.KeyPoint.convert(keypoints), np.float32), np.array(descriptors, np.float32)


def matched_features(first: Features, second: Features) -> Matches:
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
    points = matched_features(first, second).points
    fit = camera_motion(points, size, MIN_MATCHES)
    if fit is None:
        return None
    matrix, is_inlier = fit
    return FrameHomography(matrix, transfer_errors(matrix, points[is_inlier]))


def camera_motion(points: Floats, size: tuple[int, ...], least: int) -> Fit | None:
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
    if matrix is None or inliers.sum() < least or not is_camera_motion(matrix, size):
        return None
    return matrix, inliers


def _fit(matches: Floats) -> tuple[Matrices | None, NDArray[np.bool_]]:
    """Fits a homography, or to few matches a similarity, which has fewer degrees of freedom."""
    cv2.setRNGSeed(0)
    first, second = (np.ascontiguousarray(points) for points in np.split(matches, 2, axis=1))
    if len(matches) >= 40:
        matrix, inliers = cv2.findHomography(
            first, second, cv2.USAC_MAGSAC, INLIER_PX, maxIters=5000, confidence=0.9999
        )
    else:
        affine, inliers = cv2.estimateAffinePartial2D(
            first, second, ransacReprojThreshold=INLIER_PX, maxIters=5000
        )
        matrix = None if affine is None else np.vstack([affine, [0, 0, 1]])
    if matrix is None or inliers is None or abs(np.linalg.det(matrix)) < 1e-3:
        return None, np.zeros(len(matches), bool)
    return matrix, inliers.ravel().astype(bool)


def _detail_8bit(frame: Floats) -> NDArray[np.uint8]:
    detail = grey_high_pass(frame, 20.0)
    scaled: NDArray[np.uint8] = np.clip(
        detail / (3 * detail.std() + 1e-6) * 90 + 128, 0, 255
    ).astype(np.uint8)
    return scaled
