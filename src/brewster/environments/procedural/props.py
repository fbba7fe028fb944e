"""Objects of the procedural environments: surfaces, boxes, windows, cars, facades, and the lighting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from numpy.random import Generator

from brewster.environments.procedural.canvas import (
    Box,
    Canvas,
    Colour,
    Floats,
    Lighting,
    Quad,
    tint,
    unit,
    vector,
)

UP: Final = vector(0, 1, 0)
Painter: TypeAlias = Callable[[str, float, float], Canvas]
"""(face, width, height) -> canvas; a face is "front", "back", "left", "right", "top" or "bottom" of a box."""


@dataclass(frozen=True)
class Lamp:
    """A point light of intensity (3,) per steradian: to all sides, or to one half-space."""

    position: Floats
    intensity: Floats
    facing: Floats | None = None


@dataclass
class SceneLighting:
    """Lighting: ambient light, lamps, and contact shadows (x, z, half width, half depth) on the floor."""

    ambient: Floats
    floor: float
    """The height of the floor, below 0."""
    lamps: list[Lamp] = field(default_factory=list)
    contacts: list[tuple[float, float, float, float]] = field(default_factory=list)

    def __call__(self, points: Floats, normal: Floats) -> Floats:
        """Irradiance / pi (h, w, 3) at points of a surface."""
        light: Floats = np.zeros_like(points) + self.ambient * (0.8 + 0.2 * normal[1])
        middle, span = (points[0, 0] + points[-1, -1]) / 2, np.linalg.norm(points[0, 0] - points[-1, -1]) / 2
        for lamp in self.lamps:
            if np.linalg.norm(lamp.position - middle) > span + 30:
                continue
            way = lamp.position - points
            squared = np.maximum(np.einsum("hwc,hwc->hw", way, way), 0.04)
            weight = np.clip(way @ normal, 0, None) / (np.pi * squared * np.sqrt(squared))
            if lamp.facing is not None:
                weight *= np.clip(-(way @ lamp.facing), 0, None) / np.sqrt(squared)
            light += weight[..., None] * lamp.intensity
        return light * self.shade(points, normal)

    def shade(self, points: Floats, normal: Floats) -> Floats:
        """The factor (h, w, 1) of the contact shadows on the floor; 1 on other surfaces."""
        left = np.ones((*points.shape[:2], 1), np.float32)
        if normal[1] < 0.9 or points[0, 0, 1] > self.floor + 0.01:
            return left
        for x, z, half_width, half_depth in self.contacts:
            beside = np.clip(np.abs(points[..., :1] - x) - half_width, 0, None)
            behind = np.clip(np.abs(points[..., 2:] - z) - half_depth, 0, None)
            left *= 1 - 0.75 * np.exp(-(beside**2 + behind**2) / 0.12)
        return left


def vertical_quad(canvas: Canvas, foot: Floats, towards: Floats | None, light: Lighting) -> Quad:
    """A vertical canvas with the middle of its lower edge at `foot`, facing a direction or the viewer."""
    facing = unit(-foot * vector(1, 0, 1)) if towards is None else towards
    across = np.cross(-facing, UP) * canvas.width
    rise = UP * canvas.height
    return Quad(canvas, foot - across / 2 + rise, (across, -rise), light)


def horizontal_quad(canvas: Canvas, centre: Floats, light: Lighting, turn: float = 0) -> Quad:
    """A horizontal canvas. Its top is towards -z before the rotation about the vertical axis."""
    across = vector(np.cos(turn), 0, np.sin(turn)) * canvas.width
    down = vector(-np.sin(turn), 0, np.cos(turn)) * canvas.height
    return Quad(canvas, centre - across / 2 - down / 2, (across, down), light)


def box(
    paint: Painter, foot: Floats, size: tuple[float, float, float], light: Lighting, turn: float = 0
) -> list[Quad]:
    """The visible faces of a box (width, height, depth). Its front is towards +z before the rotation."""
    width, height, depth = size
    ahead, aside = vector(-np.sin(turn), 0, np.cos(turn)), vector(np.cos(turn), 0, np.sin(turn))
    faces = []
    for name, normal, reach, wide in (
        ("front", ahead, depth, width),
        ("back", -ahead, depth, width),
        ("right", aside, width, depth),
        ("left", -aside, width, depth),
    ):
        middle = foot + normal * (reach / 2)
        if normal @ middle < -0.02:
            faces.append(vertical_quad(paint(name, wide, height), middle, normal, light))
    if foot[1] + height < -0.02:
        faces.append(horizontal_quad(paint("top", width, depth), foot + UP * height, light, turn))
    elif foot[1] > 0.02:
        faces.append(horizontal_quad(paint("bottom", width, depth), foot, light, turn))
    return faces


def plain_painter(random: Generator, colour: Colour, density: float = 40, grain: float = 0.12) -> Painter:
    """A painter that paints every face in one colour with noise."""

    def paint(_face: str, width: float, height: float) -> Canvas:
        canvas = Canvas(width, height, density, colour)
        canvas.add_noise(random, grain, 6, 4)
        return canvas

    return paint


@dataclass(frozen=True)
class WindowStyle:
    """The style of the windows of one building."""

    frame: Floats
    columns: int
    rows: int
    lit: float
    """The share of lit windows; 0 in daylight."""
    sky: Floats
    """The colour of the sky that the glass reflects."""


def window(random: Generator, canvas: Canvas, place: Box, panes: WindowStyle) -> None:
    """Paints a window: glass that reflects the sky or shows a lit room, curtains or a blind, glazing bars."""
    left, top, width, height = place
    canvas.rect(place, panes.frame)
    bar = min(0.07, width / 8)
    inner = (left + bar, top + bar, width - 2 * bar, height - 2 * bar)
    glass = canvas.area(inner)
    if not glass.size:
        return
    fall = np.linspace(1, random.uniform(0.2, 0.7), glass.shape[0], dtype=np.float32)[:, None, None]
    if random.uniform() < panes.lit:
        glass[..., :3] = vector(1, random.uniform(0.6, 0.85), random.uniform(0.3, 0.7)) * (1.2 - fall)
        glass[..., 4] = 0.4 * np.exp(random.uniform(0, 3))
        canvas.rect(
            (left, top + height * 0.7, width * random.uniform(0.2, 0.6), height * 0.25),
            vector(0.05, 0.04, 0.03),
        )
    else:
        slant = np.linspace(0, random.uniform(-0.5, 0.5), glass.shape[1], dtype=np.float32)[:, None]
        glass[..., :3] = panes.sky * random.uniform(0.05, 0.45) * np.clip(fall + slant, 0.1, 1.2) + 0.01
        glass[..., 4] = 0 if panes.lit else 0.7
    _add_curtains(random, glass)
    for index in range(1, panes.columns):
        canvas.rect((left + width * index / panes.columns - bar / 2, top, bar, height), panes.frame)
    for index in range(1, panes.rows):
        canvas.rect((left, top + height * index / panes.rows - bar / 2, width, bar), panes.frame)


def _add_curtains(random: Generator, glass: Floats) -> None:
    """Paints curtains at the sides of a window, or a blind at its top, or nothing."""
    height, width = glass.shape[:2]
    choice, cloth = random.uniform(), tint(random, 0.5, 0.15)
    if choice < 0.3:
        wide = max(1, round(width * random.uniform(0.1, 0.35)))
        folds = 0.7 + 0.3 * np.cos(np.arange(wide, dtype=np.float32) * 2)[:, None]
        glass[:, :wide, :3] = cloth * folds
        glass[:, -wide:, :3] = cloth * folds
    elif choice < 0.55:
        tall = round(height * random.uniform(0.2, 0.9))
        glass[:tall, :, :3] = cloth * (0.7 + 0.3 * (np.arange(tall, dtype=np.float32) % 4 < 2))[:, None, None]


def car(random: Generator, foot: Floats, away: bool, light: Lighting, *, night: bool) -> list[Quad]:
    """A parked car along z. The viewer sees its tail lights if it points away, else its headlights."""
    colour = tint(random, random.uniform(0.02, 0.6), random.choice([0.0, 0.1, 0.8]))
    lamps = vector(0.6, 0.02, 0.02) if away else vector(0.9, 0.9, 0.85)

    def body(face: str, width: float, height: float) -> Canvas:
        canvas = Canvas(width, height, 40, colour)
        canvas.rect((0, height - 0.18, width, 0.18), vector(0.02, 0.02, 0.02))
        canvas.area((0, height * 0.35, width, 0.03))[..., :3] *= 0.3
        canvas.area((0, height * 0.25, width, 0.05))[..., :3] *= 1.5
        if face in {"left", "right"}:
            canvas.area((width * 0.5, 0, 0.02, height))[..., :3] *= 0.3
            for middle in (width * 0.2, width * 0.8):
                _wheel(canvas, middle)
        elif face in {"front", "back"}:
            for left in (0.08, width - 0.38):
                canvas.rect((left, height * 0.3, 0.3, 0.14), lamps, glow=20 if night else 0)
            canvas.rect((width * 0.36, height * 0.6, width * 0.28, 0.11), vector(0.8, 0.8, 0.6))
        return canvas

    def cabin(face: str, width: float, height: float) -> Canvas:
        canvas = Canvas(width, height, 40, colour)
        if face != "top":
            canvas.rect((0.08, 0.08, width - 0.16, height - 0.08), vector(0.02, 0.025, 0.03))
            canvas.rect((0.08, 0.08, width - 0.16, height * 0.35), vector(0.12, 0.14, 0.17))
            canvas.rect((width / 2 - 0.04, 0, 0.08, height * (face in {"left", "right"})), colour)
        return canvas

    long, tall = random.uniform(3.8, 4.8), random.uniform(0.75, 1.0)
    roof = foot + UP * (tall + 0.12) + vector(0, 0, random.uniform(-0.3, 0.3))
    return [
        *box(body, foot + UP * 0.12, (1.8, tall, long), light),
        *box(cabin, roof, (1.5, random.uniform(0.45, 0.7), long * 0.55), light),
    ]


def _wheel(canvas: Canvas, middle: float) -> None:
    """Paints a wheel at the lower edge of the side of a car."""
    rows, columns = canvas.pixels.shape[:2]
    y, x = np.ogrid[:rows, :columns]
    radius = np.hypot(x - middle * canvas.density, y - (rows - 8)) / canvas.density
    canvas.pixels[radius < 0.33, :3] = 0.015
    canvas.pixels[(radius < 0.22) & (radius > 0.04), :3] = 0.3


def bookshelf(random: Generator) -> Painter:
    """A painter of a shelf full of books."""
    wood = vector(0.35, 0.23, 0.13) * random.uniform(0.2, 1.9)
    sides = plain_painter(random, wood, 60)

    def paint(face: str, width: float, height: float) -> Canvas:
        if face != "front":
            return sides(face, width, height)
        canvas = Canvas(width, height, 110, wood)
        step = height / max(1, round(height / 0.34))
        for top in np.arange(0, height - 0.1, step):
            canvas.rect((0.03, top + 0.03, width - 0.06, step - 0.03), wood * 0.15)
            left = 0.04
            while left < width - 0.08:
                thick, tall = random.uniform(0.015, 0.055), step * random.uniform(0.5, 0.85)
                if random.uniform() < 0.9:
                    spine = tint(random, random.uniform(0.03, 0.5), 0.8)
                    canvas.rect((left, top + step - tall, thick - 0.004, tall), spine)
                    canvas.rect((left, top + step - tall * 0.8, thick - 0.004, 0.02), spine * 2)
                left += thick
        return canvas

    return paint


def cabinet(random: Generator) -> Painter:
    """A painter of a cabinet with drawers or doors."""
    colour = tint(random, random.uniform(0.1, 0.6), 0.3)
    sides = plain_painter(random, colour, 60)
    columns, rows = int(random.integers(1, 4)), int(random.integers(1, 4))

    def paint(face: str, width: float, height: float) -> Canvas:
        canvas = sides(face, width, height)
        if face == "front":
            for left in np.arange(columns) * width / columns:
                for top in np.arange(rows) * height / rows:
                    front = (left + 0.02, top + 0.02, width / columns - 0.04, height / rows - 0.04)
                    canvas.area(front)[..., :3] *= 0.5
                    canvas.area((front[0], front[1], front[2] - 0.015, front[3] - 0.015))[..., :3] *= 2.1
                    middle = left + width / columns / 2
                    canvas.rect((middle - 0.06, top + height / rows / 3, 0.12, 0.03), vector(0.1, 0.1, 0.1))
        return canvas

    return paint


def facade(
    random: Generator, wide: float, floors: int, *, density: float, night: bool, sky: Floats
) -> Canvas:
    """The front of a house: a grid of windows above a shop or an entrance, below a cornice."""
    storey, bays = random.uniform(2.8, 3.7), max(2, round(wide / random.uniform(1.8, 4.2)))
    bay = wide / bays
    wall = tint(random, random.uniform(0.12, 0.6), random.uniform(0.05, 0.3)) * vector(1.1, 1, 0.88)
    panes = WindowStyle(
        frame=vector(0.7, 0.7, 0.68) if random.uniform() < 0.6 else tint(random, 0.08, 0.5),
        columns=int(random.integers(1, 4)),
        rows=int(random.integers(1, 4)),
        lit=random.uniform(0.15, 0.7) if night else 0,
        sky=sky,
    )
    cells = _cells(random, Canvas(bay, storey, density, wall), panes)
    pattern = random.integers(0, len(cells), (floors, bays))
    body = cells[pattern].transpose(0, 2, 1, 3, 4).reshape(floors * cells.shape[1], -1, 5)
    base = _ground_floor(random, Canvas(body.shape[1] / density, storey * 1.15, density, wall), panes)
    cornice = Canvas(body.shape[1] / density, 0.7, density, wall * 1.15)
    cornice.area((0, 0.4, wide, 0.15))[..., :3] *= 0.4
    canvas = Canvas(wide, 0.7 + storey * (floors + 1.15), density, wall)
    canvas.pixels = np.concatenate([cornice.pixels, body, base.pixels])
    canvas.add_noise(random, random.uniform(0.06, 0.16), 8)
    return canvas


def _cells(random: Generator, blank: Canvas, panes: WindowStyle) -> Floats:
    """Variants (n, h, w, 5) of one bay of one storey: the same window with different content."""
    width, height = blank.width, blank.height
    share, tall = random.uniform(0.4, 0.92), random.uniform(0.45, 0.85)
    place = (width * (1 - share) / 2, height * (1 - tall) * 0.45, width * share, height * tall)
    stone = random.uniform(0.25, 0.6)
    band, sill, balcony = random.uniform(size=3) < (0.4, 0.5, 0.25)
    rail = tint(random, 0.1, 0.3)
    kinds = []
    for _ in range(9):
        cell = Canvas(width, height, blank.density, blank.colour)
        for course in np.arange(0, height, stone):
            cell.area((0, course, width, 0.03))[..., :3] *= 0.8
        if band:
            cell.area((0, height - 0.2, width, 0.2))[..., :3] *= 1.3
            cell.area((0, height - 0.04, width, 0.04))[..., :3] *= 0.4
        around = 0.12
        cell.area((place[0] - around, place[1] - around, place[2] + 2 * around, place[3] + around))[
            ..., :3
        ] *= 1.25
        window(random, cell, place, panes)
        if sill:
            cell.area((place[0] - 0.1, place[1] + place[3], place[2] + 0.2, 0.1))[..., :3] = 0.5
            cell.area((place[0] - 0.1, place[1] + place[3] + 0.1, place[2] + 0.2, 0.08))[..., :3] *= 0.5
        if balcony:
            for left in np.arange(0.1, width - 0.1, 0.15):
                cell.rect((left, height - 1.05, 0.04, 0.95), rail)
            cell.rect((0, height - 1.1, width, 0.07), rail)
            cell.rect((0, height - 0.12, width, 0.12), rail * 2)
        kinds.append(cell.pixels)
    return np.stack(kinds)


def _ground_floor(random: Generator, canvas: Canvas, panes: WindowStyle) -> Canvas:
    """Paints shop windows below signs, doors between them, and a plinth."""
    bottom, left = canvas.height, 0.3
    glow = 8 if panes.lit else 0
    shops = random.uniform() < 0.7
    canvas.rect((0, bottom - 0.4, canvas.width, 0.4), vector(0.12, 0.12, 0.12))
    while left < canvas.width - 1.5:
        wide = min(random.uniform(1.8, 4.5), canvas.width - left - 0.3)
        sign, ink = tint(random, random.uniform(0.02, 0.4), 1), tint(random, 0.7, 0.5)
        if shops:
            window(random, canvas, (left, 1.0, wide - 0.3, bottom - 1.5), panes)
            _wares(random, canvas, (left + 0.1, bottom - 1.6, wide - 0.5), glow / 3)
            canvas.rect((left - 0.1, 0.25, wide - 0.1, 0.6), sign, glow=glow * (random.uniform() < 0.3))
            canvas.write(random, (left + 0.1, 0.33, wide - 0.6, 0.44), ink, glow=glow)
        else:
            window(random, canvas, (left + 0.3, 0.9, 1.1, 1.5), panes)
        left += wide
        if left < canvas.width - 1.2 and random.uniform() < 0.6:
            door = tint(random, 0.15, 0.8)
            canvas.rect((left - 0.1, bottom - 2.4, 1.2, 2.4), door * 0.4)
            canvas.rect((left, bottom - 2.25, 1.0, 2.25), door)
            canvas.rect((left + 0.2, bottom - 2.0, 0.6, 0.8), vector(0.08, 0.09, 0.1), glow=glow)
            canvas.rect((left + 0.85, bottom - 1.1, 0.08, 0.08), vector(0.6, 0.5, 0.2))
            left += 1.3
    return canvas


def _wares(random: Generator, canvas: Canvas, place: tuple[float, float, float], glow: float) -> None:
    """Paints goods in a shop window, from (left, top) over a width, about 1 m tall."""
    left, top, wide = place
    offset = 0.0
    while offset < wide - 0.4:
        size, tall = random.uniform(0.15, 0.5), random.uniform(0.2, 0.9)
        canvas.rect((left + offset, top + 1 - tall, size, tall), tint(random, 0.3, 0.9), glow=glow)
        offset += size + random.uniform(0, 0.3)
