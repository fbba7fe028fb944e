"""The pane renderer: every camera ray is split into its transmitted and reflected orders, with exact weights.

    sample = render(scene, Assets([Path("hdri")]), device="cuda")

Smooth parallel panes need no chance: at infinity all orders leave parallel and one look behind and one before the
glass is enough; near content is looked up once an order, each shifted along the glass. A lens over far content is
a convolution, since the light then depends on direction alone. Chance is left for lenses over near content and
for rough glass (`scatter`), with the same random numbers on every device.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from brewster.errors import RecipeError
from brewster.render.assets import Assets
from brewster.render.chance import Chance
from brewster.render.lens import blurred, margin_px
from brewster.render.lights import Device, Light
from brewster.render.sample import LAYERS, Sample
from brewster.render.scatter import follow
from brewster.render.stack import (
    Order,
    all_orders,
    fresnel,
    order_shares,
    orders,
    paper_orders,
    shift_per_traversal,
)
from brewster.scene.camera import axes
from brewster.scene.scene import Scene

_MOST_GRID = 4
_STRIP = 1 << 18  # rays worked on at once


@dataclass(frozen=True)
class Rays:
    """Camera rays in the glass's frame: origins and unit directions, (3, N) each, and the angle of a pixel's side."""

    origin: Tensor
    direction: Tensor
    footprint: float


@dataclass(frozen=True)
class _Room:
    """A scene made ready: its lights and camera in the glass's frame."""

    scene: Scene
    behind: Light
    front: Light
    origin: Tensor
    right: Tensor
    up: Tensor
    back: Tensor


def render(scene: Scene, assets: Assets, device: Device = "cpu") -> Sample:
    """The five pictures of a scene, (3, H, W) float32 linear light on `device` (paper: Data Generation).

    Raises:
        RecipeError: the glass is framed or curved, which only the tracer renders, or a file is missing.
        PhotoError: a file cannot be read or is no map.
    """
    if not scene.glass.is_flat:
        raise RecipeError(
            "the glass is framed or curved", "the pane renderer takes flat glass that fills the view", "use --renderer tracer"
        )
    room = _furnish(scene, assets, device)
    with torch.no_grad():
        if scene.glass.is_rough or scene.glass.is_wedged or _needs_chance(room):
            layers = _by_chance(room, device)
        else:
            layers = _without_chance(room)
    return Sample(scene, **dict(zip(LAYERS, layers, strict=True)))


def _furnish(scene: Scene, assets: Assets, device: Device) -> _Room:
    to_glass = torch.tensor(axes(scene.glass.heading_deg, scene.glass.pitch_deg), device=device)
    position = torch.tensor(scene.camera.position_mm, device=device)
    origin = to_glass @ (position - torch.tensor(scene.glass.position_mm, device=device))
    right, up, back = (to_glass @ axis for axis in torch.tensor(
        axes(scene.camera.heading_deg, scene.camera.pitch_deg), device=device))  # fmt: skip
    behind, front = (
        Light(side, assets, behind=side is scene.behind, to_world=to_glass.T, device=device)
        for side in (scene.behind, scene.front)
    )
    return _Room(scene, behind, front, origin, right, up, back)


def _needs_chance(room: _Room) -> bool:
    return room.scene.camera.aperture_mm > 0 and (room.behind.is_near or room.front.is_near)


def _without_chance(room: _Room) -> list[Tensor]:
    """A regular grid of rays in each pixel, fine enough for the light's detail; then the lens, if there is one."""
    camera = room.scene.camera
    margin = margin_px(camera)
    width, height = camera.width + 2 * margin, camera.height + 2 * margin
    grid = _grid(room)
    total = torch.zeros(5, 3, width * height, device=room.origin.device)
    for row in range(grid):
        for column in range(grid):
            place = (column + 0.5) / grid, (row + 0.5) / grid
            for rays, pixels in _pinhole(room, place, margin, camera.pixel_rad / grid):
                total[:, :, pixels] += torch.stack(_split(room, rays)) / grid**2
    return [blurred(layer.view(3, height, width), camera, margin) for layer in total]


