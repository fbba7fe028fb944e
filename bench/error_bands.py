"""Measures at which scales the compact model removes a reflection, on photos that no model was
trained on.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/error_bands.py [MODEL]

The error of an image is split into frequency bands by differences of Gaussian blurs. Prints one row
per dataset and sharpness of the reflection: the reduction of the squared error in each band, in dB.
0 dB means that the separation does not help in this band.
"""

import os
import sys
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from verdict import read_datasets

from brewster import Separator

Errors = NDArray[np.float64]

SIGMAS_PX: Final = (1.5, 4, 12, 40)
MIXTURES: Final = 120
SMOOTH: Final = 0.1
"""Below this ratio of fine (1.5 to 4 px) to coarse (4 to 40 px) energy, a reflection is called
smooth.
"""


def main(data: Path, model: str) -> None:
    separator = Separator.load(model)
    reductions: defaultdict[tuple[str, str], list[Sequence[float]]] = defaultdict(list)
    for name, pairs in read_datasets(data, MIXTURES).items():
        for photo, ground_truth in pairs:
            transmission = separator(photo).transmission
            before, after = (
                image.pixels / 255.0 - ground_truth / 255.0 for image in (photo, transmission)
            )
            if np.square(before).mean() < 1e-4:  # no visible reflection
                continue
            energies = [energy_by_band(error) for error in (before, after)]
            fine = energies[0][1]
            coarse = energies[0][2] + energies[0][3]
            sharpness = "smooth" if fine < SMOOTH * coarse else "sharp"
            energies = [
                [*bands, float(np.square(error).mean())]
                for bands, error in zip(energies, (before, after), strict=True)
            ]
            reductions[name, sharpness].append(
                [10 * np.log10(x / y) for x, y in zip(*energies, strict=True)]
            )
    bands = [f"{low:g} to {high:g} px" for low, high in pairwise((0, *SIGMAS_PX))]
    columns = ["dataset", "reflection", "photos", *bands, f"above {SIGMAS_PX[-1]} px", "all"]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for (name, sharpness), rows in sorted(reductions.items()):
        means = " | ".join(f"{value:+.2f}" for value in np.mean(rows, axis=0))
        print(f"| {name} | {sharpness} | {len(rows)} | {means} |")


def energy_by_band(error: Errors) -> list[float]:
    """Returns the mean squared error in each band, from fine to coarse; `error` is (H, W, 3)."""
    blurred = [error, *(gaussian_filter(error, (sigma, sigma, 0)) for sigma in SIGMAS_PX)]
    bands = [*(fine - coarse for fine, coarse in pairwise(blurred)), blurred[-1]]
    return [float(np.square(band).mean()) + 1e-9 for band in bands]


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), sys.argv[1] if len(sys.argv) > 1 else "compact")
