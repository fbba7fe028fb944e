"""Makes the picture of docs/burst.md: photo, transmission of the single photo, both layers of the burst, and the ground truth.

    .venv/bin/python bench/burst_pictures.py out/simulated        # a folder of bench/simulate_bursts.py

Writes docs/bursts.jpg. The rows are every ninth burst, not chosen by their scores.
"""

import sys
from pathlib import Path

import numpy as np

from brewster import Photo, Separator, separate_burst
from brewster.photo.contact_sheet import side_by_side

NUMBERS = (0, 9, 18, 27, 36)
ROW_PX = 190


def main(folder: Path) -> None:
    separator, rows = Separator.load(), []
    for number in NUMBERS:
        burst = folder / f"{number:03}"
        single = separator(burst / "frame3.jpg")
        result = separate_burst(sorted(burst.glob("frame*.jpg")), separator=separator)
        print(f"{burst.name}: {result.burst.method}, {result.burst.relative_motion_px:.0f} px")
        truth = Photo.open(burst / "transmission3.png")
        rows.append(side_by_side((single.photo, single.transmission, *result, truth), ROW_PX))
    sheet = Photo.from_array(np.concatenate(rows), encoding="srgb")
    sheet.save(Path(__file__).parents[1] / "docs/bursts.jpg", quality=80, overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
