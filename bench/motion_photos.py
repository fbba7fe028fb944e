"""Scores photos that contain a film: separated by it, and as a photo alone.

    .venv/bin/python bench/simulate_motion_photos.py out/motion-photos 100
    .venv/bin/python bench/motion_photos.py out/motion-photos
    .venv/bin/python bench/motion_photos.py out/motion-photos 20 10     # ten, from the number 20 on

Prints a row for each photo, and the table of the proof: the median gain of T and R over the photo
alone, in dB at 1,440 px after a gain for each channel, for each range of the relative motion; how
often the film was used; and how often the result is worse than the photo alone.
"""

import csv
import sys
import time
from pathlib import Path

import numpy as np

from brewster import Photo, Separator
from brewster.batch.one_photo import separate_photo
from brewster.photo.srgb import to_encoded, to_linear

WIDTH = 1440
RANGES = ((2, 4), (4, 8), (8, 16.1))
WORSE_DB = 0.1


def main():
    folder = Path(sys.argv[1])
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 10_000
    with (folder / "samples.csv").open() as file:
        samples = [*csv.DictReader(file)][first : first + count]
    separator = Separator.load()
    rows = []
    for sample in samples:
        rows.append(score(folder, sample, separator))
        print(" ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    print(table(rows))


def score(folder, sample, separator):
    name = sample["name"]
    path = folder / f"{name}.jpg"
    truth = [read(folder / f"{name}.{layer}.png") for layer in ("transmission", "reflection")]
    started = time.perf_counter()
    found = separate_photo(path, separator)
    seconds = time.perf_counter() - started
    alone = separator(path)
    gains = [
        psnr_db(at_width(one), layer) - psnr_db(at_width(other), layer)
        for one, other, layer in zip(found, alone, truth, strict=True)
    ]
    change = psnr_db(at_width(found.transmission), at_width(alone.photo))
    report = found.burst
    return {
        "name": name,
        "relative_px": float(sample["relative_px"]),
        "has_passer": sample["has_passer"],
        "method": report.method,
        "found_px": report.relative_motion_px,
        "evidence": report.second_motion,
        "frame": report.film.nearest_frame,
        "alone_t": round(psnr_db(at_width(alone.transmission), truth[0]), 2),
        "gain_t": round(gains[0], 2),
        "gain_r": round(gains[1], 2),
        "to_input": round(change, 1),
        "seconds": round(seconds, 1),
    }


def at_width(photo):
    return photo.resized(WIDTH, round(WIDTH * photo.size[1] / photo.size[0]))


def read(path):
    return to_linear(Photo.open(path).pixels.astype(np.float32) / 255)


def psnr_db(image, truth):
    """PSNR of sRGB values after a gain for each channel in linear light."""
    gain = (image * truth).sum((0, 1)) / np.maximum((image * image).sum((0, 1)), 1e-9)
    error = to_encoded(np.clip(gain * image, 0, 1)) - to_encoded(np.clip(truth, 0, 1))
    return float(-10 * np.log10(np.maximum(np.mean(np.square(error)), 1e-7)))


def table(rows):
    lines = ["| motion, px of 1,000 | photos | by film | with hints | gain T | gain R | worse |"]
    lines.append("|---|---|---|---|---|---|---|")
    for low, high in RANGES:
        lines.append(
            line(f"{low} to {high:.0f}", [r for r in rows if low <= r["relative_px"] < high])
        )
    lines.append(line("no reflection", [r for r in rows if not r["relative_px"]]))
    lines.append(line("all", rows))
    return "\n".join(lines)


def line(title, rows):
    if not rows:
        return f"| {title} | 0 | | | | | |"
    methods = [row["method"] for row in rows]
    gains = [np.median([row[name] for row in rows]) for name in ("gain_t", "gain_r")]
    worse = sum(row["gain_t"] < -WORSE_DB for row in rows)
    return (
        f"| {title} | {len(rows)} | {methods.count('burst')} | {methods.count('hints')} | "
        f"{gains[0]:+.2f} | {gains[1]:+.2f} | {worse} |"
    )


if __name__ == "__main__":
    main()
