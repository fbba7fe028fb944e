"""Measures films of a hand that trembles (simulate_tremor.py): the gain over the single photo, how
often the layers are used, and what a second layer explains in films of one layer.

    .venv/bin/python bench/small_motions.py FOLDER               # all films
    .venv/bin/python bench/small_motions.py FOLDER all 0 30      # the films 0 and 30
    .venv/bin/python bench/small_motions.py FOLDER evidence      # only the evidence, without layers

Prints one row for each film. "gain" is the PSNR of the layers by motion minus that of the single
photo, after a gain for each channel; "result" is that of the method that was chosen.
"""

import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from burst import EQUAL_DB, psnr_db

from brewster import Photo, Separator
from brewster.film.measuring import measure_layers, prior_with_hints
from brewster.film.motion.registration.homographies import normalised
from brewster.film.motion.registration.tracks import layer_tracks
from brewster.film.motion.resizing import resized
from brewster.film.motion.small_motions import find_small_motion
from brewster.film.motion.threads import single_opencv_thread
from brewster.film.self_check import burst_report
from brewster.photo.srgb import to_linear

BINS_PX = ((3, 5), (5, 8), (8, 12))


def linear(image):
    """Linear light of an 8-bit sRGB image."""
    return to_linear(image.astype(np.float32) / 255).astype(np.float32)


def prepared(path, separator):
    """The film, its frames, the index of the reference frame, and its T and verdict as a photo."""
    film = np.load(path)
    frames = [linear(frame) for frame in film["frames"]]
    reference = len(frames) // 2
    frame = frames[reference]
    photo = Photo.from_array(frame, encoding="linear")
    upsampler, _, single = separator.fit(photo, quality="draft")
    return film, frames, reference, upsampler.apply(frame, 0, len(frame))[0].clip(0, frame), single


def title(path, film):
    relative, parallax = (float(film[name]) for name in ("relative_px", "parallax_px"))
    return f"{path.stem} | {film['case']} | {film['codec']} | {relative:.1f} | {parallax:.1f}"


def evidence(path, separator):
    """Prints what a small motion explains. The features are those of half the size."""
    film, frames, reference, prior, _ = prepared(path, separator)
    with single_opencv_thread():
        half = [resized(frame, 500) for frame in frames]
        tracks = layer_tracks(half, reference, resized(prior, 500))
        if not tracks or len(tracks[0].found) < len(frames):
            print(f"| {title(path, film)} | no track |", flush=True)
            return
        size = half[0].shape[:2]
        motions = normalised(np.linalg.inv(np.stack(tracks[0].motions)), size, size)
        small = find_small_motion(frames, reference, prior, motions)
    print(f"| {title(path, film)} | {small.evidence:.3f} |", flush=True)


def layers(path, separator):
    """Prints a row; returns the case, the true motion, the method, and the gains of the result."""
    film, frames, reference, prior, single = prepared(path, separator)
    refine_prior = partial(prior_with_hints, separator, frames[reference])
    started = time.process_time()
    solution, left_out = measure_layers(frames, reference, prior, refine_prior=refine_prior)
    seconds = time.process_time() - started
    report = burst_report(solution, single.verdict, len(frames), left_out, reference)
    if solution is None:
        print(f"| {title(path, film)} | {single.verdict} | {report.method} |", flush=True)
        return str(film["case"]), float(film["relative_px"]), report.method, np.zeros(2)
    size = max(solution.measured.shape)
    truth = [resized(linear(layer), size) for layer in film["truth"]]
    frame, prior = resized(frames[reference], size), resized(prior, size)
    pairs = {
        "unchanged": (frame, 0 * frame),
        "single photo": (prior, (frame - prior).clip(0)),
        "burst": solution.layers,
        "exchanged": solution.layers[::-1],
    }
    scores = {name: np.array([*map(psnr_db, pair, truth)]) for name, pair in pairs.items()}
    gain, exchanged, result = (
        scores[name] - scores["single photo"] for name in ("burst", "exchanged", report.method)
    )
    print(
        f"| {title(path, film)} | {single.verdict} | {report.method} "
        f"| {'small' if solution.is_small else 'large'} {report.relative_motion_px:.1f} "
        f"| {solution.small_motion_evidence:.3f} | {report.explained:.3f} "
        f"| {report.edge_correlation:.2f} | {solution.naming:+.2f} "
        f"| {scores['single photo'][0]:.2f} | {gain[0]:+.2f} | {gain[1]:+.2f} "
        f"| {exchanged[0]:+.2f} | {result[0]:+.2f} | {seconds:.0f} |",
        flush=True,
    )
    return str(film["case"]), float(film["relative_px"]), report.method, result


def summary(rows):
    """Prints one row for each range of motions, and for the films of one layer."""
    print("\n| true motion, px | films | used | median gain T | R | worse |")
    print("|---|" + "---|" * 5)
    for low, high in BINS_PX:
        found = [row for row in rows if row[0] == "two layers" and low <= row[1] < high]
        used = np.array([row[3] for row in found if row[2] == "burst"]).reshape(-1, 2)
        medians = [f"{value:+.2f}" for value in np.median(used, axis=0)] if len(used) else ["", ""]
        worse = int((used[:, 0] < -EQUAL_DB).sum())
        print(f"| {low} to {high} | {len(found)} | {len(used)} | {' | '.join(medians)} | {worse} |")
    one_layer = [row[2] for row in rows if row[0] == "one layer"]
    print(f"| one layer | {len(one_layer)} | {one_layer.count('burst')} | | | |")


def main(folder, what="all", *numbers):
    separator = Separator.load()
    paths = [folder / f"{int(number):03}.npz" for number in numbers] or sorted(folder.glob("*.npz"))
    if what == "evidence":
        paths.sort(key=lambda path: str(np.load(path)["case"]))  # those of one layer first
        for path in paths:
            evidence(path, separator)
        return
    print(
        "| film | case | codec | motion | parallax | verdict | method | found | evidence "
        "| explained | edges | naming | single T | gain T | R | exchanged T | result T | CPU s |"
    )
    print("|---|" + "---|" * 17)
    summary([layers(path, separator) for path in paths])


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
