"""Measures how bright the reflections of a scene recipe are, in the statistics of
`training_data.py`.

    .venv/bin/python bench/reflection_light.py window 120
    BREWSTER_DATA=../shared/data .venv/bin/python bench/reflection_light.py window 120

Draws the scenes 0 to COUNT - 1 of the seed 65, renders them at 128x96 px, and prints the 10, 25,
50, 75 and 90 % quantiles over the scenes: the mean luminance of R, divided by that of I; and the
light that R adds to the photograph, divided by the mean of T, as dev/notes/compact-model.md has it
for real pairs. Without BREWSTER_DATA, the built-in maps and photos are used.
"""

import os
import sys
from pathlib import Path

import numpy as np
import torch
from training_data import QUANTILES, statistics

from brewster.photo.srgb import to_linear
from brewster.render.analytic import render
from brewster.render.camera_response import develop, luminance
from brewster.render.environments.assets import Assets, read_catalog
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.sampler import draw

SEED = 65


def main(name: str, count: int) -> None:
    recipe = read_scene_recipe(name)
    camera = recipe.camera.model_copy(update={"width": 128, "height": 96})
    small = recipe.model_copy(update={"camera": camera})
    data = os.environ.get("BREWSTER_DATA")
    maps, photos = ([Path(data, "hdri")], [Path(data, "photos/permissive")]) if data else ([], [])
    catalog, _ = read_catalog(maps, photos)
    assets = Assets((*maps, *photos))
    rows: dict[str, list[float]] = {"share of R": [], "added light": [], "R inside / outside": []}
    for index in range(count):
        scene = draw(small, catalog, SEED, index)
        sample = render(scene, assets)
        developed = develop(sample)
        mean_r, mean_i = (
            luminance(layer.double().mean((1, 2))) for layer in (sample.reflection, sample.photo)
        )
        pair = (to_linear(developed.photo_encoded), to_linear(developed.transmission_encoded))
        rows["share of R"].append(mean_r / mean_i)
        rows["added light"].append(statistics(*pair)["added light"])
        blocks = torch.nn.functional.avg_pool2d(sample.reflection.mean(0)[None], 16).flatten()
        rows["R inside / outside"].append(float(blocks.quantile(0.9) / blocks.quantile(0.1)))
    for key, values in rows.items():
        quantiles = " ".join(f"{value:.3f}" for value in np.quantile(values, QUANTILES))
        print(f"{name} ({count}), {key}: {quantiles}")
    hardly = np.mean(np.array(rows["added light"]) < 0.05)
    print(f"{name} ({count}), added light below .05: {hardly:.2f}")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
