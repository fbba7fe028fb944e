"""Makes photos with ground truth by a camera that stands while the light changes.

    .venv/bin/python bench/simulate_light.py out/light 20              # 20 of each kind
    .venv/bin/python bench/simulate_light.py out/light 20 scenes 640   # of one kind, 640 px wide
    .venv/bin/python bench/light.py out/light

The photos are those of $BREWSTER_DATA that no network was trained on. photo = T + R in linear
light, with noise, exposure, white balance and JPEG of its own.

polariser: five angles; incidence 0 to 65 degrees, one or two panes; s and p by Fresnel's equations
    for each pixel.
cloth: a dark cloth in front of the mirrored scene, at another place in each of five photos.
scenes: five mirrored scenes, or one with people that walk by, or one in changing light.
flash: two photos; a lamp at the camera lights T with 1/d^2 and has a glare in the pane.
still: five photos in which nothing changes.

The folder has the layout `bursts` (docs/evaluation.md); light.csv has the kind and the angle of
incidence. The reference is the middle photo: of a flash pair, the second one, which has no flash.
"""

import csv
import os
import struct
import sys
from pathlib import Path

import cv2
import numpy as np

from brewster import Photo
from brewster.photo import FileInfo
from brewster.photo.srgb import to_encoded, to_linear

HELD_OUT = ("kodak24__*", "gianni-rosato-gb82*")
KINDS = ("polariser", "cloth", "scenes", "flash", "still")
PHOTOS = 5
MAX_INCIDENCE_DEG = 78


def read_scene(rng, paths, shape):
    """A random part of a random photo, in linear light."""
    height, width = shape
    image = to_linear(Photo.open(paths[rng.integers(len(paths))]).pixels.astype(np.float32) / 255)
    image = np.rot90(image) if image.shape[0] > image.shape[1] else image
    scale = rng.uniform(1, 1.5) * max(width / image.shape[1], height / image.shape[0])
    size = [
        max(least, round(side * scale)) for least, side in zip(shape, image.shape, strict=False)
    ]
    image = cv2.resize(np.ascontiguousarray(image), size[::-1], interpolation=cv2.INTER_AREA)
    top, left = (rng.integers(0, side - least + 1) for least, side in zip(shape, size, strict=True))
    image = image[top : top + height, left : left + width]
    return np.clip(image[:, ::-1] if rng.random() < 0.5 else image, 0, 1)


def smooth_field(rng, shape, rows, columns):
    """Random values, interpolated from a coarse grid, 0 to 1."""
    height, width = shape
    coarse = rng.normal(size=(rows, columns)).astype(np.float32)
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return ((field - field.min()) / np.ptp(field))[..., None]


def silhouette(rng, shape):
    """The opacity of a person, (h, w, 1)."""
    height, width = shape
    person = np.zeros(shape, np.float32)
    x = rng.uniform(0.05, 0.95) * width
    size = rng.uniform(0.4, 0.9) * height
    head = (int(x), int(height - size))
    cv2.circle(person, head, int(size / 9), 1, -1)
    body = int(x), int(height - size * 0.4)
    cv2.ellipse(person, body, (int(size / 6), int(size / 2)), 0, 0, 360, 1, -1)
    return cv2.GaussianBlur(person, (0, 0), rng.uniform(0.5, 2))[..., None]


