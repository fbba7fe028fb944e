"""Random numbers for a renderer: low-discrepancy, different in every pixel, the same on every device.

Each pair of numbers is a Sobol' point of its own scramble for each sample, turned by a random shift a pixel
(Cranley-Patterson), so that samples of one pixel spread evenly and neighbouring pixels do not repeat each other.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine


class SobolPoints:
    """Pairs of numbers in 0..1 for N pixels; in each sample, the same sequence of questions gets fresh answers."""

    def __init__(self, seed: int, index: int, pixels: int, samples: int, device: torch.device | str) -> None:
        self._generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
        self._pixels, self._samples, self._device = pixels, samples, device
        self._pairs: list[tuple[Tensor, Tensor]] = []
        self.turn_to(0, slice(0, pixels))

    def turn_to(self, number: int, pixels: slice) -> None:
        """Starts the sample of this number, 0 up to `samples`, for some of the pixels."""
        self._number, self._some, self._asked = number, pixels, 0

    def pair(self) -> Tensor:
        """Two numbers for each of the pixels, (2, n) in 0..1."""
        if self._asked == len(self._pairs):
            self._pairs.append(self._fresh())
        points, shift = self._pairs[self._asked]
        self._asked += 1
        turned = points[self._number][:, None] + shift[:, self._some]
        return turned - turned.floor()

    def disc(self) -> Tensor:
        """A point on the unit disc for each of the pixels, (2, n), uniform by area (Shirley and Chiu 1997)."""
        x, y = self.pair() * 2 - 1
        wide = x.abs() > y.abs()
        radius = torch.where(wide, x, y)
        ratio = torch.where(wide, y, x) / torch.where(radius == 0, 1, radius)
        angle = torch.where(wide, ratio * (math.pi / 4), math.pi / 2 - ratio * (math.pi / 4))
        return torch.stack([radius * angle.cos(), radius * angle.sin()])

    def _fresh(self) -> tuple[Tensor, Tensor]:
        scramble = int(torch.randint(2**31, (), generator=self._generator))
        points = SobolEngine(2, scramble=True, seed=scramble).draw(self._samples)  # type: ignore[no-untyped-call]
        points = points[torch.randperm(self._samples, generator=self._generator)]  # or pairs would go in step
        shift = torch.rand(2, self._pixels, generator=self._generator)
        return points.to(self._device), shift.to(self._device)
