"""Writes the figures of docs/rendering.md.

scenes.jpg: samples of all scene recipes except tiny.
mixtures.jpg: 8-bit mixtures (top row) and rendered photos of the same scenes (bottom row).

    BREWSTER_DATA=../shared/data .venv/bin/python runs/figures.py   # with the CC0 maps in hdri/

Without BREWSTER_DATA, all scenes have built-in environments.
"""

import os
from pathlib import Path

import torch

from brewster.environments.assets import Assets
from brewster.environments.catalog import read_catalog
from brewster.photo import Photo
from brewster.render.analytic import render
from brewster.render.camera_response import develop, to_uint8
from brewster.scene.recipe import RECIPES, read_scene_recipe
from brewster.scene.sampler import draw
from brewster.training.data.alpha_blend import blended

DATA = os.environ.get("BREWSTER_DATA")
MAPS = [Path(DATA) / "hdri"] if DATA else []
DOCS = Path(__file__).parent.parent / "docs"
WIDTH, HEIGHT = 256, 192


def render_sample(name, seed, index):
    recipe = read_scene_recipe(name)
    camera = recipe.camera.model_copy(update={"width": WIDTH, "height": HEIGHT})
    catalog, _ = read_catalog(MAPS, [])
    scene = draw(recipe.model_copy(update={"camera": camera}), catalog, seed, index)
    return develop(render(scene, Assets(MAPS)))


def save(rows, name):
    sheet = torch.cat([torch.cat(row, dim=2) for row in rows], dim=1)
    Photo.from_array(to_uint8(sheet), encoding="srgb").save(DOCS / name, overwrite=True)


def save_scenes():
    save(
        [
            list(render_sample(name, 3, i).layers().values())
            for name in RECIPES
            if name != "tiny"
            for i in (0, 1)
        ],
        "scenes.jpg",
    )


def save_mixtures():
    rendered = [
        render_sample(name, 5, i)
        for name, i in (("window", 0), ("window", 3), ("office", 1), ("shopfront", 2), ("window", 5))
    ]
    save(
        [
            [blended(sample).photo_encoded for sample in rendered],
            [sample.photo_encoded for sample in rendered],
        ],
        "mixtures.jpg",
    )


if __name__ == "__main__":
    save_scenes()
    save_mixtures()
