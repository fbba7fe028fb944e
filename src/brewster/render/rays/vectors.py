"""Arrays of 3-D vectors: (3, N), one vector per column."""

import torch
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Returns the inner products of two arrays of vectors, (N,)."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def normalize(vectors: Tensor) -> Tensor:
    """Returns the vectors scaled to length 1. Zero vectors stay zero."""
    return vectors * dot(vectors, vectors).clamp(min=1e-30).rsqrt()
