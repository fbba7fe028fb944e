"""The analytic renderer: every camera ray is split into its transmitted and reflected orders, with exact weights.

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

from brewster.environments.assets import Assets
from brewster.errors import RecipeError
from brewster.render.rays.defocus import blurred, margin_px
from brewster.render.rays.emitters import CameraView, Device, Rays, SideEmitters
from brewster.render.rays.layered_glass import (
    ReflectionOrder,
    all_orders,
    fresnel,
    ghost_distance_mm,
    order_shares,
    orders,
    paper_orders,
    shift_per_traversal,
)
from brewster.render.rays.rough_glass import follow
from brewster.render.rays.sobol import SobolPoints
from brewster.render.rays.vectors import unit
from brewster.render.sample import LAYERS, LightSample
from brewster.scene.camera import axes
from brewster.scene.camera import dot as inner
from brewster.scene.scene import Scene

_SAME_PX = 0.1  # orders that land closer together than this are looked up once
_STEEPEST_REFLECTANCE = (
    0.08  # what is fainter than FAINTEST at this is lumped; it falls on the side's last order
)
_STRIP = 1 << 15  # rays worked on at once on a CPU, so that they stay in its cache
_WIDE_STRIP = 1 << 20


@dataclass(frozen=True)
class _PreparedSide:
    """One side's light, and its orders in groups that land on the same place."""

    light: SideEmitters
    depth_mm: float
    groups: list[list[ReflectionOrder]]


@dataclass(frozen=True)
class _PreparedScene:
    """A scene made ready: its lights and camera in the glass's frame."""

    scene: Scene
    behind: _PreparedSide
    front: _PreparedSide
    origin: Tensor
    right: Tensor
    up: Tensor
    back: Tensor


def render(scene: Scene, assets: Assets, device: Device = "cpu") -> LightSample:
    """The five pictures of a scene, (3, H, W) float32 linear light on `device` (paper: Data Generation).

    Raises:
        RecipeError: the glass is framed or curved, which only the tracer renders, or a file is missing.
        PhotoError: a file cannot be read or is no map.
    """
    if not scene.glass.is_flat:
        raise RecipeError(
            "the glass is framed or curved",
            "the analytic renderer takes flat glass that fills the view",
            "use --renderer mitsuba",
        )
    room = _furnish(scene, assets, device)
    with torch.no_grad():
        layers = _by_chance(room, device) if _needs_chance(scene) else _without_chance(room)
    return LightSample(scene, **dict(zip(LAYERS, layers, strict=True)))


def ghost_distance_px(scene: Scene) -> float:
    """How far apart the first two mirror images of the near pane land in the view's middle; 0 for far content."""
    _, _, normal = axes(scene.glass.heading_deg, scene.glass.pitch_deg)
    _, _, back = axes(scene.camera.heading_deg, scene.camera.pitch_deg)
    incidence = math.degrees(math.acos(min(1.0, inner(back, normal))))
    away = scene.camera_above_glass_mm + scene.front.distance_mm
    return ghost_distance_mm(scene.glass.panes[0], incidence) / (scene.camera.pixel_rad * away)


def _furnish(scene: Scene, assets: Assets, device: Device) -> _PreparedScene:
    to_glass = torch.tensor(axes(scene.glass.heading_deg, scene.glass.pitch_deg), device=device)
    position = torch.tensor(scene.camera.position_mm, device=device)
    origin = to_glass @ (position - torch.tensor(scene.glass.position_mm, device=device))
    right, up, back = (to_glass @ axis for axis in torch.tensor(
        axes(scene.camera.heading_deg, scene.camera.pitch_deg), device=device))  # fmt: skip
    by_chance = _needs_chance(scene)
    view = CameraView(
        scene.camera_above_glass_mm,
        scene.camera.pixel_rad,
        scene.camera.aperture_mm if by_chance else 0.0,
        scene.camera.focus_mm,
    )
    behind, front = (
        _side(scene, assets, view, to_glass.T, behind=behind, device=device) for behind in (True, False)
    )
    return _PreparedScene(scene, behind, front, origin, right, up, back)


def _side(
    scene: Scene, assets: Assets, view: CameraView, to_world: Tensor, *, behind: bool, device: Device
) -> _PreparedSide:
    side = scene.behind if behind else scene.front
    light = SideEmitters(side, assets, view, behind=behind, to_world=to_world, device=device)
    return _PreparedSide(light, scene.glass.depth_mm if behind else 0.0, _groups(scene, light, behind=behind))


def _needs_chance(scene: Scene) -> bool:
    """Rough or wedged glass, and lenses over near content, whose blur is not the same everywhere."""
    is_near = math.isfinite(min(scene.behind.distance_mm, scene.front.distance_mm))
    return scene.glass.is_rough or scene.glass.is_wedged or (scene.camera.aperture_mm > 0 and is_near)


