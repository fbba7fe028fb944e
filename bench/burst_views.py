"""Separates real bursts and other views of each: what is right in one of them should be right in
all.

    # films, and folders with the photos of a burst
    .venv/bin/python bench/burst_views.py out/views window.mp4 photos/
    .venv/bin/python bench/burst_views.py out/views shared/data/bursts/real/*.mp4

Prints one row for each view, and writes a picture for each burst: photo, T and R of its views side
by side.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from brewster import Photo, separate_burst
from brewster.errors import BrewsterError
from brewster.film import read_video
from brewster.photo.contact_sheet import side_by_side

LONG_SIDE_PX = 900
ROW_PX = 240
FRAMES = 5
VIEWS = {
    "as it is": lambda frames: (frames, len(frames) // 2),
    "earlier": lambda frames: (frames, len(frames) // 2 - 1),
    "later": lambda frames: (frames, len(frames) // 2 + 1),
    "without the last": lambda frames: (frames[:-1], len(frames) // 2),
    "mirrored": lambda frames: ([frame[:, ::-1] for frame in frames][::-1], len(frames) // 2),
    "left": lambda frames: (
        [frame[:, : frame.shape[1] * 3 // 4] for frame in frames],
        len(frames) // 2,
    ),
    "right": lambda frames: (
        [frame[:, frame.shape[1] // 4 :] for frame in frames],
        len(frames) // 2,
    ),
    "top": lambda frames: (
        [frame[: frame.shape[0] * 3 // 4] for frame in frames],
        len(frames) // 2,
    ),
    "bottom": lambda frames: ([frame[frame.shape[0] // 4 :] for frame in frames], len(frames) // 2),
}


def read(path: Path) -> list[np.ndarray]:
    """The frames of a burst, (h, w, 3) 8-bit sRGB."""
    photos = sorted(path.iterdir()) if path.is_dir() else read_video(path, FRAMES)
    pixels = [Photo.open(photo).pixels for photo in photos]
    scale = min(1.0, LONG_SIDE_PX / max(pixels[0].shape))
    return [
        cv2.resize(each, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for each in pixels
    ]


def main(out: Path, paths: list[Path]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    print("| burst | view | method | names | motion, % | explained |\n|---|---|---|---|---|---|")
    for path in paths:
        burst = read(path)
        columns = []
        for name, view in VIEWS.items():
            frames, reference = view(burst)
            photos = [
                Photo.from_array(np.ascontiguousarray(frame), encoding="srgb") for frame in frames
            ]
            try:
                result = separate_burst(photos, reference=reference)
            except BrewsterError as error:
                print(f"| {path.stem} | {name} | {error} | | | |")
                continue
            report = result.burst
            names = "certain" if report.are_names_certain else "asked"
            print(
                f"| {path.stem} | {name} | {report.method} | {names} | "
                f"{report.relative_motion_px / 10:.1f}"
                f" | {report.explained:.2f} |",
                flush=True,
            )
            columns.append(side_by_side((photos[reference], *result), ROW_PX))
        width = max(column.shape[1] for column in columns)
        rows = [
            np.pad(column, ((0, 4), (0, width - column.shape[1]), (0, 0))) for column in columns
        ]
        sheet = Photo.from_array(np.concatenate(rows), encoding="srgb")
        sheet.save(out / f"{path.stem}.jpg", quality=85, overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(path) for path in sys.argv[2:]])
