"""Random numbers of a training sample: a function of (seed, step, slot), so that a resumed run sees the same data."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor

from brewster.scene.values import Range


class SampleRng:
    """Random numbers that depend on (seed, step, slot) and on nothing else."""

    def __init__(self, seed: int, step: int, slot: int) -> None:
        self.generator = Generator().manual_seed((seed * 1_000_003 + step) * 1_009 + slot)

    def uniform(self, bounds: Range) -> float:
        """A number between the bounds."""
        low, high = bounds
        return low + (high - low) * torch.rand((), generator=self.generator).item()

    def log_uniform(self, bounds: Range) -> float:
        """A number between the bounds whose logarithm is uniform."""
        return math.exp(self.uniform((math.log(bounds[0]), math.log(bounds[1]))))

    def bernoulli(self, probability: float) -> bool:
        """True as often as `probability` says."""
        return self.uniform((0, 1)) < probability

    def randint(self, count: int) -> int:
        """A number from 0 up to, not including, `count`."""
        return int(torch.randint(count, (), generator=self.generator).item())

    def uniform_tensor(self, *shape: int) -> Tensor:
        """A tensor of numbers between 0 and 1."""
        return torch.rand(shape, generator=self.generator)

    def normal(self, *shape: int) -> Tensor:
        """A tensor of standard normal numbers."""
        return torch.randn(shape, generator=self.generator)
