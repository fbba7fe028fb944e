"""Procedural pictures: paintings, posters, portraits, trees and people as cut-outs, and wall and floor finishes.

    picture = painting(seed=7, width=768, height=512)

Paintings are placed on walls and behind glass. They have edges and texture at several scales. Lengths on a canvas are in
metres.
"""

from __future__ import annotations

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

from brewster.environments.procedural.canvas import Canvas, Floats, fractal, lettering, resize, tint, vector


def painting(seed: int, width: int, height: int) -> NDArray[np.float32]:
    """Returns a picture (height, width, 3) in linear light, 0..1. The seed determines its kind."""
    rng = Generator(PCG64(seed))
    kind = (_abstract, _poster, _landscape, _portrait)[rng.integers(4)]
    picture = kind(rng, height, width)
    weave = fractal(rng, height, width, 40, 4)[..., None]
    result: NDArray[np.float32] = np.clip(picture * (1 + 0.04 * weave), 0, 1).astype(np.float32)
    return result


def _grid(height: int, width: int) -> tuple[Floats, Floats]:
    """Returns coordinates (1, w) and (h, 1) of texel centres relative to the middle, in image heights; y points down."""
    x = ((np.arange(width, dtype=np.float32) + 0.5) - width / 2) / height
    y = (np.arange(height, dtype=np.float32) + 0.5) / height - 0.5
    return x[None, :], y[:, None]


def _inside(distance: Floats, height: int) -> Floats:
    """Returns the mask (h, w, 1) of a shape from its signed distance (h, w), antialiased over about a texel."""
    result: Floats = np.clip(0.5 - distance * (0.7 * height), 0, 1)[..., None]
    return result


def _ellipse(grid: tuple[Floats, Floats], centre: tuple[float, float], radii: tuple[float, float]) -> Floats:
    """Returns the approximate signed distance (h, w) to an ellipse, negative inside."""
    x, y = (grid[0] - centre[0]) / radii[0], (grid[1] - centre[1]) / radii[1]
    result: Floats = (np.sqrt(x * x + y * y) - 1) * min(radii)
    return result


def _paint_ellipse(
    picture: Floats,
    centre: tuple[float, float],
    radii: tuple[float, float],
    colour: Floats,
    shade: Floats | None = None,
) -> None:
    """Paints an ellipse in a colour (3,), times a shade (h, w). Without a shade, it is translucent and of one colour."""
    height, width = picture.shape[:2]
    x, y = _grid(height, width)
    columns = np.flatnonzero(np.abs(x[0] - centre[0]) < radii[0] + 2 / height)
    rows = np.flatnonzero(np.abs(y[:, 0] - centre[1]) < radii[1] + 2 / height)
    if columns.size and rows.size:
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        mask = _inside(_ellipse((x[:, part[1]], y[part[0]]), centre, radii), height)
        if shade is None:
            _blend(picture[part], 0.5 * mask, colour)
        else:
            _blend(picture[part], mask, colour * shade[part][..., None])


def _blend(picture: Floats, mask: Floats, colour: Floats) -> None:
    """Blends a colour (..., 3) into a picture by the mask (h, w, 1)."""
    picture += (colour - picture) * mask


def _abstract(rng: Generator, height: int, width: int) -> Floats:
    """Returns brush strokes, from large to small, on a background with coarse noise."""
    palette = [tint(rng, rng.uniform(0.05, 0.6), rng.uniform(0.2, 1)) for _ in range(6)]
    coarse_noise = np.clip(0.5 + 0.3 * fractal(rng, height, width, 3), 0, 1)[..., None]
    picture = palette[0] + (palette[1] - palette[0]) * coarse_noise
    bristles = 1 + 0.25 * fractal(rng, 256, 256, 64, 2)
    for length in np.geomspace(0.9, 0.04, 260 if height > 256 else 90):
        _stroke(rng, picture, float(length), (palette[rng.integers(6)], bristles))
    return picture