def _grid(room: _Room) -> int:
    """Looks a pixel and direction, so that neighbouring looks are at most half a texel apart, or four."""
    finest = max(room.behind.texels_per_radian(), room.front.texels_per_radian())
    return min(max(1, math.ceil(2 * room.scene.camera.pixel_rad * finest)), _MOST_GRID)


def _pinhole(
    room: _Room, place: tuple[float, float], margin: int, footprint: float
) -> Iterator[tuple[Rays, slice]]:
    """Rays through one place in every pixel, in strips of rows; `margin` pixels more on every side."""
    camera = room.scene.camera
    width, height = camera.width + 2 * margin, camera.height + 2 * margin
    x = (torch.arange(width, device=room.origin.device) - margin + place[0]) / camera.width * 2 - 1
    y = (torch.arange(height, device=room.origin.device) - margin + place[1]) / camera.width * 2
    y = camera.height / camera.width - y
    rows = max(1, _STRIP // width)
    for top in range(0, height, rows):
        some = y[top : top + rows]
        across, upward = x.expand(len(some), -1).reshape(-1), some[:, None].expand(-1, width).reshape(-1)
        direction = _outer(room.right, across * camera.half_width) + _outer(room.up, upward * camera.half_width)
        direction = direction - room.back[:, None]
        origin = room.origin[:, None].expand(3, len(across))
        yield (
            Rays(origin, direction / direction.norm(dim=0), footprint),
            slice(top * width, top * width + len(across)),
        )


def _by_chance(room: _Room, device: Device) -> list[Tensor]:
    """`samples` random rays a pixel: over the pixel, the lens, and where the glass is rough, its facets."""
    scene, camera = room.scene, room.scene.camera
    chance = Chance(scene.seed, scene.index, camera.width * camera.height, scene.samples, device)
    total = torch.zeros(5, 3, camera.width * camera.height, device=room.origin.device)
    for number in range(scene.samples):
        chance.turn_to(number)
        rays = _through_lens(room, chance)
        exact = not (scene.glass.is_rough or scene.glass.is_wedged)
        total += torch.stack(_split(room, rays) if exact else _scattered(room, rays, chance))
    return list((total / scene.samples).view(5, 3, camera.height, camera.width))


def _through_lens(room: _Room, chance: Chance) -> Rays:
    """A ray a pixel, from anywhere on the lens through anywhere in the pixel's image at the focus (thin lens)."""
    camera = room.scene.camera
    pixel = torch.arange(camera.width * camera.height, device=room.origin.device)
    jitter = chance.pair()
    across = ((pixel % camera.width + jitter[0]) / camera.width * 2 - 1) * camera.half_width
    upward = (camera.height - (pixel // camera.width + jitter[1]) * 2) / camera.width * camera.half_width
    direction = _outer(room.right, across) + _outer(room.up, upward) - room.back[:, None]
    origin = room.origin[:, None].expand_as(direction)
    if camera.aperture_mm > 0:
        x, y = chance.disc() * (camera.aperture_mm / 2)
        lens = _outer(room.right, x) + _outer(room.up, y)
        origin, direction = origin + lens, direction - lens / camera.focus_mm
    return Rays(origin, direction / direction.norm(dim=0), _sample_footprint(room))


def _sample_footprint(room: _Room) -> float:
    """What one of many samples stands for: its part of the pixel and of the lens's circle of confusion."""
    camera, samples = room.scene.camera, room.scene.samples
    nearest = min(room.behind.distance_mm, room.front.distance_mm)
    spread = camera.aperture_mm * abs(1 / camera.focus_mm - 1 / nearest) if camera.aperture_mm else 0.0
    return (camera.pixel_rad + spread) / (2 * math.sqrt(samples))


def _outer(axis: Tensor, values: Tensor) -> Tensor:
    return axis[:, None] * values


def _split(room: _Room, rays: Rays) -> list[Tensor]:
    """I, T, B, R and MR along the rays, for smooth parallel panes: no chance, all orders."""
    glass = room.scene.glass
    cosine = -rays.direction[2]
    point, mirrored = _at_first_surface(rays)
    paper = room.scene.orders == "paper"
    whole = all_orders(glass, cosine)
    kept = paper_orders(glass, cosine) if paper else whole
    sides = []
    for light, origin, direction, far_whole, far_kept in (
        (room.behind, rays.origin, rays.direction, whole.transmitted, kept.transmitted),
        (room.front, point, mirrored, whole.reflected, kept.reflected),
    ):
        bare = light.along(origin, direction, rays.footprint)
        if light.is_near:
            every, mine = _near_orders(room, light, Rays(point, direction, rays.footprint))
        else:
            every, mine = far_whole * bare, far_kept * bare
        sides.append((every, mine, bare))
    (through, transmission, background), (back, reflection, mirror) = sides
    return [through + back, transmission, background, reflection, mirror]


def _near_orders(room: _Room, light: Light, leaving: Rays) -> tuple[Tensor, Tensor]:
    """One side's light through each order's own shift: of all orders, and of those that T or R keeps."""
    glass, direction = room.scene.glass, leaving.direction
    cosine = direction[2].abs()
    table = _table(room.scene)
    shifts = shift_per_traversal(glass, cosine)
    level = direction * direction.new_tensor([1, 1, 0])[:, None]
    ahead = level / level.norm(dim=0).clamp(min=1e-9)
    surface = leaving.origin.clone()
    surface[2] = -glass.depth_mm if light is room.behind else 0.0
    far = light.far(direction, leaving.footprint)
    every, mine = torch.zeros_like(direction), torch.zeros_like(direction)
    for order, share in zip(table, order_shares(glass, cosine, table), strict=True):
        if order.behind != (light is room.behind):
            continue
        shift = sum((n * s for n, s in zip(order.traversals, shifts, strict=True)), torch.zeros_like(cosine))
        seen, clear = light.near(surface + ahead * shift, direction, leaving.footprint)
        if far is not None and clear is not None:
            seen = seen + clear * far
        every += share * seen
        if room.scene.orders == "all" or order.in_paper:
            mine += share * seen
    return every, mine


def _table(scene: Scene) -> tuple[Order, ...]:
    """The scene's orders, as many as its steepest ray needs."""
    _, _, normal = axes(scene.glass.heading_deg, scene.glass.pitch_deg)
    steepest = min(
        -sum(a * b for a, b in zip(corner, normal, strict=True)) / math.hypot(*corner)
        for corner in scene.camera.corners()
    )
    cosine = torch.tensor(steepest)
    return orders(tuple(round(float(sum(fresnel(cosine, pane.index)) / 2), 3) for pane in scene.glass.panes))


def _scattered(room: _Room, rays: Rays, chance: Chance) -> list[Tensor]:
    """I, T, B, R and MR along the rays, for panes that are rough or wedged."""
    through, transmission, back, reflection = torch.zeros(4, *rays.direction.shape, device=rays.direction.device)
    lights = room.behind, room.front
    for part in follow(room.scene.glass, rays.origin, rays.direction, lights, rays.footprint, chance):
        kept = room.scene.orders == "all" or part.in_paper
        for whole, layer in ((through, transmission),) if part.behind else ((back, reflection),):
            whole += part.light
            layer += part.light * kept
    point, mirrored = _at_first_surface(rays)
    background = room.behind.along(rays.origin, rays.direction, rays.footprint)
    mirror = room.front.along(point, mirrored, rays.footprint)
    return [through + back, transmission, background, reflection, mirror]


def _at_first_surface(rays: Rays) -> tuple[Tensor, Tensor]:
    """Where rays meet the glass, and where a mirror there would send them."""
    point = rays.origin - rays.direction * (rays.origin[2] / rays.direction[2])
    return point, rays.direction * rays.direction.new_tensor([1, 1, -1])[:, None]
