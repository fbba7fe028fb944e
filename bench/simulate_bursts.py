"""Makes bursts with ground truth from pairs of photos: what motion does `brewster burst` need?

    .venv/bin/python bench/simulate_bursts.py out/simulated 60
    .venv/bin/python bench/simulate_bursts.py out/circles 60 circle
    .venv/bin/python bench/simulate_bursts.py out/objects 40 circle object
    .venv/bin/python bench/burst.py out/simulated 320

The photos are those of $BREWSTER_DATA that no network was trained on.

Each burst has five photos of 640 x 480 pixels: photo = T + R in linear light, with noise, exposure
and JPEG of its own. The camera moves along a line, or a circle of the same diameter, with a
tremble. T moves by a homography and, with the parallax of a smooth depth, differently in each
place; R moves by another distance. One burst in eight has no reflection, one in eight the same
motion for both layers, one in eight a still camera. With "object", each burst has a reflection that
moves by at least 16 px, and an opaque object between the glass and the wall, which moves by 10 to
60 px relative to the wall. The folder has the layout `bursts` (docs/evaluation.md), and motions.csv
has the true motions in pixels of a photo 1,000 pixels wide.
"""

import csv
import os
import sys
from pathlib import Path

import cv2
import numpy as np

from brewster import Photo
from brewster.photo.srgb import to_encoded, to_linear

HELD_OUT = ("kodak24__*", "gianni-rosato-gb82*")
WIDTH = 640
HEIGHT = 480
FRAMES = 5
MOTIONS_PX = (4, 70)
"""The range of the relative motion of the layers, per 1,000 px."""
MARGIN = 1.3
"""The layers are larger than the photos, so that a moved camera sees no border."""


def read_layer(rng, paths):
    """A linear photo of MARGIN times the frame."""
    image = to_linear(Photo.open(paths[rng.integers(len(paths))]).pixels.astype(np.float32) / 255)
    if image.shape[0] > image.shape[1]:
        image = np.rot90(image)
    scale = MARGIN * max(WIDTH / image.shape[1], HEIGHT / image.shape[0])
    image = cv2.resize(
        np.ascontiguousarray(image), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC
    )
    image = image[:, ::-1] if rng.random() < 0.5 else image
    return np.clip(image, 0, 1)


def view(layer, shift, rotation, depth, parallax):
    """The frame of the layer moved by `shift` px and turned, with `parallax` px times the depth
    along the shift.
    """
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    x, y = columns - WIDTH / 2, rows - HEIGHT / 2
    moved = np.asarray(shift)[:, None, None] + np.asarray(parallax)[:, None, None] * depth
    across = np.cos(rotation) * x - np.sin(rotation) * y + layer.shape[1] / 2 + moved[0]
    down = np.sin(rotation) * x + np.cos(rotation) * y + layer.shape[0] / 2 + moved[1]
    return cv2.remap(
        layer,
        across.astype(np.float32),
        down.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )


def silhouette(rng, shape):
    """The opacity of an object near the middle, (h, w): a smooth shape that covers 5 to 25 % of the
    frame.
    """
    height, width = shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    centre = rng.uniform(0.35, 0.65, 2) * (width, height)
    angle = np.arctan2(y - centre[1], x - centre[0])
    waves = sum(
        rng.normal(0, 0.35 / n) * np.cos(n * angle + rng.uniform(0, 6)) for n in range(1, 7)
    )
    radius = np.hypot((x - centre[0]) / rng.uniform(0.7, 1.4), y - centre[1]) / np.exp(waves)
    area = rng.uniform(0.05, 0.25) * WIDTH * HEIGHT
    edge = np.sort(radius.ravel())[int(area)]
    return cv2.GaussianBlur((radius < edge).astype(np.float32), (0, 0), 0.8)[..., None]