def glass_by_polarisation(cosine, index, panes):
    """Transmittance and reflectance of panes for s and p: ((Ts, Rs), (Tp, Rp))."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    s = ((cosine - index * inside) / (cosine + index * inside)) ** 2
    p = ((index * cosine - inside) / (index * cosine + inside)) ** 2
    layers = []
    for surface in (s, p):
        transmitted, reflected = (1 - surface) / (1 + surface), 2 * surface / (1 + surface)
        if panes == 2:
            both = 1 / (1 - reflected**2)
            reflected, transmitted = (
                reflected + transmitted**2 * reflected * both,
                transmitted**2 * both,
            )
        layers.append((transmitted, reflected))
    return layers


def polariser_photos(rng, behind, mirrored, incidence_deg):
    """The layers (T, R) of each photo."""
    height, width = behind.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    half = np.tan(np.radians(min(rng.uniform(20, 55) / 2, MAX_INCIDENCE_DEG - incidence_deg)))
    rays = np.stack(
        [(2 * columns + 1) / width - 1, (height - 2 * rows - 1) / width, 0 * rows - 1 / half], -1
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    angle = np.radians(incidence_deg)
    normal = np.array([np.sin(angle), 0, np.cos(angle)])
    cosine = -rays @ normal
    across = np.cross(rays, normal)
    direction = np.arctan2(across[..., 1], across[..., 0])  # of s in the photo
    layers = glass_by_polarisation(cosine, rng.uniform(1.48, 1.55), rng.integers(1, 3))
    start = rng.uniform(0, np.pi)
    photos = []
    for k in range(PHOTOS):
        share = np.cos(start + np.pi * k / PHOTOS + rng.normal(0, 0.1) - direction) ** 2
        transmittance, reflectance = (
            (share * s + (1 - share) * p)[..., None].astype(np.float32)
            for s, p in zip(*layers, strict=True)
        )
        photos.append((behind * transmittance, mirrored * reflectance))
    return photos


def cloth_photos(rng, behind, mirrored):
    height, width = behind.shape[:2]
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * (columns - width / 2) + np.sin(angle) * (rows - height / 2)
    along += 0.1 * width * (smooth_field(rng, (height, width), 3, 4)[..., 0] - 0.5)
    along = (along - along.min()) / np.ptp(along)
    size = rng.uniform(0.2, 0.5)
    covered = rng.uniform(0.5, 1.0)
    blur = rng.uniform(0.5, 12) * width / 640
    leak = rng.uniform(0.01, 0.08)
    photos = []
    for k in range(PHOTOS):
        middle = covered * (k + rng.uniform(-0.2, 0.2)) / (PHOTOS - 1)
        cover = (np.abs(along - middle) < size / 2).astype(np.float32)
        cover = cv2.GaussianBlur(cover, (0, 0), blur)[..., None]
        photos.append((behind, mirrored * (1 - (1 - leak) * cover)))
    return photos


def scene_photos(rng, behind, mirrored, read):
    kind = rng.choice(["scenes", "people", "light"], p=[0.5, 0.3, 0.2])
    photos = []
    for k in range(PHOTOS):
        if kind == "scenes":
            other = read()
            light = other * mirrored.mean() / other.mean() * np.exp(rng.normal(0, 0.5))
        elif kind == "people":
            light = mirrored.copy()
            for _ in range(rng.integers(2, 5)):
                person = read() * rng.uniform(0.1, 0.6)
                light += silhouette(rng, light.shape[:2]) * (person - light)
        else:
            light = mirrored * np.exp(
                2.5 * smooth_field(rng, behind.shape[:2], 3, 4) - 1.5 - 0.3 * k
            )
        photos.append((behind, light))
    return photos, kind


def flash_photos(rng, behind, mirrored):
    shape = behind.shape[:2]
    depth = 1 + 3 * smooth_field(rng, shape, 3, 4)
    tint = np.exp(rng.normal(0, 0.15, 3)).astype(np.float32)
    fall = (1 / depth**2).astype(np.float32)
    flash = behind * fall / fall.mean() * tint * rng.uniform(0.3, 1.5)
    glare = np.zeros(shape, np.float32)
    place = (int(rng.uniform(0.1, 0.9) * shape[1]), int(rng.uniform(0.1, 0.9) * shape[0]))
    cv2.circle(glare, place, int(shape[1] * rng.uniform(0.01, 0.04)), 5, -1)
    glare = cv2.GaussianBlur(glare, (0, 0), shape[1] * 0.012)[..., None]
    return [(behind + flash, mirrored + glare), (behind, mirrored)]


def simulate(rng, paths, kind, shape):
    """The photos as JPEG files, their layers (T, R) and a word about the case."""

    def read():
        scene = read_scene(rng, paths, shape)
        blur = shape[1] / 640 * rng.uniform(1, 4) if rng.random() < 0.3 else 0
        return cv2.GaussianBlur(scene, (0, 0), blur) if blur else scene

    behind = read_scene(rng, paths, shape)
    mirrored = read()
    light = np.exp(rng.uniform(np.log(0.15), np.log(1.0)))
    mirrored = mirrored * light * behind.mean() / (mirrored.mean() + 1e-3)
    case = ""
    if kind == "polariser":
        incidence = rng.uniform(0, 65)
        case = f"{incidence:.0f}"
        layers = polariser_photos(rng, behind, mirrored, incidence)
        gain = light * sum(t.mean() for t, _ in layers) / sum(r.mean() for _, r in layers)
        layers = [(t, r * gain) for t, r in layers]
    elif kind == "cloth":
        layers = cloth_photos(rng, behind, mirrored)
    elif kind == "scenes":
        layers, case = scene_photos(rng, behind, mirrored, read)
    elif kind == "flash":
        layers = flash_photos(rng, behind, mirrored)
    else:
        layers = [(behind, mirrored * rng.integers(0, 2))] * PHOTOS
    order = rng.permutation(len(layers)) if kind != "flash" else (0, 1)
    layers = [layers[k] for k in order]
    is_automatic = rng.random() < 0.5
    levels = [0.8 / max(np.quantile(sum(pair), 0.98), 0.1) for pair in layers]
    photos = []
    exposed = []
    for k, (transmission, reflection) in enumerate(layers):
        level = levels[k] if is_automatic else min(levels)
        exposure = level * np.exp(rng.normal(0, 0.05))
        gains = (exposure * np.exp(rng.normal(0, 0.03, 3))).astype(np.float32)
        exposed.append((transmission * gains, reflection * gains))
        total = sum(exposed[-1])
        total = total + rng.normal(0, 1, total.shape) * np.sqrt(1e-5 + 2e-4 * total.clip(0))
        settings = exif_of(level, has_flash=kind == "flash" and k == 0)
        photos.append(encoded(total, int(rng.integers(85, 97)), settings))
    return photos, exposed, case


def encoded(image, quality, exif=None):
    """The bytes of a JPEG of linear light."""
    pixels = np.rint(255 * to_encoded(image.clip(0, 1))).astype(np.uint8)
    info = FileInfo(format_name="jpeg", jpeg_quality=quality, exif=exif)
    return Photo(pixels, file_info=info).encode()


def exif_of(exposure, *, has_flash):
    """The EXIF block of a camera: 1/100 s, f/4, flash, and the ISO of the exposure. The drift of
    the exposure is not in it.
    """
    fractions = struct.pack("<4I", 1, 100, 4, 1)
    settings = struct.pack(
        "<H HHII HHII HHIHH HHIHH I",
        *(4, 33434, 5, 1, 80, 33437, 5, 1, 88),
        *(34855, 3, 1, min(65535, round(1000 * exposure)), 0),
        *(37385, 3, 1, int(has_flash), 0, 0),
    )
    first = struct.pack("<H HHII I", 1, 34665, 4, 1, 26, 0)
    return b"II*\0" + struct.pack("<I", 8) + first + settings + fractions


def read_paths():
    """The photos of which the simulations are made."""
    folder = Path(os.environ["BREWSTER_DATA"], "photos/permissive")
    return sorted(path for pattern in HELD_OUT for path in folder.glob(pattern))


def generator(kind, number):
    """Numbers below 3,000 were used while the method was made."""
    return np.random.default_rng((64, KINDS.index(kind), number))


def main(folder, count, kinds=KINDS, width=640):
    paths = read_paths()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "light.csv").open("w") as file:
        table = csv.writer(file)
        table.writerow(("burst", "kind", "case"))
        for kind in kinds:
            for number in range(count):
                shape = width * 3 // 4, width
                photos, layers, case = simulate(generator(kind, number), paths, kind, shape)
                burst = folder / f"{kind}-{number:03}"
                burst.mkdir()
                for k, photo in enumerate(photos, 1):
                    (burst / f"frame{k}.jpg").write_bytes(photo)
                middle = len(photos) // 2
                for name, layer in zip(("transmission", "reflection"), layers[middle], strict=True):
                    pixels = np.rint(255 * to_encoded(layer.clip(0, 1))).astype(np.uint8)
                    photo = Photo.from_array(pixels, encoding="srgb")
                    photo.save(burst / f"{name}{middle + 1}.png")
                table.writerow((burst.name, kind, case))


if __name__ == "__main__":
    named = sys.argv[3:4]
    sizes = [int(value) for value in sys.argv[4:5]] or [640]
    main(
        Path(sys.argv[1]), int(sys.argv[2]), named if named and named != ["all"] else KINDS, *sizes
    )
