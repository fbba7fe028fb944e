"""Measures what hints are worth: rough strokes over a tenth of the picture, simulated from the true layers of the dev pairs.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/hints.py [compact | MODEL.onnx | RUN/checkpoint.pt]

The gain is the PSNR with strokes minus that without, in the region of the reflection (more than 35 % of the light), in the painted part of
the picture, and in the rest. Each pair is a square of 384 px with the first simulated strokes that cover 7 to 13 %. Pairs without such are left out.
"""

import os
import sys
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from brewster import Photo
from brewster.benchmarks.registry import read_benchmark
from brewster.models.networks import DEFAULT_NETWORK, NETWORKS
from brewster.models.zoo import find_model
from brewster.srgb import to_encoded
from brewster.training.compact.export import read_weights
from brewster.training.data.hints import simulate_hints
from brewster.training.data.mixtures import TrainingBatch

SIZE = 384
COVERED = (0.07, 0.13)
SETS = {"Nature": "real/dev/nature", "Real": "real/dev/real"}


def read_network(name):
    network = NETWORKS[DEFAULT_NETWORK].build().eval()
    if name.endswith(".pt"):
        weights = torch.load(name, map_location="cpu", weights_only=False)["average"]
    else:
        weights = read_weights(find_model(name).path)
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
    network, data = read_network(name), Path(os.environ["BREWSTER_DATA"])
    print(
        "| pairs | pictures | reflection | painted | not painted | largest change elsewhere |\n|---|---|---|---|---|---|"
    )
    for title, folder in SETS.items():
        rows = []
        for case in (
            case for benchmark in read_benchmark("pairs", data / folder) for case in benchmark.cases
        ):
            photo, transmission = (read_square(file.read()) for file in (case.photo, case.ground_truth))
            reflection = (photo - transmission).clamp(min=0)
            layers = torch.cat([to_encoded(photo), to_encoded(transmission), to_encoded(reflection)], dim=1)
            batch = TrainingBatch.from_layers(layers)
            hints = strokes(batch)
            if hints is None:
                continue
            outputs = [network(batch.photo_encoded)[:, :3], network(batch.photo_encoded, hints)[:, :3]]
            errors = [(output.clamp(0, 1) - batch.transmission_encoded) ** 2 for output in outputs]
            share = reflection.mean(1, keepdim=True) / (photo.mean(1, keepdim=True) + 1e-3)
            share = functional.avg_pool2d(share, 13, 1, 6)
            painted = functional.max_pool2d(hints.amax(1, keepdim=True), 33, 1, 16) > 0
            regions = [(share > 0.35).float(), (hints[:, :1] > 0.3).float(), (~painted).float()]
            gains = [psnr_db(errors[1], region) - psnr_db(errors[0], region) for region in regions]
            rows.append((*gains, float(((outputs[1] - outputs[0]).abs() * ~painted).max())))
        means = np.mean(rows, axis=0)
        print(
            f"| {title} | {len(rows)} | {means[0]:+.2f} | {means[1]:+.2f} | {means[2]:+.2f} | {means[3]:.3f} |"
        )


if __name__ == "__main__":
    main(*(sys.argv[1:] or ["compact"]))
