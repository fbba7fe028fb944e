"""Seeded random numbers of a training sample, so that a resumed run uses the same data."""

import math

import torch
from torch import Generator, Tensor

from brewster.base.settings import Range


class SampleRng:
    """A random number generator seeded with (seed, step, slot), the slot of the sample in the
    batch.

    Two samples have different numbers if their slots are in 0..1,008 and their steps in
    0..1,000,002.
    """

    def __init__(self, seed: int, step: int, slot: int) -> None:
        self.generator = Generator().manual_seed((seed * 1_000_003 + step) * 1_009 + slot)

    def uniform(self, bounds: Range) -> float:
        """Returns a uniform number between the bounds."""
        low, high = bounds
        return low + (high - low) * torch.rand((), generator=self.generator).item()

    def log_uniform(self, bounds: Range) -> float:
        """Returns a number between the bounds. Its logarithm is uniform."""
        return math.exp(self.uniform((math.log(bounds[0]), math.log(bounds[1]))))

    def bernoulli(self, probability: float) -> bool:
        """Returns True with this probability."""
        return self.uniform((0, 1)) < probability

    def randint(self, count: int) -> int:
        """Returns a uniform integer in 0..count - 1."""
        return int(torch.randint(count, (), generator=self.generator).item())

    def uniform_tensor(self, *shape: int) -> Tensor:
        """Returns a tensor of uniform numbers in 0..1."""
        return torch.rand(shape, generator=self.generator)

    def normal(self, *shape: int) -> Tensor:
        """Returns a tensor of standard normal numbers."""
        return torch.randn(shape, generator=self.generator)
