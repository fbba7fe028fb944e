"""Homographies between pictures: applied to frames and places, and what they do to a frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Matrices = Doubles


def normalised(matrices: Matrices, size: tuple[int, int], to: tuple[int, int]) -> Matrices:
    """Returns homographies (..., 3, 3) from pixels of a picture of the first size (h, w) to pixels
    of a picture of the second size in normalised coordinates: -1 and 1 are the edges.
    """
    scaled: Matrices = _to_normalised(to) @ matrices @ np.linalg.inv(_to_normalised(size))
    return scaled / scaled[..., 2:, 2:]


def _to_normalised(size: tuple[int, int]) -> Matrices:
    height, width = size
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


def warped(frame: Floats, matrix: Matrices, interpolation: int = cv2.INTER_LINEAR) -> Floats:
    """Returns a frame (h, w, 3) as another picture of the same size shows it.

    Args:
        frame: (h, w, 3).
        matrix: (3, 3), from that picture to the frame, in pixels.
        interpolation: that of OpenCV.
    """
    moved: Floats = cv2.warpPerspective(
        frame,
        matrix,
        frame.shape[1::-1],
        flags=interpolation | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return moved


def transfer_errors(matrix: Matrices, points: Floats) -> Floats:
    """Returns the distances in pixels between the second points of matches (n, 4) and the moved
    first ones.
    """
    if not len(points):
        return np.zeros(0, np.float32)
    moved = cv2.perspectiveTransform(points[:, None, :2], matrix)[:, 0]
    return np.asarray(np.linalg.norm(moved - points[:, 2:], axis=1), np.float32)


def is_camera_motion(matrix: Matrices, size: tuple[int, ...]) -> bool:
    """Returns whether a homography keeps the frame convex and of similar size. Matches of unrelated
    photos do not.
    """
    height, width = size
    corners = np.array([[[0, 0]], [[width, 0]], [[width, height]], [[0, height]]], np.float32)
    moved = cv2.perspectiveTransform(corners, matrix)
    area: float = cv2.contourArea(moved) / (width * height)
    return bool(cv2.isContourConvex(moved)) and 0.5 < area < 2


def log_scale(matrix: Matrices, size: tuple[int, ...]) -> float:
    """Returns the logarithm of the scale of a homography in the middle of a frame."""
    height, width = size
    denominator = matrix[2] @ (width / 2, height / 2, 1)
    return float(np.log(abs(np.linalg.det(matrix) / denominator**3))) / 2


def moved_centre(matrix: Matrices, size: tuple[int, int]) -> Matrices:
    """Returns where the centre of the frame moves."""
    height, width = size
    moved: Matrices = cv2.perspectiveTransform(np.array([[[width / 2, height / 2]]]), matrix)[0, 0]
    return moved


def translation(x: float, y: float) -> Matrices:
    """Returns the homography (3, 3) that moves everything by x and y."""
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])
