"""Rough or wedged panes: each order is followed surface by surface, at each rough surface through a random facet.

All orders of a ray are followed (no chance decides between reflection and transmission); where a path leaves
through a rough surface into light from a map, light drawn from the map joins in (multiple importance sampling,
Veach 1995), or a small sun would be noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from brewster.render.rays.emitters import Rays, SideEmitters
from brewster.render.rays.ggx import seen_density, shadowing, visible_facet
from brewster.render.rays.layered_glass import fresnel
from brewster.render.rays.sobol import SobolPoints
from brewster.render.rays.vectors import dot, unit
from brewster.scene.glass import Glazing

FAINTEST: Final = 1e-4
"""Orders whose rays carry less on average are not followed: rough glass has very many."""
_FARTHEST_MM: Final = 1e7
_WORTH_LIGHT: Final = 3e-3
"""Orders fainter than this are lit by chance alone."""


@dataclass(frozen=True)
class Surface:
    """One side of a pane: a point on its axis, its normal towards the camera, (3, 1), and what is below it."""

    height_mm: float
    normal: Tensor
    alpha: float
    index: float
    glass_is_below: bool
    absorption: Tensor
    """Of the pane it belongs to, per mm, (3, 1)."""


@dataclass(frozen=True)
class _PathState:
    """Rays on their way: where, whereto, and their weights (3, N) for s and p light."""

    origin: Tensor
    direction: Tensor
    s: Tensor
    p: Tensor
    surface: int
    down: bool
    reflections: int
    entered_last: bool


@dataclass(frozen=True)
class ExitingLight:
    """What one order brings from one side, (3, N)."""

    behind: bool
    in_paper: bool
    light: Tensor


def surfaces(glass: Glazing, like: Tensor) -> list[Surface]:
    """The glazing's surfaces from the camera on, in its own frame; a wedge turns a pane's far surface."""
    found, height = [], 0.0
    for pane in glass.panes:
        absorption = like.new_tensor(pane.absorption_per_m)[:, None] / 1000
        for far in (False, True):
            wedge = torch.tensor(pane.wedge_deg if far else 0.0).deg2rad()
            normal = like.new_tensor([wedge.sin(), 0, wedge.cos()])[:, None]
            height -= pane.thickness_mm if far else 0.0
            alpha = pane.roughness if pane.index > 1 else 0.0  # what does not bend light does not scatter it
            found.append(Surface(height, normal, alpha, pane.index, not far, absorption))
        height -= glass.gap_mm
    return found


def follow(
    glass: Glazing, rays: Rays, behind: SideEmitters, front: SideEmitters, chance: SobolPoints
) -> Iterator[ExitingLight]:
    """Every order of the rays until it is too faint, and what light it meets behind or in front."""
    stack = surfaces(glass, rays.direction)
    ones = torch.ones_like(rays.direction)
    waiting = [_PathState(rays.origin, rays.direction, ones, ones, 0, True, 0, False)]
    while waiting:
        path = waiting.pop()
        for following, meeting in _meet(path, stack, chance):
            if 0 <= following.surface < len(stack):
                if _remaining(following) > FAINTEST:
                    waiting.append(following)
                continue
            is_behind = following.surface > 0
            light = _arriving(following, meeting, behind if is_behind else front, rays.share, chance)
            in_paper = following.reflections == 0 if is_behind else not following.entered_last
            yield ExitingLight(is_behind, in_paper, light)


def _remaining(path: _PathState) -> float:
    """The mean weight of the rays: facets may turn some to where glass reflects all, so none is typical."""
    return float((path.s + path.p).mean()) / 2


@dataclass(frozen=True)
class _SurfaceInteraction:
    """A ray at a surface: what a light sample needs to know of it."""

    towards: Tensor
    normal: Tensor
    alpha: float
    index_here: float
    index_beyond: float
    reflects: bool
    before: _PathState
    """The path as it arrives, with the weights it has there."""


def _meet(
    path: _PathState, stack: list[Surface], chance: SobolPoints
) -> Iterator[tuple[_PathState, _SurfaceInteraction]]:
    """A path reflected and a path transmitted at the surface that it comes to."""
    surface = stack[path.surface]
    in_glass = surface.glass_is_below != path.down
    away = (_height(surface) - dot(surface.normal, path.origin)) / dot(surface.normal, path.direction)
    away = away.nan_to_num(0, 0, 0).clamp(0, _FARTHEST_MM)  # paths of no weight may run along the glass
    point = path.origin + away * path.direction
    left = torch.exp(-surface.absorption * away) if in_glass else torch.ones_like(surface.absorption)
    before = replace(path, origin=point, s=path.s * left, p=path.p * left)
    normal = surface.normal if path.down else -surface.normal
    towards = -path.direction
    facet = visible_facet(towards, normal, surface.alpha, chance.pair()) if surface.alpha else normal
    here, beyond = (surface.index, 1.0) if in_glass else (1.0, surface.index)
    for reflects in (True, False):
        meeting = _SurfaceInteraction(towards, normal, surface.alpha, here, beyond, reflects, before)
        direction = _turned(meeting, facet)
        shares = _shares(meeting, facet, direction)
        yield _onward(meeting, direction, shares, last=path.surface == len(stack) - 2), meeting


def _onward(
    meeting: _SurfaceInteraction, direction: Tensor, shares: tuple[Tensor, Tensor], *, last: bool
) -> _PathState:
    """The path that leaves a surface; `last` says that the surface is the last pane's first."""
    before, down = meeting.before, meeting.before.down != meeting.reflects
    return _PathState(
        before.origin,
        direction,
        before.s * shares[0],
        before.p * shares[1],
        before.surface + (1 if down else -1),
        down,
        before.reflections + meeting.reflects,
        before.entered_last or (last and before.down and not meeting.reflects),
    )


