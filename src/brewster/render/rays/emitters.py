"""The light of one side as a renderer asks for it: along any ray, filtered to the size of what is asked.

All geometry is in the glass's frame, in millimetres: the first surface is z = 0, the camera stands at z > 0.
Vectors are (3, N). Far light depends on direction alone; near light (a dome, a plane) on the whole ray. One look
stands for a share of a pixel, and of its circle of confusion; light is filtered to that size before it is looked up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from brewster.environments.assets import Assets
from brewster.render.rays.envmap_sampling import EnvmapDistribution, lat_long
from brewster.render.rays.vectors import dot, unit
from brewster.scene.camera import axes
from brewster.scene.world import Plane, Side

Device = torch.device | str

_BETWEEN = 1.2
"""Texels that one look may stand for before it turns to the next halving: above, a sun would sparkle."""


class MipmappedTexture:
    """A picture (H, W, 3) with its halvings, sampled between texel centres; a map also wraps around."""

    def __init__(self, texels: Tensor, *, wraps: bool) -> None:
        self.width, self.wraps = texels.shape[1], wraps
        self._levels = [texels.permute(2, 0, 1)[None]]
        while min(self._levels[-1].shape[2:]) > 8:
            self._levels.append(functional.avg_pool2d(self._levels[-1], 2))
        self._padded: dict[int, Tensor] = {}

    @property
    def texels(self) -> Tensor:
        """The picture itself, (3, H, W)."""
        return self._levels[0][0]

    def __call__(self, u: Tensor, v: Tensor, span: float) -> Tensor:
        """Values (3, N) at (u, v) in 0..1, where one sample stands for `span` texels of the full picture."""
        level = min(math.ceil(math.log2(max(span / _BETWEEN, 1.0))), len(self._levels) - 1)
        texels = self._level(level)
        if self.wraps:
            width = self._levels[level].shape[3]
            u = (u * width + 1) / (width + 2)
        grid = torch.stack([u, v], dim=-1)[None, None] * 2 - 1
        return functional.grid_sample(
            texels, grid, mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0]

    def _level(self, level: int) -> Tensor:
        if not self.wraps:
            return self._levels[level]
        if level not in self._padded:
            self._padded[level] = functional.pad(self._levels[level], (1, 1, 0, 0), mode="circular")
        return self._padded[level]


@dataclass(frozen=True)
class _PlaneEmitter:
    """A plane in the glass's frame: where its centre is, its axes, and half its sides, in mm."""

    texture: MipmappedTexture
    centre: Tensor
    right: Tensor
    up: Tensor
    half_width: float
    half_height: float


@dataclass(frozen=True)
class Rays:
    """Rays with origins and unit directions, (3, N) each; each stands for this share of a pixel's side."""

    origin: Tensor
    direction: Tensor
    share: float


@dataclass(frozen=True)
class CameraView:
    """How a camera `height_mm` above the glass sees: its pixels' angle, and its lens (0: none to filter for)."""

    height_mm: float
    pixel_rad: float
    aperture_mm: float
    focus_mm: float

    def span_mm(self, beyond_mm: float) -> float:
        """What a pixel and its circle of confusion span on a surface this far beyond the glass (thin lens)."""
        away = self.height_mm + beyond_mm
        return self.pixel_rad * away + self.aperture_mm * abs(1 - away / self.focus_mm)

    def span_rad(self) -> float:
        """The same for what is infinitely far, as an angle."""
        return self.pixel_rad + self.aperture_mm / self.focus_mm


