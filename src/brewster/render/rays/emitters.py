"""The light on one side of the glass, evaluated along rays and filtered to their footprint.

Geometry is in the glass frame, in millimetres: the first surface is z = 0, the camera is at z > 0.
Vectors are (3, N). Light from a map at infinity depends on the direction alone; light from a dome
(a map at a finite radius) or a plane depends on the whole ray. The footprint of a ray is the part
of a pixel and of its circle of confusion that the ray represents. Textures are filtered to that
size before the lookup.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional
from torch.quasirandom import SobolEngine

from brewster.photo.srgb import REC709_LUMINANCE
from brewster.render.environments.assets import Assets
from brewster.render.rays.vectors import dot
from brewster.render.scene.camera import axes
from brewster.render.scene.world import Plane, Side

Device = torch.device | str

_MAX_TEXELS_PER_LOOKUP = 1.2
"""A lookup with a larger footprint uses a coarser mipmap level. With a higher limit, a sun of one
texel flickers.
"""
_LIGHT_TABLE_SIZE = 1 << 16
"""The number of points of a map from which `SideEmitters.sample_map` chooses."""


class MipmappedTexture:
    """An image (H, W, 3) with mipmap levels and bilinear lookup; a latitude-longitude map wraps
    around.
    """

    def __init__(self, texels: Tensor, *, wraps: bool) -> None:
        self.width = texels.shape[1]
        self.wraps = wraps
        self.texels = texels.permute(2, 0, 1)
        self._levels = [self.texels[None]]
        while min(self._levels[-1].shape[2:]) > 8:
            self._levels.append(functional.avg_pool2d(self._levels[-1], 2))
        self._padded: dict[int, Tensor] = {}

    def __call__(self, u: Tensor, v: Tensor, footprint: float) -> Tensor:
        """Returns values (3, N) at texture coordinates u and v, (N,) in 0..1, for a footprint in
        texels.
        """
        level = min(
            math.ceil(math.log2(max(footprint / _MAX_TEXELS_PER_LOOKUP, 1.0))),
            len(self._levels) - 1,
        )
        texels = self._levels[level]
        if self.wraps:  # each side has an additional column from the opposite side
            u = (u * texels.shape[3] + 1) / (texels.shape[3] + 2)
            if level not in self._padded:
                self._padded[level] = functional.pad(texels, (1, 1, 0, 0), mode="circular")
            texels = self._padded[level]
        grid = torch.stack([u, v], dim=-1)[None, None] * 2 - 1
        return functional.grid_sample(
            texels, grid, mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0]


@dataclass(frozen=True)
class _PlaneEmitter:
    """A textured rectangle in the glass frame: its centre in mm, its unit axes and half the length
    of its sides.
    """

    texture: MipmappedTexture
    centre: Tensor
    right: Tensor
    up: Tensor
    half_width_mm: float
    half_height_mm: float


@dataclass(frozen=True)
class Rays:
    """Rays with origins and unit directions, (3, N) each, and the width of each ray's footprint,
    relative to the footprint of a whole pixel (the pixel plus its circle of confusion).
    """

    origin: Tensor
    direction: Tensor
    relative_footprint: float


@dataclass(frozen=True)
class LightSamples:
    """Random points of a map, as unit directions from its centre in the glass frame, (3, N); the
    light there, (3, N); and the density of the points per steradian at the centre, (N,).
    """

    point: Tensor
    radiance: Tensor
    pdf: Tensor


@dataclass(frozen=True)
class CameraView:
    """What determines the footprint of a pixel: height above the glass, angle of a pixel, and thin
    lens.
    """

    height_mm: float
    pixel_rad: float
    aperture_mm: float
    focus_mm: float

    def footprint_mm(self, distance_mm: float) -> float:
        """Returns the width of a pixel plus its circle of confusion, in mm, at a distance from the
        glass.
        """
        from_camera_mm = self.height_mm + distance_mm
        return self.pixel_rad * from_camera_mm + self.aperture_mm * abs(
            1 - from_camera_mm / self.focus_mm
        )


class SideEmitters:
    """The light sources of one side: an environment map or dome, and a plane in front of it; both
    are optional.

    `to_world` is the rotation matrix (3, 3) from the glass frame to the world. In all methods,
    `relative_footprint` is the width of a ray's footprint, relative to the footprint of a whole
    pixel; see `Rays`.
    """

    def __init__(
        self,
        side: Side,
        assets: Assets,
        view: CameraView,
        *,
        behind: bool,
        to_world: Tensor,
        device: Device,
    ) -> None:
        self._view = view
        self._is_behind = behind
        self._to_world = to_world
        self._light_table: LightSamples | None = None
        self.envmap = None
        self.radius_mm = math.inf
        self._u_offset = 0.0
        if side.map:
            radiance = torch.from_numpy(assets.map_radiance(side.map)).to(device)
            self.envmap = MipmappedTexture(radiance, wraps=True)
            self.radius_mm = side.map.radius_mm
            self._u_offset = -side.map.heading_deg / 360
        self.plane = _plane_emitter(side.plane, assets, behind, device) if side.plane else None
        self.plane_distance_mm = side.plane.distance_mm if side.plane else math.inf
        self.distance_mm = side.distance_mm
        self.has_dome = math.isfinite(
            self.radius_mm
        )  # a map at a finite radius, which causes parallax

    def texels_per_pixel(self) -> float:
        """Returns the footprint of a whole pixel in texels of the map or of the plane, whichever is
        larger.
        """
        return max(self._map_footprint(1.0), self._plane_footprint(1.0))

    def _map_footprint(self, relative_footprint: float) -> float:
        """Converts a footprint that is relative to a whole pixel's to texels of the map."""
        if self.envmap is None:
            return 0.0
        view = self._view
        angle = view.pixel_rad + view.aperture_mm / view.focus_mm
        if self.has_dome:
            angle = view.footprint_mm(self.radius_mm) / self.radius_mm
        return relative_footprint * angle * self.envmap.width / (2 * math.pi)

    def _plane_footprint(self, relative_footprint: float) -> float:
        """Converts a footprint that is relative to a whole pixel's to texels of the plane's
        image.
        """
        if self.plane is None:
            return 0.0
        width_mm = self._view.footprint_mm(self.plane_distance_mm)
        return (
            relative_footprint
            * width_mm
            * self.plane.texture.width
            / (2 * self.plane.half_width_mm)
        )

    def far_radiance(self, rays: Rays) -> Tensor | None:
        """Returns light from infinity along rays: (3, N), or None if this side has no such
        light.
        """
        if self.envmap is None or self.has_dome:
            return None
        return self._lookup_map(rays.direction, rays.relative_footprint)[0]

    def radiance(self, rays: Rays) -> Tensor:
        """Returns all light along rays: (3, N)."""
        return self.add_near(self.far_radiance(rays), rays)

    def add_near(self, far: Tensor | None, rays: Rays) -> Tensor:
        """Adds the light of the dome and the plane along rays to `far`, the result of
        `far_radiance`: (3, N). Rays with the same directions need only one call of `far_radiance`.
        """
        if self.has_dome:
            far, _ = self._lookup_map(self._intersect_dome(rays)[0], rays.relative_footprint)
        return self._add_plane(torch.zeros_like(rays.direction) if far is None else far, rays)

    def _lookup_map(
        self, direction: Tensor, relative_footprint: float
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Returns the light of the map in unit directions (3, N) from its centre: (3, N), and their
        u and v, (N,).
        """
        assert self.envmap is not None
        u, v = direction_to_uv(self._to_world @ direction, self._u_offset)
        return self.envmap(u, v, self._map_footprint(relative_footprint)), (u, v)

    def sample_map(self, uniforms: Tensor, relative_footprint: float) -> LightSamples:
        """Draws points of the map with a density proportional to its luminance, for `towards`.
        `uniforms` are random numbers in [0, 1), (N,). `relative_footprint` must be the same in all
        calls.
        """
        # From a table of stratified points: to invert the distribution for each ray takes several
        # times longer.
        if self._light_table is None:
            self._light_table = self._tabulate_light(relative_footprint)
        table = self._light_table
        indices = (uniforms * _LIGHT_TABLE_SIZE).long()
        return LightSamples(table.point[:, indices], table.radiance[:, indices], table.pdf[indices])

    def _tabulate_light(self, relative_footprint: float) -> LightSamples:
        """Returns _LIGHT_TABLE_SIZE points of the map, in the order of its texels."""
        engine = SobolEngine(2, scramble=True, seed=0)  # type: ignore[no-untyped-call]
        points = engine.draw(_LIGHT_TABLE_SIZE).to(self._to_world.device)
        points = points[points[:, 0].argsort()].T
        direction = self._distribution.sample(points, self._u_offset)
        u, v = direction_to_uv(direction, self._u_offset)
        assert self.envmap is not None
        radiance = self.envmap(u, v, self._map_footprint(relative_footprint))
        return LightSamples(self._to_world.T @ direction, radiance, self._distribution.pdf(u, v))

    def towards(self, samples: LightSamples, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the unit directions (3, N) from the origins of `rays` to points of the map, the
        light from there (3, N), and the densities of the directions per steradian (N,).
        """
        direction = samples.point
        pdf = samples.pdf
        if self.has_dome:
            offset = samples.point * self.radius_mm - rays.origin
            distance = torch.sqrt(dot(offset, offset))
            direction = offset / distance
            pdf = pdf * self._dome_density_ratio(samples.point, direction, distance)
        light = self._add_plane(samples.radiance, replace(rays, direction=direction))
        return direction, light, pdf

    def radiance_and_pdf(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Returns all light along rays, (3, N), and the density of `towards` there, per steradian:
        (N,).
        """
        point = rays.direction
        if self.has_dome:
            point, distance = self._intersect_dome(rays)
        light, uv = self._lookup_map(point, rays.relative_footprint)
        pdf = self._distribution.pdf(*uv)
        if self.has_dome:
            pdf = pdf * self._dome_density_ratio(point, rays.direction, distance)
        return self._add_plane(light, rays), pdf

    def _dome_density_ratio(self, point: Tensor, direction: Tensor, distance: Tensor) -> Tensor:
        """Returns the density per steradian at a ray's origin divided by that at the dome's centre,
        (N,).
        """
        # An area A of the dome has the solid angle A / r^2 at the centre, A cos / distance^2 at the
        # origin.
        return (distance / self.radius_mm) ** 2 / dot(point, direction).clamp(min=1e-6)

    def _intersect_dome(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Returns unit directions (3, N) from the dome's centre to the intersections of rays, and
        distances along them in mm.
        """
        along = dot(rays.origin, rays.direction)
        squared = along**2 - dot(rays.origin, rays.origin) + self.radius_mm**2
        distance = torch.sqrt(squared.clamp(min=0)) - along
        return (rays.origin + distance * rays.direction) / self.radius_mm, distance

    @cached_property
    def _distribution(self) -> EnvmapDistribution:
        """The distribution of the map's light on this side of the glass."""
        assert self.envmap is not None
        outward = self._to_world @ self._to_world.new_tensor([0, 0, -1 if self._is_behind else 1])
        return EnvmapDistribution(self.envmap.texels, outward, self._u_offset)

    def _add_plane(self, light: Tensor, rays: Rays) -> Tensor:
        """Returns the light along rays, with the plane in front of `light`: (3, N). Its edges cover
        a part of a ray.
        """
        plane = self.plane
        if plane is None:
            return light
        normal = torch.linalg.cross(plane.right, plane.up)
        cosine = normal @ rays.direction
        distance = (
            normal @ (plane.centre[:, None] - rays.origin) / torch.where(cosine == 0, 1e-9, cosine)
        )
        point = rays.origin + distance * rays.direction - plane.centre[:, None]
        x, y = plane.right @ point, plane.up @ point
        u, v = x / (2 * plane.half_width_mm) + 0.5, 0.5 - y / (2 * plane.half_height_mm)
        edge_mm = rays.relative_footprint * self._view.footprint_mm(self.plane_distance_mm)
        coverage = (
            ((plane.half_width_mm - x.abs()) / edge_mm + 0.5).clamp(0, 1)
            * ((plane.half_height_mm - y.abs()) / edge_mm + 0.5).clamp(0, 1)
            * (distance > 0)
        )
        image = plane.texture(u, v, self._plane_footprint(rays.relative_footprint))
        covered: Tensor = light + coverage * (image - light)  # lerp rounds in another way
        return covered


def _plane_emitter(plane: Plane, assets: Assets, is_behind: bool, device: Device) -> _PlaneEmitter:
    """Converts a plane to the glass frame. At heading 0 and pitch 0, the plane faces the glass."""
    image = torch.from_numpy(assets.plane_radiance(plane)).to(device)
    facing = 1.0 if is_behind else -1.0
    mirrored = torch.tensor([facing, 1.0, facing], device=device)
    right, up, _ = (
        torch.tensor(axis, device=device) * mirrored
        for axis in axes(plane.heading_deg, plane.pitch_deg)
    )
    x, y = plane.offset_mm
    height, width = image.shape[:2]
    return _PlaneEmitter(
        texture=MipmappedTexture(image, wraps=False),
        centre=torch.tensor([x, y, -facing * plane.distance_mm], device=device),
        right=right,
        up=up,
        half_width_mm=plane.width_mm / 2,
        half_height_mm=(plane.height_mm or plane.width_mm * height / width) / 2,
    )


# --- importance sampling of an environment map (Pharr, Jakob and Humphreys, "Physically Based
# Rendering", image infinite lights): most samples hit even a small sun. They are drawn by inverting
# the cumulative distribution.


_MIN_WEIGHT = 1e-3
"""Added to each texel, as a fraction of the mean, because the density must be above 0 wherever
there may be light.
"""
_MIN_COSINE = -0.05
"""Minimum cosine of the angle between a sampled direction and the normal of the glass. It is below
0 because rays towards a dome do not start at the centre of the dome, so they can hit texels
slightly beyond the glass plane.
"""


def direction_to_uv(direction: Tensor, u_offset: float) -> tuple[Tensor, Tensor]:
    """Returns the texture coordinates of unit directions (3, N) in a latitude-longitude map, (N,)
    each in 0..1.

    u = atan2(x, -z) / (2 pi) + u_offset, wrapped to 0..1; v = acos(y) / pi.
    """
    x, y, z = direction
    u = torch.atan2(x, -z) / (2 * math.pi) + u_offset
    return u - u.floor(), 0.5 - torch.asin(y.clamp(-1, 1)) / math.pi


class EnvmapDistribution:
    """A distribution of directions on one side of the glass, in proportion to the luminance of a
    map.

    `texels` is the map, (3, H, W). `outward` is the normal of the glass on that side, (3,).
    `u_offset` turns it.
    """

    def __init__(self, texels: Tensor, outward: Tensor, u_offset: float) -> None:
        _, height, width = texels.shape
        luminance = (texels * texels.new_tensor(REC709_LUMINANCE)[:, None, None]).sum(0)
        # Bilinear lookups spread a bright texel over its neighbours, so the density must be high
        # there too.
        padded = functional.pad(luminance[None, None], (1, 1, 1, 1), mode="replicate")
        smoothed = functional.avg_pool2d(padded, 3, 1)[0, 0]
        self._polar = (torch.arange(height, device=texels.device) + 0.5) / height * math.pi
        solid_angle = self._polar.sin() * (math.pi / height) * (2 * math.pi / width)
        u = (torch.arange(width, device=texels.device) + 0.5) / width
        centres = uv_to_direction(u[None], self._polar[:, None] / math.pi, u_offset)
        is_outward = torch.tensordot(outward, centres, 1) > _MIN_COSINE
        weight = (
            (smoothed + _MIN_WEIGHT * smoothed.mean() + 1e-12) * solid_angle[:, None] * is_outward
        )
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
        # Uniform in the cosine of the polar angle, so that directions are uniform in solid angle
        # within the texel.
        top, bottom = (((row + edge) / height * math.pi).cos() for edge in (0, 1))
        v = torch.acos((top + (bottom - top) * uniforms[1]).clamp(-1, 1)) / math.pi
        return uv_to_direction(u, v, u_offset)

    def pdf(self, u: Tensor, v: Tensor) -> Tensor:
        """Returns the density of `sample` at texture coordinates, (N,) each in 0..1, per steradian:
        (N,).
        """
        height, width = self._pdf.shape
        row, column = (
            (v * height).long().clamp(0, height - 1),
            (u * width).long().clamp(0, width - 1),
        )
        pdf: Tensor = self._pdf[row, column]
        return pdf


def uv_to_direction(u: Tensor, v: Tensor, u_offset: float) -> Tensor:
    """Returns unit directions (3, ...); the inverse of `direction_to_uv`."""
    azimuth = (u - u_offset) * (2 * math.pi)
    polar = v * math.pi
    sine = polar.sin()
    x, z = sine * azimuth.sin(), -sine * azimuth.cos()
    return torch.stack([x, polar.cos().expand_as(x), z])
