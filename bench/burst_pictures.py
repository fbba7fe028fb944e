"""Makes the pictures of docs/burst.md and README.md: photo, T of the single photo, layers of the
burst, ground truth.

    .venv/bin/python bench/burst_pictures.py out/circles

The folder is that of `bench/simulate_bursts.py out/circles 60 circle`. Writes docs/bursts.jpg,
whose rows are every ninth burst, not chosen by their scores, and docs/film.jpg without the ground
truth, which is chosen.
"""

import sys
from pathlib import Path

import numpy as np

from brewster import Photo, Separator, separate_burst
from brewster.photo.contact_sheet import side_by_side

NUMBERS = (0, 9, 18, 27, 36)
ROW_PX = 190
CHOSEN = 27
FILM_PX = 300


def main(folder: Path) -> None:
    docs = Path(__file__).parents[1] / "docs"
    separator = Separator.load()

    def row(number: int, height_px: int, *, with_truth: bool) -> np.ndarray:
        burst = folder / f"{number:03}"
        single = separator(burst / "frame3.jpg")
        result = separate_burst(sorted(burst.glob("frame*.jpg")), separator=separator)
        print(f"{burst.name}: {result.burst.method}, {result.burst.relative_motion_px:.0f} px")
        truth = (Photo.open(burst / "transmission3.png"),) if with_truth else ()
        return side_by_side((single.photo, single.transmission, *result, *truth), height_px)

    rows = [row(number, ROW_PX, with_truth=True) for number in NUMBERS]
    for name, pixels in {
        "bursts": np.concatenate(rows),
        "film": row(CHOSEN, FILM_PX, with_truth=False),
    }.items():
        Photo.from_array(pixels, encoding="srgb").save(
            docs / f"{name}.jpg", quality=80, overwrite=True
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
