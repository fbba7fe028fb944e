"""GGX microfacets: sampling of visible normals, Smith masking and the density of the samples.

Sources: Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces"; Heitz 2018, "Sampling the GGX
Distribution of Visible Normals"; Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps".

Vectors are (3, N) and of unit length, in the frame of the surface: the z axis is its normal on the side of `wi`. `wi`
points from the surface back along the incoming path, as i does in Walter et al. `alpha` is the GGX roughness.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from brewster.render.rays.vectors import normalize


def sample_visible_normal(wi: Tensor, alpha: float, uniforms: Tensor) -> Tensor:
    """Returns random microfacet normals, (3, N), with the distribution of the facets visible from `wi` (Heitz 2018).
    `uniforms` are random numbers in [0, 1), (2, N)."""
    # Stretch wi by alpha, which turns the rough surface into a hemisphere. The directions that a mirror-like
    # hemisphere reflects are uniform in a spherical cap (Dupuy and Benyoub 2023).
    stretched = normalize(torch.stack([alpha * wi[0], alpha * wi[1], wi[2]]))
    z = (1 - uniforms[0]) * (1 + stretched[2]) - stretched[2]
    radius, angle = (1 - z**2).clamp(min=0).sqrt(), 2 * math.pi * uniforms[1]
    half = stretched + torch.stack([radius * angle.cos(), radius * angle.sin(), z])
    return normalize(torch.stack([alpha * half[0], alpha * half[1], half[2]]))


def smith_g1(cosine: Tensor, alpha: float) -> Tensor:
    """Returns Smith's masking function G1, the fraction of facets visible from a direction (Walter et al.
    2007, eq. 34), (N,). `cosine` is that of the angle between the direction and the surface normal, (N,)."""
    tangent_squared = (1 - cosine**2).clamp(min=0) / cosine.clamp(min=1e-4) ** 2
    return 2 / (1 + torch.sqrt(1 + alpha**2 * tangent_squared))


def vndf_over_cosine(wi: Tensor, facet: Tensor, alpha: float) -> Tensor:
    """Returns the density of `sample_visible_normal` at `facet`, divided by dot(wi, facet): D G1 / wi_z, (N,).
    D is the GGX distribution (Walter et al. 2007, eq. 33)."""
    # Without the factor dot(wi, facet), because the Jacobian of a reflection has it in its denominator.
    cosine, facet_cosine = wi[2].clamp(min=1e-4), facet[2]
    ndf = alpha**2 / (math.pi * ((facet_cosine**2) * (alpha**2 - 1) + 1) ** 2)
    return torch.where(facet_cosine > 0, ndf * smith_g1(cosine, alpha) / cosine, 0.0)
