"""Measures what hints are worth: rough strokes over a tenth of each dev pair, simulated from the
true layers.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/hints.py [MODEL]

MODEL is compact, an .onnx file or the checkpoint.pt of a run.

The gain is the PSNR with strokes minus that without, in the region of the reflection (more than 35
% of the light), in the painted part of the picture, and in the rest. Each pair is a square of 384
px with the first simulated strokes that cover 7 to 13 %. Pairs without such are left out.

The harm is measured with the whole product, on photos without glass to which five glints and a lamp
are added: the share of the stroked pixels that are darker than all of their surroundings in the
photo before that, and the light that the glints and the lamp keep. Strokes cover the glints, and
cross the lamp.
"""

import os
import sys
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from brewster import Photo, Separator
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.photo.srgb import to_encoded
from brewster.separation.guided_upsampling import box_mean
from brewster.separation.models.networks import DEFAULT_NETWORK, NETWORKS
from brewster.separation.models.zoo import model_file
from brewster.training.compact.export import read_weights
from brewster.training.data.hints import simulate_hints
from brewster.training.data.mixtures import TrainingBatch

SIZE = 384
COVERED = (0.07, 0.13)
PHOTOS = "photos/permissive/MiguelARD__DoorDetect-Dataset__*.webp"
EVERY = 120
"""Every such photo of the collection is measured for harm."""
MARGIN = 0.03
"""How much darker counts, sRGB-encoded."""
SETS = {"Nature": "real/dev/nature", "Real": "real/dev/real"}


def read_network(name):
    network = NETWORKS[DEFAULT_NETWORK].build().eval()
    if name.endswith(".pt"):
        weights = torch.load(name, map_location="cpu", weights_only=False)["average"]
    else:
        weights = read_weights(model_file(name).path)
    network.load_state_dict(weights, strict=False)
    return network


def read_square(file):
    """The centre of a photo as linear light, (3, SIZE, SIZE)."""
    image = torch.from_numpy(Photo.open(file).linear().copy()).permute(2, 0, 1)[None]
    side = min(image.shape[2:])
    top, left = ((length - side) // 2 for length in image.shape[2:])
    square = image[:, :, top : top + side, left : left + side]
    return functional.interpolate(square, (SIZE, SIZE), mode="area").clamp(0, 1)


def strokes(batch):
    for step in range(400):
        hints = simulate_hints(batch, probability=1, seed=7, step=step)
        if COVERED[0] < (hints[:, 0] > 0.3).float().mean() < COVERED[1]:
            return hints
    return None


def psnr_db(errors, region):
    return -10 * np.log10(float((errors * region).sum() / (3 * region.sum()).clamp(min=1)) + 1e-9)


@torch.no_grad()
def main(name):
    network = read_network(name)
    data = Path(os.environ["BREWSTER_DATA"])
    print(
        "| pairs | pictures | reflection | painted | not painted | largest change elsewhere |\n"
        "|---|---|---|---|---|---|"
    )
    for title, folder in SETS.items():
        rows = []
        for case in (
            case for benchmark in read_benchmark("pairs", data / folder) for case in benchmark.cases
        ):
            photo, transmission = (
                read_square(file.read()) for file in (case.photo, case.ground_truth)
            )
            reflection = (photo - transmission).clamp(min=0)
            layers = torch.cat(
                [to_encoded(photo), to_encoded(transmission), to_encoded(reflection)], dim=1
            )
            batch = TrainingBatch.from_layers(layers)
            hints = strokes(batch)
            if hints is None:
                continue
            outputs = [
                network(batch.photo_encoded)[:, :3],
                network(batch.photo_encoded, hints)[:, :3],
            ]
            errors = [(output.clamp(0, 1) - batch.transmission_encoded) ** 2 for output in outputs]
            share = reflection.mean(1, keepdim=True) / (photo.mean(1, keepdim=True) + 1e-3)
            share = functional.avg_pool2d(share, 13, 1, 6)
            painted = functional.max_pool2d(hints.amax(1, keepdim=True), 33, 1, 16) > 0
            regions = [(share > 0.35).float(), (hints[:, :1] > 0.3).float(), (~painted).float()]
            gains = [psnr_db(errors[1], region) - psnr_db(errors[0], region) for region in regions]
            rows.append((*gains, float(((outputs[1] - outputs[0]).abs() * ~painted).max())))
        means = np.mean(rows, axis=0)
        print(
            f"| {title} | {len(rows)} | {means[0]:+.2f} | {means[1]:+.2f} | {means[2]:+.2f} | "
            f"{means[3]:.3f} |"
        )


def with_lights(clean, rng):
    """Adds glints and a lamp to linear light (h, w, 3). Returns the photo, and where are glints,
    lamp and strokes.
    """
    height, width, _ = clean.shape
    rows, columns = np.mgrid[:height, :width]
    is_glint, is_lamp, is_stroked = np.zeros((3, height, width), bool)

    def ellipse(row, column, vertical, horizontal):
        return np.hypot((rows - row) / vertical, (columns - column) / horizontal) < 1

    centres = zip(
        rng.uniform(0.15, 0.85, 6) * height, (np.arange(6) + 0.5) / 6 * width, strict=True
    )
    for number, (row, column) in enumerate(centres):
        radii = width * rng.uniform(0.004, 0.02, 2)
        if number:
            is_glint |= ellipse(row, column, *radii)
            is_stroked |= ellipse(row, column, *(radii + 0.01 * width))
        else:
            is_lamp = ellipse(row, column, 0.06 * width, 0.06 * width)
            is_stroked |= ellipse(row, column, 0.02 * width, 0.1 * width)
    light = box_mean(2 * (is_glint | is_lamp)[..., None].astype(np.float32), 1)
    return np.minimum(clean + light, 1), is_glint, is_lamp, is_stroked


def harm(name):
    """Prints a row without and one with strokes."""
    separator = Separator.load(name)
    rows = {"no": [], "yes": []}
    files = sorted(Path(os.environ["BREWSTER_DATA"]).glob(PHOTOS))[::EVERY]
    for seed, file in enumerate(files):
        clean = Photo.open(file).linear()
        pixels, is_glint, is_lamp, is_stroked = with_lights(clean, np.random.default_rng(seed))
        photo = Photo.from_array(
            np.round(255 * to_encoded(pixels)).astype(np.uint8), encoding="srgb"
        )
        before = to_encoded(np.where(is_lamp[..., None], pixels, clean)).max(axis=2)
        radius = round(0.015 * max(before.shape))
        lowest = -functional.max_pool2d(
            -torch.from_numpy(before)[None, None], 2 * radius + 1, 1, radius
        )[0, 0]
        strokes = np.uint8([255, 0, 0]) * is_stroked[..., None]
        for case, hints in (("no", None), ("yes", strokes)):
            transmission = separator(photo, hints=hints).transmission.linear()
            is_pit = to_encoded(transmission).max(axis=2) < lowest.numpy() - MARGIN
            kept = [
                transmission[region].sum() / pixels[region].sum() for region in (is_glint, is_lamp)
            ]
            rows[case].append((is_pit[is_stroked].mean(), *kept))
    print(
        "\n| strokes | photos | darker than their surroundings | light of glints | of the lamp "
        "|\n|---|---|---|---|---|"
    )
    for case, values in rows.items():
        print(
            f"| {case} | {len(values)} | "
            + " | ".join(f"{mean:.1%}" for mean in np.mean(values, axis=0))
            + " |"
        )


if __name__ == "__main__":
    name = sys.argv[1] if len(sys.argv) > 1 else "compact"
    main(name)
    if not name.endswith(".pt"):
        harm(name)
