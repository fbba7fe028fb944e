"""GGX microfacets: sampling of visible normals, Smith masking and the density of the samples.

Sources: Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces"; Heitz 2018, "Sampling the GGX
Distribution of Visible Normals". Vectors are (3, N) and of unit length. `wi` points from the surface back along the
incoming path, as i does in Walter et al. `alpha` is the GGX roughness.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from brewster.render.rays.vectors import dot, normalize


def sample_visible_normal(wi: Tensor, normal: Tensor, alpha: float, uniforms: Tensor) -> Tensor:
    """Returns random microfacet normals, (3, N), with the distribution of the facets visible from `wi` (Heitz 2018).

    `uniforms` are random numbers in [0, 1), (2, N).
    """
    x_axis, y_axis = _tangents(normal)
    # Stretch wi by alpha, which turns the rough surface into a hemisphere.
    x, y, z = dot(wi, x_axis) * alpha, dot(wi, y_axis) * alpha, dot(wi, normal)
    length = torch.sqrt(x**2 + y**2 + z**2)
    x, y, z = x / length, y / length, z / length
    sine = torch.sqrt((x**2 + y**2).clamp(min=1e-20))
    # Sample the projection of the hemisphere towards wi: a half disc joined to a half ellipse.
    radius, angle = uniforms[0].sqrt(), 2 * math.pi * uniforms[1]
    t1, t2 = radius * angle.cos(), radius * angle.sin()
    lift = (1 + z) / 2
    t2 = (1 - lift) * (1 - t1**2).clamp(min=0).sqrt() + lift * t2
    t3 = (1 - t1**2 - t2**2).clamp(min=0).sqrt()
    # Transform from the frame of wi to the frame of the surface, and undo the stretch.
    nx = -y / sine * t1 - x * z / sine * t2 + x * t3
    ny = x / sine * t1 - y * z / sine * t2 + y * t3
    nz = (sine * t2 + z * t3).clamp(min=1e-6)
    return normalize(x_axis * (alpha * nx) + y_axis * (alpha * ny) + normal * nz)


def smith_g1(cosine: Tensor, alpha: float) -> Tensor:
    """Returns Smith's masking function G1, the fraction of facets visible from a direction (Walter et al. 2007, eq. 34).

    `cosine` is the cosine of the angle between the direction and the surface normal, (N,). The result is (N,), too.
    """
    tangent_squared = (1 - cosine**2).clamp(min=0) / cosine.clamp(min=1e-4) ** 2
    return 2 / (1 + torch.sqrt(1 + alpha**2 * tangent_squared))


def vndf_over_cosine(wi: Tensor, normal: Tensor, facet: Tensor, alpha: float) -> Tensor:
    """Returns the density of `sample_visible_normal` at `facet`, divided by dot(wi, facet): D G1 / dot(wi, normal), (N,).

    D is the GGX distribution (Walter et al. 2007, eq. 33). The factor dot(wi, facet) is left out because the Jacobian
    of a reflection has it in its denominator.
    """
    cosine, facet_cosine = dot(wi, normal).clamp(min=1e-4), dot(facet, normal)
    ndf = alpha**2 / (math.pi * ((facet_cosine**2) * (alpha**2 - 1) + 1) ** 2)
    return torch.where(facet_cosine > 0, ndf * smith_g1(cosine, alpha) / cosine, 0.0)


def _tangents(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Returns two axes perpendicular to the unit normals, (3, 1) or (3, N)."""
    x_axis = normalize(torch.stack([normal[2], torch.zeros_like(normal[0]), -normal[0]]))
    return x_axis, torch.linalg.cross(normal, x_axis, dim=0)
