"""Compares the statistics of training streams with those of real pairs, to judge how realistic the
mixtures are.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/training_data.py recipes/train/compact.toml

Prints one row for each dataset and each recipe: the 10, 25, 50, 75 and 90 % quantiles over at most
about 200 images (10 for dev), 256 px on the longer side. The statistics are computed in linear
light, the PSNR on encoded values. The script trains nothing: it only computes statistics of the
real pairs.
"""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from brewster.photo.srgb import to_encoded, to_linear
from brewster.training.data.image_loading import read_pairs
from brewster.training.recipe import read_recipe
from brewster.training.streams import open_stream

SIZE_PX = 256
COUNT = 200
QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)


def main(data: Path, recipes: list[Path]) -> None:
    print(
        "| stream | " + " | ".join(statistics(torch.rand(3, 32, 32), torch.rand(3, 32, 32))) + " |"
    )
    for name in ("dev/nature", "dev/real", "train"):
        pairs = read_pairs([data / "real" / name])
        print_row(
            f"real/{name}", (resize_pair(pair) for pair in pairs[:: max(1, len(pairs) // COUNT)])
        )
    for path in recipes:
        stream = open_stream(read_recipe(path))
        batches = (stream(10**6 + step, 8, SIZE_PX) for step in range(COUNT // 8))
        pairs = ((b.photo_encoded[i], b.transmission_encoded[i]) for b in batches for i in range(8))
        print_row(path.stem, pairs)


def print_row(name: str, pairs: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Prints the quantiles over all pairs. Mixtures without a reflection are included, as in
    training.
    """
    rows = [statistics(to_linear(photo), to_linear(truth)) for photo, truth in pairs]
    cells = [
        " ".join(f"{value:.2f}" for value in np.nanquantile([row[key] for row in rows], QUANTILES))
        for key in rows[0]
    ]
    print(f"| {name} ({len(rows)}) | " + " | ".join(cells) + " |", flush=True)


def resize_pair(pair: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Converts uint8 images (H, W, 3) to encoded tensors (3, h, w) whose longer side is 256 px."""
    scale = SIZE_PX / max(pair[0].shape[:2])
    size = [round(side * scale) for side in pair[0].shape[:2]]
    photo, truth = (
        functional.interpolate(
            image.permute(2, 0, 1)[None] / 255, size, mode="bilinear", antialias=True
        )[0]
        for image in pair
    )
    return photo, truth


def statistics(photo: Tensor, truth: Tensor) -> dict[str, float]:
    """Returns the statistics of one pair in linear light, (3, h, w) each.
    dev/notes/compact-model.md defines them.
    """
    ratio = (truth / (photo + 1e-3)).flatten()[::3]
    change = photo - truth
    coarse = functional.avg_pool2d(change[None], 16)
    coarse = functional.interpolate(coarse, photo.shape[1:], mode="bilinear")[0]
    energy = change.square().mean()
    return {
        "input PSNR, dB": psnr(photo, truth),
        "median T/I": ratio.median().item(),
        "90th pct T/I": ratio.quantile(0.9).item(),
        "added light": (change.clamp(min=0).mean() / truth.mean().clamp(min=1e-6)).item(),
        "missing light": ((-change).clamp(min=0).mean() / truth.mean().clamp(min=1e-6)).item(),
        "low-frequency share": (1 - (change - coarse).square().mean() / energy).item()
        if energy > 1e-6
        else np.nan,
        "mean T": truth.mean().item(),
        "clipped share": (photo.amax(dim=0) > 0.98).float().mean().item(),
    }


def psnr(one: Tensor, other: Tensor) -> float:
    """Returns the PSNR of encoded values, at most 58.9 dB, the PSNR of rounding to 8 bits."""
    error = (to_encoded(one.clamp(0, 1)) - to_encoded(other)).square().mean().item()
    return -10 * np.log10(max(error, 1 / (12 * 255**2)))


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), [Path(name) for name in sys.argv[1:]])