def _without_chance(room: _PreparedScene) -> list[Tensor]:
    """A regular grid of rays in each pixel, fine enough for the light's detail; then the lens, if there is one."""
    camera = room.scene.camera
    margin = margin_px(camera)
    width, height = camera.width + 2 * margin, camera.height + 2 * margin
    grid = _grid(room)
    total = torch.zeros(5, 3, width * height, device=room.origin.device)
    for row in range(grid):
        for column in range(grid):
            place = (column + 0.5) / grid, (row + 0.5) / grid
            for rays, pixels in _pinhole(room, place, margin, 1 / grid):
                total[:, :, pixels] += torch.stack(_split(room, rays)) / grid**2
    return [blurred(layer.view(3, height, width), camera, margin) for layer in total]


def _grid(room: _PreparedScene) -> int:
    """Looks a pixel and direction: a third of a texel apart, or as close as `samples` allows, and then filtered."""
    finest = max(side.light.texels_per_pixel() for side in (room.behind, room.front))
    return min(max(1, math.ceil(3 * finest)), math.isqrt(room.scene.samples))


def _pinhole(
    room: _PreparedScene, place: tuple[float, float], margin: int, share: float
) -> Iterator[tuple[Rays, slice]]:
    """Rays through one place in every pixel, in strips of rows; `margin` pixels more on every side."""
    camera = room.scene.camera
    width, height = camera.width + 2 * margin, camera.height + 2 * margin
    x = (torch.arange(width, device=room.origin.device) - margin + place[0]) / camera.width * 2 - 1
    y = (torch.arange(height, device=room.origin.device) - margin + place[1]) / camera.width * 2
    y = camera.height / camera.width - y
    rows = max(1, (_WIDE_STRIP if room.origin.is_cuda else _STRIP) // width)
    for top in range(0, height, rows):
        some = y[top : top + rows]
        across, upward = x.expand(len(some), -1).reshape(-1), some[:, None].expand(-1, width).reshape(-1)
        direction = _outer(room.right, across * camera.half_width) + _outer(
            room.up, upward * camera.half_width
        )
        direction = direction - room.back[:, None]
        origin = room.origin[:, None].expand(3, len(across))
        yield (
            Rays(origin, unit(direction), share),
            slice(top * width, top * width + len(across)),
        )


def _by_chance(room: _PreparedScene, device: Device) -> list[Tensor]:
    """`samples` random rays a pixel: over the pixel, the lens, and where the glass is rough, its facets."""
    scene, camera = room.scene, room.scene.camera
    count = camera.width * camera.height
    chance = SobolPoints(scene.seed, scene.index, count, scene.samples, device)
    split = _scattered if scene.glass.is_rough or scene.glass.is_wedged else _split
    total = torch.zeros(5, 3, count, device=room.origin.device)
    for start in range(0, count, _STRIP):
        pixels = slice(start, min(start + _STRIP, count))
        for number in range(scene.samples):
            chance.turn_to(number, pixels)
            total[:, :, pixels] += torch.stack(split(room, _through_lens(room, pixels, chance), chance))
    return list((total / scene.samples).view(5, 3, camera.height, camera.width))


def _through_lens(room: _PreparedScene, pixels: slice, chance: SobolPoints) -> Rays:
    """A ray for each of the pixels, from anywhere on the lens through anywhere in the pixel's image at the focus (thin lens)."""
    camera = room.scene.camera
    pixel = torch.arange(pixels.start, pixels.stop, device=room.origin.device)
    jitter = chance.pair()
    across = ((pixel % camera.width + jitter[0]) / camera.width * 2 - 1) * camera.half_width
    upward = (camera.height - (pixel // camera.width + jitter[1]) * 2) / camera.width * camera.half_width
    direction = _outer(room.right, across) + _outer(room.up, upward) - room.back[:, None]
    origin = room.origin[:, None].expand_as(direction)
    if camera.aperture_mm > 0:
        x, y = chance.disc() * (camera.aperture_mm / 2)
        lens = _outer(room.right, x) + _outer(room.up, y)
        origin, direction = origin + lens, direction - lens / camera.focus_mm
    return Rays(origin, unit(direction), 1 / (2 * math.sqrt(room.scene.samples)))


def _outer(axis: Tensor, values: Tensor) -> Tensor:
    return axis[:, None] * values


def _split(room: _PreparedScene, rays: Rays, _: SobolPoints | None = None) -> list[Tensor]:
    """I, T, B, R and MR along the rays, for smooth parallel panes: no chance, all orders."""
    glass = room.scene.glass
    point, mirrored = _at_first_surface(rays)
    cosine = mirrored[2]
    whole = all_orders(glass, cosine)
    kept = paper_orders(glass, cosine) if room.scene.orders == "paper" else whole
    layers = []
    for side, origin, direction, far_whole, far_kept in (
        (room.behind, rays.origin, rays.direction, whole.transmitted, kept.transmitted),
        (room.front, point, mirrored, whole.reflected, kept.reflected),
    ):
        far = side.light.far(direction, rays.share)
        bare = side.light.before(far, origin, direction, rays.share)
        if len(side.groups) > 1:
            every, mine = _shifted_orders(room, side, Rays(point, direction, rays.share), far)
        else:
            every = far_whole * bare
            mine = far_kept * bare if kept is not whole else every
        layers.append((every, mine, bare))
    (through, transmission, background), (back, reflection, mirror) = layers
    return [through + back, transmission, background, reflection, mirror]


def _shifted_orders(
    room: _PreparedScene, side: _PreparedSide, leaving: Rays, far: Tensor | None
) -> tuple[Tensor, Tensor]:
    """One side's light through each order's own shift: of all orders, and of those that T or R keeps."""
    glass, direction = room.scene.glass, leaving.direction
    cosine = direction[2].abs()
    shifts = shift_per_traversal(glass, cosine)
    ahead = unit(direction * direction.new_tensor([1, 1, 0])[:, None])
    surface = leaving.origin.clone()
    surface[2] = -side.depth_mm
    shares = iter(order_shares(glass, cosine, [order for group in side.groups for order in group]))
    every, kept = torch.zeros_like(direction), torch.zeros_like(direction)
    for group in side.groups:
        leaves = surface + ahead * _shift(group[0], shifts)
        seen = side.light.before(far, leaves, direction, leaving.share)
        mine = list(zip(group, shares, strict=False))
        every += sum((share for _, share in mine), torch.zeros_like(cosine)) * seen
        if room.scene.orders == "paper":
            kept += sum((share for order, share in mine if order.in_paper), torch.zeros_like(cosine)) * seen
    return every, every if room.scene.orders == "all" else kept


def _shift(order: ReflectionOrder, shifts: list[Tensor]) -> Tensor:
    return sum(
        (n * shift for n, shift in zip(order.traversals, shifts, strict=True)), torch.zeros_like(shifts[0])
    )


def _groups(scene: Scene, light: SideEmitters, *, behind: bool) -> list[list[ReflectionOrder]]:
    """The side's orders, brightest first, joined by those that land within a tenth of a pixel of them."""
    if not light.is_near:
        return []
    steepest = _steepest_cosine(scene)
    reflectances = (float(sum(fresnel(steepest, pane.index))) / 2 for pane in scene.glass.panes)
    table = orders(tuple(round(min(r, _STEEPEST_REFLECTANCE), 3) for r in reflectances))
    shifts = shift_per_traversal(scene.glass, steepest)
    pixel_mm = scene.camera.pixel_rad * (scene.camera_above_glass_mm + light.distance_mm)
    groups: list[tuple[float, list[ReflectionOrder]]] = []
    for order in table:
        if order.behind != behind:
            continue
        place = float(_shift(order, shifts) * steepest) / pixel_mm
        for first, group in groups:
            if abs(place - first) < _SAME_PX:
                group.append(order)
                break
        else:
            groups.append((place, [order]))
    return [group for _, group in groups]


def _steepest_cosine(scene: Scene) -> Tensor:
    _, _, normal = axes(scene.glass.heading_deg, scene.glass.pitch_deg)
    return torch.tensor(
        min(-inner(corner, normal) / math.hypot(*corner) for corner in scene.camera.corners())
    )


def _scattered(room: _PreparedScene, rays: Rays, chance: SobolPoints) -> list[Tensor]:
    """I, T, B, R and MR along the rays, for panes that are rough or wedged."""
    nothing = torch.zeros(2, *rays.direction.shape, device=rays.direction.device)
    sides = {True: nothing, False: nothing.clone()}
    for part in follow(room.scene.glass, rays, room.behind.light, room.front.light, chance):
        sides[part.behind][0] += part.light
        sides[part.behind][1] += part.light * (room.scene.orders == "all" or part.in_paper)
    (through, transmission), (back, reflection) = sides[True], sides[False]
    point, mirrored = _at_first_surface(rays)
    background = room.behind.light.along(rays.origin, rays.direction, rays.share)
    mirror = room.front.light.along(point, mirrored, rays.share)
    return [through + back, transmission, background, reflection, mirror]


def _at_first_surface(rays: Rays) -> tuple[Tensor, Tensor]:
    """Where rays meet the glass, and where a mirror there would send them."""
    point = rays.origin - rays.direction * (rays.origin[2] / rays.direction[2])
    return point, rays.direction * rays.direction.new_tensor([1, 1, -1])[:, None]
