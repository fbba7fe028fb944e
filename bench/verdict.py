"""Measures the reliability of the verdicts of `Separation.assessment`, on photos with ground truth that are not training data.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/verdict.py [MODEL]

Prints one row for each dataset and verdict: the number of photos, the fraction of photos that are closer to the ground truth
after the separation, and the mean gain in PSNR.
"""

import os
import sys
from collections import defaultdict
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brewster import Separator
from brewster.benchmarks.registry import read_benchmark
from brewster.metrics.fidelity import psnr
from brewster.photo import Photo
from brewster.training.recipe import read_recipe
from brewster.training.streams import held_out_mixtures

MIXTURES = 200
BATCH_SIZE = 8
SIZE_PX = 320
EVERY = 7
"""Every seventh pair of real/train is measured, because many of its pairs are similar."""
RECIPE = Path(__file__).parents[1] / "recipes/train/compact.toml"

Pair = tuple[Photo, NDArray[np.uint8]]


def main(data: Path, model: str) -> None:
    separator = Separator.load(model)
    gains: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    for name, pairs in read_datasets(data).items():
        for photo, ground_truth in pairs:
            separation = separator(photo)
            before, after = (psnr(layer.pixels, ground_truth) for layer in (photo, separation.transmission))
            for key in (name, "all"):
                gains[separation.assessment.verdict, key].append(after - before)
    print("| verdict | dataset | photos | better than the input | mean gain, dB |\n|---|---|---|---|---|")
    for (verdict, name), values in sorted(gains.items()):
        better = np.mean(np.array(values) > 0)
        print(f"| {verdict} | {name} | {len(values)} | {better:.0%} | {np.mean(values):+.2f} |")


def read_datasets(data: Path, mixture_count: int = MIXTURES) -> dict[str, Iterator[Pair]]:
    """Returns pairs of photo and ground truth, 8-bit (H, W, 3), of the four datasets."""
    return {
        "dev Nature": read_pairs(data / "real/dev/nature"),
        "dev Real": read_pairs(data / "real/dev/real"),
        "real/train": read_pairs(data / "real/train", EVERY),
        "held-out mixtures": mixtures(mixture_count),
    }


def read_pairs(folder: Path, every: int = 1) -> Iterator[Pair]:
    (benchmark,) = read_benchmark("pairs", folder)
    for case in benchmark.cases[::every]:
        yield Photo.open(case.photo.path), Photo.open(case.ground_truth.path).pixels


def mixtures(count: int) -> Iterator[Pair]:
    stream = held_out_mixtures(read_recipe(RECIPE))
    for step, start in enumerate(range(0, count, BATCH_SIZE)):
        batch = stream(step, BATCH_SIZE, SIZE_PX)
        pairs = zip(batch.photo_encoded, batch.transmission_encoded, strict=True)
        for images in islice(pairs, count - start):
            photo, ground_truth = ((255 * image).round().byte().permute(1, 2, 0).numpy() for image in images)
            yield Photo.from_array(photo, encoding="srgb"), ground_truth


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), sys.argv[1] if len(sys.argv) > 1 else "compact")
