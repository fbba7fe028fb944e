"""Photographs without any reflection should hardly change: PSNR of ten to themselves.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/plain.py

kodak24 01 to 10: left out of training by recipes/train/compact.toml.
"""

import os
from pathlib import Path

from brewster import Photo, Separator
from brewster.metrics import psnr
from brewster.models.zoo import MODELS


def main(data: Path) -> None:
    photos = [data / "photos/permissive" / f"kodak24__{number:02}.jpg" for number in range(1, 11)]
    for name in MODELS:
        separator = Separator.load(name, device="cpu")
        scores = [psnr(separator(photo).transmission.pixels, Photo.open(photo).pixels) for photo in photos]
        print(
            f"{name}: ten plain photographs to themselves: mean {sum(scores) / 10:.2f} dB, least {min(scores):.2f} dB"
        )


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
