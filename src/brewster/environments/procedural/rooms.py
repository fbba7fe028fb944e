"""A furnished room around the viewer, for `canvas.render`. Lengths are in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator

from brewster.environments.procedural.canvas import (
    Canvas,
    Floats,
    ProceduralEnvironment,
    Quad,
    SmallEmitter,
    resize,
    tint,
    unit,
    vector,
)
from brewster.environments.procedural.paintings import (
    curtain,
    door,
    flooring,
    hang_pictures,
    painting,
    person,
    rug,
    tree,
    wall_finish,
    window_view,
)
from brewster.environments.procedural.props import (
    UP,
    EnvironmentLighting,
    Lamp,
    bookshelf_painter,
    box,
    cabinet_painter,
    horizontal_quad,
    plain_painter,
    vertical_quad,
)

_TEXELS_PER_M: Final = 90.0


def room_environment(rng: Generator) -> ProceduralEnvironment:
    """Returns a furnished room with windows, by day or in the evening. Some rooms have no lamps."""
    return _BoxRoom(rng).environment()


@dataclass(frozen=True)
class _Opening:
    """A window in a wall, through which sunlight falls."""

    foot: Floats
    """The middle of the lower edge."""
    inward: Floats
    """The unit normal of the wall, which points into the room."""
    width_m: float
    height_m: float


class _BoxRoom:
    """A box-shaped room around the viewer: its walls, its lighting, and the furniture placed so far."""

    def __init__(self, rng: Generator) -> None:
        self.rng = rng
        ranges = (3.5, 8), (3.5, 9), (2.4, 3.3)
        width_m, depth_m, self.height_m = (rng.uniform(low, high) for low, high in ranges)
        self.floor_y_m = -rng.uniform(1.2, 1.7)
        relative_viewer_position = rng.uniform(0.3, 0.7, 2)  # along the width and the depth
        self.low = vector(
            -width_m * relative_viewer_position[0], self.floor_y_m, -depth_m * relative_viewer_position[1]
        )
        self.high = vector(width_m, self.height_m, depth_m) + self.low
        self.evening = rng.uniform() < 0.25
        self.daylight = float(np.exp(rng.uniform(-3, -1.5) if self.evening else rng.uniform(1.8, 3.4)))
        self.lighting = EnvironmentLighting(vector(0.25, 0.24, 0.22), self.floor_y_m)
        self.sun = unit(vector(*rng.uniform(-1, 1, 3)) + UP * 1.2)
        self.sunlight = vector(1, 0.9, 0.75) * (0 if self.evening else rng.choice([0, rng.uniform(4, 15)]))
        self.openings: list[_Opening] = []
        self.quads: list[Quad] = []
        self.emitters: list[SmallEmitter] = []

    def light(self, points: Floats, normal: Floats) -> Floats:
        """Returns irradiance / pi of lamps and windows, reduced in corners, and of sunlight through the windows."""
        total = self.lighting(points, normal)
        for end in (self.low, self.high):
            corner = 1 - 0.3 * np.exp(-np.abs(points - end) / 0.3)
            total *= corner[..., :1] * corner[..., 1:2] * corner[..., 2:]
        if (facing := float(normal @ self.sun)) > 0:
            for opening in self.openings:
                if (slope := float(opening.inward @ self.sun)) < -0.05:
                    distance = ((opening.foot - points) @ opening.inward / slope)[..., None]
                    hit = points + distance * self.sun - opening.foot
                    across = np.abs(hit @ np.cross(opening.inward, UP))
                    margin = np.minimum(
                        opening.width_m / 2 - across,
                        opening.height_m / 2 - np.abs(hit[..., 1] - opening.height_m / 2),
                    )
                    inside = np.clip(margin * 8 + 0.5, 0, 1) * (distance[..., 0] > 0.05)
                    shadow_factor = self.lighting.contact_shadow_factor(points, normal)
                    total += inside[..., None] * shadow_factor * facing * self.sunlight
        return total

    def environment(self) -> ProceduralEnvironment:
        """Builds the room. The lighting is baked into the textures later, when the room is rendered."""
        rng = self.rng
        wall_colour = tint(rng, rng.uniform(0.3, 0.75), rng.uniform(0, 0.2))
        inward_normals = [vector(0, 0, 1), vector(-1, 0, 0), vector(0, 0, -1), vector(1, 0, 0)]
        window_wall = int(rng.integers(4))
        for index, inward in enumerate(inward_normals):
            role = (
                "windows"
                if index == window_wall
                else str(rng.choice(["windows", "pictures", "pictures", "pictures", "bare"]))
            )
            accent = rng.uniform() < 0.3
            self._wall(inward, tint(rng, rng.uniform(0.08, 0.5), 0.7) if accent else wall_colour, role)
        self._ceiling()
        self._add_floor()
        for inward in inward_normals:
            self._furnish_wall(inward)
        for _ in range(rng.integers(3, 9)):
            self._place_free_standing()
        return ProceduralEnvironment(
            self.quads,
            self.emitters,
            lambda directions, _texel: np.zeros_like(directions),
            rng.uniform(0, 2 * np.pi),
        )

    def _wall_base(self, inward: Floats) -> tuple[Floats, float]:
        """Returns the middle of the lower edge of a wall, and the length of the wall."""
        middle = (self.low + self.high) / 2
        foot = np.where(inward > 0, self.low, np.where(inward < 0, self.high, middle))
        foot[1] = self.floor_y_m
        size = self.high - self.low
        return foot.astype(np.float32), float(size[2] if inward[0] else size[0])

    def _wall(self, inward: Floats, colour: Floats, role: str) -> None:
        rng = self.rng
        foot, length_m = self._wall_base(inward)
        canvas = Canvas(length_m, self.height_m, _TEXELS_PER_M, colour)
        wall_finish(rng, canvas)
        left = rng.uniform(0.3, 0.8)
        sill = rng.choice([0.1, 0.9, 0.9])
        while left < length_m - 1.2:
            width_m = min(rng.uniform(0.9, 2.2), length_m - left - 0.3)
            choice = rng.uniform()
            if role == "windows" and choice < 0.75:
                self._opening((left, width_m, float(sill)), canvas, foot, inward)
            elif choice < 0.15:
                door(rng, canvas, left)
            elif role != "bare":
                hang_pictures(rng, canvas, left, width_m)
            left += width_m + rng.uniform(0.3, 1.2)
        self.quads.append(vertical_quad(canvas, foot, inward, self.light))

    def _opening(
        self, opening: tuple[float, float, float], canvas: Canvas, foot: Floats, inward: Floats
    ) -> None:
        """Adds a window to a wall: a blurred view, light, bars and curtains. `opening` is (left, width, sill height)."""
        rng, (left, width_m, sill) = self.rng, opening
        top = rng.uniform(0.25, 0.45)
        height_m = self.height_m - sill - top
        canvas.rect((left - 0.08, top - 0.08, width_m + 0.16, height_m + 0.16), vector(0.75, 0.74, 0.7))
        view = window_view(rng)
        canvas.paste(resize(view, 90, 90), (left, top, width_m, height_m), emission=self.daylight)
        for part in range(rng.integers(1, 4)):
            canvas.rect((left + width_m * part / 3 - 0.03, top, 0.06, height_m), vector(0.7, 0.7, 0.68))
        canvas.rect((left, top + height_m * rng.uniform(0.2, 0.6), width_m, 0.05), vector(0.7, 0.7, 0.68))
        if rng.uniform() < 0.5:
            cloth = tint(rng, 0.5, 0.3)
            for start in (left - 0.3, left + width_m - 0.15):
                curtain(
                    canvas.area((start, top - 0.15, 0.45, self.height_m - top)), cloth, self.daylight * 0.04
                )
        across = np.cross(-inward, UP)
        middle = foot + across * (left + width_m / 2 - canvas.width / 2) + UP * sill
        mean = view.mean((0, 1)) * self.daylight
        for relative_height in (0.25, 0.75):
            source = middle + UP * height_m * relative_height + inward * 0.05
            self.lighting.lamps.append(Lamp(source, mean * width_m * height_m / 2, inward))
        self.lighting.ambient = self.lighting.ambient + mean * (width_m * height_m * 0.01)
        self.openings.append(_Opening(middle, inward, width_m, height_m))

    def _ceiling(self) -> None:
        """Adds a ceiling with lamps of one kind. In some rooms by day, there are no lamps.

        The radiance of the lamps is computed from the area of the room.
        """
        rng, size = self.rng, self.high - self.low
        canvas = Canvas(float(size[0]), float(size[2]), 60, vector(0.8, 0.79, 0.76) * rng.uniform(0.7, 1))
        if rng.uniform() < 0.3:
            canvas.pixels[::36, :, :3] *= 0.7
            canvas.pixels[:, ::36, :3] *= 0.7
        canvas.add_noise(rng, 0.03)
        colour = vector(1, rng.uniform(0.75, 0.98), rng.uniform(0.5, 0.95))
        shapes = [(0.6, 0.6, 3.0), (0.12, 1.2, 1.8), (1.2, 0.12, 1.8), (0.11, 0.11, 1.4), (0.2, 0.2, 2.2)]
        width_m, depth_m, gap = shapes[rng.integers(len(shapes))]
        lamp_counts = [max(1, int(side / gap)) for side in (size[0], size[2])]
        light = rng.uniform(0.6, 1.6)
        radiance = light * size[0] * size[2] / (0.6 * lamp_counts[0] * lamp_counts[1] * width_m * depth_m)
        if not self.evening and rng.uniform() < 0.35:
            lamp_counts = [0, 0]
        middle = (self.low + self.high) / 2
        for x in (np.arange(lamp_counts[0]) + 0.5) * size[0] / max(1, lamp_counts[0]):
            for z in (np.arange(lamp_counts[1]) + 0.5) * size[2] / max(1, lamp_counts[1]):
                canvas.rect(
                    (x - width_m / 2 - 0.04, z - depth_m / 2 - 0.04, width_m + 0.08, depth_m + 0.08),
                    vector(0.4, 0.4, 0.4),
                )
                canvas.rect(
                    (x - width_m / 2, z - depth_m / 2, width_m, depth_m), colour, emission=float(radiance)
                )
                position = vector(self.low[0] + x, self.high[1] - 0.05, self.low[2] + z)
                self.lighting.lamps.append(Lamp(position, colour * float(radiance) * width_m * depth_m, -UP))
        if rng.uniform() < 0.4:
            self._pendant(colour)
        self.lighting.ambient = self.lighting.ambient + colour * (0.35 * light if lamp_counts[0] else 0)
        centre = vector(middle[0], self.high[1], middle[2])
        self.quads.append(horizontal_quad(canvas, centre, self.light))

    def _pendant(self, colour: Floats) -> None:
        """Adds a pendant lamp: a bulb below a shade."""
        relative_position = vector(*self.rng.uniform(0.25, 0.75, 3))
        position = self.low + relative_position * (self.high - self.low)
        position[1] = self.high[1] - self.rng.uniform(0.5, 0.9)
        dark, cloth = (plain_painter(self.rng, tint(self.rng, value, 0.6)) for value in (0.03, 0.3))
        self.quads += box(dark, position, (0.015, float(self.high[1] - position[1]), 0.015), self.light)
        self.quads += box(cloth, position + UP * 0.05, (0.34, 0.2, 0.34), self.light, self.rng.uniform(0, 1))
        self.emitters.append(SmallEmitter(position, 0.05, colour * 300))
        self.lighting.lamps.append(Lamp(position, colour * 300 * np.float32(np.pi * 0.05**2)))

    def _add_floor(self) -> None:
        rng, size = self.rng, self.high - self.low
        canvas = Canvas(float(size[0]), float(size[2]), _TEXELS_PER_M, tint(rng, rng.uniform(0.1, 0.4), 0.2))
        flooring(rng, canvas)
        if rng.uniform() < 0.6:
            rug(rng, canvas)
        middle = (self.low + self.high) / 2
        self.quads.append(horizontal_quad(canvas, vector(middle[0], self.floor_y_m, middle[2]), self.light))

    def _reserve_floor(self, foot: Floats, size: tuple[float, float, float], rotation: float) -> bool:
        """Reserves floor space for a piece of furniture. Returns False if the viewer or another piece is there."""
        reach = max(size[0], size[2]) / 2
        if np.hypot(foot[0], foot[2]) < reach + 0.7:
            return False
        for x, z, half_width, half_depth in self.lighting.contact_shadows:
            if abs(x - foot[0]) < half_width + reach * 0.8 and abs(z - foot[2]) < half_depth + reach * 0.8:
                return False
        extent_x_m = abs(np.cos(rotation)) * size[0] + abs(np.sin(rotation)) * size[2]
        extent_z_m = abs(np.sin(rotation)) * size[0] + abs(np.cos(rotation)) * size[2]
        self.lighting.contact_shadows.append(
            (float(foot[0]), float(foot[2]), float(extent_x_m / 2), float(extent_z_m / 2))
        )
        return True

    def _furnish_wall(self, inward: Floats) -> None:
        """Adds shelves, cabinets, sofas, plants and screens along a wall."""
        rng = self.rng
        middle, length_m = self._wall_base(inward)
        rotation = float(np.arctan2(-inward[0], inward[2]))
        has_window = any(np.array_equal(inward, opening.inward) for opening in self.openings)
        for offset in np.arange(-length_m / 2 + 1.1, length_m / 2 - 1, rng.uniform(1.2, 2)):
            kind = rng.choice(["shelf", "cabinet", "sofa", "plant", "screen", "nothing"])
            width_m, depth_m = rng.uniform(0.8, 1.8), rng.uniform(0.3, 0.5)
            height_m = rng.uniform(0.5, 0.85) if has_window or kind != "shelf" else rng.uniform(1.2, 2.2)
            if kind == "sofa":
                width_m, depth_m = rng.uniform(1.5, 2.2), 0.85
            foot = middle + np.cross(-inward, UP) * offset + inward * (depth_m / 2 + 0.02)
            if kind == "nothing" or not self._reserve_floor(foot, (width_m, height_m, depth_m), rotation):
                continue
            if kind == "plant":
                self._plant(foot)
            elif kind == "sofa":
                self._sofa(foot, (width_m, height_m, depth_m), rotation)
            else:
                painter = bookshelf_painter(rng) if kind == "shelf" else cabinet_painter(rng)
                self.quads += box(painter, foot, (width_m, height_m, depth_m), self.light, rotation)
                if kind == "screen":
                    self._screen(foot + UP * (height_m + 0.08), inward)

    def _screen(self, foot: Floats, inward: Floats) -> None:
        rng = self.rng
        canvas = Canvas(1.1, 0.65, 120, vector(0.015, 0.015, 0.015))
        picture = painting(int(rng.integers(1 << 30)), 126, 72)
        canvas.paste(picture, (0.03, 0.03, 1.04, 0.56), emission=rng.choice([0.05, 2.5]))
        self.quads.append(vertical_quad(canvas, foot, inward, self.light))

    def _sofa(self, foot: Floats, size: tuple[float, float, float], rotation: float) -> None:
        width_m, _, depth_m = size
        cloth = plain_painter(self.rng, tint(self.rng, self.rng.uniform(0.05, 0.4), 0.6), 60, 0.2)
        forward, sideways = _horizontal_axes(rotation)
        back = foot - forward * (depth_m / 2 - 0.1)
        self.quads += box(cloth, foot, (width_m, 0.42, depth_m), self.light, rotation)
        self.quads += box(cloth, back, (width_m, 0.85, 0.2), self.light, rotation)
        for side in (-1, 1):
            armrest = foot + sideways * side * (width_m / 2 - 0.08)
            self.quads += box(cloth, armrest, (0.16, 0.6, depth_m), self.light, rotation)
        for offset in np.arange(-width_m / 2 + 0.45, width_m / 2 - 0.3, 0.6):
            cushion = plain_painter(self.rng, tint(self.rng, 0.35, 0.9), 60, 0.2)
            seat = back + sideways * offset + forward * 0.2 + UP * 0.42
            self.quads += box(cushion, seat, (0.4, 0.36, 0.12), self.light, rotation)

    def _plant(self, foot: Floats) -> None:
        height_m = self.rng.uniform(0.7, 1.5)
        self.quads += box(
            plain_painter(self.rng, tint(self.rng, 0.3, 0.5)), foot, (0.3, 0.3, 0.3), self.light, 0.4
        )
        self.quads.append(vertical_quad(tree(self.rng, height_m, 90), foot + UP * 0.25, None, self.light))

    def _place_free_standing(self) -> None:
        """Adds a table with chairs, a person or a floor lamp."""
        rng = self.rng
        margin = vector(0.8, 0, 0.8)
        relative_position = vector(rng.uniform(), 0, rng.uniform())
        foot = self.low + margin + relative_position * (self.high - self.low - 2 * margin)
        foot[1] = self.floor_y_m
        kind, rotation = rng.choice(["table", "table", "person", "lamp"]), rng.uniform(0, 2 * np.pi)
        if kind == "table":
            size = rng.uniform(0.8, 1.6), 0.74, rng.uniform(0.6, 0.9)
            if self._reserve_floor(foot, size, rotation):
                self._table(foot, size, rotation)
        elif kind == "person" and self._reserve_floor(foot, (0.5, 1.7, 0.4), 0):
            self.quads.append(vertical_quad(person(rng, rng.uniform(1.55, 1.85), 90), foot, None, self.light))
        elif kind == "lamp" and self._reserve_floor(foot, (0.4, 1.6, 0.4), 0):
            self._floor_lamp(foot)

    def _table(self, foot: Floats, size: tuple[float, float, float], rotation: float) -> None:
        rng, (width_m, height_m, depth_m) = self.rng, size
        wood = plain_painter(rng, vector(0.35, 0.22, 0.12) * rng.uniform(0.4, 1.6), 60, 0.2)
        forward, sideways = _horizontal_axes(rotation)
        self.quads += box(wood, foot + UP * (height_m - 0.05), (width_m, 0.05, depth_m), self.light, rotation)
        for right in (-0.45, 0.45):
            for front in (-0.42, 0.42):
                leg = foot + sideways * right * width_m + forward * front * depth_m
                self.quads += box(wood, leg, (0.06, height_m - 0.05, 0.06), self.light, rotation)
        for _ in range(rng.integers(1, 6)):
            thing = (
                foot
                + UP * height_m
                + sideways * rng.uniform(-0.4, 0.4) * width_m
                + forward * rng.uniform(-0.3, 0.3) * depth_m
            )
            bulk = rng.uniform(0.05, 0.25), rng.uniform(0.03, 0.3), rng.uniform(0.05, 0.2)
            self.quads += box(
                plain_painter(rng, tint(rng, 0.3, 0.9)), thing, bulk, self.light, rng.uniform(0, 3)
            )
        seat = plain_painter(rng, tint(rng, 0.2, 0.6), 60, 0.2)
        for side in (-1, 1):
            chair = foot + forward * side * (depth_m / 2 + 0.3)
            if np.hypot(chair[0], chair[2]) > 1:
                self.quads += box(seat, chair + UP * 0.42, (0.42, 0.05, 0.42), self.light, rotation)
                self.quads += box(
                    seat, chair + forward * side * 0.2 + UP * 0.47, (0.42, 0.45, 0.04), self.light, rotation
                )
                self.quads += box(wood, chair, (0.3, 0.42, 0.05), self.light, rotation)

    def _floor_lamp(self, foot: Floats) -> None:
        colour = vector(1, 0.78, 0.5)

        def shade(_face: str, width: float, height: float) -> Canvas:
            canvas = Canvas(width, height, 80)
            canvas.rect((0, 0, width, height), colour, emission=5)
            canvas.area((0, 0, width, 0.05))[..., 4] = 15
            canvas.add_noise(self.rng, 0.1)
            return canvas

        self.quads += box(plain_painter(self.rng, vector(0.1, 0.1, 0.1)), foot, (0.03, 1.4, 0.03), self.light)
        self.quads += box(shade, foot + UP * 1.35, (0.36, 0.26, 0.36), self.light, 0.6)
        self.lighting.lamps.append(Lamp(foot + UP * 1.5, colour * 1.2))
        self.emitters.append(SmallEmitter(foot + UP * 1.66, 0.03, colour * 400))


def _horizontal_axes(rotation: float) -> tuple[Floats, Floats]:
    """Returns the forward and the sideways direction of a piece of furniture."""
    cos, sin = np.cos(rotation), np.sin(rotation)
    return vector(-sin, 0, cos), vector(cos, 0, sin)
