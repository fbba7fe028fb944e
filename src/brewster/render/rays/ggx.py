"""Rough surfaces: GGX facets seen from a direction, their shadowing, and how densely they send light anywhere.

Sources: Walter et al. 2007 (microfacet refraction); Heitz 2018 (sampling visible normals). Vectors are (3, N).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from brewster.render.rays.vectors import dot, unit


def visible_facet(towards: Tensor, normal: Tensor, alpha: float, pair: Tensor) -> Tensor:
    """A facet's normal, (3, N), drawn as often as it is seen from unit `towards`; `pair` is uniform, (2, N)."""
    x_axis, y_axis = _tangents(normal)
    x, y, z = dot(towards, x_axis) * alpha, dot(towards, y_axis) * alpha, dot(towards, normal)
    length = torch.sqrt(x**2 + y**2 + z**2)
    x, y, z = x / length, y / length, z / length
    across = torch.sqrt((x**2 + y**2).clamp(min=1e-20))
    radius, angle = pair[0].sqrt(), 2 * math.pi * pair[1]
    one, two = radius * angle.cos(), radius * angle.sin()
    lift = (1 + z) / 2
    two = (1 - lift) * (1 - one**2).clamp(min=0).sqrt() + lift * two
    three = (1 - one**2 - two**2).clamp(min=0).sqrt()
    nx = -y / across * one - x * z / across * two + x * three
    ny = x / across * one - y * z / across * two + y * three
    nz = (across * two + z * three).clamp(min=1e-6)
    return unit(x_axis * (alpha * nx) + y_axis * (alpha * ny) + normal * nz)


def shadowing(cosine: Tensor, alpha: float) -> Tensor:
    """Smith's share of facets that are seen (or lit) from this cosine to the surface's normal."""
    tangent = (1 - cosine**2).clamp(min=0) / cosine.clamp(min=1e-4) ** 2
    return 2 / (1 + torch.sqrt(1 + alpha**2 * tangent))


def seen_density(towards: Tensor, normal: Tensor, facet: Tensor, alpha: float) -> Tensor:
    """How densely `visible_facet` draws this facet, over its cosine to `towards`: D G1 / cos, (N,)."""
    cosine, tilt = dot(towards, normal).clamp(min=1e-4), dot(facet, normal)
    spread = alpha**2 / (math.pi * ((tilt**2) * (alpha**2 - 1) + 1) ** 2)
    return torch.where(tilt > 0, spread * shadowing(cosine, alpha) / cosine, 0.0)


def _tangents(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two axes across unit normals (3, 1) or (3, N)."""
    x_axis = unit(torch.stack([normal[2], torch.zeros_like(normal[0]), -normal[0]]))
    return x_axis, torch.linalg.cross(normal, x_axis, dim=0)
