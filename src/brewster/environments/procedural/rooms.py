"""Procedural environment maps from a seed, for machines without HDR maps: a street, a street at night, a room.

    picture = ENVIRONMENTS["street"](7, 512)  # (512, 1024, 3), linear radiance around the viewer
    poster = painting(seed=7, width=768, height=512)  # (512, 768, 3), linear, 0..1

The same seed gives the same bytes. Radiance 1 is about that of a white sheet in the shade.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

from brewster.environments.procedural.canvas import (
    Canvas,
    Floats,
    Glow,
    ProceduralEnvironment,
    Quad,
    render,
    resize,
    tint,
    unit,
    vector,
)
from brewster.environments.procedural.paintings import (
    curtain,
    door,
    figure,
    flooring,
    hang_pictures,
    outside,
    painting,
    rug,
    tree,
    wallpaper,
)
from brewster.environments.procedural.props import (
    UP,
    Lamp,
    SceneLighting,
    bookshelf,
    box,
    cabinet,
    horizontal_quad,
    plain_painter,
    vertical_quad,
)
from brewster.environments.procedural.streets import street_environment

__all__ = ["ENVIRONMENTS", "night", "painting", "room", "street"]

_DENSITY: Final = 90.0


def street(seed: int, height: int) -> NDArray[np.float32]:
    """A street by day, radiance (height, 2 height, 3): the sky is about 1, its sun 1e3 to 1e5."""
    return render(street_environment(Generator(PCG64(seed)), night=False), height)


def night(seed: int, height: int) -> NDArray[np.float32]:
    """A street at night, radiance (height, 2 height, 3): the road is about 1, its lamps 1e2 to 1e4."""
    return render(street_environment(Generator(PCG64(seed)), night=True), height)


def room(seed: int, height: int) -> NDArray[np.float32]:
    """A furnished room, radiance (height, 2 height, 3): the walls are below 1, the lamps 15 to 500."""
    return render(_BoxRoom(Generator(PCG64(seed))).world(), height)


ENVIRONMENTS: Final[dict[str, Callable[[int, int], NDArray[np.float32]]]] = {
    "street": street,
    "room": room,
    "night": night,
}
"""Name -> function (seed, height) that returns a lat-long map (height, 2 height, 3) in linear light."""


class _BoxRoom:
    """A box-shaped room around the viewer: its walls, its lighting, and the furniture placed so far."""

    def __init__(self, random: Generator) -> None:
        self.random = random
        wide, deep, self.tall = random.uniform(3.5, 8), random.uniform(3.5, 9), random.uniform(2.4, 3.3)
        self.floor = -random.uniform(1.2, 1.7)
        share = random.uniform(0.3, 0.7, 2)
        self.low = vector(-wide * share[0], self.floor, -deep * share[1])
        self.high = vector(wide, self.tall, deep) + self.low
        self.evening = random.uniform() < 0.25
        self.daylight = float(np.exp(random.uniform(-3, -1.5) if self.evening else random.uniform(1.8, 3.4)))
        self.lamps = SceneLighting(vector(0.25, 0.24, 0.22), self.floor)
        self.sun = unit(vector(*random.uniform(-1, 1, 3)) + UP * 1.2)
        self.sunlight = vector(1, 0.9, 0.75) * (
            0 if self.evening else random.choice([0, random.uniform(4, 15)])
        )
        self.openings: list[tuple[Floats, Floats, float, float]] = []
        self.quads: list[Quad] = []
        self.glows: list[Glow] = []

    def light(self, points: Floats, normal: Floats) -> Floats:
        """Irradiance / pi of lamps and windows, darker in corners, and of sunlight through the windows."""
        total = self.lamps(points, normal)
        for end in (self.low, self.high):
            corner = 1 - 0.3 * np.exp(-np.abs(points - end) / 0.3)
            total *= corner[..., :1] * corner[..., 1:2] * corner[..., 2:]
        if (facing := float(normal @ self.sun)) > 0:
            for foot, inward, wide, tall in self.openings:
                if (slope := float(inward @ self.sun)) < -0.05:
                    way = ((foot - points) @ inward / slope)[..., None]
                    place = points + way * self.sun - foot
                    aside = np.abs(place @ np.cross(inward, UP))
                    margin = np.minimum(wide / 2 - aside, tall / 2 - np.abs(place[..., 1] - tall / 2))
                    inside = np.clip(margin * 8 + 0.5, 0, 1) * (way[..., 0] > 0.05)
                    total += inside[..., None] * self.lamps.shade(points, normal) * facing * self.sunlight
        return total

    def world(self) -> ProceduralEnvironment:
        """Builds the room. Lights come first; lighting is baked into textures when they are rendered."""
        random = self.random
        paint = tint(random, random.uniform(0.3, 0.75), random.uniform(0, 0.2))
        ways = [vector(0, 0, 1), vector(-1, 0, 0), vector(0, 0, -1), vector(1, 0, 0)]
        first = int(random.integers(4))
        for index, inward in enumerate(ways):
            role = (
                "windows"
                if index == first
                else str(random.choice(["windows", "pictures", "pictures", "pictures", "bare"]))
            )
            accent = random.uniform() < 0.3
            self._wall(inward, tint(random, random.uniform(0.08, 0.5), 0.7) if accent else paint, role)
        self._ceiling()
        self._floor()
        for inward in ways:
            self._furnish_wall(inward)
        for _ in range(random.integers(3, 9)):
            self._place_free_standing()
        return ProceduralEnvironment(
            self.quads, self.glows, lambda ways, _texel: np.zeros_like(ways), random.uniform(0, 2 * np.pi)
        )

    def _wall_base(self, inward: Floats) -> tuple[Floats, float]:
        """The middle of the lower edge of a wall, and the length of the wall."""
        middle = (self.low + self.high) / 2
        foot = np.where(inward > 0, self.low, np.where(inward < 0, self.high, middle))
        foot[1] = self.floor
        size = self.high - self.low
        return foot.astype(np.float32), float(size[2] if inward[0] else size[0])

    def _wall(self, inward: Floats, colour: Floats, role: str) -> None:
        random = self.random
        foot, long = self._wall_base(inward)
        canvas = Canvas(long, self.tall, _DENSITY, colour)
        wallpaper(random, canvas)
        left = random.uniform(0.3, 0.8)
        sill = random.choice([0.1, 0.9, 0.9])
        while left < long - 1.2:
            wide = min(random.uniform(0.9, 2.2), long - left - 0.3)
            choice = random.uniform()
            if role == "windows" and choice < 0.75:
                self._opening((left, wide, float(sill)), canvas, foot, inward)
            elif choice < 0.15:
                door(random, canvas, left)
            elif role != "bare":
                hang_pictures(random, canvas, left, wide)
            left += wide + random.uniform(0.3, 1.2)
        self.quads.append(vertical_quad(canvas, foot, inward, self.light))

    def _opening(
        self, place: tuple[float, float, float], canvas: Canvas, foot: Floats, inward: Floats
    ) -> None:
        """Adds a window at (left, width, sill height) of a wall: blurred view, light, bars and curtains."""
        random, (left, wide, sill) = self.random, place
        top = random.uniform(0.25, 0.45)
        tall = self.tall - sill - top
        canvas.rect((left - 0.08, top - 0.08, wide + 0.16, tall + 0.16), vector(0.75, 0.74, 0.7))
        view = outside(random)
        canvas.paste(resize(view, 90, 90), (left, top, wide, tall), glow=self.daylight)
        for part in range(random.integers(1, 4)):
            canvas.rect((left + wide * part / 3 - 0.03, top, 0.06, tall), vector(0.7, 0.7, 0.68))
        canvas.rect((left, top + tall * random.uniform(0.2, 0.6), wide, 0.05), vector(0.7, 0.7, 0.68))
        if random.uniform() < 0.5:
            cloth = tint(random, 0.5, 0.3)
            for start in (left - 0.3, left + wide - 0.15):
                curtain(canvas.area((start, top - 0.15, 0.45, self.tall - top)), cloth, self.daylight * 0.04)
        across = np.cross(-inward, UP)
        middle = foot + across * (left + wide / 2 - canvas.width / 2) + UP * sill
        mean = view.mean((0, 1)) * self.daylight
        for share in (0.25, 0.75):
            source = middle + UP * tall * share + inward * 0.05
            self.lamps.lamps.append(Lamp(source, mean * wide * tall / 2, inward))
        self.lamps.ambient = self.lamps.ambient + mean * (wide * tall * 0.01)
        self.openings.append((middle, inward, wide, tall))

    def _ceiling(self) -> None:
        """Adds a ceiling with lamps of one kind, or none by day. Their radiance follows from the size of the room."""
        random, size = self.random, self.high - self.low
        canvas = Canvas(float(size[0]), float(size[2]), 60, vector(0.8, 0.79, 0.76) * random.uniform(0.7, 1))
        if random.uniform() < 0.3:
            canvas.pixels[::36, :, :3] *= 0.7
            canvas.pixels[:, ::36, :3] *= 0.7
        canvas.add_noise(random, 0.03)
        colour = vector(1, random.uniform(0.75, 0.98), random.uniform(0.5, 0.95))
        shapes = [(0.6, 0.6, 3.0), (0.12, 1.2, 1.8), (1.2, 0.12, 1.8), (0.11, 0.11, 1.4), (0.2, 0.2, 2.2)]
        wide, deep, gap = shapes[random.integers(len(shapes))]
        rows = [max(1, int(side / gap)) for side in (size[0], size[2])]
        light = random.uniform(0.6, 1.6)
        radiance = light * size[0] * size[2] / (0.6 * rows[0] * rows[1] * wide * deep)
        if not self.evening and random.uniform() < 0.35:
            rows = [0, 0]
        middle = (self.low + self.high) / 2
        for x in (np.arange(rows[0]) + 0.5) * size[0] / max(1, rows[0]):
            for z in (np.arange(rows[1]) + 0.5) * size[2] / max(1, rows[1]):
                canvas.rect(
                    (x - wide / 2 - 0.04, z - deep / 2 - 0.04, wide + 0.08, deep + 0.08),
                    vector(0.4, 0.4, 0.4),
                )
                canvas.rect((x - wide / 2, z - deep / 2, wide, deep), colour, glow=float(radiance))
                place = vector(self.low[0] + x, self.high[1] - 0.05, self.low[2] + z)
                self.lamps.lamps.append(Lamp(place, colour * float(radiance) * wide * deep, -UP))
        if random.uniform() < 0.4:
            self._pendant(colour)
        self.lamps.ambient = self.lamps.ambient + colour * (0.35 * light if rows[0] else 0)
        centre = vector(middle[0], self.high[1], middle[2])
        self.quads.append(horizontal_quad(canvas, centre, self.light))

    def _pendant(self, colour: Floats) -> None:
        """Adds a pendant lamp: a bulb below a shade."""
        share = vector(*self.random.uniform(0.25, 0.75, 3))
        place = self.low + share * (self.high - self.low)
        place[1] = self.high[1] - self.random.uniform(0.5, 0.9)
        dark, cloth = (plain_painter(self.random, tint(self.random, value, 0.6)) for value in (0.03, 0.3))
        self.quads += box(dark, place, (0.015, float(self.high[1] - place[1]), 0.015), self.light)
        self.quads += box(cloth, place + UP * 0.05, (0.34, 0.2, 0.34), self.light, self.random.uniform(0, 1))
        self.glows.append(Glow(place, 0.05, colour * 300))
        self.lamps.lamps.append(Lamp(place, colour * 300 * np.float32(np.pi * 0.05**2)))

    def _floor(self) -> None:
        random, size = self.random, self.high - self.low
        canvas = Canvas(float(size[0]), float(size[2]), _DENSITY, tint(random, random.uniform(0.1, 0.4), 0.2))
        flooring(random, canvas)
        if random.uniform() < 0.6:
            rug(random, canvas)
        middle = (self.low + self.high) / 2
        self.quads.append(horizontal_quad(canvas, vector(middle[0], self.floor, middle[2]), self.light))

    def _reserve_floor(self, foot: Floats, size: tuple[float, float, float], turn: float) -> bool:
        """Reserves floor space for a piece of furniture. Returns False if the viewer or another piece is there."""
        reach = max(size[0], size[2]) / 2
        if np.hypot(foot[0], foot[2]) < reach + 0.7:
            return False
        for x, z, half_width, half_depth in self.lamps.contacts:
            if abs(x - foot[0]) < half_width + reach * 0.8 and abs(z - foot[2]) < half_depth + reach * 0.8:
                return False
        across = abs(np.cos(turn)) * size[0] + abs(np.sin(turn)) * size[2]
        deep = abs(np.sin(turn)) * size[0] + abs(np.cos(turn)) * size[2]
        self.lamps.contacts.append((float(foot[0]), float(foot[2]), float(across / 2), float(deep / 2)))
        return True

    def _furnish_wall(self, inward: Floats) -> None:
        """Adds shelves, cabinets and sofas along a wall."""
        random = self.random
        middle, long = self._wall_base(inward)
        turn = float(np.arctan2(-inward[0], inward[2]))
        lit = any(np.array_equal(inward, way) for _, way, _, _ in self.openings)
        for offset in np.arange(-long / 2 + 1.1, long / 2 - 1, random.uniform(1.2, 2)):
            kind = random.choice(["shelf", "cabinet", "sofa", "plant", "screen", "nothing"])
            wide, deep = random.uniform(0.8, 1.8), random.uniform(0.3, 0.5)
            tall = random.uniform(0.5, 0.85) if lit or kind != "shelf" else random.uniform(1.2, 2.2)
            if kind == "sofa":
                wide, deep = random.uniform(1.5, 2.2), 0.85
            foot = middle + np.cross(-inward, UP) * offset + inward * (deep / 2 + 0.02)
            if kind == "nothing" or not self._reserve_floor(foot, (wide, tall, deep), turn):
                continue
            if kind == "plant":
                self._plant(foot)
            elif kind == "sofa":
                self._sofa(foot, (wide, tall, deep), turn)
            else:
                paint = bookshelf(random) if kind == "shelf" else cabinet(random)
                self.quads += box(paint, foot, (wide, tall, deep), self.light, turn)
                if kind == "screen":
                    self._screen(foot + UP * (tall + 0.08), inward)

    def _screen(self, foot: Floats, inward: Floats) -> None:
        random = self.random
        canvas = Canvas(1.1, 0.65, 120, vector(0.015, 0.015, 0.015))
        picture = painting(int(random.integers(1 << 30)), 126, 72)
        canvas.paste(picture, (0.03, 0.03, 1.04, 0.56), glow=random.choice([0.05, 2.5]))
        self.quads.append(vertical_quad(canvas, foot, inward, self.light))

    def _sofa(self, foot: Floats, size: tuple[float, float, float], turn: float) -> None:
        wide, _, deep = size
        cloth = plain_painter(self.random, tint(self.random, self.random.uniform(0.05, 0.4), 0.6), 60, 0.2)
        ahead, aside = vector(-np.sin(turn), 0, np.cos(turn)), vector(np.cos(turn), 0, np.sin(turn))
        back = foot - ahead * (deep / 2 - 0.1)
        self.quads += box(cloth, foot, (wide, 0.42, deep), self.light, turn)
        self.quads += box(cloth, back, (wide, 0.85, 0.2), self.light, turn)
        for side in (-1, 1):
            self.quads += box(
                cloth, foot + aside * side * (wide / 2 - 0.08), (0.16, 0.6, deep), self.light, turn
            )
        for place in np.arange(-wide / 2 + 0.45, wide / 2 - 0.3, 0.6):
            cushion = plain_painter(self.random, tint(self.random, 0.35, 0.9), 60, 0.2)
            seat = back + aside * place + ahead * 0.2 + UP * 0.42
            self.quads += box(cushion, seat, (0.4, 0.36, 0.12), self.light, turn)

    def _plant(self, foot: Floats) -> None:
        tall = self.random.uniform(0.7, 1.5)
        self.quads += box(
            plain_painter(self.random, tint(self.random, 0.3, 0.5)), foot, (0.3, 0.3, 0.3), self.light, 0.4
        )
        self.quads.append(vertical_quad(tree(self.random, tall, 90), foot + UP * 0.25, None, self.light))

    def _place_free_standing(self) -> None:
        """Adds a table with chairs, a person or a floor lamp."""
        random = self.random
        margin = vector(0.8, 0, 0.8)
        share = vector(random.uniform(), 0, random.uniform())
        foot = self.low + margin + share * (self.high - self.low - 2 * margin)
        foot[1] = self.floor
        kind, turn = random.choice(["table", "table", "person", "lamp"]), random.uniform(0, 2 * np.pi)
        if kind == "table":
            size = random.uniform(0.8, 1.6), 0.74, random.uniform(0.6, 0.9)
            if self._reserve_floor(foot, size, turn):
                self._table(foot, size, turn)
        elif kind == "person" and self._reserve_floor(foot, (0.5, 1.7, 0.4), 0):
            self.quads.append(
                vertical_quad(figure(random, random.uniform(1.55, 1.85), 90), foot, None, self.light)
            )
        elif kind == "lamp" and self._reserve_floor(foot, (0.4, 1.6, 0.4), 0):
            self._floor_lamp(foot)

    def _table(self, foot: Floats, size: tuple[float, float, float], turn: float) -> None:
        random, (wide, tall, deep) = self.random, size
        wood = plain_painter(random, vector(0.35, 0.22, 0.12) * random.uniform(0.4, 1.6), 60, 0.2)
        ahead, aside = vector(-np.sin(turn), 0, np.cos(turn)), vector(np.cos(turn), 0, np.sin(turn))
        self.quads += box(wood, foot + UP * (tall - 0.05), (wide, 0.05, deep), self.light, turn)
        for right in (-0.45, 0.45):
            for front in (-0.42, 0.42):
                leg = foot + aside * right * wide + ahead * front * deep
                self.quads += box(wood, leg, (0.06, tall - 0.05, 0.06), self.light, turn)
        for _ in range(random.integers(1, 6)):
            thing = (
                foot
                + UP * tall
                + aside * random.uniform(-0.4, 0.4) * wide
                + ahead * random.uniform(-0.3, 0.3) * deep
            )
            bulk = random.uniform(0.05, 0.25), random.uniform(0.03, 0.3), random.uniform(0.05, 0.2)
            self.quads += box(
                plain_painter(random, tint(random, 0.3, 0.9)), thing, bulk, self.light, random.uniform(0, 3)
            )
        seat = plain_painter(random, tint(random, 0.2, 0.6), 60, 0.2)
        for side in (-1, 1):
            chair = foot + ahead * side * (deep / 2 + 0.3)
            if np.hypot(chair[0], chair[2]) > 1:
                self.quads += box(seat, chair + UP * 0.42, (0.42, 0.05, 0.42), self.light, turn)
                self.quads += box(
                    seat, chair + ahead * side * 0.2 + UP * 0.47, (0.42, 0.45, 0.04), self.light, turn
                )
                self.quads += box(wood, chair, (0.3, 0.42, 0.05), self.light, turn)

    def _floor_lamp(self, foot: Floats) -> None:
        colour = vector(1, 0.78, 0.5)

        def shade(_face: str, width: float, height: float) -> Canvas:
            canvas = Canvas(width, height, 80)
            canvas.rect((0, 0, width, height), colour, glow=5)
            canvas.area((0, 0, width, 0.05))[..., 4] = 15
            canvas.add_noise(self.random, 0.1)
            return canvas

        self.quads += box(
            plain_painter(self.random, vector(0.1, 0.1, 0.1)), foot, (0.03, 1.4, 0.03), self.light
        )
        self.quads += box(shade, foot + UP * 1.35, (0.36, 0.26, 0.36), self.light, 0.6)
        self.lamps.lamps.append(Lamp(foot + UP * 1.5, colour * 1.2))
        self.glows.append(Glow(foot + UP * 1.66, 0.03, colour * 400))
