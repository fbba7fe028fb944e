"""The order of the frames of a burst along the path of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import cv2
import numpy as np

from brewster.film.motion.registration.high_pass import high_pass
from brewster.film.motion.registration.homographies import Floats, Matrices, warped
from brewster.film.motion.registration.tracks import Track, likeliest_motion

_ORDER_PX: Final = 80
"""The width at which frames are compared to order them."""


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
    transmission = [likeliest_motion(tracks, k) for k in range(len(frames))]
    used = [k for k, matrix in enumerate(transmission) if matrix is not None]
    height, width = frames[0].shape[:2]
    size = _ORDER_PX, max(8, _ORDER_PX * height // width)
    inner = slice(height // 12, -height // 12), slice(width // 12, -width // 12)
    aligned = [
        warped(frame, matrix)[inner]
        for frame, matrix in zip(frames, transmission, strict=True)
        if matrix is not None
    ]
    small = [
        np.sqrt(cv2.resize(frame, size, interpolation=cv2.INTER_AREA) + 0.01) for frame in aligned
    ]
    details = np.stack([high_pass(image, _ORDER_PX / 10) for image in small])
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
