"""Rough or wedged panes: each order is traced from surface to surface, with one microfacet sample
per rough surface.

At each surface, every path is split into a reflected and a transmitted path, without a random
choice between them. In rough glass, rays whose weight has become small are continued at random
(Russian roulette, Arvo and Kirk 1990), because paths cannot be merged here as in `layered_glass`,
so their number would grow fast. A path that exits through a rough surface towards a map uses
multiple importance sampling (Veach 1997, chapter 9), because with microfacet samples alone, very
few rays hit a small sun, and the image is noisy.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from brewster.render.rays.emitters import Rays, SideEmitters
from brewster.render.rays.layered_glass import fresnel
from brewster.render.rays.sobol import SobolPoints
from brewster.render.rays.vectors import dot, normalize
from brewster.render.scene.glass import Glazing

_MIN_PATH_WEIGHT: Final = 1e-4
"""Paths with a smaller weight, averaged over all rays, are not traced further. Total reflection
keeps the weight of a few rays near 1, so these rays would be traced for a long time.
"""
_ROULETTE_WEIGHT: Final = 0.04
"""A ray with a smaller weight is continued with the probability weight / _ROULETTE_WEIGHT. Its
weight is then _ROULETTE_WEIGHT, so that the mean does not change. At normal incidence, glass
reflects about this fraction.
"""
_MAX_CONTINUED_SHARE: Final = 0.8
"""If a larger share of the rays would be continued, all are: their selection takes longer than
tracing the others.
"""
_MAX_DISTANCE_MM: Final = 1e7
_MIN_LIGHT_SAMPLING_WEIGHT: Final = 3e-3
"""Orders with a smaller weight, averaged over all rays, use microfacet samples only; their noise is
invisible.
"""


@dataclass(frozen=True)
class Surface:
    """One surface of a pane: its height on the z axis, the axes of its frame as rows, (3, 3), of
    which the last is its normal towards the camera, and its material.
    """

    height_mm: float
    axes: Tensor
    alpha: float
    refractive_index: float
    glass_is_below: bool
    absorption: Tensor
    """Absorption of the pane that the surface belongs to, per mm, (3, 1)."""


@dataclass(frozen=True)
class _PathState:
    """Rays on one order: origins, directions and weights for s- and p-polarised light, (3, N)
    each.
    """

    origin: Tensor
    direction: Tensor
    s: Tensor
    p: Tensor
    surface: int
    """The index of the next surface; -1 or the number of surfaces after the rays have left the
    glass.
    """
    is_downward: bool
    """Whether the rays go away from the camera."""
    reflections: int
    entered_last_pane: bool
    rays: Tensor
    """The indices of these rays among all rays that are traced, (N,)."""


@dataclass(frozen=True)
class ExitingLight:
    """The light of one order from one side, (3, N), the indices of its rays, (N,), and if T or R
    has it.
    """

    is_transmitted: bool
    in_truncated_layers: bool
    light: Tensor
    rays: Tensor


def surfaces(glass: Glazing, like: Tensor) -> list[Surface]:
    """Returns the surfaces of a glazing in the glass frame, from the nearest to the camera to the
    farthest, with the dtype and the device of `like`.
    """
    stack = []
    height_mm = 0.0
    for pane in glass.panes:
        absorption = like.new_tensor(pane.absorption_per_m)[:, None] / 1000
        for is_far in (False, True):
            wedge = torch.tensor(pane.wedge_deg if is_far else 0.0).deg2rad()
            sine = float(wedge.sin())
            cosine = float(wedge.cos())
            axes = like.new_tensor([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
            height_mm -= pane.thickness_mm if is_far else 0.0
            # Without refraction there is no scattering.
            alpha = pane.roughness if pane.refractive_index > 1 else 0.0
            stack.append(
                Surface(height_mm, axes, alpha, pane.refractive_index, not is_far, absorption)
            )
        height_mm -= glass.gap_mm
    return stack


def trace_orders(
    glass: Glazing, rays: Rays, behind: SideEmitters, front: SideEmitters, sobol: SobolPoints
) -> Iterator[ExitingLight]:
    """Traces the orders of the rays until no ray is left. Yields the light of each order that
    exits.
    """
    # Refraction scales radiance by the squared ratio of the refractive indices. These factors
    # cancel in air.
    stack = surfaces(glass, rays.direction)
    count = rays.direction.shape[1]
    ones = torch.ones_like(rays.direction)
    indices = torch.arange(count, device=rays.direction.device)
    # All orders of a side share their light samples.
    light_uniforms = {
        side: sobol.next_1d() for side in (behind, front) if side.envmap and glass.is_rough
    }
    pending = [_PathState(rays.origin, rays.direction, ones, ones, 0, True, 0, False, indices)]
    while pending:
        path = pending.pop()
        if glass.is_rough:
            path = _continue_at_random(path, sobol)
        for branch, interaction in _interact(path, stack, sobol):
            if 0 <= branch.surface < len(stack):
                if _mean_weight(branch, count) > _MIN_PATH_WEIGHT:
                    pending.append(branch)
                continue
            is_behind = branch.surface > 0
            emitters = behind if is_behind else front
            samples_light = (
                interaction.alpha and _mean_weight(branch, count) > _MIN_LIGHT_SAMPLING_WEIGHT
            )
            uniforms = (
                light_uniforms[emitters][branch.rays] if samples_light and emitters.envmap else None
            )
            light = _exit_radiance(branch, interaction, emitters, rays.relative_footprint, uniforms)
            in_truncated_layers = (
                branch.reflections == 0 if is_behind else not branch.entered_last_pane
            )
            yield ExitingLight(is_behind, in_truncated_layers, light, branch.rays)


def _mean_weight(path: _PathState, count: int) -> float:
    """Returns the mean weight over both polarisations and all `count` rays, which is 0 off the
    path.
    """
    # The weights of single rays are no measure: total reflection at a microfacet makes some of them
    # 0 or 1.
    return float((path.s + path.p).sum()) / (6 * count)


def _continue_at_random(path: _PathState, sobol: SobolPoints) -> _PathState:
    """Ends rays of small weight at random, and raises the weights of the others by the inverse of
    their probability.
    """
    weight = (path.s + path.p).mean(dim=0) / 2
    probability = (weight / _ROULETTE_WEIGHT).clamp(max=1)
    if probability.mean() > _MAX_CONTINUED_SHARE:
        return path
    kept = (sobol.next_1d(path.rays) < probability).nonzero()[:, 0]
    scale = 1 / probability[kept]
    return replace(
        path,
        origin=path.origin[:, kept],
        direction=path.direction[:, kept],
        s=path.s[:, kept] * scale,
        p=path.p[:, kept] * scale,
        rays=path.rays[kept],
    )


@dataclass(frozen=True)
class _SurfaceInteraction:
    """Rays at a surface that reflects or transmits them. Directions are unit vectors in the frame
    of `axes`.
    """

    axes: Tensor
    """The axes of the surface's frame, as rows, (3, 3). The last is the normal on the side of `wi`.
    """
    wi: Tensor
    """Directions back along the rays."""
    alpha: float
    index_in: float
    """Refractive index on the side of `wi`."""
    index_out: float
    reflects: bool
    before: _PathState
    """The path at the surface, with its weights before the interaction."""
    wo: Tensor
    """Directions of the rays after the interaction."""
    facet: Tensor
    """Normals of the microfacets that scatter `wi` into `wo`, (3, N) or (3, 1)."""
    cosine: Tensor
    """dot(wi, facet), (N,)."""


def _interact(
    path: _PathState, stack: list[Surface], sobol: SobolPoints
) -> Iterator[tuple[_PathState, _SurfaceInteraction]]:
    """Splits a path at its next surface. Yields the reflected path, then the transmitted path."""
    surface = stack[path.surface]
    in_glass = surface.glass_is_below != path.is_downward
    side = 1.0 if path.is_downward else -1.0
    axes = surface.axes * surface.axes.new_tensor([1, 1, side])[:, None]
    wi = -axes @ path.direction
    distance = (axes[2] @ path.origin - axes[2, 2] * surface.height_mm) / wi[2]
    # Paths of weight 0 may be parallel to the glass. Their distance must stay finite, because 0 *
    # inf gives NaN.
    distance = distance.nan_to_num(0, 0, 0).clamp(0, _MAX_DISTANCE_MM)
    point = torch.addcmul(path.origin, distance, path.direction)
    s = path.s
    p = path.p
    if in_glass:
        # Beer-Lambert law over the length of each ray.
        transmittance = torch.exp(-surface.absorption * distance)
        s = s * transmittance
        p = p * transmittance
    before = replace(path, origin=point, s=s, p=p)
    facet = (
        sample_visible_normal(wi, surface.alpha, sobol.next_2d(path.rays))
        if surface.alpha
        else wi.new_tensor([0, 0, 1])[:, None]
    )
    cosine = dot(wi, facet)
    index_in, index_out = (
        (surface.refractive_index, 1.0) if in_glass else (1.0, surface.refractive_index)
    )
    reflectances = _reflectances(cosine, index_in, index_out)
    for reflects in (True, False):
        wo = _scattered_direction(wi, facet, cosine, None if reflects else index_in / index_out)
        interaction = _SurfaceInteraction(
            axes, wi, surface.alpha, index_in, index_out, reflects, before, wo, facet, cosine
        )
        s_weight, p_weight = _facet_weights(interaction, cosine, reflectances, wo)
        is_downward = path.is_downward != reflects
        enters_last_pane = path.surface == len(stack) - 2 and path.is_downward and not reflects
        after = replace(
            before,
            direction=axes.T @ wo,
            s=s * s_weight,
            p=p * p_weight,
            surface=path.surface + (1 if is_downward else -1),
            is_downward=is_downward,
            reflections=path.reflections + reflects,
            entered_last_pane=path.entered_last_pane or enters_last_pane,
        )
        yield after, interaction


def _scattered_direction(wi: Tensor, facet: Tensor, cosine: Tensor, ratio: float | None) -> Tensor:
    """Returns the directions after reflection or refraction at microfacets (Walter et al. 2007, eq.
    39, 40). `ratio` is the refractive index on the side of `wi` divided by the other one; None for
    reflection.
    """
    if ratio is None:
        return 2 * cosine * facet - wi
    # Under total reflection the result is arbitrary, and its weight is 0.
    cosine_out = (1 - ratio**2 * (1 - cosine**2)).clamp(min=0).sqrt()
    return (ratio * cosine - cosine_out) * facet - ratio * wi


def _facet_weights(
    interaction: _SurfaceInteraction,
    cosine: Tensor,
    reflectances: tuple[Tensor, Tensor],
    wo: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns BSDF times cosine divided by density, for s- and p-polarised light, (N,) each. With
    visible normals and the separable Smith term, all but the Fresnel factor and G1(wo) cancels
    (Heitz 2018).
    """
    cosine_out = wo[2] if interaction.reflects else -wo[2]
    # Facets seen from behind have weight 0, and so do facets that scatter light to the wrong side
    # of the surface.
    valid = (cosine_out > 0) & (cosine > 0)
    visible = (
        smith_g1(cosine_out, interaction.alpha) * valid if interaction.alpha else valid.float()
    )
    s, p = ((r if interaction.reflects else 1 - r) * visible for r in reflectances)
    return s, p