def simulate(rng, paths, path, *, has_object=False, motions_px=MOTIONS_PX):
    """The photos, the layers of the middle one, and the true motions. `path` is "line" or
    "circle".
    """
    transmission = read_layer(rng, paths)
    reflection = read_layer(rng, paths)
    case = rng.choice(
        ["moved", "no reflection", "equal distances", "still camera"],
        p=[5 / 8, 1 / 8, 1 / 8, 1 / 8],
    )
    case = "object" if has_object else case
    if rng.random() < 0.3:  # the mirrored scene is out of focus
        reflection = cv2.GaussianBlur(reflection, (0, 0), rng.uniform(1, 4))
    brightness = np.exp(rng.uniform(np.log(0.15), np.log(1.2)))
    reflection = reflection * min(brightness * transmission.mean() / (reflection.mean() + 1e-3), 1)
    reflection *= case != "no reflection"
    small = rng.normal(size=(4, 5)).astype(np.float32)
    depth = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    depth = (depth - depth.mean()) / np.ptp(depth)
    pixel = WIDTH / 1000
    least, most = motions_px
    least = 16 if has_object else least
    relative = (
        np.exp(rng.uniform(np.log(least), np.log(most)))
        * pixel
        * (case in ("moved", "no reflection", "object"))
    )
    camera = rng.uniform(8, 60) * pixel * rng.choice([-1, 1]) * (case != "still camera")
    parallax = rng.uniform(0, 8) * pixel * (case != "still camera")
    angle = rng.normal(0, 0.15)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    around = 2 * np.pi * np.arange(FRAMES) / FRAMES
    line = np.linspace(-0.5, 0.5, FRAMES), np.zeros(FRAMES)
    along, across = {"line": line, "circle": (np.cos(around) / 2, np.sin(around) / 2)}[path]
    places = np.stack([along + rng.normal(0, 0.04, FRAMES), across], 1) @ turn
    length = np.linalg.norm(places[:, None] - places, axis=-1).max()
    light = 0.8 / max(np.quantile(transmission, 0.98), 0.2)
    if has_object:
        near = read_layer(rng, paths)
        near = np.dstack(
            [
                near * rng.uniform(0.5, 1.5) * transmission.mean() / near.mean(),
                silhouette(rng, near.shape[:2]),
            ]
        )
        nearness = rng.uniform(10, 60) * pixel * np.sign(camera or 1)
        relative *= rng.choice([-1, 1])
    photos = []
    middle = None
    for place in places:
        tremble = rng.normal(0, 1.5, 2) * pixel
        rotation = rng.normal(0, 0.003)
        behind = view(transmission, camera * place + tremble, rotation, depth, parallax * place)
        if has_object:
            opaque = view(near, (camera + nearness) * place + tremble, rotation, depth, (0, 0))
            behind += opaque[..., 3:] * (opaque[..., :3] - behind)
        mirrored = view(reflection, (camera + relative) * place + tremble, rotation, depth, (0, 0))
        layers = [light * behind, light * mirrored]
        middle = layers if len(photos) == FRAMES // 2 else middle
        total = sum(layers) * np.exp(rng.normal(0, 0.03))
        total = total + rng.normal(0, 1, total.shape) * np.sqrt(1e-5 + 2e-4 * total)
        photos.append(np.clip(total, 0, 1))
    return (
        photos,
        middle,
        (case, *(abs(motion) / pixel * length for motion in (relative, camera, parallax))),
    )


def save(image, path, quality=None):
    pixels = np.rint(255 * to_encoded(image.clip(0, 1))).astype(np.uint8)
    Photo.from_array(pixels, encoding="srgb").save(path, quality=quality)


def main(folder, count, path="line", kind="plain"):
    photos_folder = Path(os.environ["BREWSTER_DATA"], "photos/permissive")
    paths = sorted(path for pattern in HELD_OUT for path in photos_folder.glob(pattern))
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "motions.csv").open("w") as file:
        table = csv.writer(file)
        table.writerow(("burst", "case", "relative_motion_px", "camera_motion_px", "parallax_px"))
        for number in range(count):
            rng = np.random.default_rng((31, number))
            photos, (transmission, reflection), (case, *motions) = simulate(
                rng, paths, path, has_object=kind == "object"
            )
            burst = folder / f"{number:03}"
            burst.mkdir()
            for k, photo in enumerate(photos, 1):
                save(photo, burst / f"frame{k}.jpg", int(rng.integers(85, 97)))
            middle = FRAMES // 2 + 1
            save(transmission, burst / f"transmission{middle}.png")
            save(reflection, burst / f"reflection{middle}.png")
            table.writerow((burst.name, case, *(f"{motion:.1f}" for motion in motions)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