def _stroke(rng: Generator, picture: Floats, length: float, paint: tuple[Floats, Floats]) -> None:
    """Paints one curved stroke with streaks of bristles. `length` is its approximate length in image heights."""
    height, width = picture.shape[:2]
    colour, bristles = paint
    reach = max(4, round(length * height * rng.uniform(0.6, 1.2)))
    top, left = int(rng.integers(-reach // 2, height)), int(rng.integers(-reach // 2, width))
    part = picture[max(0, top) : max(0, top + reach), max(0, left) : max(0, left + reach)]
    y, x = np.mgrid[: part.shape[0], : part.shape[1]].astype(np.float32) / reach - 0.5
    angle, bend, thickness = rng.uniform(0, np.pi), rng.uniform(-1, 1), rng.uniform(0.05, 0.2)
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle) + bend * (along * along - 0.1)
    streak = bristles[(across * 400).astype(np.int32) % 256, (along * 30).astype(np.int32) % 256]
    ragged = thickness * np.clip((0.42 + 0.06 * streak - np.abs(along)) * 20, 0, 1)
    mask = np.clip((ragged - np.abs(across)) * reach + 0.5, 0, 1) * np.clip(streak, 0.2, 1)
    _blend(part, mask[..., None], colour * streak[..., None])


def _poster(rng: Generator, height: int, width: int) -> Floats:
    """Returns a poster: bands, discs and stripes between a title and small print."""
    background_colour, *inks = (tint(rng, rng.uniform(0.02, 0.8), rng.uniform(0, 1)) for _ in range(5))
    picture = np.ones((height, width, 3), np.float32) * background_colour
    grid = _grid(height, width)
    angle = rng.uniform(0, np.pi)
    slope = grid[0] * np.cos(angle) + grid[1] * np.sin(angle)
    for ink in inks:
        band = np.abs(slope - rng.uniform(-0.6, 0.6)) - rng.uniform(0.02, 0.15)
        _blend(picture, _inside(band, height), ink)
    for _ in range(rng.integers(1, 6)):
        centre = rng.uniform(-0.45, 0.45) * width / height, rng.uniform(-0.3, 0.4)
        radius = rng.uniform(0.05, 0.3)
        disc = _ellipse(grid, centre, (radius, radius))
        if rng.uniform() < 0.5:
            disc = np.maximum(disc, np.abs(np.mod(slope * rng.uniform(12, 30), 1) - 0.5) * 0.04 - 0.01)
        _blend(picture, _inside(disc, height), inks[rng.integers(4)])
    ink = vector(0.9, 0.88, 0.8) if background_colour.mean() < 0.25 else vector(0.02, 0.02, 0.03)
    _print_line(rng, picture, (0.05, rng.uniform(0.1, 0.2), int(rng.integers(4, 11))), ink)
    top = rng.uniform(0.6, 0.75)
    for line in range(rng.integers(2, 7)):
        _print_line(rng, picture, (top + 0.05 * line, 0.03, int(rng.integers(18, 36))), ink)
    return picture


def _print_line(rng: Generator, picture: Floats, line: tuple[float, float, int], ink: Floats) -> None:
    """Prints a line of glyphs, at most as wide as the margins allow.

    `line` is the top and the height of the line in image heights, and the number of glyphs.
    """
    height, width = picture.shape[:2]
    top, rows = round(line[0] * height), max(2, round(line[1] * height))
    columns = min(round(width * 0.9), max(4, round(rows * 0.75 * line[2])))
    part = picture[top : top + rows, width // 20 :][:, :columns]
    if part.size:
        _blend(part, lettering(rng, line[2], *part.shape[:2])[..., None], ink)


def _landscape(rng: Generator, height: int, width: int) -> Floats:
    """Returns a landscape: sky, a sun, ranges of hills that fade with distance, and trees in front."""
    x, y = _grid(height, width)
    zenith, haze = (
        tint(rng, 0.3, 0.5) * vector(0.6, 0.9, 1.5),
        tint(rng, 0.7, 0.15) * vector(1.1, 1, 0.95),
    )
    picture: Floats = zenith + (haze - zenith) * np.clip(y * 1.6 + 0.7 + 0 * x, 0, 1)[..., None] ** 1.5
    clouds = np.clip(fractal(rng, height, width, 4, 7) * 0.5 - 0.1, 0, 0.9) * np.clip(0.3 - y, 0, 1)
    _blend(picture, clouds[..., None] * 1.5, vector(0.95, 0.92, 0.9))
    sun = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0)
    _blend(picture, _inside(_ellipse((x, y), sun, (0.04, 0.04)), height), vector(1, 0.95, 0.8))
    ground = tint(rng, 0.12, 0.4) * vector(0.9, 1.2, 0.6)
    texture = 1 + 0.35 * fractal(rng, height, width, 50, 4)
    range_count = rng.integers(4, 7)
    for number in range(range_count):
        nearness = number / (range_count - 1)  # 0 for the farthest range of hills, 1 for the nearest
        ridge = rng.uniform(-0.05, 0.02) + 0.4 * nearness - _ridge(rng, width) * rng.uniform(0.03, 0.09)
        if nearness > 0.4:  # trees along the ridge
            ridge = ridge - np.abs(_ridge(rng, width, 60)) * 0.02 * nearness
        colour = haze * (1 - nearness) * 0.6 + ground * (0.4 + 0.6 * nearness)
        shade = (texture * np.clip(1.2 - (y - ridge) * 1.5, 0.3, 1.2))[..., None]
        _blend(picture, _inside(ridge - y, height), colour * (1 + (shade - 1) * nearness))
    return picture


def _ridge(rng: Generator, width: int, bumps: int = 3) -> Floats:
    """Returns fractal noise (width,) with this number of bumps at the coarsest scale."""
    line = np.zeros(width, np.float32)
    for octave in range(6):
        line += resize(rng.standard_normal((1, bumps * 2**octave), np.float32), 1, width)[0] * 0.5**octave
    return line


def _portrait(rng: Generator, height: int, width: int) -> Floats:
    """Returns a portrait: head and shoulders of a person, with defocused lights in the background."""
    grid = _grid(height, width)
    background_colour = tint(rng, rng.uniform(0.05, 0.4), rng.uniform(0.1, 0.6))
    picture = background_colour * np.clip(1 + 0.35 * fractal(rng, height, width, 2, 4), 0.2, 3)[..., None]
    for _ in range(rng.integers(5, 30)):
        centre = rng.uniform(-0.5, 0.5) * width / height, rng.uniform(-0.5, 0.5)
        radius = rng.uniform(0.02, 0.09)
        colour = tint(rng, 0.6, 0.6)
        _paint_ellipse(picture, centre, (radius, radius), colour)
    skin = vector(0.62, 0.36, 0.25) * rng.uniform(0.2, 1.1)
    hair, cloth = (
        vector(0.4, 0.25, 0.14) * rng.uniform(0.05, 1.4),
        tint(rng, rng.uniform(0.03, 0.6), 0.8),
    )
    middle, top = rng.uniform(-0.15, 0.15), rng.uniform(-0.14, -0.04)
    light = 0.75 - rng.choice([-1, 1]) * np.clip((grid[0] - middle) * 2.5, -0.5, 0.5) + 0 * grid[1]
    texture = light * (1 + 0.12 * fractal(rng, height, width, 30, 5))
    strands = light * (1 + 0.4 * resize(fractal(rng, 8, 256, 2, 6), height, width))
    weave = texture * (
        1 + 0.3 * np.sign(np.sin((grid[0] + rng.uniform(-1, 1) * grid[1]) * rng.uniform(40, 160)))
    )
    hair_length = rng.uniform(0.16, 0.3)
    parts = [
        ((0.0, hair_length * 0.4), (0.19, 0.2 + hair_length * 0.7), hair, strands),
        ((0.0, 0.62), (0.4, 0.36), cloth, weave),
        ((0.0, 0.22), (0.075, 0.13), skin * 0.75, texture),
        ((0.0, 0.0), (0.145, 0.2), skin, texture),
        ((0.0, -0.16), (0.16, 0.085), hair, strands),
        ((0.0, 0.115), (0.05, 0.014), skin * vector(0.8, 0.35, 0.4), texture),
        ((0.0, 0.05), (0.018, 0.03), skin * 0.7, texture),
    ]
    for side in (-0.06, 0.06):
        parts.append(((side, -0.02), (0.026, 0.012), vector(0.75, 0.75, 0.72), light))
        parts.append(((side, -0.02), (0.011, 0.011), vector(0.02, 0.02, 0.03), light))
        parts.append(((side, -0.055), (0.036, 0.007), hair * 0.7, strands))
    for (right, down), radii, colour, shade in parts:
        _paint_ellipse(picture, (middle + right, top + down), radii, colour, shade)
    return picture


def tree(rng: Generator, height: float, density: float) -> Canvas:
    """Returns a cut-out tree on a square canvas, `height` metres tall. `density` is in texels per metre."""
    canvas = Canvas(height, height, density)
    size = canvas.pixels.shape[0]
    x, y = _grid(size, size)
    crown = np.full((size, size), 9, np.float32)
    reach = rng.uniform(0.2, 0.3)
    for _ in range(24):
        radius = rng.uniform(0.06, 0.15)
        centre = np.clip(rng.normal(0, reach * 0.6, 2), -0.4 + radius, 0.4 - radius) - (0, 0.1)
        crown = np.minimum(crown, _ellipse((x, y), (float(centre[0]), float(centre[1])), (radius, radius)))
    leaves = 0.7 * fractal(rng, size, size, 8, 4) + 0.8 * fractal(rng, size, size, 48, 3)
    trunk = np.abs(x + 0.02 * np.sin(y * 9)) - 0.02 - 0.02 * np.clip(y, 0, 1)
    trunk = np.where(y > -0.2, trunk, 9)
    foliage = crown + 0.035 * leaves < 0
    green = vector(0.09, 0.14, 0.035) * (0.6 + 0.8 * rng.uniform(size=3).astype(np.float32))
    shade = np.clip(1 - 1.2 * y + 0.45 * leaves, 0.25, 2.5)[..., None]
    canvas.pixels[..., :3] = np.where(foliage[..., None], green * shade, vector(0.08, 0.06, 0.045))
    canvas.pixels[..., 3] = foliage | (trunk < 0)
    return canvas


def person(rng: Generator, height: float, density: float) -> Canvas:
    """Returns a cut-out standing person, `height` metres tall. `density` is in texels per metre."""
    canvas = Canvas(height * 0.4, height, density)
    rows, columns = canvas.pixels.shape[:2]
    grid = _grid(rows, columns)
    skin = vector(0.6, 0.35, 0.25) * rng.uniform(0.2, 1)
    coat, trousers, hair = (tint(rng, rng.uniform(0.03, 0.5), 0.7) for _ in range(3))
    step = rng.uniform(0.02, 0.07)
    parts = [
        ((-step, 0.27), (0.04, 0.24), trousers),
        ((step, 0.27), (0.04, 0.24), trousers * 0.8),
        ((-0.1, -0.1), (0.028, 0.2), coat * 0.7),
        ((0.1, -0.1), (0.028, 0.2), coat * 0.8),
        ((0.0, -0.13), (0.095, 0.23), coat),
        ((0.0, -0.425), (0.048, 0.07), hair),
        ((0.0, -0.41), (0.04, 0.052), skin),
    ]
    canvas.pixels[..., 3] = 0
    shade = np.clip(1 + 0.1 * fractal(rng, rows, columns, 40, 3) - 2 * grid[0], 0.3, 1.6)[..., None]
    for centre, radii, colour in parts:
        inside = _ellipse(grid, centre, radii) < 0
        canvas.pixels[inside, :3] = (colour * shade)[inside]
        canvas.pixels[inside, 3] = 1
    return canvas


def window_view(rng: Generator) -> Floats:
    """Returns a defocused view from a window (24, 24, 3): sky, roofs and trees. The maximum is about 1."""
    sky = vector(0.6, 0.8, 1) if rng.uniform() < 0.6 else vector(0.95, 0.97, 1)
    down = np.linspace(0, 1, 24, dtype=np.float32)[:, None, None]
    view = sky + (vector(1, 1, 1) - sky) * down + np.zeros((24, 24, 1), np.float32)
    left = 0
    while left < 24:
        columns, top = int(rng.integers(2, 7)), int(rng.integers(6, 20))
        view[top:, left : left + columns] = tint(rng, rng.uniform(0.1, 0.35), 0.35)
        left += columns
    leaf = vector(0.1, 0.18, 0.05) * rng.uniform(0.6, 1.6)
    view[rng.integers(14, 22) :] = leaf * (0.6 + rng.uniform(size=(24, 1)).astype(np.float32))
    return view


def wall_finish(rng: Generator, canvas: Canvas) -> None:
    """Paints plaster, stripes, bricks or panels above a baseboard at the floor."""
    choice = rng.uniform()
    if choice < 0.2:
        period = round(canvas.density * rng.uniform(0.08, 0.3))
        canvas.pixels[:, np.arange(canvas.pixels.shape[1]) % period < period // 2, :3] *= rng.uniform(
            0.7, 0.95
        )
    elif choice < 0.35:
        for brick_row, top in enumerate(np.arange(0, canvas.height, 0.09)):
            canvas.area((0, top, canvas.width, 0.02))[..., :3] *= 1.35
            for left in np.arange((brick_row % 2) * 0.13, canvas.width, 0.26):
                canvas.area((left, top, 0.245, 0.07))[..., :3] *= rng.uniform(0.75, 1.15)
    elif choice < 0.5:
        for left in np.arange(0.1, canvas.width, 0.7):
            canvas.area((left, canvas.height - 1.0, 0.55, 0.8))[..., :3] *= 0.8
            canvas.area((left + 0.03, canvas.height - 0.97, 0.55, 0.8))[..., :3] *= 1.25
    canvas.add_noise(rng, rng.uniform(0.01, 0.05), 10)
    canvas.add_noise(rng, rng.uniform(0.01, 0.06), 100, 2)
    canvas.rect((0, canvas.height - 0.1, canvas.width, 0.1), vector(0.7, 0.69, 0.66))
    canvas.rect((0, canvas.height - 0.11, canvas.width, 0.015), vector(0.2, 0.2, 0.2))


def door(rng: Generator, canvas: Canvas, left: float) -> None:
    """Paints a panelled door on a wall. `left` is the position of its left edge."""
    colour, top = tint(rng, rng.uniform(0.15, 0.7), 0.3), canvas.height - 2.05
    canvas.rect((left - 0.08, top - 0.08, 1.06, 2.2), colour * 0.7)
    canvas.rect((left, top, 0.9, 2.05), colour)
    for row in (0.15, 1.1):
        canvas.rect((left + 0.13, top + row, 0.64, 0.8), colour * 0.6)
        canvas.rect((left + 0.15, top + row + 0.02, 0.62, 0.78), colour * 1.05)
    canvas.rect((left + 0.8, top + 1.0, 0.05, 0.12), vector(0.6, 0.55, 0.4))


def hang_pictures(rng: Generator, canvas: Canvas, left: float, width_m: float) -> None:
    """Paints one large framed picture, or two or three small ones."""
    count = int(rng.integers(1, 4))
    each = width_m / count
    for index in range(count):
        width, height = each * 0.85, rng.uniform(0.35, 0.9)
        start, top = left + index * each, rng.uniform(0.4, 0.7)
        frame = tint(rng, rng.choice([0.03, 0.3, 0.7]), 0.3)
        canvas.area((start + 0.02, top + 0.03, width, height))[..., :3] *= 0.5
        canvas.rect((start, top, width, height), frame)
        mount = rng.choice([0.03, 0.07])
        canvas.rect((start + 0.025, top + 0.025, width - 0.05, height - 0.05), vector(0.8, 0.8, 0.77))
        inner = (start + mount, top + mount, width - 2 * mount, height - 2 * mount)
        rows, columns = canvas.area(inner).shape[:2]
        if min(rows, columns) > 8:
            canvas.paste(painting(int(rng.integers(1 << 30)), columns, rows), inner)


def curtain(area: Floats, cloth: Floats, emission: float) -> None:
    """Paints folds of cloth on an area (h, w, 5). `emission` is the light of the window that the cloth transmits."""
    folds = 0.65 + 0.35 * np.cos(np.arange(area.shape[1], dtype=np.float32) * 0.9)
    area[..., :3] = cloth * folds[:, None]
    area[..., 3:] = (1, emission)


def flooring(rng: Generator, canvas: Canvas) -> None:
    """Paints planks, tiles or carpet."""
    choice, colour = rng.uniform(), np.array(canvas.colour, np.float32)
    if choice < 0.5:
        wood = vector(0.36, 0.22, 0.12) * rng.uniform(0.4, 1.5)
        for left in np.arange(0, canvas.width, 0.14):
            top = -rng.uniform(0, 1.5)
            while top < canvas.height:
                canvas.rect((left, top, 0.13, 1.49), wood * rng.uniform(0.7, 1.25))
                canvas.rect((left + 0.13, top, 0.012, 1.5), wood * 0.3)
                canvas.rect((left, top + 1.485, 0.14, 0.015), wood * 0.3)
                top += 1.5
    elif choice < 0.8:
        size, other = rng.uniform(0.2, 0.6), tint(rng, rng.uniform(0.05, 0.5), 0.3)
        for row, top in enumerate(np.arange(0, canvas.height, size)):
            for column, left in enumerate(np.arange(0, canvas.width, size)):
                shade = (colour, other)[(row + column) % 2] * rng.uniform(0.9, 1.1)
                canvas.rect((left, top, size - 0.015, size - 0.015), shade)
    canvas.add_noise(rng, 0.1 if choice < 0.8 else 0.25, 30)


def rug(rng: Generator, canvas: Canvas) -> None:
    """Paints a rug with nested borders and a woven pattern in the middle."""
    width, height = canvas.width * rng.uniform(0.3, 0.6), canvas.height * rng.uniform(0.3, 0.6)
    left, top = (canvas.width - width) * rng.uniform(), (canvas.height - height) * rng.uniform()
    for inset in (0.0, 0.06, 0.16, 0.22):
        rim = (left + inset, top + inset, width - 2 * inset, height - 2 * inset)
        canvas.rect(rim, tint(rng, rng.uniform(0.05, 0.4), 0.8))
    area = canvas.area((left + 0.22, top + 0.22, width - 0.44, height - 0.44))
    y, x = np.ogrid[: area.shape[0], : area.shape[1]]
    period = rng.uniform(12, 40)
    area[..., :3] *= 1 + 0.4 * np.sign(np.sin(x / period * 6) * np.sin(y / period * 6))[..., None]
    canvas.area((left, top, width, height))[..., :3] *= rng.uniform(
        0.8, 1.2, (*canvas.area((left, top, width, height)).shape[:2], 1)
    )
