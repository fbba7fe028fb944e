"""Moves smooth light between both layers, where the errors of the frames ask for it.

Light that is in T instead of R, and changes slowly from place to place, moves with the wrong layer.
Its errors are small, of one sign in large areas, and hidden by those of edges, so that the steps of
the optimiser, each of which changes single pixels, hardly find it. On a coarse grid, it is the
solution of a linear system:

    d_k(x) + e(x_R) - e(x_T) + f_k(x) p_k(x) = 0 for each box x of each frame k

e is the light that moves from T to R, in coordinates of the reference frame, x_T and x_R the places
of x in both layers, d the error of the predicted light, and f the light of the frame. p is a
polynomial of its own for each frame: vignetting and white balance change the light of a frame in
large areas, too, and must not count as light that moves. Boxes of linear light keep their mean if
an edge in them is blurred or in a slightly wrong place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.film.motion.model.joint_model import Doubles, Floats, JointModel, pixel_grid
from brewster.film.motion.model.kernels import CLIPPED, MARGIN

_GRID: Final = (15, 20)
"""Rows and columns of the grid on the canvases. Its cells are 7 % of the width of a frame wide."""
_BOXES: Final = 40
"""Boxes along the long side of a frame."""
_RIDGE: Final = 3e-3
_SMOOTHNESS: Final = 1e-3
"""The costs of the moved light and of its differences between neighbouring points, relative to the
errors that it would make if R were black.
"""
_EXPLAINED_ERROR: Final = 1.1e-3
_COST_POWER: Final = 4
"""If the boxes have larger errors than this, as differences of square roots of light, both costs
grow with this power: what no light explains would move some.
"""
_MAX_ERROR: Final = 3.5e-3
"""More than in any of the simulated bursts that were compared (docs: dev/notes/burst.md)."""
_PASSES: Final = 2
"""With weights and costs that follow from the errors that the pass before leaves."""
_SHADOWS: Final = 0.01
"""Added to light in the weights: errors in the shadows count less."""
_MAX_CLIPPED: Final = 0.25
"""Boxes with a larger share of clipped pixels do not count."""
_OUTLIERS: Final = 1.5
"""Errors above this often the median count as absolute errors (Huber 1964)."""
_TINY: Final = 1e-9


def with_moved_light(model: JointModel, frames: Floats) -> JointModel | None:
    """Returns the model of two layers with smooth light moved between them, or None if the errors
    that no moved light explains are too large. The sum of the layers in the reference frame stays
    the same.

    Args:
        model: one candidate with two layers.
        frames: (K, h, w, 4) linear light.
    """
    equations = [
        _Equations.of_frame(model, frame[..., :3], k)
        for k, frame in enumerate(frames)
        if k != model.reference  # both places are the same there
    ]
    moved = np.zeros((3, _GRID[0] * _GRID[1]))
    cost = 1.0
    for _ in range(_PASSES):
        normals = [[each.reduced(moved, channel) for each in equations] for channel in range(3)]
        moved = np.stack([_solved(channel, cost) for channel in normals])
        left = [
            each.energy_left(light)
            for channel, light in zip(normals, moved, strict=True)
            for each in channel
        ]
        error = float(np.sqrt(np.mean(left)))
        if error > _MAX_ERROR:
            return None
        cost = max(1.0, error / _EXPLAINED_ERROR) ** _COST_POWER
    return _applied(model, moved.reshape(3, *_GRID).transpose(1, 2, 0))


@final
@dataclass(frozen=True)
class _Normal:
    """The normal equations of a channel of a frame, without its shading, as means of boxes."""

    matrix: Doubles
    """(points, points)"""
    side: Doubles
    """(points,)"""
    energy: float
    """The mean of the squared weighted errors."""
    weight: float
    """The mean of the weights."""

    def energy_left(self, moved: Doubles) -> float:
        """Returns what is left of `energy` after light (points,) has moved."""
        return float(self.energy - 2 * self.side @ moved + moved @ self.matrix @ moved)


@final
@dataclass(frozen=True)
class _Equations:
    """The equations of the boxes of a frame."""

    points: NDArray[np.int64]
    """(boxes, 8): the points of the grid around the places of a box in both layers."""
    coefficients: Doubles
    """(boxes, 8): what light at these points adds to the predicted light of the box."""
    shading: Doubles
    """(3, boxes, terms): the light of the frame, times the terms of the polynomial."""
    errors: Doubles
    """(3, boxes): predicted minus true light."""
    weights: Doubles
    """(3, boxes): squared, they make the errors differences of square roots of light."""

    @classmethod
    def of_frame(cls, model: JointModel, frame: Floats, k: int) -> _Equations:
        """Returns the equations of frame `k`, (h, w, 3)."""
        height, width = frame.shape[:2]
        shrinking = _BOXES / max(height, width)
        rows, columns = (max(2, round(length * shrinking)) for length in (height, width))

        def boxed(image: Floats) -> Doubles:
            means = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
            planes: Doubles = means.reshape(-1, 3).T.astype(np.float64)
            return planes

        points, coefficients = (
            np.hstack(parts)
            for parts in zip(
                *(
                    _corners(model.positions(0, layer, k, rows, columns) / (1 + 2 * MARGIN))
                    for layer in (0, -1)
                ),
                strict=True,
            )
        )
        coefficients[:, :4] *= -1  # light leaves T
        gains = model.fixed_motion()[2][0, k].astype(np.float32)
        predicted = model.frame_layers(k, height, width).sum(0) * gains
        clipped = (frame > CLIPPED).astype(np.float32)
        light = boxed(frame)
        return cls(
            points=points,
            coefficients=coefficients,
            shading=light[..., None] * _polynomial(rows, columns),
            errors=boxed((predicted - frame) * (1 - clipped)),
            weights=(boxed(clipped) <= _MAX_CLIPPED) * 0.25 / (light + _SHADOWS),
        )

    def reduced(self, moved: Doubles, channel: int) -> _Normal:
        """Returns the normal equations of a channel, from which the unknown shading is eliminated.

        Args:
            moved: light (3, points), whose errors give the weights.
            channel: the index of the channel.
        """
        errors = self.errors[channel]
        change = (self.coefficients * moved[channel][self.points]).sum(1)
        left = np.abs(errors + change) * np.sqrt(self.weights[channel])
        limit = _OUTLIERS * np.median(left) + _TINY
        weights = self.weights[channel] * np.minimum(1, limit / np.maximum(left, limit))
        weighted = weights[:, None] * self.coefficients
        count = _GRID[0] * _GRID[1]
        pairs = (self.points[:, :, None] * count + self.points[:, None]).ravel()
        products = (weighted[:, :, None] * self.coefficients[:, None]).ravel()
        matrix = np.bincount(pairs, products, count * count).reshape(count, count)
        others = np.column_stack([self.shading[channel], -errors])
        mixed = np.stack(
            [
                np.bincount(self.points.ravel(), (weighted * other[:, None]).ravel(), count)
                for other in others.T
            ]
        )  # the last row is the right side
        # Not matrix products of NumPy, whose threads wait for each other on a busy machine
        inner = np.einsum("bi,b,bj->ij", others, weights, others)
        shading = inner[:-1, :-1] + _TINY * np.eye(len(inner) - 1)
        eliminated = np.linalg.solve(shading, np.column_stack([mixed[:-1], inner[:-1, -1]]))
        return _Normal(
            matrix=(matrix - np.einsum("ti,tj->ij", mixed[:-1], eliminated[:, :-1])) / len(errors),
            side=(mixed[-1] - np.einsum("ti,t->i", mixed[:-1], eliminated[:, -1])) / len(errors),
            energy=float((inner[-1, -1] - inner[:-1, -1] @ eliminated[:, -1]) / len(errors)),
            weight=float(self.weights[channel].mean()),
        )


def _corners(positions: Doubles) -> tuple[NDArray[np.int64], Doubles]:
    """Returns the four points of the grid around positions (2, rows, columns) on the canvas, -1 to
    1, and their weights in bilinear interpolation: (rows * columns, 4) each.
    """
    (x, left), (y, top) = (
        _cell(_on_grid(axis.ravel(), count), count)
        for axis, count in zip(positions.clip(-1, 1), _GRID[::-1], strict=True)
    )
    first = top * _GRID[1] + left
    points = first[:, None] + np.array([0, 1, _GRID[1], _GRID[1] + 1])
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], 1)
    return points, weights


def _cell(places: Doubles, count: int) -> tuple[Doubles, NDArray[np.int64]]:
    """Returns the distances of places, 0 to `count` - 1, to the grid point before them, and the
    indices of these points.
    """
    first = np.minimum(places.astype(np.int64), count - 2)
    return places - first, first


def _on_grid(coordinates: Doubles, count: int) -> Doubles:
    """Returns coordinates of the canvas, -1 to 1, as those of a grid of `count` points."""
    return (coordinates + 1) / 2 * (count - 1)


def _polynomial(rows: int, columns: int) -> Doubles:
    """Returns the terms of a polynomial of second degree, (rows * columns, 6)."""
    x, y = pixel_grid(rows, columns).reshape(2, -1)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _solved(equations: list[_Normal], cost: float) -> Doubles:
    """Returns the moved light of a channel, (points,).

    Args:
        equations: those of the frames.
        cost: the factor of the costs of moved light.
    """
    matrix = np.mean([each.matrix for each in equations], 0)
    side = np.mean([each.side for each in equations], 0)
    points = len(side)
    scale = max(float(np.mean([each.weight for each in equations])) / points, _TINY)
    costs = _RIDGE * np.eye(points) + _SMOOTHNESS * _LAPLACIAN
    # Not numpy.linalg.solve: threads of OpenBLAS that wait for each other took 150 ms in place of 1
    _, solved = cv2.solve(matrix + cost * scale * costs, side[:, None], flags=cv2.DECOMP_CHOLESKY)
    moved: Doubles = solved[:, 0]
    return moved


def _laplacian(rows: int, columns: int) -> Doubles:
    """Returns the matrix of the squared differences of neighbouring points of a grid."""
    along_rows, along_columns = (np.diff(np.eye(count), axis=0) for count in (rows, columns))
    across_rows = np.kron(along_rows.T @ along_rows, np.eye(columns))
    return across_rows + np.kron(np.eye(rows), along_columns.T @ along_columns)


_LAPLACIAN: Final = _laplacian(*_GRID)


def _applied(model: JointModel, moved: Doubles) -> JointModel:
    """Returns the model after light on the grid, (rows, columns, 3), moved from T to R. No layer
    becomes negative.
    """
    x, y = (
        _on_grid(axis, count).astype(np.float32)
        for axis, count in zip(pixel_grid(*model.layers.shape[2:4]), _GRID[::-1], strict=True)
    )
    on_canvas = cv2.remap(
        moved.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return model.with_light_moved(on_canvas)
