"""Measures the reliability of the verdicts of `Separation.assessment`, on photos with ground truth,
no training data.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/verdict.py [MODEL]

Prints the gain in PSNR of the photos of each verdict, of all datasets and of each, then of each bin
of the agreement, and the verdicts of the ground truths: clean photos, of which at most 15 % may
claim a removal. From the second and the third table, the limits in separation/assessment.py are
chosen: medians that fall from word to word, and "removed" only where the tenth percentile is above
2 dB.
"""

import os
import sys
from collections import defaultdict
from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from brewster import Separator
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.metrics.fidelity import psnr
from brewster.photo import Photo
from brewster.separation import Separation
from brewster.separation.assessment import Verdict, encoded_change, spread_from_confidence
from brewster.training.recipe import read_recipe
from brewster.training.streams import held_out_mixtures

MIXTURES = 200
CLAIMS = ("removed", "partly removed")
"""The verdicts that claim a removal."""
BATCH_SIZE = 8
SIZE_PX = 320
LIMITS = (0, 0.5, 0.7, 1, 1.25, 1.5, 2, 2.5, 3, 4, 6)
DATASETS = ("dev Nature", "dev Real", "real/train", "held-out mixtures")
HEADER = "\n|---|---|---|---|---|---|---|---|---|"
EVERY = 7
"""Every seventh pair of real/train is measured, because many of its pairs are similar."""
RECIPE = Path(__file__).parents[1] / "recipes/train/compact.toml"

Pair = tuple[Photo, NDArray[np.uint8]]


def main(data: Path, model: str) -> None:
    separator = Separator.load(model)
    gains: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    agreements = []
    found_gains = []
    of_clean: defaultdict[str, list[Verdict]] = defaultdict(list)
    for name, pairs in read_datasets(data).items():
        for photo, ground_truth in pairs:
            separation = separator(photo)
            before, after = (
                psnr(layer.pixels, ground_truth) for layer in (photo, separation.transmission)
            )
            verdict = separation.assessment.verdict
            clean = separator(Photo.from_array(ground_truth, encoding="srgb"))
            of_clean[name].append(clean.assessment.verdict)
            for key in ("all", name):
                gains[verdict, key].append(after - before)
            if verdict != "little found":
                agreements.append(agreement(separation))
                found_gains.append(after - before)
    print("| verdict | dataset | photos | better | 10 % | 25 % | median | 75 % | 90 % |" + HEADER)
    for verdict in get_args(Verdict):
        for name in ("all", *DATASETS):
            if gains[verdict, name]:
                print_row(f"{verdict} | {name}", gains[verdict, name])
    print("\n| agreement | to | photos | better | 10 % | 25 % | median | 75 % | 90 % |" + HEADER)
    for low, high in pairwise((*LIMITS, np.inf)):
        inside = [gain for gain, x in zip(found_gains, agreements, strict=True) if low <= x < high]
        if inside:
            print_row(f"{low:g} | {high:g}", inside)
    print_clean(of_clean)


def print_clean(of_clean: dict[str, list[Verdict]]) -> None:
    print(
        "\n| ground truths of | photos | claim a removal | reflection remains |\n|---|---|---|---|"
    )
    for name, verdicts in of_clean.items():
        shares = (
            sum(verdict in words for verdict in verdicts)
            for words in (CLAIMS, ("reflection remains",))
        )
        print(
            f"| {name} | {len(verdicts)} | "
            + " | ".join(f"{n / len(verdicts):.0%}" for n in shares)
            + " |"
        )


def print_row(label: str, gains: list[float]) -> None:
    quantiles = " | ".join(
        f"{value:+.2f}" for value in np.quantile(gains, (0.1, 0.25, 0.5, 0.75, 0.9))
    )
    print(f"| {label} | {len(gains)} | {np.mean(np.array(gains) > 0):.0%} | {quantiles} |")


def agreement(separation: Separation) -> float:
    """Returns the mean change divided by the mean spread of the outputs, which the verdict depends
    on.
    """
    height, width, _ = separation.confidence_map.shape
    change = encoded_change(
        *(layer.resized(width, height) for layer in (separation.photo, separation.transmission))
    )
    return float(change.mean() / spread_from_confidence(separation.confidence_map).mean())


def read_datasets(data: Path, mixture_count: int = MIXTURES) -> dict[str, Iterator[Pair]]:
    """Returns pairs of photo and ground truth, 8-bit (H, W, 3), of the four datasets."""
    pairs = [
        read_pairs(data / "real" / folder, every)
        for folder, every in (("dev/nature", 1), ("dev/real", 1), ("train", EVERY))
    ]
    return dict(zip(DATASETS, (*pairs, mixtures(mixture_count)), strict=True))


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
            photo, ground_truth = (
                (255 * image).round().byte().permute(1, 2, 0).numpy() for image in images
            )
            yield Photo.from_array(photo, encoding="srgb"), ground_truth


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), sys.argv[1] if len(sys.argv) > 1 else "compact")
