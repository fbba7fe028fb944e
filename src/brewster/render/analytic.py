"""The analytic renderer: each camera ray is split into transmission and reflection orders with
exact weights.

Smooth parallel panes need no Monte Carlo integration. All orders leave such a glazing in the same
direction, so light from infinity needs one lookup behind the glass and one in front of it. Near
content needs one lookup per group of orders, because each order shifts the ray along the glass by
its own distance. Defocus of light from infinity is a convolution, because that light depends on the
direction alone. Monte Carlo integration is used only for defocus of near content, for wedges and
for rough glass (`rough_glass`). Its random numbers are the same on every device.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from brewster.errors import RecipeError
from brewster.render.environments.assets import Assets
from brewster.render.rays.defocus import defocus_blur, margin_px
from brewster.render.rays.emitters import CameraView, Device, Rays, SideEmitters
from brewster.render.rays.layered_glass import (
    ReflectionOrder,
    enumerate_orders,
    fresnel,
    ghost_distance_mm,
    in_plane_shifts_mm,
    order_throughputs,
    total_throughput,
    truncated_throughput,
)
from brewster.render.rays.rough_glass import trace_orders
from brewster.render.rays.sobol import SobolPoints
from brewster.render.rays.vectors import normalize
from brewster.render.sample import LinearSample
from brewster.render.scene.camera import axes, dot
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import Side

_MERGE_DISTANCE_PX = 0.1  # orders whose images are closer than this share one lookup
_MAX_TABLE_REFLECTANCE = 0.08
"""Upper limit of the reflectance for which orders are enumerated. At grazing angles, the true
reflectance leads to too many orders. The throughput of each order is exact; the last order of a
side also gets the light of the others.
"""
_CPU_BATCH_RAYS = 1 << 15  # small enough for the cache of a CPU
_ROUGH_BATCH_RAYS = (
    1 << 18
)  # large, because most orders of rough glass have few of the rays of a batch
_GPU_BATCH_RAYS = 1 << 20


@dataclass(frozen=True)
class _PreparedSide:
    """One side of the glass: its emitters, the depth of the surface where light exits, and
    coinciding orders.
    """

    emitters: SideEmitters
    depth_mm: float
    groups: list[list[ReflectionOrder]]


@dataclass(frozen=True)
class _PreparedScene:
    """A scene with its emitters loaded, and the camera in the glass frame."""

    scene: Scene
    behind: _PreparedSide
    front: _PreparedSide
    origin: Tensor
    right: Tensor
    up: Tensor
    back: Tensor

    def directions(self, across: Tensor, upward: Tensor) -> Tensor:
        """Returns the directions (3, N) through points of the plane at distance 1, (N,) each. Not
        normalised.
        """
        return self.right[:, None] * across + self.up[:, None] * upward - self.back[:, None]


def render(scene: Scene, assets: Assets, device: Device = "cpu") -> LinearSample:
    """Renders the five images of a scene (the paper's section "Data Generation") in float32, on
    `device`. Raises RecipeError if the glass is framed or curved (only Mitsuba renders it), or a
    file is missing; PhotoError if a file cannot be decoded, or is not an environment map.
    """
    if not scene.glass.is_flat:
        raise RecipeError(
            "the glass is framed or curved",
            "the analytic renderer expected flat glass that fills the view",
            "use --renderer mitsuba",
        )
    prepared = _prepare(scene, assets, device)
    trace = _render_monte_carlo if needs_monte_carlo(scene) else _render_deterministic
    with torch.no_grad():
        return LinearSample(scene, *trace(prepared))


def ghost_distance_px(scene: Scene) -> float:
    """Returns the distance between the first two reflections of a point at the image centre, in px;
    0 at infinity.
    """
    _, _, normal = axes(scene.glass.heading_deg, scene.glass.pitch_deg)
    _, _, back = scene.camera.axes
    incidence = math.degrees(math.acos(min(1.0, dot(back, normal))))
    distance_mm = scene.camera_above_glass_mm + scene.front.distance_mm
    return ghost_distance_mm(scene.glass.panes[0], incidence) / (
        scene.camera.pixel_rad * distance_mm
    )


def _prepare(scene: Scene, assets: Assets, device: Device) -> _PreparedScene:
    to_glass = torch.tensor(axes(scene.glass.heading_deg, scene.glass.pitch_deg), device=device)
    position = torch.tensor(scene.camera.position_mm, device=device)
    origin = to_glass @ (position - torch.tensor(scene.glass.position_mm, device=device))
    right, up, back = (to_glass @ axis for axis in torch.tensor(scene.camera.axes, device=device))
    # Only lookups of Monte Carlo rays are filtered to the circle of confusion. The deterministic
    # renderer applies the blur later, as a convolution.
    view = CameraView(
        scene.camera_above_glass_mm,
        scene.camera.pixel_rad,
        scene.camera.aperture_mm if needs_monte_carlo(scene) else 0.0,
        scene.camera.focus_mm,
    )

    def prepare(side: Side, *, is_behind: bool) -> _PreparedSide:
        emitters = SideEmitters(
            side, assets, view, behind=is_behind, to_world=to_glass.T, device=device
        )
        groups = _group_orders(scene, emitters, is_behind=is_behind)
        return _PreparedSide(emitters, scene.glass.depth_mm if is_behind else 0.0, groups)

    sides = prepare(scene.behind, is_behind=True), prepare(scene.front, is_behind=False)
    return _PreparedScene(scene, *sides, origin, right, up, back)


def needs_monte_carlo(scene: Scene) -> bool:
    """Whether the glass is rough or wedged, or the defocus blur varies over the image because
    content is near.
    """
    is_near = math.isfinite(min(scene.behind.distance_mm, scene.front.distance_mm))
    return (
        scene.glass.is_rough or scene.glass.is_wedged or (scene.camera.aperture_mm > 0 and is_near)
    )


def _render_deterministic(prepared: _PreparedScene) -> list[Tensor]:
    """Traces a regular grid of rays in each pixel, then applies the defocus: I, T, B, R and MR, (3,
    H, W).
    """
    scene = prepared.scene
    camera = prepared.scene.camera
    margin = margin_px(camera)
    width, height = camera.width + 2 * margin, camera.height + 2 * margin
    finest = max(side.emitters.texels_per_pixel() for side in (prepared.behind, prepared.front))
    # Textures are filtered to the distance between the rays.
    rays_per_axis = min(max(1, math.ceil(3 * finest)), math.isqrt(scene.samples_per_pixel))
    total = torch.zeros(5, 3, width * height, device=prepared.origin.device)
    for row in range(rays_per_axis):
        for column in range(rays_per_axis):
            offset = (column + 0.5) / rays_per_axis, (row + 0.5) / rays_per_axis
            for rays, pixels in _pinhole_rays(prepared, offset, margin, 1 / rays_per_axis):
                total[:, :, pixels] += torch.stack(_trace_smooth(prepared, rays)) / rays_per_axis**2
    return [defocus_blur(layer.view(3, height, width), camera, margin) for layer in total]


def _pinhole_rays(
    prepared: _PreparedScene, offset: tuple[float, float], margin: int, relative_footprint: float
) -> Iterator[tuple[Rays, slice]]:
    """Yields rays through the point `offset` (0..1) of every pixel, in batches, and their range of
    pixels.
    """
    camera = prepared.scene.camera
    width, height = camera.width + 2 * margin, camera.height + 2 * margin
    x = (
        torch.arange(width, device=prepared.origin.device) - margin + offset[0]
    ) / camera.width * 2 - 1
    y = (
        (torch.arange(height, device=prepared.origin.device) - margin + offset[1])
        / camera.width
        * 2
    )
    y = camera.height / camera.width - y
    rows = max(1, (_GPU_BATCH_RAYS if prepared.origin.is_cuda else _CPU_BATCH_RAYS) // width)
    for top in range(0, height, rows):
        upward, across = (
            part.reshape(-1) for part in torch.meshgrid(y[top : top + rows], x, indexing="ij")
        )
        direction = prepared.directions(across * camera.half_width, upward * camera.half_width)
        rays = Rays(
            prepared.origin[:, None].expand_as(direction), normalize(direction), relative_footprint
        )
        yield rays, slice(top * width, top * width + len(across))


def _render_monte_carlo(prepared: _PreparedScene) -> list[Tensor]:
    """Traces `samples_per_pixel` random rays per pixel, over pixel, lens and microfacets: I, T, B,
    R, MR, (3, H, W).
    """
    scene = prepared.scene
    camera = prepared.scene.camera
    count = camera.width * camera.height
    sobol = SobolPoints(
        scene.seed, scene.index, count, scene.samples_per_pixel, prepared.origin.device
    )
    is_traced = scene.glass.is_rough or scene.glass.is_wedged
    trace, batch_rays = (
        (_trace_rough, _ROUGH_BATCH_RAYS) if is_traced else (_trace_smooth, _CPU_BATCH_RAYS)
    )
    total = torch.zeros(5, 3, count, device=prepared.origin.device)
    for start in range(0, count, batch_rays):
        pixels = slice(start, min(start + batch_rays, count))
        for sample in range(scene.samples_per_pixel):
            sobol.start_sample(sample, pixels)
            rays = _thin_lens_rays(prepared, pixels, sobol)
            total[:, :, pixels] += torch.stack(trace(prepared, rays, sobol))
    return list((total / scene.samples_per_pixel).view(5, 3, camera.height, camera.width))


def _thin_lens_rays(prepared: _PreparedScene, pixels: slice, sobol: SobolPoints) -> Rays:
    """Returns one ray per pixel, from a random point of the lens to a random point of the pixel in
    the focus plane.
    """
    camera = prepared.scene.camera
    pixel = torch.arange(pixels.start, pixels.stop, device=prepared.origin.device)
    jitter = sobol.next_2d()
    across = ((pixel % camera.width + jitter[0]) / camera.width * 2 - 1) * camera.half_width
    upward = (
        (camera.height - (pixel // camera.width + jitter[1]) * 2) / camera.width * camera.half_width
    )
    direction = prepared.directions(across, upward)
    origin = prepared.origin[:, None].expand_as(direction)
    if camera.aperture_mm > 0:
        x, y = sobol.next_disc() * (camera.aperture_mm / 2)
        lens = prepared.right[:, None] * x + prepared.up[:, None] * y
        origin = origin + lens
        direction = direction - lens / camera.focus_mm
    # The footprint is half the mean distance between the samples in a pixel. A full footprint blurs
    # too much, because the average over the samples is also a filter.
    return Rays(origin, normalize(direction), 1 / (2 * math.sqrt(prepared.scene.samples_per_pixel)))


def _trace_smooth(
    prepared: _PreparedScene, rays: Rays, _: SobolPoints | None = None
) -> list[Tensor]:
    """Returns I, T, B, R and MR along the rays, (3, N) each, for smooth parallel panes: all orders,
    no randomness.
    """
    glass = prepared.scene.glass
    mirrored = _mirror_at_first_surface(rays)
    s_share = _s_share(prepared, rays.direction)
    complete = in_layers = total_throughput(glass, mirrored.direction[2], s_share)
    if prepared.scene.orders == "truncated":
        in_layers = truncated_throughput(glass, mirrored.direction[2], s_share)
    layers = []
    for side, seen, total_ratio, layer_ratio in (
        (prepared.behind, rays, complete.transmittance, in_layers.transmittance),
        (prepared.front, mirrored, complete.reflectance, in_layers.reflectance),
    ):
        far = side.emitters.far_radiance(seen)
        unattenuated = side.emitters.add_near(far, seen)
        if len(side.groups) > 1:
            total, layer = _shifted_orders(
                prepared, side, replace(seen, origin=mirrored.origin), far, s_share
            )
        else:
            total = total_ratio * unattenuated
            layer = layer_ratio * unattenuated
        layers.append((total, layer, unattenuated))
    (transmitted, transmission, background), in_front = layers
    uncovered = _uncovered(prepared, rays.direction)
    reflected, reflection, mirror = (
        in_front if uncovered is None else (uncovered * light for light in in_front)
    )
    return [transmitted + reflected, transmission, background, reflection, mirror]


def _s_share(prepared: _PreparedScene, direction: Tensor) -> Tensor | None:
    """Returns the share of s-polarised light that the polariser of the camera passes along rays
    (3, N), (N,) in 0..1: the squared cosine of the angle between both directions (Malus's law).
    None without a polariser.
    """
    angle_deg = prepared.scene.camera.polariser_deg
    if angle_deg is None:
        return None
    angle = math.radians(angle_deg)
    axis = (prepared.right * math.cos(angle) + prepared.up * math.sin(angle))[:, None]
    axis = normalize(axis - (axis * direction).sum(0) * direction)
    normal = direction.new_tensor([0, 0, 1])[:, None].expand_as(direction)
    across = torch.linalg.cross(direction, normal, dim=0)
    # At normal incidence, s and p are the same
    share: Tensor = (axis * across).sum(0).square() / across.square().sum(0).clamp(min=1e-12)
    return share


def _uncovered(prepared: _PreparedScene, direction: Tensor) -> Tensor | None:
    """Returns the share of the mirrored light that the cloth lets pass along rays (3, N), (N,);
    None without a cloth.
    """
    cloth = prepared.scene.cloth
    if cloth is None:
        return None
    angle = math.radians(cloth.direction_deg)
    axis = prepared.right * math.cos(angle) + prepared.up * math.sin(angle)
    depth = -(prepared.back[:, None] * direction).sum(0) * prepared.scene.camera.half_width
    place = (axis[:, None] * direction).sum(0) / depth - cloth.centre
    inside = (cloth.width / 2 - place.abs()) / max(cloth.softness, 1e-6) + 0.5
    return 1 - (1 - cloth.transmittance) * inside.clamp(0, 1)


def _shifted_orders(
    prepared: _PreparedScene,
    side: _PreparedSide,
    exiting: Rays,
    far: Tensor | None,
    s_share: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Returns the light of all orders of a side with near content, and that of the orders in T or
    R, (3, N). `exiting` are the rays after the glass, from its first surface; `far` is their light
    from infinity.
    """
    glass = prepared.scene.glass
    direction = exiting.direction
    cosine = direction[2].abs()
    shifts = in_plane_shifts_mm(glass, cosine)
    in_plane = normalize(direction * direction.new_tensor([1, 1, 0])[:, None])
    surface = exiting.origin.clone()
    surface[2] = -side.depth_mm
    throughputs = iter(
        order_throughputs(
            glass, cosine, [order for group in side.groups for order in group], s_share
        )
    )
    total = torch.zeros_like(direction)
    layer = torch.zeros_like(direction)
    for group in side.groups:
        exit_point = surface + in_plane * _in_plane_shift(group[0], shifts)
        radiance = side.emitters.add_near(far, replace(exiting, origin=exit_point))
        weights = list(zip(group, throughputs, strict=False))
        total += sum((weight for _, weight in weights), torch.zeros_like(cosine)) * radiance
        if prepared.scene.orders == "truncated":
            in_layer = (weight for order, weight in weights if order.in_truncated_layers)
            layer += sum(in_layer, torch.zeros_like(cosine)) * radiance
    return total, total if prepared.scene.orders == "all" else layer


def _in_plane_shift(order: ReflectionOrder, shifts: list[Tensor]) -> Tensor:
    return sum(
        (n * x for n, x in zip(order.traversals, shifts, strict=True)), torch.zeros_like(shifts[0])
    )


def _group_orders(
    scene: Scene, emitters: SideEmitters, *, is_behind: bool
) -> list[list[ReflectionOrder]]:
    """Groups the orders of one side with images less than `_MERGE_DISTANCE_PX` apart, the brightest
    first.
    """
    if not emitters.has_dome and emitters.plane is None:  # all light is from infinity
        return []
    _, _, normal = axes(scene.glass.heading_deg, scene.glass.pitch_deg)
    # The images are farthest apart in the corner of the view with the largest angle of incidence.
    cosine = torch.tensor(min(-dot(c, normal) / math.hypot(*c) for c in scene.camera.corners()))
    reflectances = (
        float(sum(fresnel(cosine, pane.refractive_index))) / 2 for pane in scene.glass.panes
    )
    table = enumerate_orders(tuple(round(min(r, _MAX_TABLE_REFLECTANCE), 3) for r in reflectances))
    shifts = in_plane_shifts_mm(scene.glass, cosine)
    pixel_mm = scene.camera.pixel_rad * (scene.camera_above_glass_mm + emitters.distance_mm)
    groups: dict[float, list[ReflectionOrder]] = {}
    for order in (order for order in table if order.is_transmitted == is_behind):
        shift_px = float(_in_plane_shift(order, shifts) * cosine) / pixel_mm
        group_px = next((px for px in groups if abs(shift_px - px) < _MERGE_DISTANCE_PX), shift_px)
        groups.setdefault(group_px, []).append(order)
    return list(groups.values())


def _trace_rough(prepared: _PreparedScene, rays: Rays, sobol: SobolPoints) -> list[Tensor]:
    """Returns I, T, B, R and MR along the rays, (3, N) each, for panes that are rough or wedged."""
    zeros = torch.zeros(2, *rays.direction.shape, device=rays.direction.device)
    sides = {True: zeros, False: zeros.clone()}
    emitters = prepared.behind.emitters, prepared.front.emitters
    for exiting in trace_orders(prepared.scene.glass, rays, *emitters, sobol):
        complete, in_layer = sides[exiting.is_transmitted]
        complete.index_add_(1, exiting.rays, exiting.light)
        if prepared.scene.orders == "all" or exiting.in_truncated_layers:
            in_layer.index_add_(1, exiting.rays, exiting.light)
    (transmitted, transmission), (reflected, reflection) = sides[True], sides[False]
    background = prepared.behind.emitters.radiance(rays)
    mirror = prepared.front.emitters.radiance(_mirror_at_first_surface(rays))
    return [transmitted + reflected, transmission, background, reflection, mirror]


def _mirror_at_first_surface(rays: Rays) -> Rays:
    point = rays.origin - rays.direction * (rays.origin[2] / rays.direction[2])
    return replace(
        rays,
        origin=point,
        direction=rays.direction * rays.direction.new_tensor([1, 1, -1])[:, None],
    )
