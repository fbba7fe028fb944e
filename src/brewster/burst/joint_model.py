"""Two layers and their motions, optimised jointly until their sum explains every frame of a burst.

    frame_k(x) = gain_k * (T(motion_T,k(x)) + R(motion_R,k(x)))

T and R are explicit images in linear light on canvases that are larger than the frames, because the camera moves. They are stored as square
roots, so that they are never negative. A motion maps coordinates of frame k to the reference frame: a homography plus a spline for
parallax; that of the reference frame is the identity. Coordinates are normalised: -1 and 1 are the edges of a frame.

Several candidates for the motion are optimised at once, as a batch: Adam treats each parameter separately, so that they do not
influence each other. In the spirit of neural spline fields (Chugunov et al. 2024), with images instead of networks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, final

import torch
from torch import Tensor
from torch.nn import functional

_ALL: Final = slice(None)
_CHUNK_PIXELS: Final = 300_000
"""The errors of at most this many pixels are computed at once: smaller tensors are faster, because they stay in the caches."""
MARGIN: Final = 0.15
"""The canvases extend beyond each edge of the reference frame by this share of its size."""
OFFSET: Final = 0.003
"""Added to linear light below the square root, so that noise in the shadows counts less."""
_CHARBONNIER_EPSILON: Final = 0.01
_TRANSMISSION_GRADIENTS: Final = 0.03
_REFLECTION_GRADIENTS: Final = 0.05
_CLIPPED: Final = 0.98
"""Above this value, a pixel of a frame is clipped, and a brighter sum of the layers is no error."""
_MIN_DENOMINATOR: Final = 0.1
"""Of a projection: points at infinity would end the program in `grid_sample`."""
_ERROR_AT_1_E: Final = 0.05
"""The mean error of the frames, as a difference of square roots of light, at which the confidence is 1/e."""
_GAIN_PENALTY: Final = 0.5
_SPLINE_CURVATURE: Final = 5.0
_SPLINE_SIZE: Final = 1.0
_REFLECTION_RIGIDITY: Final = 2.0
"""The splines of the reflection cost this much more than those of the transmission."""


@final
@dataclass(frozen=True)
class Weights:
    """The weights of the terms of the loss that change from level to level."""

    common_edges: float
    prior: float
    """The pull of the low frequencies of T to those of the single-photo result."""


@final
@dataclass
class JointModel:
    """C candidates for the layers of K frames. The first axis of `layers`, `homographies` and `splines` is T, R."""

    layers: Tensor
    """(2, C, 3, H, W), square roots of linear light."""
    homographies: Tensor
    """(2, C, K, 8), frame to reference."""
    splines: Tensor
    """(2, C, K, 2, rows, columns), the offsets that are added to the homographies."""
    log_gains: Tensor
    """(C, K, 3)"""
    is_locked: Tensor
    """(C,): whether R moves with T, so that both are one layer."""
    reference: int
    losses: Tensor
    """(C,): the loss at the end of the last optimisation."""
    data_losses: Tensor
    """(C,): the part of `losses` that compares the frames with their prediction."""

    @classmethod
    def start(
        cls, frames: Tensor, motions: Tensor, is_locked: Tensor, reference: int, density: float
    ) -> JointModel:
        """Returns a model with first images: T is the second darkest of the frames aligned with its motion, R a part of the darkest.

        Args:
            frames: (K, 3, h, w) linear light.
            motions: (2, C, K, 3, 3), frame to reference, of T and R.
            is_locked: (C,), whether R moves with T.
            reference: the index of the reference frame.
            density: the number of pixels of the canvases per pixel of the frames, along each axis.
        """
        _, count, frame_count = motions.shape[:3]
        height, width = _canvas_size(frames, density)
        canvas = pixel_grid(height, width) * (1 + 2 * MARGIN)
        to_frames = torch.linalg.inv(motions)
        layers = torch.empty(2, count, 3, height, width)
        for candidate in range(count):
            for layer in range(2):
                positions = _project(
                    to_frames[layer, candidate].flatten(1)[:, :8] / to_frames[layer, candidate, :, 2:, 2],
                    canvas,
                )
                aligned = functional.grid_sample(
                    frames, positions, align_corners=False, padding_mode="border"
                )
                is_outside = (positions.abs().amax(-1) > 1)[:, None]
                darkest = (aligned + 9 * is_outside).sort(0).values
                second = torch.where(darkest[1] < 2, darkest[:2].mean(0), darkest[0])
                image = second * 0.9 if layer == 0 else darkest[0] * 0.3
                image = torch.where(darkest[0] < 2, image, aligned[reference] * (0.9 if layer == 0 else 0.3))
                layers[layer, candidate] = image.clamp(min=1e-4 if layer == 0 else 4e-3).sqrt()
        homographies = motions.flatten(3)[..., :8] / motions[..., 2, 2, None]
        splines = torch.zeros(2, count, frame_count, 2, 2, 2)
        log_gains, losses = torch.zeros(count, frame_count, 3), torch.full((count,), torch.inf)
        return cls(layers, homographies, splines, log_gains, is_locked, reference, losses, losses)

    def selected(self, candidates: Sequence[int]) -> JointModel:
        """Returns a model with these candidates only."""
        chosen = list(candidates)
        return JointModel(
            self.layers[:, chosen], self.homographies[:, chosen], self.splines[:, chosen], self.log_gains[chosen],
            self.is_locked[chosen], self.reference, self.losses[chosen], self.data_losses[chosen],
        )  # fmt: skip

    def exchanged(self) -> JointModel:
        """Returns a model with T and R exchanged."""
        layers, homographies, splines = (
            tensor.flip(0) for tensor in (self.layers, self.homographies, self.splines)
        )
        return replace(self, layers=layers, homographies=homographies, splines=splines)

    def resized(self, frames: Tensor, density: float, spline_size: tuple[int, int] | None) -> JointModel:
        """Returns the model for larger frames (K, 3, h, w), with `density` pixels per pixel of a frame, and finer splines."""
        layers = _resize(self.layers, _canvas_size(frames, density), align_corners=False)
        splines = _resize(self.splines, spline_size, align_corners=True) if spline_size else self.splines
        return replace(self, layers=layers, splines=splines)

    def positions(self, height: int, width: int, frames: slice = _ALL) -> Tensor:
        """Returns the coordinates in the reference frame of each pixel of K frames: (2, C, K, h, w, 2)."""
        moves = self._moves()[frames]
        identity = torch.eye(3).flatten()[:8]
        homographies = identity + moves * (self._locked(self.homographies)[:, :, frames] - identity)
        positions = _project(homographies, pixel_grid(height, width))
        rows, columns = (
            _interpolation(size, n) for size, n in zip((height, width), self.splines.shape[-2:], strict=True)
        )
        offsets = rows @ (moves[:, None, None] * self._locked(self.splines)[:, :, frames]) @ columns.T
        return positions + offsets.movedim(-3, -1)

    def render(self, height: int, width: int, frames: slice = _ALL) -> tuple[Tensor, Tensor]:
        """Returns the layers of K frames, (2, C, K, 3, h, w) linear light, and the gains of the frames, (C, K, 3, 1, 1)."""
        positions = self.positions(height, width, frames) / (1 + 2 * MARGIN)
        count, frame_count = positions.shape[1:3]
        # One tall grid for all frames: the gradient of the layers is accumulated in place
        grid = positions.reshape(2 * count, frame_count * height, width, 2)
        rendered = functional.grid_sample(
            self.layers.flatten(0, 1).square(), grid, align_corners=False, padding_mode="border"
        )
        rendered = rendered.reshape(2, count, 3, frame_count, height, width).transpose(2, 3)
        gains = torch.exp(self._moves() * self.log_gains)[:, frames, :, None, None]
        return rendered, gains

    def reference_layers(self, height: int, width: int) -> Tensor:
        """Returns both layers of the reference frame: (2, C, 3, h, w) linear light."""
        rendered, _ = self.render(height, width, slice(self.reference, self.reference + 1))
        return rendered[:, :, 0]

    def relative_motion(self, height: int, width: int) -> Tensor:
        """Returns the largest mean motion of R relative to T between two frames, as a share of the width, (C,)."""
        transmission, reflection = self.positions(height, width)
        offsets = (reflection - transmission).mean((2, 3)) * torch.tensor([0.5, 0.5 * height / width])
        return torch.cdist(offsets, offsets).amax((1, 2))

    def confidence(self, frames: Tensor) -> Tensor:
        """Returns how well the frames agree with their prediction at each pixel of the reference frame, (C, 1, h, w) in 0..1.

        The mean errors of the frames are collected on the canvas of T, in the opposite direction of the rendering.
        """
        height, width = frames.shape[-2:]
        count, frame_count = self.log_gains.shape[:2]
        rendered, gains = self.render(height, width)
        errors = data_errors(rendered.sum(0) * gains, frames).abs().mean(2)
        positions = self.positions(height, width)[0].reshape(count, frame_count * height, width, 2)
        canvas = torch.zeros(count, 2, height, width, requires_grad=True)
        with torch.enable_grad():
            sampled = functional.grid_sample(canvas, positions, align_corners=False)
            values = torch.stack([errors.flatten(1, 2), torch.ones_like(errors).flatten(1, 2)], 1)
            (collected,) = torch.autograd.grad((sampled * values).sum(), canvas)
        return torch.exp(-collected[:, :1] / (collected[:, 1:] + 1e-3) / _ERROR_AT_1_E)

    def _locked(self, motion: Tensor) -> Tensor:
        """Returns the homographies or splines, with those of T for the reflection of locked candidates."""
        is_locked = self.is_locked.reshape(-1, *[1] * (motion.ndim - 2))
        return torch.stack([motion[0], torch.where(is_locked, motion[0], motion[1])])

    def _moves(self) -> Tensor:
        """Returns (K, 1): 0 for the reference frame, whose motion is the identity and whose gain is 1, and 1 for others."""
        moves = torch.ones(self.log_gains.shape[1], 1)
        moves[self.reference] = 0
        return moves


@final
@dataclass(frozen=True)
class Rates:
    """The learning rates of an optimisation. 0 keeps the values."""

    layers: float = 0.012
    homographies: float = 0.003
    splines: float = 0.001
    log_gains: float = 0.003

    def scaled(self, factor: float) -> Rates:
        """Returns rates with slower motion: its unit is the frame, so that it must be finer for larger frames."""
        return Rates(self.layers, self.homographies * factor, self.splines * factor, self.log_gains)


def optimise(
    model: JointModel,
    frames: Tensor,
    prior: Tensor,
    steps: int,
    *,
    rates: Rates,
    weights: Weights,
    on_step: Callable[[], None] = lambda: None,
) -> JointModel:
    """Returns the model after some steps of Adam.

    Args:
        model: the start; its canvases fit the size of the frames.
        frames: (K, 3, h, w) linear light.
        prior: T of the reference frame from a single photo, (3, h, w).
        steps: the number of steps. The rates fall over the last 40 %; those of the motion rise during the first ten.
        rates: the learning rates.
        weights: the weights of the loss.
        on_step: called after each step.
    """
    parameters: dict[str, Any] = {
        name: getattr(model, name).detach().clone().requires_grad_(rate > 0)
        for name, rate in asdict(rates).items()
    }
    current = replace(model, **parameters)
    optimiser = torch.optim.Adam(
        [{"params": [parameters[name]], "lr": rate} for name, rate in asdict(rates).items() if rate],
        betas=(0.9, 0.99),
    )
    base_rates = [group["lr"] for group in optimiser.param_groups]
    size = max(1, _CHUNK_PIXELS // (len(model.is_locked) * frames[0, 0].numel()))
    chunks = [slice(first, first + size) for first in range(0, len(frames), size)]
    for step in range(steps):
        decay = min(1.0, 0.2 + 0.8 * (steps - step) / (0.4 * steps))
        for i, (group, rate) in enumerate(zip(optimiser.param_groups, base_rates, strict=True)):
            group["lr"] = rate * decay * (min(1.0, step / 10) if i else 1)
        optimiser.zero_grad()
        penalty = _penalties(current, frames, prior, weights)
        penalty.sum().backward()  # type: ignore[no-untyped-call]
        data_losses = torch.zeros_like(penalty)
        for chunk in chunks:
            data_loss = _data_loss(current, frames, chunk)
            data_loss.sum().backward()  # type: ignore[no-untyped-call]
            data_losses += data_loss.detach()
        optimiser.step()
        on_step()
    found = {name: parameter.detach() for name, parameter in parameters.items()}
    return replace(model, **found, losses=penalty.detach() + data_losses, data_losses=data_losses)


def _data_loss(model: JointModel, frames: Tensor, chunk: slice) -> Tensor:
    """Returns the part of the data term that comes from some of the frames, (C,)."""
    height, width = frames.shape[-2:]
    rendered, gains = model.render(height, width, chunk)
    errors = data_errors(rendered.sum(0) * gains, frames[chunk])
    return _smooth_root(errors.square()).sum((1, 2, 3, 4)) / frames.numel()


def _penalties(model: JointModel, frames: Tensor, prior: Tensor, weights: Weights) -> Tensor:
    """Returns the terms of the loss of each candidate that do not compare the frames with their prediction, (C,)."""
    terms = torch.zeros(len(model.is_locked))
    density = model.layers.shape[-1] / (frames.shape[-1] * (1 + 2 * MARGIN))
    for layer, weight in zip(model.layers, (_TRANSMISSION_GRADIENTS, _REFLECTION_GRADIENTS), strict=True):
        x, y = _differences(layer)
        # The length of the gradient, not the sum of its components, which favours edges along the axes
        lengths = _smooth_root(density**2 * (x[..., :-1, :].square() + y[..., :-1].square()))
        terms = terms + weight * lengths.mean((1, 2, 3))
    if weights.common_edges:
        terms = terms + weights.common_edges * _common_edges(*model.layers)
    transmission = model.reference_layers(*frames.shape[-2:])[0]
    low = _low_pass(_encode(transmission)) - _low_pass(_encode(prior))
    terms = terms + weights.prior * low.abs().mean((1, 2, 3))
    terms = terms + _GAIN_PENALTY * model.log_gains.square().mean((1, 2))
    for splines, rigidity in zip(model.splines, (1.0, _REFLECTION_RIGIDITY), strict=True):
        cost = _SPLINE_SIZE * splines.square().mean((1, 2, 3, 4))
        if min(splines.shape[-2:]) > 2:
            curvature = sum(
                d.diff(dim=axis).square().mean((1, 2, 3, 4))
                for axis, d in ((-1, splines.diff(dim=-1)), (-2, splines.diff(dim=-2)))
            )
            cost = cost + _SPLINE_CURVATURE * curvature
        terms = terms + rigidity * cost
    return terms


def data_errors(predicted: Tensor, frames: Tensor) -> Tensor:
    """Returns the differences of square roots of light. Where a frame is clipped, a brighter prediction is no error."""
    errors = _encode(predicted) - _encode(frames)
    return torch.where((frames > _CLIPPED) & (errors > 0), 0.0, errors)


def _smooth_root(squares: Tensor) -> Tensor:
    """Returns the root of a sum of squares, smooth at 0 (Charbonnier)."""
    return (squares + _CHARBONNIER_EPSILON**2).sqrt() - _CHARBONNIER_EPSILON


def pixel_grid(height: int, width: int) -> Tensor:
    """Returns the normalised coordinates (x, y) of the pixel centres, (h, w, 2)."""
    y, x = (((torch.arange(length) + 0.5) * 2 / length - 1) for length in (height, width))
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def _project(homographies: Tensor, grid: Tensor) -> Tensor:
    """Applies homographies (..., 8) to a grid (h, w, 2). Returns (..., h, w, 2)."""
    matrices = torch.cat([homographies, torch.ones_like(homographies[..., :1])], -1).reshape(
        *homographies.shape[:-1], 3, 3
    )
    points = torch.cat([grid, torch.ones_like(grid[..., :1])], -1).flatten(0, 1)
    projected = points @ matrices.transpose(-1, -2)
    points = projected[..., :2] / projected[..., 2:].clamp(min=_MIN_DENOMINATOR)
    return points.reshape(*homographies.shape[:-1], *grid.shape)


def _canvas_size(frames: Tensor, density: float) -> tuple[int, int]:
    height, width = (round(length * (1 + 2 * MARGIN) * density) for length in frames.shape[-2:])
    return height, width


def _resize(maps: Tensor, size: tuple[int, int], *, align_corners: bool) -> Tensor:
    """Returns maps (..., channels, h, w) at another size, by bicubic interpolation."""
    resized = functional.interpolate(
        maps.flatten(0, -4), size=size, mode="bicubic", align_corners=align_corners
    )
    return resized.reshape(*maps.shape[:-2], *size)


def _interpolation(length: int, knots: int) -> Tensor:
    """Returns the matrix (length, knots) of bicubic interpolation. Its products are faster than `interpolate`."""
    unit = torch.eye(knots)[None, None]
    return functional.interpolate(unit, size=(length, knots), mode="bicubic", align_corners=True)[0, 0]


def _encode(light: Tensor) -> Tensor:
    return (light + OFFSET).sqrt()


def _low_pass(images: Tensor) -> Tensor:
    return functional.avg_pool2d(images, 9, 4, 4)


def _differences(images: Tensor) -> tuple[Tensor, Tensor]:
    return images.diff(dim=-1), images.diff(dim=-2)


def _common_edges(transmission: Tensor, reflection: Tensor) -> Tensor:
    """Returns how much the edges of both layers (C, 3, H, W) coincide, at three scales (Zhang et al. 2018): (C,)."""
    total = torch.zeros(len(transmission))
    for _ in range(3):
        for pair in zip(_differences(transmission), _differences(reflection), strict=True):
            edges = [d.abs().mean(1) for d in pair]
            limited = [torch.tanh(e / (2 * e.detach().mean((1, 2), keepdim=True) + 1e-4)) for e in edges]
            total = total + (limited[0] * limited[1]).mean((1, 2)) / 6
        transmission, reflection = (functional.avg_pool2d(image, 2) for image in (transmission, reflection))
    return total
