"""Quasi-random numbers for Monte Carlo rendering: well distributed in each pixel, and equal on
every device.

Every pair of dimensions is a 2-D Sobol' sequence with its own scrambling (Kollig and Keller 2002).
Each pixel adds a random shift modulo 1 (Cranley and Patterson 1976), so that neighbouring pixels
have uncorrelated noise. The numbers are drawn on the CPU, because torch's generators differ between
devices.
"""

import math

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine


class SobolPoints:
    """2-D points in [0, 1) for each pixel and sample. Each call of `next_2d` returns the next two
    dimensions.
    """

    def __init__(
        self, seed: int, index: int, pixel_count: int, sample_count: int, device: torch.device | str
    ) -> None:
        self._generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
        self._pixel_count = pixel_count
        self._sample_count = sample_count
        self._device = device
        self._sequences: list[tuple[Tensor, Tensor]] = []
        self.start_sample(0, slice(0, pixel_count))

    def start_sample(self, number: int, pixels: slice) -> None:
        """Selects sample `number`, from 0, of these pixels, and restarts at the first dimension."""
        self._sample = number
        self._pixels = pixels
        self._next = 0

    def next_1d(self, subset: Tensor | None = None) -> Tensor:
        """Returns the first coordinate of the next points, (n,); see `next_2d`."""
        return self.next_2d(subset, slice(1))[0]

    def next_2d(self, subset: Tensor | None = None, axes: slice = slice(None)) -> Tensor:
        """Returns the next point of each selected pixel, (2, n) in [0, 1), or only of those with
        indices `subset`.
        """
        if self._next == len(self._sequences):
            self._sequences.append(self._new_sequence())
        points, shift = self._sequences[self._next]
        self._next += 1
        shift = (
            shift[axes, self._pixels]
            if subset is None
            else shift[axes, self._pixels.start + subset]
        )
        shifted = points[self._sample, axes, None] + shift
        return shifted - shifted.floor()

    def next_disc(self) -> Tensor:
        """Returns a point on the unit disc for each selected pixel, (2, n), uniform by area."""
        # The concentric map (Shirley and Chiu 1997) maps close points of the square to close points
        # of the disc, which keeps the low discrepancy of the sequence.
        x, y = self.next_2d() * 2 - 1
        x_is_larger = x.abs() > y.abs()
        radius = torch.where(x_is_larger, x, y)
        ratio = torch.where(x_is_larger, y, x) / torch.where(radius == 0, 1, radius)
        angle = torch.where(x_is_larger, ratio * (math.pi / 4), math.pi / 2 - ratio * (math.pi / 4))
        return torch.stack([radius * angle.cos(), radius * angle.sin()])

    def _new_sequence(self) -> tuple[Tensor, Tensor]:
        scramble = int(torch.randint(2**31, (), generator=self._generator))
        points = SobolEngine(2, scramble=True, seed=scramble).draw(self._sample_count)  # type: ignore[no-untyped-call]
        # The random order prevents correlations: without it, sample i has similar points in all
        # pairs of dimensions.
        points = points[torch.randperm(self._sample_count, generator=self._generator)]
        shift = torch.rand(2, self._pixel_count, generator=self._generator)
        return points.to(self._device), shift.to(self._device)
