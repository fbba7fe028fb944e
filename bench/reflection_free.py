"""Measures the change of ten photos without reflection: the PSNR of the transmission, compared with
the input.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/reflection_free.py

Higher is better. The photos are kodak24 01 to 10, which are not training data of the compact model.
"""

import os
from pathlib import Path

from brewster import Photo, Separator
from brewster.metrics import psnr
from brewster.separation.models.zoo import MODELS


def main(data: Path) -> None:
    photos = [data / "photos/permissive" / f"kodak24__{number:02}.jpg" for number in range(1, 11)]
    for name in MODELS:
        separator = Separator.load(name, device="cpu")
        scores = [
            psnr(separator(photo).transmission.pixels, Photo.open(photo).pixels) for photo in photos
        ]
        print(
            f"{name}: PSNR of ten reflection-free photos: mean {sum(scores) / 10:.2f} dB, "
            f"minimum {min(scores):.2f} dB"
        )


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