def _reflectances(cosine: Tensor, index_in: float, index_out: float) -> tuple[Tensor, Tensor]:
    """Returns Fresnel reflectances for s- and p-polarised light from either side; 1 under total
    reflection.
    """
    if index_in <= index_out:
        return fresnel(cosine.clamp(1e-4, 1), index_out)
    # From inside, evaluate at the refracted angle in air, because both directions of a path have
    # the same reflectance.
    squared = 1 - index_in**2 * (1 - cosine**2)
    s, p = fresnel(squared.clamp(min=1e-8).sqrt(), index_in)
    return torch.where(squared <= 0, 1.0, s), torch.where(squared <= 0, 1.0, p)


def _exit_radiance(
    path: _PathState,
    interaction: _SurfaceInteraction,
    emitters: SideEmitters,
    relative_footprint: float,
    light_uniforms: Tensor | None,
) -> Tensor:
    """Returns the light of an order, (3, N), from a microfacet sample and, with random numbers
    (N,), a light sample. The balance heuristic weights them by their densities (Veach 1997, eq.
    9.8).
    """
    weight = (path.s + path.p) / 2
    rays = Rays(path.origin, path.direction, relative_footprint)
    if light_uniforms is None:
        return weight * emitters.radiance(rays)
    radiance, light_pdf = emitters.radiance_and_pdf(rays)
    facet_pdf = _scattering_pdf(interaction, interaction.facet, interaction.cosine, interaction.wo)
    light = weight * radiance * (facet_pdf / (facet_pdf + light_pdf).clamp(min=1e-20))
    direction, radiance, light_pdf = emitters.towards(
        emitters.sample_map(light_uniforms, relative_footprint), rays
    )
    wo = interaction.axes @ direction
    # The normals of the facets that scatter `wi` into `wo` (Walter et al. 2007, eq. 13 and 16)
    half = -(interaction.index_in * interaction.wi + interaction.index_out * wo)
    half = interaction.wi + wo if interaction.reflects else half
    facet = normalize(half) * torch.sign(half[2])
    cosine = dot(interaction.wi, facet)
    reflectances = _reflectances(cosine, interaction.index_in, interaction.index_out)
    s, p = _facet_weights(interaction, cosine, reflectances, wo)
    facet_pdf = _scattering_pdf(interaction, facet, cosine, wo)
    # The weights s and p are f cos / facet_pdf. The light sample needs f cos / light_pdf, times the
    # heuristic's light_pdf / (light_pdf + facet_pdf): light_pdf cancels.
    ratio = facet_pdf / (light_pdf + facet_pdf).clamp(min=1e-20)
    return light + (interaction.before.s * s + interaction.before.p * p) / 2 * ratio * radiance


