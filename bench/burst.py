"""Measures bursts with ground truth: the gain over the single photo, and how often the choice between the two was right.

    .venv/bin/python bench/burst.py FOLDER    # a dataset of `brewster render --burst`, or folders as docs/evaluation.md describes
    .venv/bin/python bench/burst.py           # time and memory for five photos of 12 megapixels

Prints one row for each burst. "gain" is the PSNR of the layers by motion minus that of the single photo, after a gain for each
channel; the choice is right if the better one of the two was chosen, or if they differ by less than 0.1 dB.
"""

import resource
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from brewster import Photo, Separator, separate_burst
from brewster.benchmarks.registry import read_benchmark
from brewster.burst.separate import burst_report, measure_layers
from brewster.burst.solver import resized
from brewster.srgb import to_encoded

BORDER_PX = 8
EQUAL_DB = 0.1
BINS_PX = (0, 4, 10, 16, 32, np.inf)


def psnr_db(image, truth):
    """PSNR of sRGB-encoded images after a gain for each channel, without the border."""
    image, truth = (
        array[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].astype(float) for array in (image, truth)
    )
    image = image * ((image * truth).sum((0, 1)) / np.maximum((image * image).sum((0, 1)), 1e-9))
    error = to_encoded(image.clip(0, 1)) - to_encoded(truth.clip(0, 1))
    return float(-10 * np.log10(np.maximum(np.mean(error**2), 1e-6)))


def quality(folder):
    separator = Separator.load()
    rows = []
    print(
        "| burst | motion, px | explained | method | input T | single T | gain T | gain R | right |\n|---|"
        + "---|" * 8
    )
    for case in (case for benchmark in read_benchmark("bursts", folder) for case in benchmark.cases):
        photos = [Photo.open(frame.read()) for frame in case.frames]
        reference = len(photos) // 2
        frames = [resized(photo.linear(), min(1000, max(photo.size))).clip(0, 1) for photo in photos]
        upsampler, _, single = separator.fit(photos[reference])
        frame = frames[reference]
        prior = upsampler.apply(frame, 0, len(frame))[0].clip(0, frame)
        solution, left_out = measure_layers(frames, reference, prior)
        report = burst_report(solution, single.verdict == "little found", len(photos), left_out, reference)
        if solution is None:
            print(f"| {case.name} | | | {report.method} | | | | | |")
            continue
        long_side = max(solution.transmission.shape)
        truth = [
            resized(Photo.open(file.read()).linear(), long_side)
            for file in (case.ground_truth, case.reflection)
        ]
        singles = [resized(image, long_side) for image in (prior, frame - prior)]
        scores = [psnr_db(image, layer) for image, layer in zip(singles, truth, strict=True)]
        gains = [
            psnr_db(image, layer) - score
            for image, layer, score in zip(
                (solution.transmission, solution.reflection), truth, scores, strict=True
            )
        ]
        right = abs(gains[0]) < EQUAL_DB or (gains[0] > 0) == (report.method == "burst")
        rows.append((report.relative_motion_px, report.method == "burst", *gains, right))
        print(
            f"| {case.name} | {report.relative_motion_px:.1f} | {report.explained:.2f} | {report.method}"
            f" | {psnr_db(resized(frame, long_side), truth[0]):.2f} | {scores[0]:.2f} | {gains[0]:+.2f} | {gains[1]:+.2f}"
            f" | {'yes' if right else 'no'} |",
            flush=True,
        )
    print(
        "\n| measured motion, px | bursts | by motion | median gain T of these | R | choice right |\n|---|---|---|---|---|---|"
    )
    for low, high in pairwise(BINS_PX):
        found = [row for row in rows if low <= row[0] < high]
        chosen = np.array([row[2:4] for row in found if row[1]]).reshape(-1, 2)
        medians = [f"{value:+.2f}" for value in np.median(chosen, axis=0)] if len(chosen) else ["", ""]
        right = f"{np.mean([row[4] for row in found]):.0%}" if found else ""
        print(
            f"| {low:g} to {high:g} | {len(found)} | {len(chosen)} | {medians[0]} | {medians[1]} | {right} |"
        )


def speed():
    """Five photos of 12 megapixels, of two random textures that move differently."""
    rng = np.random.default_rng(1)
    layers = [np.kron(rng.random((80, 110, 3)), np.ones((50, 50, 1))).astype(np.float32) for _ in range(2)]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, f"{k}.jpg") for k in range(5)]
        for k, path in enumerate(paths):
            views = [
                layer[100:3100, 400 + step * k : 4400 + step * k]
                for layer, step in zip(layers, (8, 40), strict=True)
            ]
            light = 0.6 * views[0] + 0.3 * views[1]
            Photo.from_array(np.rint(255 * to_encoded(light)).astype(np.uint8), encoding="srgb").save(path)
        del layers, views, light
        started = time.perf_counter()
        result = separate_burst(paths)
        seconds = time.perf_counter() - started
    mebibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"five photos of 12 megapixels: {seconds:.1f} s, {mebibytes:.0f} MiB ({result.burst.method})")


if __name__ == "__main__":
    quality(Path(sys.argv[1])) if len(sys.argv) > 1 else speed()
