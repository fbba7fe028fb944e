"""Makes bursts with ground truth in which the glass covers only a part of the picture.

    .venv/bin/python bench/simulate_panes.py out/panes 30 picture
    .venv/bin/python bench/simulate_panes.py out/doors 30 door
    .venv/bin/python bench/simulate_panes.py out/mirrors 30 mirror
    .venv/bin/python bench/film_verdicts.py out/panes out/doors out/mirrors

The photos are those of $BREWSTER_DATA that no network was trained on. Each burst has five photos of
640 x 480 pixels, with noise, exposure and JPEG of their own. A pinhole camera (26 mm equivalent)
moves along a line or a circle in front of a plane wall with a hole:

- picture: a picture under glass, in the plane of the wall, which is nearly parallel to the sensor.
  Wall and picture move alike: two layers explain everything.
- door: a glass door in a wall that is filmed obliquely. The wall, the scene behind the door and the
  mirrored scene have three motions, and no two layers explain them.
- mirror: a mirror in such a wall. It transmits nothing.

The folder has the layout `bursts` (docs/evaluation.md), and pane.png is white where the middle
photo shows glass. motions.csv has the relative motion of the layers behind and in the glass.
"""

import csv
import os
import sys
from pathlib import Path

import cv2
import numpy as np
from simulate_bursts import FRAMES, HEIGHT, HELD_OUT, WIDTH, read_layer, save

FOCAL_PX = 0.75 * WIDTH
MIDDLE = FRAMES // 2
EDGE_PX = 0.7
MOTIONS_PX = (12, 60)
"""Of the mirrored scene relative to the scene behind the glass, in pixels of 1,000."""
MIRRORED = 0.85
"""The share of light that a mirror reflects."""


def seen(plane, camera):
    """Where the middle view, at 0, shows what a camera at (x, y) metres sees of a plane: pixels
    from the centre, (2, h, w). `plane` is its normal and its distance in metres.
    """
    normal, distance = plane
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    rays = np.stack([columns - WIDTH / 2, rows - HEIGHT / 2, np.full(rows.shape, FOCAL_PX)])
    rays /= FOCAL_PX
    start = np.array([*camera, 0.0])
    along = (distance - normal @ start) / np.tensordot(normal, rays, 1)
    points = start[:, None, None] + along * rays
    return FOCAL_PX * points[:2] / np.maximum(points[2], 0.1)


