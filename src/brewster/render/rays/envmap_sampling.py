"""Drawing directions from a lat-long map as often as they are bright, so that the sun is found."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from brewster.srgb import REC709_LUMINANCE

_LEAST = 1e-3  # of the mean, so that no light is ever out of reach
_OVER_THE_EDGE = -0.05  # cosine: lights just behind the pane's plane may be seen from a dome's other points


def lat_long(direction: Tensor, turn: float) -> tuple[Tensor, Tensor]:
    """Where unit directions (3, N) lie in a map: u = atan2(x, -z) / 2 pi + turn, wrapped, and v = acos(y) / pi."""
    x, y, z = direction
    u = torch.atan2(x, -z) / (2 * math.pi) + turn
    return u - u.floor(), 0.5 - torch.asin(y.clamp(-1, 1)) / math.pi


class EnvmapDistribution:
    """A map's texels (3, H, W) as a distribution over directions, on the `outward` side alone."""

    def __init__(self, texels: Tensor, outward: Tensor, turn: float) -> None:
        _, height, width = texels.shape
        luminance = (texels * texels.new_tensor(REC709_LUMINANCE)[:, None, None]).sum(0)
        spread = functional.avg_pool2d(
            functional.pad(luminance[None, None], (1, 1, 1, 1), mode="replicate"), 3, 1
        )[0, 0]
        self._latitude = (torch.arange(height, device=texels.device) + 0.5) / height * math.pi
        solid_angle = self._latitude.sin() * (math.pi / height) * (2 * math.pi / width)
        u = (torch.arange(width, device=texels.device) + 0.5) / width
        facing = _direction(u[None], self._latitude[:, None] / math.pi, turn)
        allowed = torch.tensordot(outward, facing, 1) > _OVER_THE_EDGE
        weight = (spread + _LEAST * spread.mean() + 1e-12) * solid_angle[:, None] * allowed
        share = weight.double() / weight.double().sum()
        self._density = (share / solid_angle[:, None]).float()
        self._running = share.flatten().cumsum(0)

    def draw(self, pair: Tensor, turn: float) -> Tensor:
        """Unit directions (3, N) for uniform pairs (2, N)."""
        height, width = self._density.shape
        first = pair[0].double() * self._running[-1]
        cell = torch.searchsorted(self._running, first, right=True).clamp(max=height * width - 1)
        low = torch.where(cell > 0, self._running[cell - 1], 0.0)
        inside = ((first - low) / (self._running[cell] - low)).float()
        u = (cell % width + inside.clamp(0, 1)) / width
        row = torch.div(cell, width, rounding_mode="floor")
        top, bottom = (((row + edge) / height * math.pi).cos() for edge in (0, 1))
        v = torch.acos((top + (bottom - top) * pair[1]).clamp(-1, 1)) / math.pi
        return _direction(u, v, turn)

    def density(self, direction: Tensor, turn: float) -> Tensor:
        """How densely `draw` goes along unit directions (3, N), per solid angle: (N,)."""
        height, width = self._density.shape
        u, v = lat_long(direction, turn)
        row, column = (v * height).long().clamp(0, height - 1), (u * width).long().clamp(0, width - 1)
        density: Tensor = self._density[row, column]
        return density


def _direction(u: Tensor, v: Tensor, turn: float) -> Tensor:
    """The inverse of `lat_long`, (3, ...)."""
    heading, latitude = (u - turn) * (2 * math.pi), v * math.pi
    across = latitude.sin()
    x, z = across * heading.sin(), -across * heading.cos()
    return torch.stack([x, latitude.cos().expand_as(x), z])
