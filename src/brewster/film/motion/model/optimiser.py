"""Optimises both layers, their motions and the gains of the frames jointly, with Adam and exact
gradients (kernels/).

Adam treats each parameter separately, so that candidates do not influence each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final, final

import cv2
import numpy as np

from brewster.film.motion.model.joint_model import (
    Doubles,
    Floats,
    JointModel,
    bicubic_pieces,
    bicubic_weights,
    pixel_grid,
    to_pixels,
)
from brewster.film.motion.model.kernels import MARGIN, OFFSET, edges, sampling
from brewster.film.motion.model.kernels.adam import BETA1, BETA2, layer_step
from brewster.film.motion.model.kernels.data_term import data_term
from brewster.film.motion.threads import run_items

_GRADIENTS: Final = np.array([0.03, 0.05, 0.05])
"""The costs of the gradients of the layers."""
_GAIN_PENALTY: Final = 0.5
_SPLINE_CURVATURE: Final = 5.0
_SPLINE_SIZE: Final = 1.0
_RIGIDITY: Final = (1.0, 2.0, 2.0)
"""The costs of the splines of the layers."""
_EDGE_SCALES: Final = 3
_PARTS: Final = 8
"""The strips of rows of all candidates together, if there are fewer candidates. Each strip has a
canvas of its own.
"""
_LARGE_CANVAS: Final = 1_000_000
"""With more pixels, there are half as many strips: they need most of the memory."""
_SPARSE: Final = 2
"""The prior is compared at every second pixel of every second row."""
_LOW_PASS: Final = 5, 2
"""The width of the box, and the distance of boxes, in which the prior is compared, in these pixels.
"""


@final
@dataclass(frozen=True)
class Weights:
    """The weights of the terms of the loss that change from level to level."""

    common_edges: float
    prior: float
    """The pull of the low frequencies of T to those of the single-photo result."""


@final
@dataclass(frozen=True)
class Rates:
    """The learning rates of an optimisation. 0 keeps the values."""

    layers: float = 0.018
    homographies: float = 0.006
    splines: float = 0.002
    log_gains: float = 0.003

    def scaled(self, factor: float) -> Rates:
        """Returns rates with slower motion: its unit is the frame, so that it must be finer for
        larger frames.
        """
        return replace(self, homographies=self.homographies * factor, splines=self.splines * factor)


def optimise(
    model: JointModel,
    frames: Floats,
    prior: Floats,
    steps: int,
    *,
    rates: Rates,
    weights: Weights,
    every: int = 1,
    edges_every: int = 1,
    on_step: Callable[[], None] = lambda: None,
) -> JointModel:
    """Returns the model after some steps of Adam. The result does not depend on the number of
    threads.

    Args:
        model: the start; its canvases fit the size of the frames.
        frames: (K, h, w, 4) linear light.
        prior: T of the reference frame from a single photo, (h, w, 4).
        steps: the number of steps. The rates fall over the last 40 %; those of the motion rise
            during the first ten.
        rates: the learning rates.
        weights: the weights of the loss.
        every: a step but the last one compares only each `every`-th row of the frames, the next
            step the rows after these.
        edges_every: in each `edges_every`-th step, and in the last one, the edges of both layers
            are compared, with so many times the weight.
        on_step: called after each step. An exception raised in it stops the work.
    """
    loss = _Loss(model, frames, prior, weights)
    moving = (
        _Adam(loss.model.homographies, rates.homographies),
        _Adam(loss.model.splines, rates.splines),
        _Adam(loss.model.log_gains, rates.log_gains),
    )
    for step in range(1, steps + 1):
        decay = min(1.0, 0.2 + 0.8 * (steps - step + 1) / (0.4 * steps))
        is_last = step == steps
        edge_factor = 1 if is_last else edges_every * (step % edges_every == 1 % edges_every)
        penalties, data_losses, gradients = loss.gradients(
            1 if is_last else every, step, edge_factor
        )
        loss.step_layers(rates.layers * decay, step)
        for parameters, gradient in zip(moving, gradients, strict=True):
            parameters.step(gradient, decay * min(1.0, (step - 1) / 10), step)
        on_step()
    return replace(loss.model, losses=penalties + data_losses, data_losses=data_losses)


def compile_kernels() -> Iterator[float]:
    """Calls all kernels with small images, which compiles them, in the order in which a burst needs
    them. Yields the completed fraction from time to time.
    """
    frames = np.full((2, 16, 16, 4), 0.5, np.float32)
    motions = np.tile(np.eye(3), (1, 2, 2, 1, 1))
    model = JointModel.start(frames, motions, np.array([False]), 0, 1.0)
    yield 0.0
    loss = _Loss(model, frames, frames[0], Weights(common_edges=1.0, prior=1.0))
    light = np.zeros((1, 1, 3), np.float32)
    codes = np.zeros((1, 1, 3), np.uint8)
    table = np.zeros(256, np.float32)
    steps: tuple[Callable[[], object], ...] = (
        lambda: loss._layer_penalties(1),
        loss._prior_penalties,
        lambda: loss._data_term(loss._extra, 1, 0),
        lambda: loss.step_layers(0.0, 1),
        lambda: model.collected_errors(frames, 0),
        lambda: sampling.apply_linear(codes, table, light, light, codes[0, 0], codes),
    )
    for done, step in enumerate(steps, 1):
        step()
        yield done / len(steps)


@final
class _Adam:
    """Steps of Adam, in place, for parameters other than the layers."""

    def __init__(self, values: Doubles, rate: float) -> None:
        self._values = values
        self._rate = rate
        self._first = np.zeros_like(values)
        self._second = np.zeros_like(values)

    def step(self, gradient: Doubles, factor: float, step: int) -> None:
        """Takes a step.

        Args:
            gradient: that of the values, with their shape.
            factor: multiplies the rate.
            step: the number of the step, from 1.
        """
        self._first += (1 - BETA1) * (gradient - self._first)
        self._second += (1 - BETA2) * (gradient**2 - self._second)
        root = np.sqrt(self._second / (1 - BETA2**step)) + 1e-8
        self._values -= self._rate * factor / (1 - BETA1**step) * self._first / root


@final
class _Loss:
    """The loss of all candidates and its gradients, with the arrays that are used in each step.

    Its model has arrays of its own, which change.
    """

    def __init__(self, model: JointModel, frames: Floats, prior: Floats, weights: Weights) -> None:
        self.model = replace(
            model,
            layers=model.layers.copy(),
            homographies=model.homographies.copy(),
            splines=model.splines.copy(),
            log_gains=model.log_gains.copy(),
        )
        layers = self.model.layers
        splines = self.model.splines
        self._weights = weights
        count, layer_count, canvas_height, canvas_width, _ = layers.shape
        frame_count, height, width, _ = frames.shape
        is_large = canvas_height * canvas_width > _LARGE_CANVAS
        self._parts = max(1, _PARTS // (2 * count if is_large else count))
        self._light = np.square(layers)
        self._target = np.sqrt(frames + OFFSET)
        self._target[..., 3] = np.sqrt(OFFSET)
        self._moments = np.zeros_like(layers), np.zeros_like(layers)
        self._squared_density = np.float32((canvas_width / (width * (1 + 2 * MARGIN))) ** 2)
        self._low_prior = _low_pass(np.sqrt(prior[::_SPARSE, ::_SPARSE] + OFFSET))
        self._pyramid = [layers]
        for _ in range(_EDGE_SCALES - 1):
            h, w = (length // 2 for length in self._pyramid[-1].shape[2:4])
            self._pyramid.append(np.zeros((count, 2, h, w, 4), np.float32))
        self._gradients = [np.zeros_like(images) for images in self._pyramid]
        self._edges = [
            np.zeros((2, count, 2, *images.shape[2:4]), np.float32) for images in self._pyramid
        ]
        grid = pixel_grid(height, width)[:, ::_SPARSE, ::_SPARSE]
        self._places = to_pixels(grid / (1 + 2 * MARGIN), layers.shape[2:4])
        self._encoded = np.empty((count, *self._places[0].shape, 4), np.float32)
        self._visible = np.empty((count, *self._places[0].shape), np.float32)
        self._extra = np.zeros((count, height, width, 4), np.float32)
        columns, self._pieces = bicubic_pieces(width, splines.shape[-1])
        self._rows, self._columns = (
            weights.astype(np.float32)
            for weights in (bicubic_weights(height, splines.shape[-2]), columns)
        )
        strips = count * self._parts
        self._scatter = np.zeros(
            (strips, layer_count, canvas_height * canvas_width * 4), np.float32
        )
        self._touched = np.zeros((strips, layer_count, 2), np.int64)
        self._found = np.zeros((strips, frame_count, 4 + layer_count * (8 + splines[0, 0, 0].size)))

    def gradients(
        self, every: int = 1, step: int = 0, edge_factor: int = 1
    ) -> tuple[Doubles, Doubles, tuple[Doubles, Doubles, Doubles]]:
        """Computes the loss and its gradients. That of the layers stays in the arrays of this
        object.

        Args:
            every: see `optimise`: the data term is that of each `every`-th row, times `every`.
            step: the number of the step, which selects these rows.
            edge_factor: multiplies the weight of common edges.

        Returns:
            The penalties (C,), the data term (C,), and the gradients of the homographies (C, L, K,
            8), the splines (C, L, K, 2, rows, columns) and the logarithms of the gains (C, K, 3).
        """
        model = self.model
        penalties = self._layer_penalties(edge_factor)
        prior_penalties, extra = self._prior_penalties()
        data_losses, gains, motion = self._data_term(extra, every, step % every)
        homographies, splines = np.split(motion, [8], axis=-1)
        splines = splines.reshape(model.splines.shape)
        for layer, rigidity in enumerate(_RIGIDITY[: model.splines.shape[1]]):
            cost, gradient = _spline_penalties(model.splines[:, layer])
            penalties += rigidity * cost
            splines[:, layer] += rigidity * gradient
        penalties += prior_penalties + _GAIN_PENALTY * np.square(model.log_gains).mean((1, 2))
        gains += 2 * _GAIN_PENALTY * model.log_gains / model.log_gains[0].size
        return penalties, data_losses, (homographies, splines, gains)

    def step_layers(self, rate: float, step: int) -> None:
        """Takes a step of Adam for the layers.

        Args:
            rate: the learning rate.
            step: the number of the step, from 1.
        """
        rate = rate / (1 - BETA1**step)
        correction = 1 / np.sqrt(1 - BETA2**step)
        layers = self.model.layers
        run_items(
            layer_step,
            layers.shape[0] * layers.shape[1] * layers.shape[2],
            layers,
            self._light,
            self._gradients[0],
            self._scatter,
            self._touched,
            self._parts,
            *self._moments,
            np.float32(rate),
            np.float32(correction),
        )

    def _layer_penalties(self, edge_factor: int) -> Doubles:
        """Returns the costs of gradients and of edges at the same places in both layers, at three
        scales (Zhang et al. 2018): (C,). `edge_factor` multiplies the weight of the edges.
        """
        count = len(self.model.layers)
        parts = self._parts
        losses = np.zeros(count * self.model.layers.shape[1] * parts)
        run_items(
            edges.gradient_lengths,
            len(losses),
            self.model.layers,
            self._squared_density,
            _GRADIENTS,
            parts,
            self._gradients[0],
            losses,
        )
        penalties: Doubles = losses.reshape(count, -1).sum(1)
        weight = edge_factor * self._weights.common_edges
        if not weight:
            return penalties
        for fine, coarse in zip(self._pyramid, self._pyramid[1:], strict=False):
            run_items(edges.halved, count * 2 * coarse.shape[2], fine, coarse)
        none = np.zeros((count, 2, 0, 0, 4), np.float32)
        for scale in reversed(range(_EDGE_SCALES)):
            images = self._pyramid[scale]
            across, down = self._edges[scale]
            gradient = self._gradients[scale]
            height, width = images.shape[2:4]
            sums = np.zeros((count, parts, 2, 2))
            losses = np.zeros(count * parts)
            run_items(edges.edge_strengths, count * parts, images, parts, across, down, sums)
            sizes = np.array([height * (width - 1), (height - 1) * width])[:, None]
            scales = (1 / (2 * sums.sum(1) / sizes + 1e-4)).astype(np.float32)
            run_items(edges.edge_products, count * parts, parts, scales, across, down, losses)
            penalties += weight * losses.reshape(count, parts).sum(1)
            coarse = self._gradients[scale + 1] if scale + 1 < _EDGE_SCALES else none
            if scale:
                gradient[:] = 0
            run_items(
                edges.edge_gradient,
                count * 2 * height,
                images,
                across,
                down,
                weight,
                coarse,
                gradient,
            )
        return penalties

    def _prior_penalties(self) -> tuple[Doubles, Floats]:
        """Returns the differences of the smooth light of T from that of the prior (C,), and their
        gradients in the reference frame, (C, h, w, 4).
        """
        size, step = _LOW_PASS
        run_items(
            sampling.encoded_transmission,
            self._visible.shape[0] * self._visible.shape[1],
            self._light,
            *self._places,
            self._encoded,
            self._visible,
        )
        penalties = []
        for candidate, encoded in enumerate(self._encoded):
            difference = (_low_pass(encoded) - self._low_prior)[..., :3]
            penalties.append(self._weights.prior * np.abs(difference).mean())
            spread = np.zeros_like(encoded)
            spread[::step, ::step, :3] = np.sign(difference) * (
                0.5 * self._weights.prior / difference.size
            )
            box = cv2.boxFilter(spread, -1, (size, size), borderType=cv2.BORDER_CONSTANT)
            box *= self._visible[candidate, ..., None]
            np.divide(box, encoded, out=self._extra[candidate, ::_SPARSE, ::_SPARSE])
        return np.array(penalties), self._extra

    def _data_term(self, extra: Floats, every: int, phase: int) -> tuple[Doubles, Doubles, Doubles]:
        """Computes the data term and its gradients.

        Args:
            extra: (C, h, w, 4), the gradient of the prior, see `data_term`.
            every: the distance of the rows that are compared.
            phase: the first of these rows.

        Returns:
            The data term (C,), and the gradients of the logarithms of the gains (C, K, 3) and of
            the motion (C, L, K, 8 + 2 rows columns).
        """
        model = self.model
        homographies, splines, gains = model.fixed_motion()
        count, frame_count, _ = gains.shape
        run_items(
            data_term,
            len(self._scatter),
            self._light,
            self._target,
            homographies.astype(np.float32),
            splines.astype(np.float32),
            self._rows,
            self._columns,
            self._pieces,
            np.pad(gains, ((0, 0), (0, 0), (0, 1))).astype(np.float32),
            extra,
            model.reference,
            every,
            phase,
            self._parts,
            self._scatter,
            self._touched,
            self._found,
        )
        found = self._found.reshape(count, self._parts, frame_count, -1).sum(1)
        motion = (
            found[..., 4:]
            .reshape(count, frame_count, homographies.shape[1], -1)
            .swapaxes(1, 2)
            .copy()
        )
        motion[model.is_locked, 0] += motion[model.is_locked, -1]
        motion[model.is_locked, -1] = 0
        return (
            every * found[..., 0].sum(1) / self._target[..., :3].size,
            found[..., 1:4].copy(),
            motion,
        )


def _spline_penalties(splines: Doubles) -> tuple[Doubles, Doubles]:
    """Returns the costs of size and curvature of splines (C, K, 2, r, c), (C,), and their
    gradients.
    """
    axes = (1, 2, 3, 4)
    cost = _SPLINE_SIZE * np.square(splines).mean(axes)
    gradient = 2 * _SPLINE_SIZE * splines / splines[0].size
    if min(splines.shape[-2:]) > 2:
        for axis in (-1, -2):
            bend = np.diff(splines, 2, axis)
            cost = cost + _SPLINE_CURVATURE * np.square(bend).mean(axes)
            force = np.moveaxis(2 * _SPLINE_CURVATURE * bend / bend[0].size, axis, -1)
            target = np.moveaxis(gradient, axis, -1)
            target[..., :-2] += force
            target[..., 1:-1] -= 2 * force
            target[..., 2:] += force
    return cost, gradient


def _low_pass(image: Floats) -> Floats:
    """Returns the means of boxes of an image (h, w, 4), at some distance from each other."""
    size, step = _LOW_PASS
    low: Floats = cv2.boxFilter(image, -1, (size, size), borderType=cv2.BORDER_CONSTANT)[
        ::step, ::step
    ]
    return low
