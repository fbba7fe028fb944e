"""Measures whether white stays white: the compact model on photos with blown skies or lamps,
without glass.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/white.py [MODEL]

Takes the ten photos with the most clipped pixels among those that training excludes. Prints for
each the share of pixels above 250 in all channels, and the share of the area in which such a pixel
falls below 245 in a channel. The goal is at most 0.1 % for each photo.
"""

import os
import sys
from pathlib import Path
from typing import Final

import numpy as np

from brewster import Separator
from brewster.photo import Photo

PATTERNS: Final = ("kodak24__*", "gianni-rosato-gb82*", "debian_wallpapers__*")
COUNT: Final = 10
WHITE = 250
GREY = 245
MAX_LOST_SHARE = 0.001


def main(data: Path, model: str) -> None:
    folder = data / "photos/permissive"
    separator = Separator.load(model)
    paths = sorted(path for pattern in PATTERNS for path in folder.glob(pattern))
    clipped_share = {
        path: (Photo.open(path).srgb_8bit() > WHITE).all(axis=2).mean() for path in paths
    }
    chosen = sorted(paths, key=lambda path: clipped_share[path], reverse=True)[:COUNT]
    passed = 0
    print("| photo | white | lost | verdict |\n|---|---|---|---|")
    for path in chosen:
        photo = Photo.open(path)
        separation = separator(photo)
        before, after = (image.srgb_8bit() for image in (photo, separation.transmission))
        is_lost = (before > WHITE).all(axis=2) & (after < GREY).any(axis=2)
        lost_share = float(np.mean(is_lost))
        passed += lost_share <= MAX_LOST_SHARE
        verdict = separation.assessment.verdict
        print(
            f"| {path.stem} | {clipped_share[path]:.2%} | {lost_share:.3%} | {verdict} |",
            flush=True,
        )
    print(
        f"\n{passed} of {len(chosen)} photos lose white in at most {MAX_LOST_SHARE:.1%} of the area"
    )


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), sys.argv[1] if len(sys.argv) > 1 else "compact")