def _scattering_pdf(
    interaction: _SurfaceInteraction, facet: Tensor, cosine: Tensor, wo: Tensor
) -> Tensor:
    """Returns the density of microfacet samples at `wo`, per steradian, (N,): that of the facet's
    normal times the Jacobian of the half vector (Walter et al. 2007, eq. 14 and 17). `cosine` is
    dot(wi, facet).
    """
    cosine_out = dot(wo, facet)
    normal_pdf = vndf_over_cosine(interaction.wi, facet, interaction.alpha)
    if interaction.reflects:
        # The Jacobian 1 / (4 cosine) cancels the cosine that `vndf_over_cosine` leaves out.
        pdf = normal_pdf / 4
        is_right_side = cosine_out > 0
    else:
        denominator = interaction.index_in * cosine + interaction.index_out * cosine_out
        jacobian = (
            interaction.index_out**2 * cosine_out.abs() / denominator.square().clamp(min=1e-12)
        )
        pdf = normal_pdf * cosine * jacobian
        is_right_side = cosine_out < 0
    return torch.where(is_right_side & (cosine > 0), pdf, 0.0)


# --- GGX microfacets: Walter et al. 2007, "Microfacet Models for Refraction through Rough
# Surfaces"; Heitz 2018, "Sampling the GGX Distribution of Visible Normals"; Dupuy and Benyoub 2023,
# "Sampling Visible GGX Normals with Spherical Caps". Vectors are (3, N), of unit length, in the
# frame of the surface: z is its normal on the side of `wi`, which points back along the incoming
# path, as i in Walter et al. `alpha` is the GGX roughness.