class SideEmitters:
    """All the light of one side."""

    def __init__(
        self, side: Side, assets: Assets, view: CameraView, *, behind: bool, to_world: Tensor, device: Device
    ) -> None:
        self._drawn: EnvmapDistribution | None = None
        self.radius_mm = side.map.radius_mm if side.map else math.inf
        self.map = (
            MipmappedTexture(torch.from_numpy(assets.map_light(side.map)).to(device), wraps=True)
            if side.map
            else None
        )
        self._view = view
        self._turn = -(side.map.heading_deg if side.map else 0.0) / 360
        self._behind = behind
        self._to_world = to_world
        self.board = _board(side.plane, assets, behind, device) if side.plane else None
        self.plane_mm = side.plane.distance_mm if side.plane else math.inf
        self.distance_mm = side.distance_mm

    @property
    def is_dome(self) -> bool:
        """Whether the map has parallax."""
        return self.map is not None and math.isfinite(self.radius_mm)

    @property
    def is_near(self) -> bool:
        """Whether any of this light depends on where a ray starts."""
        return self.is_dome or self.board is not None

    def texels_per_pixel(self) -> float:
        """How many texels a pixel spans at most: what a grid of looks must not miss."""
        return max(self._map_span(1.0), self._board_span(1.0))

    def _map_span(self, share: float) -> float:
        if self.map is None:
            return 0.0
        angle = self._view.span_mm(self.radius_mm) / self.radius_mm if self.is_dome else self._view.span_rad()
        return share * angle * self.map.width / (2 * math.pi)

    def _board_span(self, share: float) -> float:
        if self.board is None:
            return 0.0
        return (
            share * self._view.span_mm(self.plane_mm) * self.board.texture.width / (2 * self.board.half_width)
        )

    def far(self, direction: Tensor, share: float) -> Tensor | None:
        """Light from infinity along unit directions (3, N); None where there is none."""
        if self.map is None or self.is_dome:
            return None
        return self.look_up(direction, share)

    def near(self, origin: Tensor, direction: Tensor, share: float) -> tuple[Tensor, Tensor | None]:
        """Near light along rays, (3, N), and how much of the far light is seen past it, (N,) or None for nothing."""
        seen, clear = torch.zeros_like(direction), None
        if self.is_dome:
            place, _ = self._on_dome(origin, direction)
            seen = self.look_up(place, share)
        elif self.map is not None:
            clear = torch.ones_like(direction[0])
        if self.board is not None:
            picture, covered = self._before(self.board, origin, direction, share)
            seen = seen + covered * (picture - seen)
            clear = None if clear is None else clear * (1 - covered)
        return seen, clear

    def along(self, origin: Tensor, direction: Tensor, share: float) -> Tensor:
        """All light along rays from `origin` to unit `direction`, both (3, N): (3, N)."""
        return self.before(self.far(direction, share), origin, direction, share)

    def before(self, far: Tensor | None, origin: Tensor, direction: Tensor, share: float) -> Tensor:
        """All light along rays whose `far` light, (3, N), is known already."""
        if not self.is_near:
            return torch.zeros_like(direction) if far is None else far
        seen, clear = self.near(origin, direction, share)
        return seen if far is None or clear is None else seen + clear * far

    def look_up(self, direction: Tensor, share: float) -> Tensor:
        """The map along unit directions (3, N) from its centre."""
        assert self.map is not None
        u, v = lat_long(self._to_world @ direction, self._turn)
        return self.map(u, v, self._map_span(share))

    def draw(self, origin: Tensor, pair: Tensor) -> tuple[Tensor, Tensor]:
        """Directions (3, N) from `origin` to the map, bright places more often, and their density, (N,).

        `pair` is (2, N) in 0..1. Densities are per solid angle at `origin`.
        """
        place = self._to_world.T @ self._odds().draw(pair, self._turn)
        direction = place * self.radius_mm - origin if self.is_dome else place
        direction = unit(direction)
        return direction, self.density(origin, direction)

    def density(self, origin: Tensor, direction: Tensor) -> Tensor:
        """How densely `draw` goes along unit directions (3, N), per solid angle at `origin`: (N,)."""
        if not self.is_dome:
            return self._odds().density(self._to_world @ direction, self._turn)
        place, away = self._on_dome(origin, direction)
        facing = dot(place, direction).clamp(min=1e-6)
        return (
            self._odds().density(self._to_world @ place, self._turn) * (away / self.radius_mm) ** 2 / facing
        )

    def _on_dome(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays meet the dome, as unit directions from its centre, (3, N), and how far away, (N,) in mm."""
        along = dot(origin, direction)
        away = torch.sqrt((along**2 - dot(origin, origin) + self.radius_mm**2).clamp(min=0)) - along
        return (origin + away * direction) / self.radius_mm, away

    def _odds(self) -> EnvmapDistribution:
        """The map's bright places on its own side of the glass; made when first needed."""
        if self._drawn is None:
            assert self.map is not None
            outward = self._to_world @ self._to_world.new_tensor([0, 0, -1 if self._behind else 1])
            self._drawn = EnvmapDistribution(self.map.texels, outward, self._turn)
        return self._drawn

    def _before(
        self, board: _PlaneEmitter, origin: Tensor, direction: Tensor, share: float
    ) -> tuple[Tensor, Tensor]:
        normal = torch.linalg.cross(board.right, board.up)
        towards = normal @ direction
        away = normal @ (board.centre[:, None] - origin) / torch.where(towards == 0, 1e-9, towards)
        place = origin + away * direction - board.centre[:, None]
        across, upward = board.right @ place, board.up @ place
        u, v = across / (2 * board.half_width) + 0.5, 0.5 - upward / (2 * board.half_height)
        edge_mm = share * self._view.span_mm(self.plane_mm)
        covered = (
            ((board.half_width - across.abs()) / edge_mm + 0.5).clamp(0, 1)
            * ((board.half_height - upward.abs()) / edge_mm + 0.5).clamp(0, 1)
            * (away > 0)
        )
        return board.texture(u, v, self._board_span(share)), covered


def _board(plane: Plane, assets: Assets, behind: bool, device: Device) -> _PlaneEmitter:
    """The plane's frame: it faces the glass, and is turned about the glass's own upright axis."""
    picture = torch.from_numpy(assets.plane_light(plane)).to(device)
    facing = 1.0 if behind else -1.0
    side = torch.tensor([facing, 1.0, facing], device=device)
    right, up, _ = (
        torch.tensor(axis, device=device) * side for axis in axes(plane.heading_deg, plane.pitch_deg)
    )
    x, y = plane.offset_mm
    height, width = picture.shape[:2]
    return _PlaneEmitter(
        texture=MipmappedTexture(picture, wraps=False),
        centre=torch.tensor([x, y, -facing * plane.distance_mm], device=device),
        right=right,
        up=up,
        half_width=plane.width_mm / 2,
        half_height=plane.width_mm / 2 * height / width,
    )
