"""Measures photos in changing light with ground truth (simulate_light.py): the gain over the single
photo, and over what people and papers do.

    .venv/bin/python bench/light.py --count 40                       # 40 of each kind, 320 px wide
    .venv/bin/python bench/light.py --count 40 --kind polariser --width 640 --sheets out
    .venv/bin/python bench/light.py --count 100 --first 6000 --minutes 35

Prints one row for each case: PSNR of T after a gain for each channel, minus that of the single
photo. "minimum" is the least light of each pixel with the true exposures, "gradients" the median of
their gradients (Weiss 2001), "closed form" the layers of known angles, index and exposures
(polarisers only). The last table has means, the median of the result, and how many are worse than
the single photo by more than 0.1 dB. The sheets have the cases with the smallest gains: photo,
single photo, minimum, result, truth.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from simulate_light import KINDS, generator, read_paths, simulate

from brewster import Photo, Separator, separate_burst
from brewster.photo.srgb import to_encoded

BORDER_PX = 8
METHODS = ("input", "minimum", "gradients", "closed form", "result")
EQUAL_DB = 0.1
FIRST = 3000
"""The first case: those below were used while the method was made, and those below 6,000 have been
looked at since.
"""
SHEET_ROWS = 12


def psnr_db(image, truth):
    """PSNR of sRGB-encoded images after a gain for each channel, without the border."""
    inner = slice(BORDER_PX, -BORDER_PX)
    image, truth = (array[inner, inner].clip(0).astype(float) for array in (image, truth))
    image = image * ((image * truth).sum((0, 1)) / np.maximum((image * image).sum((0, 1)), 1e-9))
    error = to_encoded(image.clip(0, 1)) - to_encoded(truth.clip(0, 1))
    return float(-10 * np.log10(np.maximum(np.mean(error**2), 1e-6)))


def median_of_gradients(photos, weight=1e-4):
    """T whose gradients are the medians of those of the photos (K, h, w, 3), and whose light is
    roughly their median.
    """
    light = np.median(photos, axis=0)
    height, width = light.shape[:2]
    right, below = (
        np.median(np.diff(photos, axis=axis, append=photos.take([-1], axis)), axis=0)
        for axis in (2, 1)
    )
    divergence = right + below
    divergence[:, 1:] -= right[:, :-1]
    divergence[1:] -= below[:-1]
    eigenvalues = sum(
        (2 - 2 * np.cos(np.pi * np.arange(side) / side)).reshape(shape)
        for side, shape in ((height, (-1, 1)), (width, (1, -1)))
    )
    planes = [
        cv2.idct(cv2.dct(plane.astype(float)) / (eigenvalues + weight))
        for plane in np.moveaxis(weight * light - divergence, 2, 0)
    ]
    return np.stack(planes, axis=2)


def closed_form(photos, layers, middle):
    """T by least squares, with the true strength of both layers in each photo."""
    strengths = np.stack(
        [
            [layer[k] / np.maximum(layer[middle], 1e-6) for k in range(len(photos))]
            for layer in zip(*layers, strict=True)
        ]
    )
    a, b = strengths
    aa, ab, bb = (a * a).sum(0), (a * b).sum(0), (b * b).sum(0)
    first, second = (a * photos).sum(0), (b * photos).sum(0)
    return (bb * first - ab * second) / np.maximum(aa * bb - ab * ab, 1e-6)


def group(kind, case):
    """The row of the last table."""
    if kind == "polariser":
        angle = float(case)
        return f"polariser {'0-30' if angle < 30 else '30-45' if angle < 45 else '45-65'} deg"
    return f"{kind} {case}".strip()


def measured(kind, number, shape, paths, separator):
    """The group of a case, the report, the PSNR of the single photo, the gains and the images."""
    files, layers, case = simulate(generator(kind, number), paths, kind, shape)
    middle = len(files) // 2
    photos = np.stack([Photo.open(file).linear() for file in files])
    truth = layers[middle][0]
    single = separator(files[middle]).transmission.linear()
    separation = separate_burst(files, separator=separator)
    levels = np.stack([t.mean((0, 1)) for t, _ in layers])
    scaled = photos / (levels / levels[middle])[:, None, None]
    results = {
        "input": photos[middle],
        "minimum": scaled.min(0),
        "gradients": median_of_gradients(scaled),
        "result": separation.transmission.linear(),
    }
    if kind == "polariser":
        results["closed form"] = closed_form(photos, layers, middle)
    base = psnr_db(single, truth)
    gains = {name: psnr_db(image, truth) - base for name, image in results.items()}
    shown = photos[middle], single, results["minimum"], results["result"], truth
    images = np.hstack([to_encoded(image.clip(0, 1)) for image in shown])
    return case, separation.burst, base, gains, np.rint(255 * images).astype(np.uint8)


def print_table(table):
    print(f"\n| kind | cases | by light | worse | median | {' | '.join(METHODS)} |")
    print(f"|{'---|' * 10}")
    for name, cases in sorted(table.items()):
        means = []
        for method in METHODS:
            values = [gains[method] for _, gains in cases if method in gains]
            means.append(f"{np.mean(values):+.2f}" if values else "")
        by_light = sum(method == "light" for method, _ in cases)
        results = [gains["result"] for _, gains in cases]
        worse = sum(gain < -EQUAL_DB for gain in results)
        print(
            f"| {name} | {len(cases)} | {by_light} | {worse} | {np.median(results):+.2f} | "
            f"{' | '.join(means)} |"
        )


def main(arguments):
    paths = read_paths()
    separator = Separator.load()
    end = time.monotonic() + 60 * arguments.minutes
    table = {}
    rows = {kind: [] for kind in arguments.kinds}
    print(f"| case | kind | method | area | single | {' | '.join(METHODS)} |\n|{'---|' * 10}")
    shape = arguments.width * 3 // 4, arguments.width
    for number in range(arguments.first, arguments.first + arguments.count):
        for kind in arguments.kinds:
            if time.monotonic() > end:
                break
            case, report, base, gains, images = measured(kind, number, shape, paths, separator)
            table.setdefault(group(kind, case), []).append((report.method, gains))
            cells = [f"{gains[name]:+.2f}" if name in gains else "" for name in METHODS]
            light = report.light
            area = f"{light.changed_area:.2f} {light.kind}" if light else ""
            print(
                f"| {kind} {number} {case} | {kind} | {report.method} | {area} | {base:.2f} | "
                f"{' | '.join(cells)} |",
                flush=True,
            )
            rows[kind].append((gains["result"], number, images))
            rows[kind] = sorted(rows[kind], key=lambda row: row[:2])[:SHEET_ROWS]
    if arguments.sheets:
        arguments.sheets.mkdir(parents=True, exist_ok=True)
        for kind, worst in rows.items():
            if worst:
                sheet = Photo.from_array(np.vstack([row[2] for row in worst]), encoding="srgb")
                sheet.save(arguments.sheets / f"{kind}.jpg", overwrite=True)
    print_table(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, required=True, help="cases of each kind")
    parser.add_argument("--kind", dest="kinds", action="append", choices=KINDS)
    parser.add_argument("--first", type=int, default=FIRST, help="the number of the first case")
    parser.add_argument("--width", type=int, default=320, help="pixels")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stops after that")
    parser.add_argument("--sheets", type=Path, help="folder for contact sheets")
    arguments = parser.parse_args()
    arguments.kinds = arguments.kinds or KINDS
    main(arguments)