def sample_visible_normal(wi: Tensor, alpha: float, uniforms: Tensor) -> Tensor:
    """Returns random microfacet normals, (3, N), with the distribution of the facets visible from
    `wi` (Heitz 2018). `uniforms` are random numbers in [0, 1), (2, N).
    """
    # Stretch wi by alpha, which turns the rough surface into a hemisphere. The directions that a
    # mirror-like hemisphere reflects are uniform in a spherical cap (Dupuy and Benyoub 2023).
    stretched = normalize(torch.stack([alpha * wi[0], alpha * wi[1], wi[2]]))
    z = (1 - uniforms[0]) * (1 + stretched[2]) - stretched[2]
    radius = (1 - z**2).clamp(min=0).sqrt()
    angle = 2 * math.pi * uniforms[1]
    half = stretched + torch.stack([radius * angle.cos(), radius * angle.sin(), z])
    return normalize(torch.stack([alpha * half[0], alpha * half[1], half[2]]))


def smith_g1(cosine: Tensor, alpha: float) -> Tensor:
    """Returns Smith's masking function G1, the fraction of facets visible from a direction (Walter
    et al. 2007, eq. 34), (N,). `cosine` is that of the angle between the direction and the surface
    normal, (N,).
    """
    tangent_squared = (1 - cosine**2).clamp(min=0) / cosine.clamp(min=1e-4) ** 2
    return 2 / (1 + torch.sqrt(1 + alpha**2 * tangent_squared))


def vndf_over_cosine(wi: Tensor, facet: Tensor, alpha: float) -> Tensor:
    """Returns the density of `sample_visible_normal` at `facet`, divided by dot(wi, facet): D G1 /
    wi_z, (N,). D is the GGX distribution (Walter et al. 2007, eq. 33).
    """
    # Without the factor dot(wi, facet), because the Jacobian of a reflection has it in its
    # denominator.
    cosine = wi[2].clamp(min=1e-4)
    facet_cosine = facet[2]
    ndf = alpha**2 / (math.pi * ((facet_cosine**2) * (alpha**2 - 1) + 1) ** 2)
    return torch.where(facet_cosine > 0, ndf * smith_g1(cosine, alpha) / cosine, 0.0)
