"""Measures bursts with ground truth: the gain over the single photo, and how often the choice
between the two was right.

    .venv/bin/python bench/burst.py FOLDER            # all bursts of a folder
    .venv/bin/python bench/burst.py FOLDER 320 0 5    # at most 320 px; bursts 0 and 5
    .venv/bin/python bench/burst.py                   # time and memory for five photos

FOLDER is a dataset of `brewster render --burst`, or has folders as docs/evaluation.md says. Time
and memory are compared with those of the solver in torch.

Prints one row for each burst. "gain" is the PSNR of the layers by motion minus that of the single
photo, after a gain for each channel; "exchanged" is that of the two layers with each other's names,
"result" that of the method that was chosen. The second table counts results that are worse by more
than 0.1 dB.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from brewster import Photo, Separator, separate_burst
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.film import measuring
from brewster.film.motion.model.levels import LEVELS
from brewster.film.motion.resizing import resized
from brewster.film.motion.solver import solve
from brewster.film.self_check import burst_report
from brewster.photo.srgb import to_encoded

BORDER_PX = 8
EQUAL_DB = 0.1
BEFORE = "903985e8"
"""The last commit whose solver used torch."""
BINS_PX = (0, 4, 10, 16, 32, np.inf)


def psnr_db(image, truth):
    """PSNR of sRGB-encoded images after a gain for each channel, without the border."""
    image, truth = (
        array[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].astype(float) for array in (image, truth)
    )
    image = image * ((image * truth).sum((0, 1)) / np.maximum((image * image).sum((0, 1)), 1e-9))
    error = to_encoded(image.clip(0, 1)) - to_encoded(truth.clip(0, 1))
    return float(-10 * np.log10(np.maximum(np.mean(error**2), 1e-6)))


def quality(folder, long_side_px, numbers):
    measuring.solve = partial(
        solve, levels=[level for level in LEVELS if level.long_side_px <= long_side_px]
    )
    separator = Separator.load()
    rows = []
    print(
        "| burst | motion, px | explained | naming | verdict | method | input T | single T | "
        "gain T | gain R | exchanged T | result T |"
    )
    print("|---|" + "---|" * 11)
    cases = [case for benchmark in read_benchmark("bursts", folder) for case in benchmark.cases]
    for case in [cases[number] for number in numbers] or cases:
        photos = [Photo.open(frame.read()) for frame in case.frames]
        reference = len(photos) // 2
        frames = [
            resized(photo.linear(), min(1000, max(photo.size))).clip(0, 1) for photo in photos
        ]
        upsampler, _, single = separator.fit(photos[reference])
        frame = frames[reference]
        prior = upsampler.apply(frame, 0, len(frame))[0].clip(0, frame)
        refine_prior = partial(measuring.prior_with_hints, separator, frame)
        solution, left_out = measuring.measure_layers(
            frames, reference, prior, refine_prior=refine_prior
        )
        report = burst_report(solution, single.verdict, len(photos), left_out, reference)
        if solution is None:
            print(f"| {case.name} | | | | {single.verdict} | {report.method} | | | | | |")
            continue
        long_side = max(solution.measured.shape)
        truth = [
            resized(Photo.open(file.read()).linear(), long_side)
            for file in (case.ground_truth, case.reflection)
        ]
        small = resized(frame, long_side)
        prior = resized(prior, long_side)
        layers = {
            "unchanged": (small, 0 * small),
            "single photo": (prior, small - prior),
            "burst": solution.layers,
            "exchanged": solution.layers[::-1],
        }
        scores = {method: np.array([*map(psnr_db, pair, truth)]) for method, pair in layers.items()}
        gain, exchanged, result = (
            scores[method] - scores["single photo"]
            for method in ("burst", "exchanged", report.method)
        )
        rows.append((report.relative_motion_px, report.method, result))
        print(
            f"| {case.name} | {report.relative_motion_px:.1f} | {report.explained:.2f} | "
            f"{solution.naming:+.2f}"
            f" | {single.verdict} | {report.method} | {scores['unchanged'][0]:.2f} | "
            f"{scores['single photo'][0]:.2f}"
            f" | {gain[0]:+.2f} | {gain[1]:+.2f} | {exchanged[0]:+.2f} | {result[0]:+.2f} |",
            flush=True,
        )
    print(
        "\n| measured motion, px | bursts | burst / single / unchanged | median gain T | R | "
        "worse |\n|---|---|---|---|---|---|"
    )
    for low, high in pairwise(BINS_PX):
        found = [row for row in rows if low <= row[0] < high]
        counts = " / ".join(
            str(sum(row[1] == method for row in found))
            for method in ("burst", "single photo", "unchanged")
        )
        chosen = np.array([row[2] for row in found if row[1] == "burst"]).reshape(-1, 2)
        medians = (
            [f"{value:+.2f}" for value in np.median(chosen, axis=0)] if len(chosen) else ["", ""]
        )
        worse = sum(row[2][0] < -EQUAL_DB for row in found)
        print(
            f"| {low:g} to {high:g} | {len(found)} | {counts} | {medians[0]} | {medians[1]} | "
            f"{worse} |"
        )


def make_photos(folder, width):
    """Makes five photos of two random textures that move differently."""
    rng = np.random.default_rng(1)
    height = width * 3 // 4
    scale = width / 4000
    layers = [
        cv2.resize(
            rng.random((80, 110, 3), np.float32),
            None,
            fx=50 * scale,
            fy=50 * scale,
            interpolation=0,
        )
        for _ in range(2)
    ]
    for k in range(5):
        starts = [round((400 + step * k) * scale) for step in (8, 40)]
        views = [
            layer[: height + 1][1:, start : start + width]
            for layer, start in zip(layers, starts, strict=True)
        ]
        light = 0.6 * views[0] + 0.3 * views[1]
        photo = Photo.from_array(np.rint(255 * to_encoded(light)).astype(np.uint8), encoding="srgb")
        photo.save(Path(folder, f"{k}.jpg"), overwrite=True)


def measure(folder):
    """Prints seconds and MiB for the photos of a folder."""
    started = time.perf_counter()
    result = separate_burst(sorted(Path(folder).glob("*.jpg")))
    seconds = time.perf_counter() - started
    # Not ru_maxrss, which a process inherits from its parent.
    peak_kib = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]
    print(seconds, int(peak_kib) / 1024, result.burst.method)


def speed():
    """Compares this version with the last one whose solver used torch, in one run. The first run
    compiles the kernels.
    """
    print("\n| five photos | solver | seconds | MiB | method | ratio |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as photos:
        git = ["git", "-C", str(Path(__file__).parent)]
        subprocess.run([*git, "worktree", "add", "--quiet", "--detach", folder, BEFORE], check=True)
        try:
            sources = {"torch": Path(folder, "src"), "numba": Path(__file__).parents[1] / "src"}
            for width, size in ((640, ""), (4000, "12 megapixels"), (1154, "1 megapixel")):
                first = 0.0
                make_photos(photos, width)
                for name, source in sources.items():
                    environment = os.environ | {"PYTHONPATH": str(source)}
                    command = [sys.executable, __file__, "measure", photos]
                    out = subprocess.run(
                        command, env=environment, check=True, capture_output=True, text=True
                    )
                    seconds, mebibytes, method = out.stdout.split(maxsplit=2)
                    first = first or float(seconds)
                    if size:
                        print(
                            f"| {size} | {name} | {float(seconds):.1f} | {float(mebibytes):.0f} "
                            f"| {method.strip()}"
                            f" | {first / float(seconds):.1f} |",
                            flush=True,
                        )
        finally:
            subprocess.run([*git, "worktree", "remove", "--force", folder], check=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        measure(sys.argv[2])
    elif len(sys.argv) > 1:
        folder, long_side_px, *numbers = (
            [*sys.argv[1:], "640"] if len(sys.argv) == 2 else sys.argv[1:]
        )
        quality(Path(folder), int(long_side_px), [*map(int, numbers)])
    else:
        speed()
