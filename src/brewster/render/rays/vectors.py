"""Vectors in bulk: (3, N), one a column."""

from __future__ import annotations

from torch import Tensor


def dot(one: Tensor, other: Tensor) -> Tensor:
    """Inner products, (N,)."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def unit(vectors: Tensor) -> Tensor:
    """The same directions with length 1; zero stays zero."""
    return vectors * dot(vectors, vectors).clamp(min=1e-30).rsqrt()