def sampled(layer, positions):
    """A layer, which is larger than the frame, at positions from its centre."""
    centre = np.array(layer.shape[1::-1])[:, None, None] / 2
    x, y = (positions + centre).astype(np.float32)
    return cv2.remap(layer, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def tilted(rng, degrees, distance):
    """A plane whose centre is at this distance, turned around the vertical."""
    angle = np.radians(rng.choice([-1, 1]) * rng.uniform(*degrees))
    normal = np.array([np.sin(angle), 0, np.cos(angle)])
    return normal, distance * normal[2]


def opening(rng, share):
    """The hole of the wall in the middle view, larger than the frame, (h, w, 1): a quadrilateral
    with vertical sides.
    """
    size = np.array([WIDTH, HEIGHT])
    big = (1.3 * size).astype(int)
    wide = share * WIDTH / rng.uniform(0.75, 1)
    left = rng.choice([-0.62, rng.uniform(-0.4, 0.45 - wide / WIDTH), 0.62 - wide / WIDTH])
    x = np.array([left * WIDTH, left * WIDTH + wide])
    top, bottom = -rng.uniform(0.3, 0.6, 2), rng.uniform(0.3, 0.6, 2)
    corners = np.array([(x[0], top[0]), (x[1], top[1]), (x[1], bottom[1]), (x[0], bottom[0])]) * [
        1,
        HEIGHT,
    ]
    corners[:, 1] = [y * HEIGHT for y in (top[0], top[1], bottom[1], bottom[0])]
    mask = np.zeros(big[::-1], np.float32)
    cv2.fillPoly(mask, [np.rint(corners + big / 2).astype(np.int32)], 1.0)
    return cv2.GaussianBlur(mask, (0, 0), EDGE_PX)[..., None]


def simulate(rng, paths, kind):
    """The photos, both layers and the glass of the middle one, and the relative motion."""
    wall, behind, mirrored = (read_layer(rng, paths) for _ in range(3))
    glass = opening(rng, rng.uniform(0.3, 0.6))
    degrees = (0, 10) if kind == "picture" else (25, 55)
    wall_m = rng.uniform(1, 2.5)
    behind_m = wall_m if kind == "picture" else wall_m * rng.uniform(1.5, 6)
    mirrored_m = wall_m * rng.uniform(1.6, 5)
    while abs(1 / mirrored_m - 1 / behind_m) < 0.15 / wall_m:
        mirrored_m = wall_m * rng.uniform(1.3, 6)
    relative = np.exp(rng.uniform(*np.log(MOTIONS_PX)))
    step = relative / 750 / abs(1 / mirrored_m - 1 / behind_m)
    step = min(step, 80 * wall_m / 750)
    wall_plane = tilted(rng, degrees, wall_m)
    behind_plane = wall_plane if kind == "picture" else tilted(rng, (0, 20), behind_m)
    mirrored_plane = tilted(rng, (0, 20), mirrored_m)
    behind = behind * (kind != "mirror")
    if kind == "mirror":
        mirrored = MIRRORED * mirrored
    else:
        brightness = np.exp(rng.uniform(np.log(0.2), np.log(1.2)))
        mirrored *= min(brightness * behind.mean() / (mirrored.mean() + 1e-3), 1)
    light = 0.8 / max(np.quantile(wall, 0.98), np.quantile(behind, 0.98), 0.2)
    angle = rng.normal(0, 0.3)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    if rng.random() < 0.5:
        around = 2 * np.pi * np.arange(FRAMES) / FRAMES
        places = np.stack([np.cos(around), np.sin(around)], 1) / 2
    else:
        places = np.stack([np.linspace(-0.5, 0.5, FRAMES), np.zeros(FRAMES)], 1)
    places = (places + rng.normal(0, 0.04, places.shape)) @ turn
    places = step * (places - places[MIDDLE])
    photos = []
    for k, place in enumerate(places):
        shake = (k != MIDDLE) * rng.normal(0, 4, 2)[:, None, None]
        on_wall, on_behind, on_mirrored = (
            seen(plane, place) + shake for plane in (wall_plane, behind_plane, mirrored_plane)
        )
        hole = sampled(glass, on_wall)[..., None]
        transmission = light * (
            sampled(wall, on_wall) * (1 - hole) + sampled(behind, on_behind) * hole
        )
        reflection = light * sampled(mirrored, on_mirrored) * hole
        if k == MIDDLE:
            truth = transmission, reflection, hole
        total = (transmission + reflection) * np.exp(rng.normal(0, 0.03))
        total = total + rng.normal(0, 1, total.shape) * np.sqrt(1e-5 + 2e-4 * total)
        photos.append(np.clip(total, 0, 1))
    motion = 750 * abs(1 / mirrored_m - 1 / behind_m)
    length = np.linalg.norm(places[:, None] - places, axis=-1).max()
    return photos, truth, motion * length


def main(folder, count, kind):
    photos_folder = Path(os.environ["BREWSTER_DATA"], "photos/permissive")
    paths = sorted(path for pattern in HELD_OUT for path in photos_folder.glob(pattern))
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "motions.csv").open("w") as file:
        table = csv.writer(file)
        table.writerow(("burst", "case", "relative_motion_px"))
        for number in range(count):
            rng = np.random.default_rng((43, number, len(kind)))
            photos, (transmission, reflection, glass), motion = simulate(rng, paths, kind)
            burst = folder / f"{number:03}"
            burst.mkdir()
            for k, photo in enumerate(photos, 1):
                save(photo, burst / f"frame{k}.jpg", int(rng.integers(85, 97)))
            save(transmission, burst / f"transmission{MIDDLE + 1}.png")
            save(reflection, burst / f"reflection{MIDDLE + 1}.png")
            save(np.repeat(glass, 3, 2), burst / "pane.png")
            table.writerow((burst.name, kind, f"{motion:.1f}"))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
