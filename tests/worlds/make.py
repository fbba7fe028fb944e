"""Makes the pictures beside it: the builtin worlds and paintings as they are, small, for test_worlds.

    .venv/bin/python tests/worlds/make.py

Sets that were rendered from these worlds can be rendered again only as long as the worlds stay what they are. Who
changes them on purpose runs this, looks at the pictures, and says in the change log that such sets are new ones.
"""

from pathlib import Path

import numpy as np

from brewster.environments.procedural.rooms import WORLDS, painting
from brewster.photo import Photo
from brewster.srgb import to_encoded

HERE = Path(__file__).parent
HEIGHT = 64
SEEDS = (1, 7)


def pictures():
    """Every picture by its name, uint8 sRGB: maps over four times their median, so that lamps are white."""
    for name, world in WORLDS.items():
        for seed in SEEDS:
            light = world(seed, HEIGHT)
            yield f"{name}-{seed}", coded(light / (4 * np.median(light.max(axis=2))))
    yield "paintings", np.concatenate([coded(painting(seed, 96, 64)) for seed in range(8)])


def coded(light):
    return np.rint(255 * to_encoded(light.clip(0, 1))).astype(np.uint8)


if __name__ == "__main__":
    for name, picture in pictures():
        Photo(picture).save(HERE / f"{name}.png", overwrite=True)
