"""Makes the pictures of docs/results.md: eight rows of photo, transmission, reflection and ground
truth.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/pictures.py [MODEL]

Writes docs/results-1.jpg to -8.jpg and the section Pictures of docs/results.md. The rows are chosen
by rule and not by their scores: every tenth rendered window, and every tenth mixture of held-out
photos. Run it again for new weights.
"""

import os
import re
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from brewster import Photo, Separator
from brewster.metrics.fidelity import psnr
from brewster.photo.contact_sheet import side_by_side
from brewster.render.analytic import render
from brewster.render.camera_response import develop, to_uint8
from brewster.render.environments.assets import Assets, read_catalog
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.sampler import draw
from brewster.training.recipe import read_recipe
from brewster.training.streams import held_out_mixtures

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SEED = 5
INDICES = (0, 10, 20, 30)
SIZE = 512, 384
ROW_PX = 170
UNRESTRICTED = ["kodak24__*", "gianni-rosato-gb82*", "blender_*"]
"""The held-out photos and maps that may be shown without attribution: released for unrestricted
usage, and CC0.
"""
MAX_BYTES = 50_000
SECTION = """\
## Pictures

Photo, transmission and reflection of the model, and the ground truth of the transmission. The rows
are chosen by rule, not by their scores: samples {indices} of the recipe `window` with the seed
{seed} and the built-in environments, and mixtures {indices} of the held-out photos (Kodak and gb82,
384 px). The rendered scenes are no training samples, but the built-in photos and maps in them may
have been seen in training; the photos of the mixtures have not. All rows are synthetic, because no
real pairs at hand may be shown. Below each row: PSNR of the photo and of the transmission. The
model fails on rows whose PSNR falls or hardly rises.

{rows}

`bench/pictures.py` makes this section.

"""


def windows() -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yields name, photo and ground truth, uint8 (H, W, 3). The ground truth is the light that the
    pane transmits.
    """
    recipe = read_scene_recipe("window")
    camera = recipe.camera.model_copy(update={"width": SIZE[0], "height": SIZE[1]})
    catalog, _ = read_catalog([], [])
    for index in INDICES:
        scene = draw(recipe.model_copy(update={"camera": camera}), catalog, SEED, index)
        sample = develop(render(scene, Assets([])))
        yield (
            f"rendered window {index}",
            to_uint8(sample.photo_encoded),
            to_uint8(sample.transmission_encoded),
        )


def mixtures() -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    recipe = read_recipe(ROOT / "recipes/train/compact.toml")
    recipe = recipe.model_copy(
        update={"data": recipe.data.model_copy(update={"held_out": UNRESTRICTED})}
    )
    stream = held_out_mixtures(recipe)
    assert stream is not None
    for index in INDICES:
        batch = stream(index, 1, SIZE[1])
        yield (
            f"mixture {index}",
            to_uint8(batch.photo_encoded[0]),
            to_uint8(batch.transmission_encoded[0]),
        )


def row(separator: Separator, number: int, name: str, photo: np.ndarray, truth: np.ndarray) -> str:
    """Writes a row as JPEG. Returns its Markdown."""
    separation = separator(Photo.from_array(photo, encoding="srgb"))
    transmission = separation.transmission
    ground_truth = Photo.from_array(truth, encoding="srgb")
    sheet = side_by_side(
        (separation.photo, transmission, separation.reflection, ground_truth), ROW_PX
    )
    encoded = (
        Photo.from_array(sheet, encoding="srgb").encode("jpeg", quality=q) for q in (85, 75, 65, 55)
    )
    data = next(data for data in encoded if len(data) <= MAX_BYTES)
    (DOCS / f"results-{number}.jpg").write_bytes(data)
    before = psnr(photo, truth)
    after = psnr(transmission.srgb_8bit(), truth)
    caption = f"{name}: {before:.2f} dB, then {after:.2f} dB ({after - before:+.2f})"
    print(caption)
    return (
        f"![{name}: photo, transmission, reflection, ground "
        f"truth](results-{number}.jpg)\n\n{caption}"
    )


def main(model: str) -> None:
    separator = Separator.load(model)
    rows = [
        row(separator, number, *case) for number, case in enumerate(chain(windows(), mixtures()), 1)
    ]
    section = SECTION.format(
        indices=", ".join(map(str, INDICES)), seed=SEED, rows="\n\n".join(rows)
    )
    path = DOCS / "results.md"
    text = path.read_text("utf-8")
    path.write_text(
        re.sub(r"## Pictures\n.*?(?=## )", lambda _: section, text, flags=re.DOTALL), "utf-8"
    )


if __name__ == "__main__":
    if "BREWSTER_DATA" not in os.environ:
        sys.exit(
            "BREWSTER_DATA is not set; expected the folder of the data with photos/permissive "
            "and hdri"
        )
    main(sys.argv[1] if len(sys.argv) > 1 else "compact")
