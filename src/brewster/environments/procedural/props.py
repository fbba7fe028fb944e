"""Objects of the procedural environments (surfaces, boxes, windows, cars, facades), and their lighting.

Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from numpy.random import Generator

from brewster.environments.procedural.canvas import (
    Canvas,
    Colour,
    Floats,
    Lighting,
    Quad,
    Rect,
    tint,
    unit,
    vector,
)

UP: Final = vector(0, 1, 0)
Painter: TypeAlias = Callable[[str, float, float], Canvas]
"""A function (face, width, height) that returns the painted canvas of a face of a box.

A face is "front", "back", "left", "right", "top" or "bottom".
"""


@dataclass(frozen=True)
class Lamp:
    """A point light of intensity (3,) per steradian. If `facing` is None, it emits equally in all directions.
    Otherwise it emits only in the half-space of `facing`, with intensity proportional to the cosine of the angle to `facing`.
    """

    position: Floats
    intensity: Floats
    facing: Floats | None = None


@dataclass
class EnvironmentLighting:
    """The lighting: ambient light, lamps, and contact shadows (x, z, half width, half depth) on the floor."""

    ambient: Floats
    floor_y_m: float
    """The height of the floor relative to the viewer, below 0."""
    lamps: list[Lamp] = field(default_factory=list)
    contact_shadows: list[tuple[float, float, float, float]] = field(default_factory=list)

    def __call__(self, points: Floats, normal: Floats) -> Floats:
        """Returns irradiance / pi (h, w, 3) at points (h, w, 3) of a surface with this unit normal (3,)."""
        light: Floats = np.zeros_like(points) + self.ambient * (0.8 + 0.2 * normal[1])
        middle, span = (points[0, 0] + points[-1, -1]) / 2, np.linalg.norm(points[0, 0] - points[-1, -1]) / 2
        for lamp in self.lamps:
            if np.linalg.norm(lamp.position - middle) > span + 30:
                continue
            to_lamp = lamp.position - points
            squared = np.maximum(np.einsum("hwc,hwc->hw", to_lamp, to_lamp), 0.04)
            weight = np.clip(to_lamp @ normal, 0, None) / (np.pi * squared * np.sqrt(squared))
            if lamp.facing is not None:
                weight *= np.clip(-(to_lamp @ lamp.facing), 0, None) / np.sqrt(squared)
            light += weight[..., None] * lamp.intensity
        return light * self.contact_shadow_factor(points, normal)

    def contact_shadow_factor(self, points: Floats, normal: Floats) -> Floats:
        """Returns the factor (h, w, 1) of the contact shadows on the floor; 1 on other surfaces."""
        factor = np.ones((*points.shape[:2], 1), np.float32)
        if normal[1] < 0.9 or points[0, 0, 1] > self.floor_y_m + 0.01:
            return factor
        for x, z, half_width, half_depth in self.contact_shadows:
            x_distance = np.clip(np.abs(points[..., :1] - x) - half_width, 0, None)
            z_distance = np.clip(np.abs(points[..., 2:] - z) - half_depth, 0, None)
            factor *= 1 - 0.75 * np.exp(-(x_distance**2 + z_distance**2) / 0.12)
        return factor


def vertical_quad(canvas: Canvas, foot: Floats, normal: Floats | None, light: Lighting) -> Quad:
    """Places a canvas vertically, with the middle of its lower edge at `foot`.

    The canvas faces the direction `normal`, or the viewer if `normal` is None.
    """
    facing = unit(-foot * vector(1, 0, 1)) if normal is None else normal
    across = np.cross(-facing, UP) * canvas.width
    rise = UP * canvas.height
    return Quad(canvas, foot - across / 2 + rise, (across, -rise), light)


def horizontal_quad(canvas: Canvas, centre: Floats, light: Lighting, rotation: float = 0) -> Quad:
    """Places a canvas horizontally. Its upper edge is towards -z before the rotation about the vertical axis."""
    across = vector(np.cos(rotation), 0, np.sin(rotation)) * canvas.width
    down = vector(-np.sin(rotation), 0, np.cos(rotation)) * canvas.height
    return Quad(canvas, centre - across / 2 - down / 2, (across, down), light)


def box(
    paint: Painter, foot: Floats, size: tuple[float, float, float], light: Lighting, rotation: float = 0
) -> list[Quad]:
    """Returns the visible faces of a box of `size` (width, height, depth). Its front is towards +z before the rotation."""
    width, height, depth = size
    forward, sideways = (
        vector(-np.sin(rotation), 0, np.cos(rotation)),
        vector(np.cos(rotation), 0, np.sin(rotation)),
    )
    faces = []
    for name, normal, extent, face_width in (
        ("front", forward, depth, width),
        ("back", -forward, depth, width),
        ("right", sideways, width, depth),
        ("left", -sideways, width, depth),
    ):
        middle = foot + normal * (extent / 2)
        if normal @ middle < -0.02:
            faces.append(vertical_quad(paint(name, face_width, height), middle, normal, light))
    if foot[1] + height < -0.02:
        faces.append(horizontal_quad(paint("top", width, depth), foot + UP * height, light, rotation))
    elif foot[1] > 0.02:
        faces.append(horizontal_quad(paint("bottom", width, depth), foot, light, rotation))
    return faces


def plain_painter(rng: Generator, colour: Colour, density: float = 40, grain: float = 0.12) -> Painter:
    """Returns a painter that paints every face in one colour with noise."""

    def paint(_face: str, width: float, height: float) -> Canvas:
        canvas = Canvas(width, height, density, colour)
        canvas.add_noise(rng, grain, 6, 4)
        return canvas

    return paint


@dataclass(frozen=True)
class WindowStyle:
    """The style of the windows of one building."""

    frame: Floats
    columns: int
    rows: int
    lit_fraction: float
    """The fraction of lit windows, 0..1; 0 in daylight."""
    sky: Floats
    """The colour of the sky that the glass reflects."""


def paint_window(rng: Generator, canvas: Canvas, outline: Rect, style: WindowStyle) -> None:
    """Paints a window: glass that reflects the sky or shows a lit room, curtains or a blind, and glazing bars."""
    left, top, width, height = outline
    canvas.rect(outline, style.frame)
    bar = min(0.07, width / 8)
    inner = (left + bar, top + bar, width - 2 * bar, height - 2 * bar)
    glass = canvas.area(inner)
    if not glass.size:
        return
    vertical_gradient = np.linspace(1, rng.uniform(0.2, 0.7), glass.shape[0], dtype=np.float32)[:, None, None]
    if rng.uniform() < style.lit_fraction:
        glass[..., :3] = vector(1, rng.uniform(0.6, 0.85), rng.uniform(0.3, 0.7)) * (1.2 - vertical_gradient)
        glass[..., 4] = 0.4 * np.exp(rng.uniform(0, 3))
        canvas.rect(
            (left, top + height * 0.7, width * rng.uniform(0.2, 0.6), height * 0.25),
            vector(0.05, 0.04, 0.03),
        )
    else:
        slant = np.linspace(0, rng.uniform(-0.5, 0.5), glass.shape[1], dtype=np.float32)[:, None]
        glass[..., :3] = (
            style.sky * rng.uniform(0.05, 0.45) * np.clip(vertical_gradient + slant, 0.1, 1.2) + 0.01
        )
        glass[..., 4] = 0 if style.lit_fraction else 0.7
    _add_curtains(rng, glass)
    for index in range(1, style.columns):
        canvas.rect((left + width * index / style.columns - bar / 2, top, bar, height), style.frame)
    for index in range(1, style.rows):
        canvas.rect((left, top + height * index / style.rows - bar / 2, width, bar), style.frame)


def _add_curtains(rng: Generator, glass: Floats) -> None:
    """Paints curtains at the sides of a window, or a blind at its top, or nothing."""
    height, width = glass.shape[:2]
    choice, cloth = rng.uniform(), tint(rng, 0.5, 0.15)
    if choice < 0.3:
        curtain_columns = max(1, round(width * rng.uniform(0.1, 0.35)))
        folds = 0.7 + 0.3 * np.cos(np.arange(curtain_columns, dtype=np.float32) * 2)[:, None]
        glass[:, :curtain_columns, :3] = cloth * folds
        glass[:, -curtain_columns:, :3] = cloth * folds
    elif choice < 0.55:
        blind_rows = round(height * rng.uniform(0.2, 0.9))
        glass[:blind_rows, :, :3] = (
            cloth * (0.7 + 0.3 * (np.arange(blind_rows, dtype=np.float32) % 4 < 2))[:, None, None]
        )


def car_quads(rng: Generator, foot: Floats, faces_away: bool, light: Lighting, *, night: bool) -> list[Quad]:
    """Returns a parked car along z. The viewer sees its tail lights if the car faces away, else its headlights."""
    colour = tint(rng, rng.uniform(0.02, 0.6), rng.choice([0.0, 0.1, 0.8]))
    lamps = vector(0.6, 0.02, 0.02) if faces_away else vector(0.9, 0.9, 0.85)

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
                canvas.rect((left, height * 0.3, 0.3, 0.14), lamps, emission=20 if night else 0)
            canvas.rect((width * 0.36, height * 0.6, width * 0.28, 0.11), vector(0.8, 0.8, 0.6))
        return canvas

    def cabin(face: str, width: float, height: float) -> Canvas:
        canvas = Canvas(width, height, 40, colour)
        if face != "top":
            canvas.rect((0.08, 0.08, width - 0.16, height - 0.08), vector(0.02, 0.025, 0.03))
            canvas.rect((0.08, 0.08, width - 0.16, height * 0.35), vector(0.12, 0.14, 0.17))
            canvas.rect((width / 2 - 0.04, 0, 0.08, height * (face in {"left", "right"})), colour)
        return canvas

    length_m, height_m = rng.uniform(3.8, 4.8), rng.uniform(0.75, 1.0)
    cabin_foot = foot + UP * (height_m + 0.12) + vector(0, 0, rng.uniform(-0.3, 0.3))
    return [
        *box(body, foot + UP * 0.12, (1.8, height_m, length_m), light),
        *box(cabin, cabin_foot, (1.5, rng.uniform(0.45, 0.7), length_m * 0.55), light),
    ]


def _wheel(canvas: Canvas, middle: float) -> None:
    """Paints a wheel at the lower edge of the side of a car."""
    rows, columns = canvas.pixels.shape[:2]
    y, x = np.ogrid[:rows, :columns]
    radius = np.hypot(x - middle * canvas.density, y - (rows - 8)) / canvas.density
    canvas.pixels[radius < 0.33, :3] = 0.015
    canvas.pixels[(radius < 0.22) & (radius > 0.04), :3] = 0.3


def bookshelf_painter(rng: Generator) -> Painter:
    """Returns a painter of a shelf full of books."""
    wood = vector(0.35, 0.23, 0.13) * rng.uniform(0.2, 1.9)
    sides = plain_painter(rng, wood, 60)

    def paint(face: str, width: float, height: float) -> Canvas:
        if face != "front":
            return sides(face, width, height)
        canvas = Canvas(width, height, 110, wood)
        step = height / max(1, round(height / 0.34))
        for top in np.arange(0, height - 0.1, step):
            canvas.rect((0.03, top + 0.03, width - 0.06, step - 0.03), wood * 0.15)
            left = 0.04
            while left < width - 0.08:
                thickness_m, height_m = rng.uniform(0.015, 0.055), step * rng.uniform(0.5, 0.85)
                if rng.uniform() < 0.9:
                    spine = tint(rng, rng.uniform(0.03, 0.5), 0.8)
                    canvas.rect((left, top + step - height_m, thickness_m - 0.004, height_m), spine)
                    canvas.rect((left, top + step - height_m * 0.8, thickness_m - 0.004, 0.02), spine * 2)
                left += thickness_m
        return canvas

    return paint


def cabinet_painter(rng: Generator) -> Painter:
    """Returns a painter of a cabinet with drawers or doors."""
    colour = tint(rng, rng.uniform(0.1, 0.6), 0.3)
    sides = plain_painter(rng, colour, 60)
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 4))

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
    rng: Generator, width_m: float, floors: int, *, density: float, night: bool, sky: Floats
) -> Canvas:
    """Returns the front of a house: a cornice, a grid of windows, and shops or entrances on the ground floor."""
    storey, bays = rng.uniform(2.8, 3.7), max(2, round(width_m / rng.uniform(1.8, 4.2)))
    bay = width_m / bays
    wall = tint(rng, rng.uniform(0.12, 0.6), rng.uniform(0.05, 0.3)) * vector(1.1, 1, 0.88)
    style = WindowStyle(
        frame=vector(0.7, 0.7, 0.68) if rng.uniform() < 0.6 else tint(rng, 0.08, 0.5),
        columns=int(rng.integers(1, 4)),
        rows=int(rng.integers(1, 4)),
        lit_fraction=rng.uniform(0.15, 0.7) if night else 0,
        sky=sky,
    )
    cells = _cells(rng, Canvas(bay, storey, density, wall), style)
    pattern = rng.integers(0, len(cells), (floors, bays))
    body = cells[pattern].transpose(0, 2, 1, 3, 4).reshape(floors * cells.shape[1], -1, 5)
    base = _ground_floor(rng, Canvas(body.shape[1] / density, storey * 1.15, density, wall), style)
    cornice = Canvas(body.shape[1] / density, 0.7, density, wall * 1.15)
    cornice.area((0, 0.4, width_m, 0.15))[..., :3] *= 0.4
    canvas = Canvas(width_m, 0.7 + storey * (floors + 1.15), density, wall)
    canvas.pixels = np.concatenate([cornice.pixels, body, base.pixels])
    canvas.add_noise(rng, rng.uniform(0.06, 0.16), 8)
    return canvas


def _cells(rng: Generator, blank: Canvas, style: WindowStyle) -> Floats:
    """Returns variants (n, h, w, 5) of one bay of one storey: the same window with different content."""
    width, height = blank.width, blank.height
    width_fraction, height_fraction = rng.uniform(0.4, 0.92), rng.uniform(0.45, 0.85)
    outline = (
        width * (1 - width_fraction) / 2,
        height * (1 - height_fraction) * 0.45,
        width * width_fraction,
        height * height_fraction,
    )
    stone = rng.uniform(0.25, 0.6)
    band, sill, balcony = rng.uniform(size=3) < (0.4, 0.5, 0.25)
    rail = tint(rng, 0.1, 0.3)
    cells = []
    for _ in range(9):
        cell = Canvas(width, height, blank.density, blank.colour)
        for stone_row in np.arange(0, height, stone):
            cell.area((0, stone_row, width, 0.03))[..., :3] *= 0.8
        if band:
            cell.area((0, height - 0.2, width, 0.2))[..., :3] *= 1.3
            cell.area((0, height - 0.04, width, 0.04))[..., :3] *= 0.4
        margin = 0.12
        cell.area((outline[0] - margin, outline[1] - margin, outline[2] + 2 * margin, outline[3] + margin))[
            ..., :3
        ] *= 1.25
        paint_window(rng, cell, outline, style)
        if sill:
            cell.area((outline[0] - 0.1, outline[1] + outline[3], outline[2] + 0.2, 0.1))[..., :3] = 0.5
            cell.area((outline[0] - 0.1, outline[1] + outline[3] + 0.1, outline[2] + 0.2, 0.08))[..., :3] *= (
                0.5
            )
        if balcony:
            for left in np.arange(0.1, width - 0.1, 0.15):
                cell.rect((left, height - 1.05, 0.04, 0.95), rail)
            cell.rect((0, height - 1.1, width, 0.07), rail)
            cell.rect((0, height - 0.12, width, 0.12), rail * 2)
        cells.append(cell.pixels)
    return np.stack(cells)


def _ground_floor(rng: Generator, canvas: Canvas, style: WindowStyle) -> Canvas:
    """Paints shop windows below signs, or plain windows; doors; and a plinth."""
    bottom, left = canvas.height, 0.3
    emission = 8 if style.lit_fraction else 0
    shops = rng.uniform() < 0.7
    canvas.rect((0, bottom - 0.4, canvas.width, 0.4), vector(0.12, 0.12, 0.12))
    while left < canvas.width - 1.5:
        width_m = min(rng.uniform(1.8, 4.5), canvas.width - left - 0.3)
        sign, ink = tint(rng, rng.uniform(0.02, 0.4), 1), tint(rng, 0.7, 0.5)
        if shops:
            paint_window(rng, canvas, (left, 1.0, width_m - 0.3, bottom - 1.5), style)
            _shop_goods(rng, canvas, left + 0.1, bottom - 0.6, width_m - 0.5, emission=emission / 3)
            canvas.rect(
                (left - 0.1, 0.25, width_m - 0.1, 0.6), sign, emission=emission * (rng.uniform() < 0.3)
            )
            canvas.write(rng, (left + 0.1, 0.33, width_m - 0.6, 0.44), ink, emission=emission)
        else:
            paint_window(rng, canvas, (left + 0.3, 0.9, 1.1, 1.5), style)
        left += width_m
        if left < canvas.width - 1.2 and rng.uniform() < 0.6:
            door = tint(rng, 0.15, 0.8)
            canvas.rect((left - 0.1, bottom - 2.4, 1.2, 2.4), door * 0.4)
            canvas.rect((left, bottom - 2.25, 1.0, 2.25), door)
            canvas.rect((left + 0.2, bottom - 2.0, 0.6, 0.8), vector(0.08, 0.09, 0.1), emission=emission)
            canvas.rect((left + 0.85, bottom - 1.1, 0.08, 0.08), vector(0.6, 0.5, 0.2))
            left += 1.3
    return canvas


def _shop_goods(
    rng: Generator, canvas: Canvas, left: float, bottom: float, width_m: float, *, emission: float
) -> None:
    """Paints a row of goods, at most 0.9 m tall, in a shop window. `left` and `bottom` are in metres on the canvas."""
    offset = 0.0
    while offset < width_m - 0.4:
        size, height_m = rng.uniform(0.15, 0.5), rng.uniform(0.2, 0.9)
        canvas.rect(
            (left + offset, bottom - height_m, size, height_m), tint(rng, 0.3, 0.9), emission=emission
        )
        offset += size + rng.uniform(0, 0.3)
