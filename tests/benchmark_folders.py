"""Writes small copies of the public benchmarks, in every layout, for tests.

Images have 8x6 pixels by default. The names of files and folders and the numbers of images are
those of the benchmarks.
"""

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np

from brewster import Photo
from picture_files import file_of, smooth

POSTCARD_SCENES = tuple(f"{first}{second}" for first, second in product("abcd", "bcdef"))
POSTCARD_SHOTS = (
    *(("Focus", variant) for variant in (11, 13, 16, 19, 22, 27, 32)),
    *(("Thick", variant) for variant in (3, 5, 10)),
)


@cache
def picture(size=(8, 6), kind="PNG"):
    width, height = size
    return file_of(smooth(height, width), kind)


def write(root: Path, *paths: str, size=(8, 6), data=None):
    """Writes an image, or `data`, to each path below `root`; returns `root`."""
    for relative_path in paths:
        path = root / relative_path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(picture(size) if data is None else data)
    return root


def repacked(
    root: Path, names, roles=("blended", "transmission_layer"), suffix=".png", size=(8, 6)
):
    """Writes images with equal names into one folder per role: pairs, or triplets with a third
    role.
    """
    return write(root, *(f"{role}/{name}{suffix}" for name in names for role in roles), size=size)


def postcard(root: Path, scenes=POSTCARD_SCENES):
    """Writes Postcard of SIR2 in its original folders: 10 shots of each scene, but 9 of the last of
    the 20 scenes.
    """
    for scene, (kind, variant) in product(scenes, POSTCARD_SHOTS):
        if (scene, variant) != (POSTCARD_SCENES[-1], 10):
            first, last = (variant, 32) if variant in (3, 5) else (variant, 3)
            if kind == "Focus":
                first = 3
                last = variant
            write(
                root,
                *(
                    f"{kind}/{scene}/{variant}/{scene}-{first}-{letter}-{last}.png"
                    for letter in "mgr"
                ),
            )
    return root


def solidobject(root: Path, scenes=range(1, 21)):
    """Writes SolidObject of SIR2 in its original folders: 10 shots of each scene."""
    for scene, (kind, variant) in product(scenes, POSTCARD_SHOTS):
        write(root, *(f"{scene}/{kind}/{variant}/{letter}.jpg" for letter in "mgr"))
    return root


def wildscene(root: Path, count=101):
    """Writes Wildscene of SIR2 in its original folders. Every third folder has a name such as
    7s.
    """
    shots = [f"{number}s" if number % 3 == 1 else str(number) for number in range(1, count + 1)]
    return write(root, *(f"{shot}/{letter}.jpg" for shot in shots for letter in "mgr"))


def sir2(root: Path):
    """Writes all of SIR2: 199 + 200 + 101 triplets."""
    postcard(root / "Postcard Dataset")
    solidobject(root / "SolidObjectDataset")
    wildscene(root / "Wildscene")
    return root


def paint(path, seed, size=(24, 16), *, noise=0):
    """Writes a random image of coloured squares. `noise` is a standard deviation in 8-bit
    levels.
    """
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 200, (size[1] // 4, size[0] // 4, 3)).repeat(4, 0).repeat(4, 1)
    pixels = np.clip(pixels + rng.normal(0, noise, pixels.shape), 0, 255).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(Photo.from_array(pixels, encoding="srgb").encode("png"))
