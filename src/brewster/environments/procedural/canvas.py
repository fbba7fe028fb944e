"""Textured rectangles around a viewer, and their rendering as a lat-long map. All procedural environments use this module.

The surfaces of an environment are painted on a flat `Canvas` each and placed in space as a `Quad` with baked lighting.
`render` casts rays at all quads. Lengths are in metres, the viewer is at the origin, y is up, light is linear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[Any]
"""float32 of any shape."""
Colour: TypeAlias = Sequence[float] | Floats
Rect: TypeAlias = tuple[float, float, float, float]
"""Left, top, width and height in metres from the upper left corner of a canvas."""
Lighting: TypeAlias = Callable[[Floats, Floats], Floats]
"""A function of points (h, w, 3) and their unit normal (3,). It returns irradiance / pi at the points, (h, w, 3)."""

_STRIP_ROWS: Final = 32


def vector(*values: float) -> Floats:
    """Returns a float32 vector."""
    return np.array(values, np.float32)


def unit(values: Floats) -> Floats:
    """Returns the vectors (..., 3), normalised to length 1."""
    normalised: Floats = values / np.linalg.norm(values, axis=-1, keepdims=True)
    return normalised


def tint(rng: Generator, value: float, saturation: float) -> Floats:
    """Returns a random colour (3,) of about the brightness `value`: warm in 50 % of cases, blue in 30 %, else of any hue."""
    hues = rng.normal(0.92, 0.05), rng.normal(0.38, 0.05), rng.uniform()
    phase = hues[rng.choice(3, p=(0.5, 0.3, 0.2))] + vector(0, 1 / 3, 2 / 3)
    return np.clip(value * (1 + saturation * np.cos(2 * np.pi * phase)), 0.01, 1).astype(np.float32)


def resize(image: Floats, height: int, width: int, *, wrap: bool = False) -> Floats:
    """Resizes an image (h, w, ...) by bilinear interpolation between texel centres, without a low-pass filter."""
    return _stretch(_stretch(image, height, 0, wrap), width, 1, wrap)


def _stretch(image: Floats, length: int, axis: int, wrap: bool) -> Floats:
    old_length = image.shape[axis]
    if old_length == length:
        return image
    coordinates = (np.arange(length, dtype=np.float32) + 0.5) * (old_length / length) - 0.5
    low = np.floor(coordinates).astype(np.int32)
    fraction = (coordinates - low).reshape([-1 if side == axis else 1 for side in range(image.ndim)])
    mode: Literal["wrap", "clip"] = "wrap" if wrap else "clip"
    first: Floats = image.take(low, axis, mode=mode)
    second: Floats = image.take(low + 1, axis, mode=mode)
    second -= first
    second *= fraction
    second += first
    return second


def fractal(rng: Generator, height: int, width: int, cells: float = 4, octaves: int = 5) -> Floats:
    """Returns tileable fractal noise (height, width) of mean 0 and standard deviation 1.

    `cells` is the number of cells of the coarsest octave along the height.
    """
    total = np.zeros((1, 1), np.float32)
    for octave in range(octaves):
        rows = max(1, round(cells * 2**octave))
        size = min(rows, height), min(max(1, round(rows * width / height)), width)
        total = resize(total, *size, wrap=True) + rng.standard_normal(size, np.float32) * 0.65**octave
        if size == (height, width):
            break
    total = resize(total, height, width, wrap=True)
    noise: Floats = (total - total.mean()) / (total.std() + 1e-6)
    return noise


def lettering(rng: Generator, count: int, height: int, width: int) -> Floats:
    """Returns the mask (height, width) of a line of `count` random glyphs with gaps between words."""
    glyphs = np.zeros((count, 9, 6), np.float32)
    bars = rng.uniform(size=(count, 3)) < 0.6
    stems = rng.uniform(size=(count, 4)) < 0.6
    glyphs[:, 1:8, 0] = stems[:, :1] | ~stems[:, 1:2]
    glyphs[:, 1:4, 4] = stems[:, 1:2]
    glyphs[:, 4:8, 4] = stems[:, 2:3]
    glyphs[:, 1:8, 2] = np.maximum(glyphs[:, 1:8, 2], (stems[:, 3:] & ~bars[:, :1]).astype(np.float32))
    glyphs[:, [1, 4, 7], :5] = np.maximum(glyphs[:, [1, 4, 7], :5], bars[:, :, None])
    glyphs *= (rng.uniform(size=(count, 1, 1)) > 0.14) | (count < 6)
    line = glyphs.transpose(1, 0, 2).reshape(9, -1)
    return np.clip((resize(line, height, width) - 0.45) * 4 + 0.5, 0, 1)


@dataclass
class Canvas:
    """A flat surface that is painted. The radiance of an opaque texel is colour * (light + emission)."""

    width: float
    height: float
    density: float
    """Texels per metre."""
    colour: Colour = (0.5, 0.5, 0.5)
    pixels: Floats = field(init=False)
    """The texels (h, w, 5): red, green, blue, opacity, emission."""

    def __post_init__(self) -> None:
        size = (max(2, round(self.height * self.density)), max(2, round(self.width * self.density)), 5)
        self.pixels = np.empty(size, np.float32)
        self.pixels[:] = (*self.colour, 1, 0)

    def area(self, rect: Rect) -> Floats:
        """Returns a view of the texels (h, w, 5) of a rectangle, cropped to the canvas."""
        left, top, width, height = (self.density * side for side in rect)
        rows = slice(max(0, round(top)), max(0, round(top + height)))
        return self.pixels[rows, max(0, round(left)) : max(0, round(left + width))]

    def rect(self, rect: Rect, colour: Colour, *, emission: float = 0) -> None:
        """Paints a rectangle in one colour."""
        self.area(rect)[:] = (*colour, 1, emission)

    def paste(self, image: Floats, rect: Rect, *, emission: float = 0) -> None:
        """Paints an image (h, w, 3), scaled to the rectangle."""
        area = self.area(rect)
        area[..., :3] = resize(image, *area.shape[:2])
        area[..., 3:] = (1, emission)

    def write(self, rng: Generator, rect: Rect, colour: Colour, *, emission: float = 0) -> None:
        """Paints one line of random glyphs that fills the rectangle."""
        area = self.area(rect)
        if min(area.shape[:2]) > 2:
            count = max(1, round(rect[2] / rect[3] * 1.3))
            mask = lettering(rng, count, *area.shape[:2])[..., None]
            area += (np.array((*colour, 1, emission), np.float32) - area) * mask

    def add_noise(self, rng: Generator, amount: float, cells: float = 6, octaves: int = 6) -> None:
        """Multiplies the colours by fractal noise of relative standard deviation `amount`."""
        height, width = self.pixels.shape[:2]
        noise = fractal(rng, height, width, cells, octaves)
        self.pixels[..., :3] *= np.clip(1 + amount * noise, 0.2, 2)[..., None]


class MipmapTexture:
    """A mipmap of an image (h, w, c)."""

    def __init__(self, image: Floats) -> None:
        levels = [image]
        while min(levels[-1].shape[:2]) > 1:
            last = levels[-1][: levels[-1].shape[0] // 2 * 2, : levels[-1].shape[1] // 2 * 2]
            levels.append((last[::2, ::2] + last[1::2, ::2] + last[::2, 1::2] + last[1::2, 1::2]) * 0.25)
        self._texels = np.concatenate([level.reshape(-1, image.shape[2]) for level in levels])
        self._rows, self._columns = np.array([level.shape[:2] for level in levels], np.int32).T
        self._starts = np.cumsum([0, *(self._rows * self._columns)[:-1]], dtype=np.int32)

    def sample(self, across: Floats, down: Floats, footprint: Floats) -> Floats:
        """Returns texels (n, c) at coordinates that repeat with period 1.

        `footprint` is the width of a sample in texels of the finest level.
        """
        level = np.log2(np.maximum(footprint, 1)).astype(np.int32)
        level = np.minimum(level, len(self._starts) - 1)
        rows, columns = self._rows[level], self._columns[level]
        row = (down * rows).astype(np.int32) % rows
        column = (across * columns).astype(np.int32) % columns
        texels: Floats = self._texels.take(self._starts[level] + row * columns + column, axis=0)
        return texels


class Quad:
    """A canvas in space, with baked lighting. `sides` are the vectors from `corner` along its upper and its left edge."""

    def __init__(self, canvas: Canvas, corner: Floats, sides: tuple[Floats, Floats], light: Lighting) -> None:
        across, down = sides
        normal = unit(np.cross(across, down))
        self.distance = abs(float(normal @ corner))
        self.density = canvas.density
        self._outline = corner, across, down
        self._canvas, self._light = canvas, light
        self._normal = normal if normal @ corner < 0 else -normal

    @cached_property
    def projection(self) -> Floats:
        """The matrix (3, 3) that maps a direction to its coordinates (across, down, 1), divided by the distance."""
        corner, across, down = self._outline
        return np.linalg.inv(np.stack([across, down, corner], 1).astype(np.float64)).astype(np.float32)

    @cached_property
    def texture(self) -> MipmapTexture:
        """Radiance and opacity (h, w, 4)."""
        corner, across, down = self._outline
        pixels = self._canvas.pixels
        del self._canvas  # large, and not used from here on
        fine = 8 / (1 + self.distance / 6)
        lattice = [int(np.clip(np.linalg.norm(side) * fine, 4, 128)) for side in (down, across)]
        rows, columns = ((np.arange(count, dtype=np.float32) + 0.5) / count for count in lattice)
        points = corner + rows[:, None, None] * down + columns[:, None] * across
        light = resize(self._light(points, self._normal).astype(np.float32), *pixels.shape[:2])
        radiance = pixels[..., :3] * (light + pixels[..., 4:])
        return MipmapTexture(np.concatenate([radiance, pixels[..., 3:4]], 2))

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """The smallest and largest azimuth, and the smallest and largest polar angle, in radians."""
        corner, across, down = self._outline
        step = np.linspace(0, 1, 65)[:, None]
        path = [corner + step * across, corner + across + step * down]
        path += [corner + down + across - step * across, corner + down - step * down]
        x, y, z = np.concatenate(path).T
        turns = np.unwrap(np.arctan2(x, -z))
        polar = np.arctan2(np.hypot(x, z), y)
        if abs(turns[-1] - turns[0]) > 3:  # the outline encloses a pole
            return 0, 2 * np.pi, *((0, polar.max()) if y[0] > 0 else (polar.min(), np.pi))
        return turns.min(), turns.max(), polar.min() - 0.03, polar.max() + 0.03


@dataclass(frozen=True)
class SmallEmitter:
    """A round light source that may be smaller than a texel of the map. Its energy is preserved."""

    position: Floats
    radius: float
    """The radius in metres, at the distance of the position."""
    radiance: Colour


@dataclass(frozen=True)
class ProceduralEnvironment:
    """All surfaces and light sources around the viewer."""

    quads: Sequence[Quad]
    emitters: Sequence[SmallEmitter]
    sky: Callable[[Floats, float], Floats]
    """A function of unit directions (h, w, 3) and the angle of a texel in radians. It returns the radiance (h, w, 3) in
    directions without a surface."""
    rotation: float
    """Azimuth of the -z axis of the environment in the map, in radians."""


def render(environment: ProceduralEnvironment, height: int) -> NDArray[np.float32]:
    """Returns the lat-long map (height, 2 height, 3) of an environment, with four rays per texel.

    The map is rendered in strips that fit into the processor cache.
    """
    strips = [_strip(environment, height, top) for top in range(0, height, _STRIP_ROWS)]
    image: NDArray[np.float32] = np.concatenate(strips).astype(np.float32)
    for emitter in environment.emitters:
        if not _is_occluded(environment, emitter.position):
            _add_emitter(image, emitter, environment.rotation)
    return image


def _strip(environment: ProceduralEnvironment, height: int, top: int) -> Floats:
    rows = min(_STRIP_ROWS, height - top)
    polar = (np.arange(2 * top, 2 * (top + rows)) + 0.5) * (np.pi / (2 * height))
    inverse_depth = np.zeros((2 * rows, 4 * height), np.float32)
    colours = np.zeros((*inverse_depth.shape, 3), np.float32)
    for quad in environment.quads:
        low, high = quad.bounds[2:]
        inside = np.flatnonzero((polar >= low) & (polar <= high))
        if inside.size:
            chosen = slice(inside[0], inside[-1] + 1)
            for columns in _columns(quad, environment.rotation, 4 * height):
                _rasterise(
                    quad,
                    environment.rotation,
                    polar[chosen],
                    (columns, inverse_depth[chosen], colours[chosen]),
                )
    blocks = colours.reshape(rows, 2, 2 * height, 2, 3)
    solid = blocks[:, 0, :, 0] + blocks[:, 0, :, 1] + blocks[:, 1, :, 0] + blocks[:, 1, :, 1]
    free = (inverse_depth == 0).reshape(rows, 2, 2 * height, 2).mean((1, 3), dtype=np.float32)[..., None]
    radiance: Floats = solid * 0.25
    if free.any():
        radiance = radiance + free * environment.sky(
            directions(height, environment.rotation, top, rows), np.pi / height
        )
    return radiance


def directions(height: int, rotation: float, top: int, rows: int) -> Floats:
    """Returns unit directions (rows, 2 height, 3) of texel centres from row `top`, in an environment rotated by `rotation`."""
    polar = (np.arange(top, top + rows) + 0.5)[:, None] * (np.pi / height)
    azimuth = (np.arange(2 * height) + 0.5) * (np.pi / height) - rotation
    parts = np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth, -np.sin(polar) * np.cos(azimuth)
    return np.stack(parts, 2).astype(np.float32)


def _columns(quad: Quad, rotation: float, width: int) -> list[slice]:
    """Returns the columns that a quad may cover: one range, or two ranges if it crosses the seam of the map."""
    low, high = ((angle + rotation) * width / (2 * np.pi) for angle in quad.bounds[:2])
    first, count = int(np.floor(low)) % width, int(np.ceil(high) - np.floor(low)) + 1
    if count >= width:
        return [slice(0, width)]
    return [
        slice(first, min(width, first + count)),
        *([slice(0, over)] if (over := first + count - width) > 0 else []),
    ]


def _rasterise(quad: Quad, rotation: float, polar: Floats, target: tuple[slice, Floats, Floats]) -> None:
    """Draws the part of a quad that is closer than the surfaces drawn before.

    `target` is a range of columns, and the inverse depth and the colours of all columns of some rows. `polar` has the
    polar angles of these rows.
    """
    columns, inverse_depth, colours = target[0], target[1][:, target[0]], target[2][:, target[0]]
    width = target[1].shape[1]
    azimuth = (np.arange(columns.start, columns.stop) + 0.5) * (2 * np.pi / width) - rotation
    heading = np.stack([np.sin(azimuth), -np.cos(azimuth)]).astype(np.float32)
    level, rise = np.sin(polar).astype(np.float32)[:, None], np.cos(polar).astype(np.float32)[:, None]
    across, down, inverse_distance = (
        level * (row[0] * heading[0] + row[2] * heading[1]) + rise * row[1] for row in quad.projection
    )
    hit = (
        (inverse_distance > inverse_depth)
        & (across >= 0)
        & (across < inverse_distance)
        & (down >= 0)
        & (down < inverse_distance)
    )
    across, down, inverse_distance = across[hit], down[hit], inverse_distance[hit]
    if not inverse_distance.size:
        return
    # The footprint of a ray grows with distance, and with the angle to the normal of the surface.
    footprint = (
        quad.density
        * 2
        * np.pi
        / width
        / inverse_distance
        * np.maximum(inverse_distance * quad.distance, 0.01) ** -0.6
    )
    texels = quad.texture.sample(across / inverse_distance, down / inverse_distance, footprint)
    opaque = texels[:, 3] > 0.5
    if not opaque.all():
        hit[hit], texels, inverse_distance = opaque, texels[opaque], inverse_distance[opaque]
    inverse_depth[hit] = inverse_distance
    colours[hit] = texels[:, :3]


def _is_occluded(environment: ProceduralEnvironment, position: Floats) -> bool:
    for quad in environment.quads:
        across, down, inverse_distance = quad.projection @ position
        if inverse_distance > 1.05 and 0 <= across < inverse_distance and 0 <= down < inverse_distance:
            coordinates = np.array([[across / inverse_distance], [down / inverse_distance]], np.float32)
            if quad.texture.sample(coordinates[0], coordinates[1], np.ones(1, np.float32))[0, 3] > 0.5:
                return True
    return False


def _add_emitter(image: Floats, emitter: SmallEmitter, rotation: float) -> None:
    """Adds a disc at least three texels wide with exactly the energy of the emitter."""
    height, texel = image.shape[0], np.pi / image.shape[0]
    distance = float(np.linalg.norm(emitter.position))
    direction, radius = emitter.position / distance, emitter.radius / distance
    disc_radius = max(radius, 1.5 * texel)
    polar = float(np.arccos(np.clip(direction[1], -1, 1)))
    top = max(0, int((polar - disc_radius) / texel) - 2)
    rows = min(height, int((polar + disc_radius) / texel) + 3) - top
    chord = np.linalg.norm(directions(height, rotation, top, rows) - direction, axis=2)
    weight = np.clip((disc_radius - chord) / texel + 0.5, 0, 1)
    solid_angle = np.sin((np.arange(top, top + rows) + 0.5) * texel)[:, None] * texel**2
    energy = np.pi * radius**2 / (weight * solid_angle).sum()
    image[top : top + rows] += (weight * energy)[..., None] * np.asarray(emitter.radiance, np.float32)
