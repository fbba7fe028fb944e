"""Importance sampling of an environment map: directions are drawn with a density proportional to luminance.

Source: Pharr, Jakob and Humphreys, "Physically Based Rendering", section on image infinite lights. The probability of a
texel is proportional to its luminance times its solid angle, so most samples hit the sun even if it is small. Samples
are drawn by inverting the cumulative distribution.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from brewster.srgb import REC709_LUMINANCE

_MIN_WEIGHT = 1e-3
"""Added to each texel, as a fraction of the mean, because the density must be above 0 wherever a lookup may return
light."""
_MIN_COSINE = -0.05
"""Minimum cosine of the angle between a sampled direction and the normal of the glass. It is below 0 because rays
towards a dome do not start at the centre of the dome, so they can hit texels slightly beyond the glass plane."""


def direction_to_uv(direction: Tensor, u_offset: float) -> tuple[Tensor, Tensor]:
    """Returns the texture coordinates of unit directions (3, N) in a latitude-longitude map, (N,) each in 0..1.

    u = atan2(x, -z) / (2 pi) + u_offset, wrapped to 0..1; v = acos(y) / pi.
    """
    x, y, z = direction
    u = torch.atan2(x, -z) / (2 * math.pi) + u_offset
    return u - u.floor(), 0.5 - torch.asin(y.clamp(-1, 1)) / math.pi


class EnvmapDistribution:
    """A distribution of directions on one side of the glass, in proportion to the luminance of a map.

    `texels` is the map, (3, H, W). `outward` is the normal of the glass on that side, (3,). `u_offset` rotates the map.
    """

    def __init__(self, texels: Tensor, outward: Tensor, u_offset: float) -> None:
        _, height, width = texels.shape
        luminance = (texels * texels.new_tensor(REC709_LUMINANCE)[:, None, None]).sum(0)
        # Bilinear lookups spread a bright texel over its neighbours, so the density must be high there too.
        padded = functional.pad(luminance[None, None], (1, 1, 1, 1), mode="replicate")
        smoothed = functional.avg_pool2d(padded, 3, 1)[0, 0]
        self._polar = (torch.arange(height, device=texels.device) + 0.5) / height * math.pi
        solid_angle = self._polar.sin() * (math.pi / height) * (2 * math.pi / width)
        u = (torch.arange(width, device=texels.device) + 0.5) / width
        centres = uv_to_direction(u[None], self._polar[:, None] / math.pi, u_offset)
        is_outward = torch.tensordot(outward, centres, 1) > _MIN_COSINE
        weight = (smoothed + _MIN_WEIGHT * smoothed.mean() + 1e-12) * solid_angle[:, None] * is_outward
        # float64, because a float32 cumulative sum over a million texels loses the dark texels.
        probability = weight.double() / weight.double().sum()
        self._pdf = (probability / solid_angle[:, None]).float()
        self._cdf = probability.flatten().cumsum(0)

    def sample(self, uniforms: Tensor, u_offset: float) -> Tensor:
        """Returns unit directions (3, N) for random numbers in [0, 1), (2, N)."""
        height, width = self._pdf.shape
        target = uniforms[0].double() * self._cdf[-1]
        cell = torch.searchsorted(self._cdf, target, right=True).clamp(max=height * width - 1)
        low = torch.where(cell > 0, self._cdf[cell - 1], 0.0)
        inside = ((target - low) / (self._cdf[cell] - low)).float()
        u = (cell % width + inside.clamp(0, 1)) / width
        row = torch.div(cell, width, rounding_mode="floor")
        # Uniform in the cosine of the polar angle, so that directions are uniform in solid angle within the texel.
        top, bottom = (((row + edge) / height * math.pi).cos() for edge in (0, 1))
        v = torch.acos((top + (bottom - top) * uniforms[1]).clamp(-1, 1)) / math.pi
        return uv_to_direction(u, v, u_offset)

    def pdf(self, u: Tensor, v: Tensor) -> Tensor:
        """Returns the density of `sample` at texture coordinates, (N,) each in 0..1, per steradian: (N,)."""
        height, width = self._pdf.shape
        row, column = (v * height).long().clamp(0, height - 1), (u * width).long().clamp(0, width - 1)
        pdf: Tensor = self._pdf[row, column]
        return pdf


def uv_to_direction(u: Tensor, v: Tensor, u_offset: float) -> Tensor:
    """Returns unit directions (3, ...); the inverse of `direction_to_uv`."""
    azimuth, polar = (u - u_offset) * (2 * math.pi), v * math.pi
    sine = polar.sin()
    x, z = sine * azimuth.sin(), -sine * azimuth.cos()
    return torch.stack([x, polar.cos().expand_as(x), z])