def _height(surface: Surface) -> Tensor:
    return surface.normal[2] * surface.height_mm


def _turned(meeting: _SurfaceInteraction, facet: Tensor) -> Tensor:
    """The direction after reflection or refraction at facets; where there is none (total reflection), any."""
    cosine = dot(meeting.towards, facet)
    if meeting.reflects:
        return 2 * cosine * facet - meeting.towards
    ratio = meeting.index_here / meeting.index_beyond
    beyond = (1 - ratio**2 * (1 - cosine**2)).clamp(min=0).sqrt()
    return (ratio * cosine - beyond) * facet - ratio * meeting.towards


def _shares(meeting: _SurfaceInteraction, facet: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of a drawn facet for s and p light: Fresnel's share, and the shadowing on the way out."""
    cosine = dot(meeting.towards, facet)
    reflected = _reflectances(cosine, meeting.index_here, meeting.index_beyond)
    leaving = dot(direction, meeting.normal) * (1 if meeting.reflects else -1)
    lit = (leaving > 0) & (cosine > 0)
    seen = shadowing(leaving, meeting.alpha) * lit if meeting.alpha else lit.float()
    s, p = ((r if meeting.reflects else 1 - r) * seen for r in reflected)
    return s, p


def _reflectances(cosine: Tensor, here: float, beyond: float) -> tuple[Tensor, Tensor]:
    """Fresnel's reflectances from either side, 1 where the reflection is total."""
    if here <= beyond:
        return fresnel(cosine.clamp(1e-4, 1), beyond)
    squared = 1 - here**2 * (1 - cosine**2)
    s, p = fresnel(squared.clamp(min=1e-8).sqrt(), here)
    return torch.where(squared <= 0, 1.0, s), torch.where(squared <= 0, 1.0, p)


def _arriving(
    path: _PathState, meeting: _SurfaceInteraction, light: SideEmitters, share: float, chance: SobolPoints
) -> Tensor:
    """The light that an order brings: along its own direction, joined by light drawn from the map."""
    weight = (path.s + path.p) / 2
    seen = light.along(path.origin, path.direction, share)
    if not (meeting.alpha and light.map and _remaining(path) > _WORTH_LIGHT):
        return weight * seen
    own = _density(meeting, path.direction)
    balance = own / (own + light.density(path.origin, path.direction)).clamp(min=1e-20)
    direction, density = light.draw(path.origin, chance.pair())
    facet = _half(meeting, direction)
    s, p = _shares(meeting, facet, direction)
    own = _density(meeting, direction)
    other = own / (density + own).clamp(min=1e-20)
    weight_drawn = (meeting.before.s * s + meeting.before.p * p) / 2 * other
    return weight * seen * balance + weight_drawn * light.along(path.origin, direction, share)


def _half(meeting: _SurfaceInteraction, direction: Tensor) -> Tensor:
    """The facet that sends light between the two directions."""
    if meeting.reflects:
        half = meeting.towards + direction
    else:
        half = -(meeting.index_here * meeting.towards + meeting.index_beyond * direction)
    half = unit(half)
    return half * torch.sign(dot(half, meeting.normal))


def _density(meeting: _SurfaceInteraction, direction: Tensor) -> Tensor:
    """How densely facets send light into `direction`, per solid angle, (N,)."""
    facet = _half(meeting, direction)
    cosine, leaving = dot(meeting.towards, facet), dot(direction, facet)
    seen = seen_density(meeting.towards, meeting.normal, facet, meeting.alpha)
    if meeting.reflects:
        density, right = seen / 4, leaving > 0
    else:
        span = meeting.index_here * cosine + meeting.index_beyond * leaving
        jacobian = meeting.index_beyond**2 * leaving.abs() / span.square().clamp(min=1e-12)
        density, right = seen * cosine * jacobian, leaving < 0
    return torch.where(right & (cosine > 0), density, 0.0)
