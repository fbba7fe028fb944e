"""Writes the figures of docs/rendering.md and docs/results.md.

scenes.jpg: samples of all scene recipes except tiny.
mixtures.jpg: 8-bit mixtures (top row) and rendered photos of the same scenes (bottom row).
learning-curve.png: validation metrics of the compact model during training, from compact-log.csv.

    BREWSTER_DATA=../shared/data .venv/bin/python runs/figures.py   # with the CC0 maps in hdri/

Without BREWSTER_DATA, all scenes have built-in environments.
"""

import csv
import os
from itertools import accumulate, pairwise
from pathlib import Path

import torch
from matplotlib.figure import Figure

from brewster.photo import Photo
from brewster.render.analytic import render
from brewster.render.camera_response import develop, to_uint8
from brewster.render.environments.assets import Assets, read_catalog
from brewster.render.scene.recipe import RECIPES, read_scene_recipe
from brewster.render.scene.sampler import draw
from brewster.training.data.rendered import blended_layers

DATA = os.environ.get("BREWSTER_DATA")
MAPS = [Path(DATA) / "hdri"] if DATA else []
DOCS = Path(__file__).parent.parent / "docs"
WIDTH = 256
HEIGHT = 192
CURVES = {
    "mixtures_db": "held-out mixtures",
    "real_db": "dev Real",
    "nature_db": "dev Nature",
    "real_train_db": "real/train",
}
"""Columns of compact-log.csv and their labels."""


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
            list(render_sample(name, 3, i).images().values())
            for name in RECIPES
            if name != "tiny"
            for i in (0, 1)
        ],
        "scenes.jpg",
    )


def save_mixtures():
    rendered = [
        render_sample(name, 5, i)
        for name, i in (
            ("window", 0),
            ("window", 3),
            ("office", 1),
            ("shopfront", 2),
            ("window", 5),
        )
    ]
    save(
        [
            [
                blended_layers(each.background_encoded, each.mirror_encoded, each.scene)[0]
                for each in rendered
            ],
            [sample.photo_encoded for sample in rendered],
        ],
        "mixtures.jpg",
    )


def save_learning_curve():
    with Path(__file__).with_name("compact-log.csv").open(newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    steps = [
        row["step"] - (last["step"] if row["stage"] == last["stage"] else 0)
        for last, row in pairwise([{"step": 0, "stage": 0}, *rows])
    ]
    images = list(
        accumulate(count * row["batch_size"] / 1000 for count, row in zip(steps, rows, strict=True))
    )
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    for column, label in CURVES.items():
        axis.plot(images, [row[column] for row in rows], marker="o", markersize=3, label=label)
    for end, (last, row) in zip(images, pairwise(rows), strict=False):
        if row["stage"] != last["stage"]:
            axis.axvline(end, color="grey", linewidth=0.6, linestyle=":")
    axis.set_xlabel("training images, thousands")
    axis.set_ylabel("PSNR gain over the input, dB")
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8)
    figure.savefig(DOCS / "learning-curve.png", dpi=100)


if __name__ == "__main__":
    save_scenes()
    save_mixtures()
    save_learning_curve()
