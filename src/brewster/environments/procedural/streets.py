"""A street between two rows of houses, by day or by night, for `canvas.render`. Lengths are in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator

from brewster.environments.procedural.canvas import (
    Canvas,
    Floats,
    MipmapTexture,
    ProceduralEnvironment,
    Quad,
    SmallEmitter,
    fractal,
    tint,
    unit,
    vector,
)
from brewster.environments.procedural.paintings import painting, person, tree
from brewster.environments.procedural.props import (
    UP,
    EnvironmentLighting,
    Lamp,
    box,
    car_quads,
    facade,
    horizontal_quad,
    plain_painter,
    vertical_quad,
)

_HALF_LENGTH_M: Final = 90.0
"""Half the length of the street in m."""
_SUN_RADIUS_RAD: Final = 0.00465


@dataclass(frozen=True)
class _Sky:
    """The sky: a gradient, clouds and, by day, the halo of the sun."""

    zenith: Floats
    horizon: Floats
    cloud: Floats
    cloud_threshold: float
    """Threshold of the cloud noise: -2 is overcast, 2 is clear."""
    sun: Floats
    """The unit direction of the sun."""
    sunlight: Floats
    """Irradiance / pi (3,) on a surface that faces the sun; 0 if clouds hide the sun."""
    noise: MipmapTexture

    def __call__(self, directions: Floats, texel: float) -> Floats:
        """Returns the radiance (h, w, 3) in unit directions (h, w, 3). `texel` is the angle of a texel in radians."""
        rise = np.maximum(directions[..., 1:2], 0)
        radiance = self.zenith + (self.horizon - self.zenith) * np.exp(-5 * rise)
        nearness = np.maximum(directions @ self.sun, 0)[..., None]
        halo = 0.03 * nearness**8 + 0.12 * nearness**64 + 0.6 * nearness**800
        radiance = radiance + self.sunlight * halo
        thickness = self._thickness(directions, rise[..., 0], texel)
        cloud_opacity = np.clip(thickness * 1.5, 0, 1) * np.clip(rise * 8, 0, 1)
        dark = np.clip(1.25 - 0.45 * thickness, 0.5, 1.2)
        lit = self.cloud * dark + self.sunlight * halo * np.exp(-3 * thickness)
        result: Floats = radiance + (lit - radiance) * cloud_opacity
        return result

    def _thickness(self, directions: Floats, rise: Floats, texel: float) -> Floats:
        """Returns the thickness (h, w, 1) of the clouds, a flat layer that curves down at the horizon."""
        height = rise + 0.1
        coordinates = [(directions[..., axis] / height * 0.35 % 1).ravel() for axis in (0, 2)]
        footprint = (texel * 0.35 * 512 / height**1.5).ravel()
        return np.maximum(
            self.noise.sample(coordinates[0], coordinates[1], footprint).reshape(*rise.shape, 1)
            - self.cloud_threshold,
            0,
        )


def _day_sky(rng: Generator) -> _Sky:
    elevation, azimuth = rng.uniform(0.25, 1.2), rng.uniform(0, 2 * np.pi)
    sun = vector(np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth))
    low = np.exp(-elevation * 4)
    is_overcast = rng.uniform() < 0.25
    warmth = vector(1, 0.93 - 0.3 * low, 0.85 - 0.6 * low)
    blue = vector(0.3, 0.5, 1) * rng.uniform(0.4, 0.8)
    grey = vector(0.95, 0.97, 1) * rng.uniform(0.6, 1.2)
    haze = vector(0.9, 0.95, 1) * rng.uniform(0.7, 1.3) + (warmth - 0.8) * low
    return _Sky(
        zenith=grey * 0.9 if is_overcast else blue,
        horizon=grey if is_overcast else haze,
        cloud=grey if is_overcast else warmth * rng.uniform(1.1, 1.8),
        cloud_threshold=rng.uniform(-1.2, -0.3) if is_overcast else rng.uniform(-0.1, 1.8),
        sun=sun,
        sunlight=warmth * (0.0 if is_overcast else rng.uniform(3, 6.5) * (1 - 0.5 * low)),
        noise=MipmapTexture(fractal(rng, 512, 512, 3, 7)[..., None]),
    )


def _night_sky(rng: Generator) -> _Sky:
    town = vector(1, 0.65, 0.4) * rng.uniform(0.005, 0.04)
    return _Sky(
        zenith=vector(0.3, 0.4, 1) * rng.uniform(0.002, 0.01),
        horizon=town,
        cloud=town * 0.7,
        cloud_threshold=rng.uniform(-0.5, 1.8),
        sun=UP,
        sunlight=vector(0, 0, 0),
        noise=MipmapTexture(fractal(rng, 512, 512, 3, 7)[..., None]),
    )


class _Street:
    """The layout of one street, its lighting, and the objects placed so far."""

    def __init__(self, rng: Generator, *, night: bool) -> None:
        self.rng, self.night = rng, night
        self.ground = -float(rng.choice([1.6, 1.6, rng.uniform(3, 8)]))
        self.half_width = {side: rng.uniform(6, 16) for side in (-1, 1)}
        self.pavement = rng.uniform(2.4, 3.6)
        self.sky = _night_sky(rng) if night else _day_sky(rng)
        ambient = vector(0.04, 0.04, 0.05) if night else 0.5 * (self.sky.zenith + self.sky.horizon)
        self.lighting = EnvironmentLighting(ambient, self.ground)
        self.roofs = {side: np.full(256, -99, np.float32) for side in (-1, 1)}
        self.crowns: list[tuple[Floats, float]] = []
        self.quads: list[Quad] = []
        self.emitters: list[SmallEmitter] = []

    def light(self, points: Floats, normal: Floats) -> Floats:
        """Returns irradiance / pi of lamps, sky (reduced near the ground) and sun (with shadows of houses and trees)."""
        height_factor = np.clip((points[..., 1:2] - self.ground) / 12, 0, 1)
        total = self.lighting(points, normal) * (1 if self.night else 0.65 + 0.35 * height_factor)
        facing = float(normal @ self.sky.sun)
        if facing > 0 and self.sky.sunlight.any():
            total += (
                self._sunlit(points)[..., None]
                * self.lighting.contact_shadow_factor(points, normal)
                * facing
                * self.sky.sunlight
            )
        haze = 0 if self.night else np.clip(np.linalg.norm(points, axis=2, keepdims=True) / 400, 0, 0.3)
        result: Floats = total * (1 - haze) + haze * self.sky.horizon * 1.5
        return result

    def _sunlit(self, points: Floats) -> Floats:
        x, y, z = np.moveaxis(points, 2, 0)
        sun = self.sky.sun
        side = 1 if sun[0] > 0 else -1
        distance = (side * self.half_width[side] - x) / (sun[0] + 1e-6 * side)
        column = np.clip((z + distance * sun[2] + 128).astype(np.int32), 0, 255)
        above = y + distance * sun[1] - self.roofs[side][column]
        lit = np.where(distance < 0.3, 1, np.clip(above * 1.5 + 0.5, 0, 1))
        for crown, radius in self.crowns:
            offset = crown - points
            along = offset @ sun
            squared_distance = np.einsum("hwc,hwc->hw", offset, offset) - along * along
            lit *= 1 - 0.85 * (np.clip(1.3 - squared_distance / radius**2, 0, 0.5) * 2) * (along > 0)
        return lit


def street_environment(rng: Generator, *, night: bool) -> ProceduralEnvironment:
    """Returns a street with houses, trees, cars and people, and with lamps at night."""
    street = _Street(rng, night=night)
    if night:
        _light_lamps(street)
    planted = rng.uniform() < 0.6
    for side in (-1, 1):
        park = rng.uniform() < 0.15
        if not park:
            _row_of_houses(street, side)
        if planted or park:
            _trees(street, side, park=park)
        _signs_and_poles(street, side)
    _cars(street)
    _people_and_posters(street)
    _ends(street)
    _paving(street)
    if not night and street.sky.sunlight.any():
        radiance = street.sky.sunlight / _SUN_RADIUS_RAD**2
        street.emitters.append(SmallEmitter(street.sky.sun * 1000, _SUN_RADIUS_RAD * 1000, radiance))
    return ProceduralEnvironment(street.quads, street.emitters, street.sky, rng.uniform(0, 2 * np.pi))


def _row_of_houses(street: _Street, side: int) -> None:
    rng, z = street.rng, -_HALF_LENGTH_M
    typical = rng.uniform(2, 7)
    while z < _HALF_LENGTH_M:
        if rng.uniform() < 0.12:
            z += rng.uniform(3, 9)
        width_m = rng.uniform(8, 22)
        floors = max(1, round(typical * rng.uniform(0.6, 1.5)))
        back = street.half_width[side] + rng.choice([0, 0, rng.uniform(0.3, 2)])
        foot = vector(side * back, street.ground, z + width_m / 2)
        _house(street, foot, width_m, floors)
        z += width_m


def _house(street: _Street, foot: Floats, width_m: float, floors: int) -> None:
    rng, side = street.rng, 1 if foot[0] > 0 else -1
    normal = vector(-side, 0, 0)
    distance_m = float(np.hypot(foot[0], max(0, abs(foot[2]) - width_m / 2)))
    front = facade(
        rng,
        width_m,
        floors,
        density=float(np.clip(170 / distance_m, 4, 26)),
        night=street.night,
        sky=street.sky.horizon,
    )
    street.quads.append(vertical_quad(front, foot, normal, street.light))
    start = int(foot[2] - width_m / 2 + 128)
    street.roofs[side][start : start + round(width_m)] = foot[1] + front.height
    gable = Canvas(12, front.height, 8, front.colour)
    for index in range(floors):
        gable.rect((rng.uniform(1, 10), front.height - 2.5 - 3.2 * index, 0.9, 1.3), vector(0.04, 0.05, 0.06))
    gable.add_noise(rng, 0.15)
    end = -np.sign(foot[2])  # the end that the viewer sees
    corner = foot + vector(side * 6, 0, end * width_m / 2)
    if abs(foot[2]) > width_m / 2:
        street.quads.append(vertical_quad(gable, corner, vector(0, 0, end), street.light))
    if rng.uniform() < 0.45:
        _roof(street, foot + UP * front.height, width_m, side)


def _roof(street: _Street, eave: Floats, width_m: float, side: int) -> None:
    """Adds a tiled roof with skylights above the eave."""
    rng = street.rng
    slope = vector(-side * rng.uniform(3, 5), -rng.uniform(2, 4), 0)
    canvas = Canvas(width_m, float(np.linalg.norm(slope)), 12, tint(rng, 0.12, 0.3) + vector(0.06, 0.01, 0))
    canvas.pixels[::3, :, :3] *= 0.7
    canvas.add_noise(rng, 0.25, 12)
    for left in np.arange(1.5, width_m - 1.5, rng.uniform(2.5, 5)):
        canvas.rect((left, 1.2, 0.9, 1.3), vector(0.5, 0.55, 0.6), emission=0)
    across = vector(0, 0, side) * width_m
    street.quads.append(Quad(canvas, eave - slope - across / 2, (across, slope), street.light))


def _paving(street: _Street) -> None:
    """Adds road, kerbs, pavements and markings: a fine canvas around the viewer, and a coarse, slightly lower canvas."""
    rng = street.rng
    asphalt, slabs = rng.uniform(0.05, 0.12), tint(rng, rng.uniform(0.2, 0.4), 0.06)
    stripes = rng.uniform() < 0.4
    for length_m, density in ((44.0, 20.0), (2 * _HALF_LENGTH_M + 40, 5.0)):
        width_m = street.half_width[-1] + street.half_width[1] + 30
        canvas = Canvas(width_m, length_m, density, slabs)
        middle = 15 + street.half_width[-1]
        canvas.pixels[:: max(2, round(density * 0.6)), :, :3] *= 0.75
        canvas.pixels[:, :: max(2, round(density * 0.6)), :3] *= 0.75
        left, right = (
            middle - street.half_width[-1] + street.pavement,
            middle + street.half_width[1] - street.pavement,
        )
        canvas.rect((left - 0.2, 0, right - left + 0.4, length_m), vector(0.3, 0.3, 0.29))
        canvas.rect((left, 0, right - left, length_m), vector(1, 1, 1.03) * asphalt)
        for start in np.arange(0.5, length_m, 6):
            canvas.rect(((left + right) / 2 - 0.08, start, 0.16, 3), vector(0.55, 0.55, 0.52))
        if stripes and length_m < 50:
            for start in np.arange(left + 0.4, right - 0.4, 1.0):
                canvas.rect((start, length_m / 2 - 11, 0.5, 3.5), vector(0.6, 0.6, 0.58))
        canvas.add_noise(rng, 0.06, length_m / 3, 3)
        canvas.add_noise(rng, 0.1, length_m * 6, 2)
        centre = vector(
            (street.half_width[1] - street.half_width[-1]) / 2,
            street.ground - (0.04 if length_m > 50 else 0),
            0,
        )
        street.quads.append(horizontal_quad(canvas, centre, street.light))


def _ends(street: _Street) -> None:
    """Adds a house or hills at both ends of the street."""
    rng = street.rng
    for end in (-1, 1):
        foot = vector(rng.uniform(-10, 10), street.ground, end * (_HALF_LENGTH_M + rng.uniform(5, 40)))
        if rng.uniform() < 0.6:
            canvas = facade(
                rng, 60, int(rng.integers(3, 9)), density=5, night=street.night, sky=street.sky.horizon
            )
        else:
            canvas = Canvas(300, 30, 3, vector(0.1, 0.12, 0.08))
            canvas.add_noise(rng, 0.4, 5)
            ridge = 30 + 25 * fractal(rng, 4, canvas.pixels.shape[1], 1, 6)[0]
            canvas.pixels[..., 3] = np.arange(canvas.pixels.shape[0])[:, None] > ridge
        street.quads.append(vertical_quad(canvas, foot, vector(0, 0, -end), street.light))


def _trees(street: _Street, side: int, *, park: bool) -> None:
    rng = street.rng
    typical = rng.uniform(5, 10)
    first = street.half_width[side] - street.pavement + 0.6
    rows = [first, first + 7, first + 16] if park else [first]
    for row in rows:
        for z in np.arange(-60, 60, rng.uniform(8, 15)):
            foot = vector(side * (row + rng.uniform(-0.3, 0.3)), street.ground, z + rng.uniform(-2, 2))
            distance_m = float(np.hypot(foot[0], foot[2]))
            if distance_m > 3:
                canvas = tree(rng, typical * rng.uniform(0.7, 1.3), float(np.clip(170 / distance_m, 4, 28)))
                street.quads.append(vertical_quad(canvas, foot, None, street.light))
                street.crowns.append((foot + UP * canvas.height * 0.6, canvas.height * 0.3))


def _light_lamps(street: _Street) -> None:
    """Adds street lamps along both kerbs."""
    rng = street.rng
    height_m, gap = rng.uniform(5, 8), rng.uniform(16, 26)
    colour = vector(1, rng.uniform(0.5, 0.9), rng.uniform(0.15, 0.8)) * rng.uniform(100, 250)
    start = rng.uniform(0, gap)
    for index, z in enumerate(np.arange(-60 + start, 60, gap)):
        side = 1 if index % 2 else -1
        position = vector(
            side * (street.half_width[side] - street.pavement - 0.5), street.ground + height_m, z
        )
        street.lighting.lamps.append(Lamp(position, colour, -UP))
        street.emitters.append(SmallEmitter(position - UP * 0.12, 0.16, colour / (np.pi * 0.16**2)))
        street.quads += box(
            plain_painter(rng, vector(0.1, 0.1, 0.1)), position, (0.9, 0.12, 0.35), street.light
        )


def _signs_and_poles(street: _Street, side: int) -> None:
    """Adds posts, road signs on posts, and signs that hang from the houses."""
    rng = street.rng
    kerb = street.half_width[side] - street.pavement + 0.3
    for z in np.arange(-55 + rng.uniform(0, 15), 60, rng.uniform(12, 20)):
        foot = vector(side * kerb, street.ground, z)
        height_m = rng.uniform(2.5, 6)
        street.quads.append(
            vertical_quad(Canvas(0.12, height_m, 30, vector(0.15, 0.16, 0.16)), foot, None, street.light)
        )
        face = Canvas(0.7, 0.7, 90, tint(rng, 0.4, 1))
        face.rect((0.06, 0.06, 0.58, 0.58), vector(0.8, 0.8, 0.8))
        face.write(rng, (0.1, 0.2, 0.5, 0.28), tint(rng, 0.05, 1))
        normal = vector(0, 0, -np.sign(z))
        street.quads.append(
            vertical_quad(face, foot + UP * (height_m - 0.6) + normal * 0.08, normal, street.light)
        )
        if rng.uniform() < 0.6:
            _hanging_sign(
                street,
                vector(side * (street.half_width[side] - 0.6), street.ground + rng.uniform(3, 5), z + 4),
            )


def _hanging_sign(street: _Street, foot: Floats) -> None:
    rng, colour = street.rng, tint(street.rng, 0.5, 1)
    emission = rng.uniform(5, 40) if street.night else 0
    height_m = rng.uniform(0.6, 2.5)
    canvas = Canvas(1.1, height_m, 60, colour * (0.1 if emission else 1))
    ink = colour if emission else vector(0.9, 0.9, 0.85)
    canvas.rect((0.05, 0.05, 1, 0.05), ink, emission=emission)
    canvas.rect((0.05, height_m - 0.1, 1, 0.05), ink, emission=emission)
    for top in np.arange(0.18, height_m - 0.5, 0.5):
        canvas.write(rng, (0.12, top, 0.86, 0.36), ink, emission=emission)
    normal = vector(0, 0, -np.sign(foot[2]))
    street.quads.append(vertical_quad(canvas, foot, normal, street.light))
    if emission:
        street.lighting.lamps.append(Lamp(foot + UP * height_m / 2, colour * emission * 0.4))


def _cars(street: _Street) -> None:
    rng = street.rng
    for side in (-1, 1):
        if (x := street.half_width[side] - street.pavement - 1.1) < 2.4 and street.ground > -3:
            continue
        for z in np.arange(-45, 45, 6.0):
            if rng.uniform() < 0.45:
                foot = vector(side * x, street.ground, z + rng.uniform(-0.5, 0.5))
                faces_away = bool((side > 0) == (z < 0))
                street.lighting.contact_shadows.append((float(foot[0]), float(foot[2]), 0.85, 2))
                street.quads += car_quads(rng, foot, faces_away, street.light, night=street.night)
                if street.night and not faces_away and rng.uniform() < 0.5:
                    nose = foot - vector(0, 0, np.sign(z) * 2.6) + UP * 0.7
                    for offset in (-0.65, 0.65):
                        position = nose + vector(offset, 0, 0)
                        street.emitters.append(SmallEmitter(position, 0.07, vector(1, 0.93, 0.8) * 4000))


def _people_and_posters(street: _Street) -> None:
    rng = street.rng
    for _ in range(rng.integers(3, 12)):
        side = rng.choice([-1, 1])
        x = street.half_width[side] - rng.uniform(0.5, street.pavement - 0.3)
        foot = vector(side * x, street.ground, rng.uniform(-30, 30))
        street.quads.append(vertical_quad(person(rng, rng.uniform(1.55, 1.9), 60), foot, None, street.light))
    for _ in range(4):  # posters on a column
        side = rng.choice([-1, 1])
        foot = vector(side * (street.half_width[side] - 0.8), street.ground, rng.uniform(-20, 20))
        picture = painting(int(rng.integers(1 << 30)), 96, 144)
        canvas = Canvas(1.2, 2.2, 80, vector(0.1, 0.1, 0.1))
        canvas.paste(picture, (0.08, 0.08, 1.04, 1.6), emission=6 if street.night else 0)
        street.quads.append(
            vertical_quad(canvas, foot, unit(vector(-side, 0, -np.sign(foot[2]))), street.light)
        )
