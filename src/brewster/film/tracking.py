"""Follows the measured layers of a burst through a film: the motion of each layer in any frame that
shows the window.

The layers stay fixed. The motion of a layer is a smooth field of displacements from the frame to
the reference frame: (2, rows, columns) knots of a bicubic spline, in normalised coordinates
(motion/joint_model.py). Gauss-Newton steps fit the sum of the moved layers to the frame; the knots
separate into rows and columns, so that a step costs little more than the samples of the layers.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import (
    Doubles,
    Floats,
    JointModel,
    bicubic_weights,
    canvas_size,
    compose,
    data_errors,
    pixel_grid,
    to_pixels,
)
from brewster.film.motion.model.kernels import CHARBONNIER, MARGIN, OFFSET, sampling
from brewster.photo.srgb import to_linear

_KNOTS: Final = 5, 7
_CURVATURE: Final = 0.02
"""The cost of the curvature of the splines."""
_DAMPING: Final = 1e-3
"""The cost of a step. It keeps the motion where nothing shows it."""
LINEAR_LIGHT: Final = to_linear(np.arange(256) / 255).astype(np.float32)
"""The light of each code of 8-bit sRGB."""
_GAINS: Final = 0.2, 5.0
_COVERED_BY: Final = 2
"""The number of frames that must show a place of a layer: a single one does not separate it."""
_FADE: Final = 0.04
"""The width of the fade at the border of the covered part, as a share of the width of a frame."""


@final
class Tracker:
    """Aligns frames of one size with the layers of a model.

    Args:
        model: a single candidate.
        size: height and width of the frames.
    """

    def __init__(self, model: JointModel, size: tuple[int, int]) -> None:
        self.size = size
        canvas = canvas_size(size)
        interpolation = cv2.INTER_AREA if canvas[0] < model.layers.shape[2] else cv2.INTER_LINEAR
        light = np.square(model.layers[0])
        self._canvases = [
            cv2.resize(layer, canvas[::-1], interpolation=interpolation) for layer in light
        ]
        self._grid = pixel_grid(*size).astype(np.float32)
        self._rows, self._columns = (
            bicubic_weights(side, knots).astype(np.float32)
            for side, knots in zip(size, _KNOTS, strict=True)
        )
        self._across = np.ascontiguousarray(self._columns.T)
        self._row_pairs = _pairs(self._rows)
        self._column_pairs = _pairs(self._columns)
        bends = [np.kron(np.diff(np.eye(_KNOTS[0]), 2, 0), np.eye(_KNOTS[1]))]
        bends.append(np.kron(np.eye(_KNOTS[0]), np.diff(np.eye(_KNOTS[1]), 2, 0)))
        self._stiffness = _CURVATURE * sum(bend.T @ bend for bend in bends)

    def places(self, motion: Doubles) -> Floats:
        """Returns the places that a frame shows of each layer, (L, 2, h, w), normalised.

        Args:
            motion: (L, 2, r, c), that of the frame.
        """
        return np.stack(
            [
                [
                    # Not a matrix product of NumPy, whose threads wait for each other on a busy
                    # machine
                    axis + np.einsum("hr,rw->hw", self._rows, offsets @ self._across)
                    for axis, offsets in zip(self._grid, knots.astype(np.float32), strict=True)
                ]
                for knots in motion
            ]
        )

    def samples(self, places: Floats, canvases: Sequence[Floats] | None = None) -> Floats:
        """Returns the layers, or other images, at some places: (L, h, w, ...).

        Args:
            places: (L, 2, h, w), from `places`.
            canvases: images on the canvases of the layers, (H, W, ...) each; by default the layers.
        """
        images = []
        for canvas, axes in zip(canvases or self._canvases, places, strict=True):
            x, y = (
                axis * np.float32(length / (2 + 4 * MARGIN)) + np.float32(length / 2 - 0.5)
                for axis, length in zip(axes, canvas.shape[1::-1], strict=True)
            )
            images.append(
                cv2.remap(canvas, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            )
        return np.stack(images)

    def aligned(self, frame: Floats, motion: Doubles, steps: int) -> Doubles:
        """Returns the motion of a frame, (L, 2, r, c), after some Gauss-Newton steps.

        Args:
            frame: (h, w, 3) linear light.
            motion: (L, 2, r, c), the start.
            steps: the number of steps.
        """
        for _ in range(steps):
            motion = motion - self._step(frame, self.samples(self.places(motion)), motion)
        return motion

    def fit(self, frame: Floats, motion: Doubles) -> tuple[Floats, Floats]:
        """Returns the exposure of a frame relative to the layers, (3,), and the mean absolute
        errors of square roots of light, (h, w).

        Args:
            frame: (h, w, 3) linear light.
            motion: (L, 2, r, c), that of the frame.
        """
        gains, errors = _explained(frame, self.total(motion))
        return gains, np.abs(errors).mean(-1)

    def total(self, motion: Doubles) -> Floats:
        """Returns the sum of the layers at the places that a frame shows, (h, w, 3).

        Args:
            motion: (L, 2, r, c), that of the frame.
        """
        total: Floats = compose(self.samples(self.places(motion))).sum(0)
        return total

    def _step(self, frame: Floats, samples: Floats, motion: Doubles) -> Doubles:
        """Returns a Gauss-Newton step of the motion, (L, 2, r, c).

        Args:
            frame: (h, w, 3) linear light.
            samples: (L, h, w, 4), the layers at the places that the frame shows.
            motion: (L, 2, r, c), for the curvature of its splines.
        """
        total = compose(samples).sum(0)
        gains, errors = _explained(frame, total)
        # Charbonnier, by iteratively reweighted least squares
        weights = _planes(1 / np.sqrt(np.square(errors) + CHARBONNIER * CHARBONNIER)) / np.float32(
            errors.size
        )
        slopes = self._slopes(samples) * _planes(
            np.float32(0.5) * gains / np.sqrt(gains * total + OFFSET)
        )
        weighted = slopes * weights
        products = np.einsum("achw,bchw->abhw", weighted[..., ::2, ::2], slopes[..., ::2, ::2])
        blocks = self._row_pairs.T @ products @ self._column_pairs
        count = len(slopes)
        rows, columns = _KNOTS
        blocks = blocks.reshape(count, count, rows, rows, columns, columns).transpose(
            0, 2, 4, 1, 3, 5
        )
        forces = (
            self._rows.T @ np.einsum("achw,chw->ahw", weighted, _planes(errors)) @ self._columns
        )
        forces = forces.reshape(count, -1) + motion.reshape(count, -1) @ self._stiffness
        matrix = blocks.reshape(forces.size, -1) + np.kron(np.eye(count), self._stiffness)
        matrix[np.diag_indices_from(matrix)] += _DAMPING
        # Nor NumPy's solve
        _, step = cv2.solve(matrix, forces.reshape(-1, 1), flags=cv2.DECOMP_CHOLESKY)
        return np.asarray(step.reshape(motion.shape))

    def _slopes(self, samples: Floats) -> Floats:
        """Returns the change of the sum of the layers with the motion of each layer and axis, (2 L,
        3, h, w), from the samples of the layers, (L, h, w, 4).
        """
        height, width = self.size
        planes = np.ascontiguousarray(np.moveaxis(samples, -1, 1))
        down, across = np.gradient(planes, axis=(2, 3))
        slopes = np.stack([across * np.float32(width / 2), down * np.float32(height / 2)], 1)
        hidden = slopes[1, :, 3:] * planes[0, :3]
        slopes[0] *= 1 - np.minimum(planes[1, 3:], 1)
        slopes[1, :, :3] -= hidden
        return slopes[:, :, :3].reshape(-1, 3, height, width)


def _pairs(weights: Floats) -> Floats:
    """Returns twice the products of the weights (n, k) of two knots at each second pixel, (n / 2, k
    k). Each second pixel suffices for the curvature of the loss.
    """
    half = weights[::2]
    pairs: Floats = (2 * half[:, :, None] * half[:, None]).reshape(len(half), -1)
    return pairs


def solved_motions(model: JointModel) -> Doubles:
    """Returns the motions of the frames from which the layers were measured, (K, L, 2, r, c)."""
    size = tuple(4 * knots for knots in _KNOTS)
    rows, columns = (
        np.linalg.pinv(bicubic_weights(side, knots))
        for side, knots in zip(size, _KNOTS, strict=True)
    )
    layer_count, frame_count = model.homographies.shape[1:3]
    grid = pixel_grid(*size)
    motions = [
        [
            rows @ (model.positions(0, layer, k, *size) - grid) @ columns.T
            for layer in range(layer_count)
        ]
        for k in range(frame_count)
    ]
    return np.array(motions)


def followed(
    model: JointModel,
    pictures: Sequence[NDArray[np.uint8]],
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> list[Doubles]:
    """Returns the motion of each frame of a film, (L, 2, r, c).

    It begins with the frame that the layers explain best with a motion of the solution, and
    continues in both directions: from the motion of the frame before, or one of the solution.

    Args:
        model: the solution, a single candidate.
        pictures: (h, w, 3) sRGB, small, in the order of time.
        on_progress: called with the completed fraction. An exception raised in it stops the work.
    """
    height, width = pictures[0].shape[:2]
    coarse, fine = (Tracker(model, (max(8, height // n), max(8, width // n))) for n in (2, 1))
    solved = solved_motions(model)

    def small(picture: NDArray[np.uint8]) -> Floats:
        return linear_light(cv2.resize(picture, coarse.size[::-1], interpolation=cv2.INTER_AREA))

    def error(frame: Floats, motion: Doubles) -> float:
        return float(coarse.fit(frame, motion)[1].mean())

    totals = [coarse.total(motion) for motion in solved]
    errors = np.empty((len(pictures), len(solved)))
    for k, picture in enumerate(pictures):
        frame = small(picture)
        errors[k] = [float(np.abs(_explained(frame, total)[1]).mean()) for total in totals]
        on_progress(0.0)
    start = int(errors.min(1).argmin())
    motions: dict[int, Doubles] = {}
    for frames, step in ((range(start, len(pictures)), 1), (range(start - 1, -1, -1), -1)):
        for k in frames:
            guesses = [solved[errors[k].argmin()]]
            if k - step in motions:
                guesses.append(motions[k - step])
            if k - 2 * step in motions:  # with the same speed
                guesses.append(2 * motions[k - step] - motions[k - 2 * step])
            frame = small(pictures[k])
            motion = coarse.aligned(frame, min(guesses, key=partial(error, frame)), 4)
            motions[k] = fine.aligned(linear_light(pictures[k]), motion, 3)
            on_progress(len(motions) / len(pictures))
    return [motions[k] for k in range(len(pictures))]


def linear_light(picture: NDArray[np.uint8]) -> Floats:
    """Returns an 8-bit sRGB picture in linear light."""
    linear: Floats = cv2.LUT(picture, LINEAR_LIGHT)
    return linear


def coverage(model: JointModel) -> list[Floats]:
    """Returns how well each layer is known at each place of its canvas: 1 where at least two frames
    show it, with a fade to 0.
    """
    height, width = (round(side / (2 + 4 * MARGIN)) for side in model.layers.shape[2:4])
    canvas = canvas_size((height, width))
    covered = []
    for layer in range(model.layers.shape[1]):
        count = np.zeros(canvas, np.uint8)
        for k in range(model.homographies.shape[2]):
            seen = np.zeros((*canvas, 2), np.float32)
            positions = model.positions(0, layer, k, 2 * height, 2 * width) / (1 + 2 * MARGIN)
            sampling.collect(
                np.ones((2 * height, 2 * width), np.float32), *to_pixels(positions, canvas), seen
            )
            count += seen[..., 1] > 1
        inside = np.pad((count >= _COVERED_BY).astype(np.uint8), 1)
        distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
        covered.append(np.minimum(distance / (_FADE * width), 1)[..., None])
    return covered


def _planes(image: NDArray[np.floating]) -> Floats:
    """Returns an image (h, w, c) as planes (c, h, w)."""
    return np.ascontiguousarray(np.moveaxis(image, -1, 0), np.float32)


def _explained(frame: Floats, total: Floats) -> tuple[Floats, Floats]:
    """Returns the exposure of a frame relative to the sum of the layers, (3,), and the errors of
    square roots, (h, w, 3).

    Args:
        frame: (h, w, 3) linear light.
        total: (h, w, 3), the sum of the layers at the places that the frame shows.
    """
    gains = _gains(frame, total)
    return gains, data_errors(gains * total, frame)


def _gains(frame: Floats, total: Floats) -> Floats:
    """Returns the exposure of a frame relative to the layers, (3,), by least squares of square
    roots of light.

    Args:
        frame: (h, w, 3) linear light.
        total: (h, w, 3), the sum of the layers.
    """
    frame, total = (np.sqrt(image[::2, ::2] + OFFSET).reshape(-1, 3) for image in (frame, total))
    weights = np.ones_like(total)
    for _ in range(3):  # with less weight of pixels that the layers do not explain
        root = np.einsum("nc,nc->c", weights * frame, total) / np.einsum(
            "nc,nc->c", weights * total, total
        )
        weights = 1 / np.sqrt(np.square(root * total - frame) + np.float32(0.05**2))
    gains: Floats = np.clip(np.square(root), *_GAINS)
    return gains
