"""Measures the verdicts of bursts with ground truth, at 160 pixels.

    .venv/bin/python bench/film_verdicts.py out/simulated out/panes out/doors out/mirrors

The folders are those of simulate_bursts.py and simulate_panes.py. Prints a row for each burst, and
for each folder, method and verdict the gain of T over the photo, in dB after a gain for each
channel.
"""

import sys
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
from burst import psnr_db

from brewster import Photo, Separator
from brewster.film import measuring
from brewster.film.motion.model.levels import LEVELS, NAMING_PX
from brewster.film.motion.resizing import resized
from brewster.film.motion.solver import solve
from brewster.film.self_check import burst_report


def measured(separator, folder):
    """The solution of a burst, its report, and T of the single photo."""
    photos = [Photo.open(path) for path in sorted(folder.glob("frame*"))]
    reference = len(photos) // 2
    frames = [photo.linear().clip(0, 1) for photo in photos]
    frame = frames[reference]
    upsampler, _, single = separator.fit(photos[reference], quality="draft")
    prior = upsampler.apply(frame, 0, len(frame))[0].clip(0, frame)
    refine_prior = partial(measuring.prior_with_hints, separator, frame)
    solution, left_out = measuring.measure_layers(
        frames, reference, prior, refine_prior=refine_prior
    )
    report = burst_report(solution, single.verdict, len(photos), left_out, reference)
    return solution, report, frame, prior


def main(folders):
    levels = [level for level in LEVELS if level.long_side_px <= NAMING_PX]
    measuring.solve = partial(solve, levels=levels)
    separator = Separator.load()
    gains = defaultdict(list)
    print("| burst | motion, px | method | verdict | names | no glass | photo T | gain T |")
    print("|---|---|---|---|---|---|---|---|")
    for folder in folders:
        for burst in sorted(path for path in folder.iterdir() if path.is_dir()):
            solution, report, frame, prior = measured(separator, burst)
            if solution is None:
                continue
            long_side_px = max(solution.measured.shape)
            truth = Photo.open(next(burst.glob("transmission*"))).linear()
            results = {"burst": solution.layers[0], "single photo": prior, "unchanged": frame}
            photo, result, true = (
                resized(image, long_side_px) for image in (frame, results[report.method], truth)
            )
            before, after = (psnr_db(image, true) for image in (photo, result))
            names = "certain" if report.are_names_certain else "asked"
            outside = 0 if solution.without_glass is None else solution.without_glass.mean()
            kind = report.method, report.measured_verdict, names
            gains[folder.name, *kind].append(after - before)
            print(
                f"| {folder.name}/{burst.name} | {report.relative_motion_px:.0f} | "
                f"{' | '.join(kind)} | {outside:.2f} | {before:.1f} | {after - before:+.1f} |",
                flush=True,
            )
    print("\n| folder | method | verdict | names | bursts | lowest | median | highest |")
    print("|---|---|---|---|---|---|---|---|")
    for kind, values in sorted(gains.items()):
        lowest, median, highest = np.quantile(values, (0, 0.5, 1))
        print(
            f"| {' | '.join(kind)} | {len(values)} | {lowest:+.1f} | {median:+.1f} | "
            f"{highest:+.1f} |"
        )


if __name__ == "__main__":
    main([Path(folder) for folder in sys.argv[1:]])
