"""Writes small reference images of the built-in environments and paintings, for test_environments.

    .venv/bin/python tests/environments/make.py

A dataset that was rendered from these environments can be rendered again only if they do not change. If you change them on
purpose, run this script, look at the images, and note in the changelog that such datasets cannot be continued.
"""

from pathlib import Path

import numpy as np

from brewster.environments.procedural.paintings import painting
from brewster.environments.procedural.registry import ENVIRONMENTS
from brewster.photo import Photo
from brewster.srgb import to_encoded

HERE = Path(__file__).parent
HEIGHT = 64
SEEDS = (1, 7)


def pictures():
    """Yields (name, image), uint8 sRGB. Maps are divided by four times their median, so that lamps are white."""
    for name, environment in ENVIRONMENTS.items():
        for seed in SEEDS:
            light = environment(seed, HEIGHT)
            yield f"{name}-{seed}", coded(light / (4 * np.median(light.max(axis=2))))
    yield "paintings", np.concatenate([coded(painting(seed, 96, 64)) for seed in range(8)])


def coded(light):
    return np.rint(255 * to_encoded(light.clip(0, 1))).astype(np.uint8)


if __name__ == "__main__":
    for name, picture in pictures():
        Photo(picture).save(HERE / f"{name}.png", overwrite=True)
