"""Measures `brewster evaluate` with the default metrics: images per second with one and two
workers, and memory.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/evaluate.py [COUNT]

COUNT images (default 500) of 540x400 are scored: the unprocessed input and one folder of
predictions. The processor time per image is also given as a multiple of the time of AlexNet on the
images of a case, because LPIPS cannot take less than that.
"""

import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import torch

from brewster import Photo
from brewster.evaluation.runner import SCORES_FILE
from brewster.metrics import Lpips
from brewster.photo.srgb import to_encoded

OUT = Path("out/bench/evaluate")
SIZE = (540, 400)
# Photo, both ground truths, and both predicted layers; the black reflection of the baseline is
# cached
ALEXNET_RUNS = 5


def main(data: Path, count: int = 500) -> None:
    make_pairs(data, count)
    seconds = {}
    alexnet_s = measure_alexnet()
    for workers in (1, 2):
        out = OUT / f"workers-{workers}"
        shutil.rmtree(out, ignore_errors=True)
        cpu_before = cpu_seconds_of_children()
        seconds[workers], memory = measure(out, workers)
        cpu_s = (cpu_seconds_of_children() - cpu_before) / count
        quarter = len(memory) // 4
        first, last = (max(part) / 2**20 for part in (memory[:quarter], memory[-quarter:]))
        rate = count / seconds[workers]
        print(
            f"--workers {workers}: {rate:.2f} images per second, default metrics, "
            "for the unprocessed input and one folder"
        )
        print(
            f"  {cpu_s:.3f} CPU seconds per image, {cpu_s / alexnet_s:.2f} times those of AlexNet "
            f"on the {ALEXNET_RUNS} images of a case"
        )
        print(
            f"  memory of all processes: {first:.2f} GiB in the first quarter, {last:.2f} GiB in "
            "the last"
        )
    print(f"two workers are {seconds[1] / seconds[2]:.2f} times as fast as one")
    same = (OUT / "workers-1/results.json").read_bytes() == (
        OUT / "workers-2/results.json"
    ).read_bytes()
    print(f"the results.json files of both runs are {'equal' if same else 'NOT EQUAL'}")


def make_pairs(data: Path, count: int) -> None:
    """Mixes pairs from photos, and writes them with the predictions of a simulated method."""
    photos = sorted((data / "photos/permissive").glob("*.jpg"))
    rng = np.random.default_rng(7)
    for i in range(count):
        if (OUT / "predictions" / f"{i}.png").exists():
            continue
        behind, mirrored = (
            Photo.open(photos[(i + step) % len(photos)]).resized(*SIZE) for step in (0, 17)
        )
        reflection = 0.3 * rng.uniform() * mirrored
        layers = {
            "blended": 0.9 * behind + reflection,
            "transmission": behind,
            "reflection": reflection,
            "../predictions": 0.95 * behind + 0.3 * reflection,
        }
        for role, light in layers.items():
            pixels = np.rint(255 * to_encoded(np.clip(light, 0, 1))).astype(np.uint8)
            Photo.from_array(pixels, encoding="srgb").save(
                OUT / "pairs" / role / f"{i}.png", overwrite=True
            )


def measure_alexnet() -> float:
    """CPU seconds of the features of the images of one case, with one thread."""
    torch.set_num_threads(1)
    metric = Lpips.load()
    images = np.random.default_rng(1).integers(0, 256, (1 + ALEXNET_RUNS, *SIZE[::-1], 3), np.uint8)
    metric.features(images[0])  # a warm-up
    started = time.process_time()
    for image in images[1:]:
        metric.features(image)
    return time.process_time() - started


def cpu_seconds_of_children() -> float:
    """CPU seconds of all child processes that have ended, with their descendants."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure(out: Path, workers: int) -> tuple[float, list[float]]:
    """Returns the wall time in seconds, and the resident memory of all processes in KiB for every
    second.

    The memory is measured after the first image is scored.
    """
    command = [
        sys.executable,
        "-m",
        "brewster",
        "evaluate",
        "--quiet",
        "-o",
        out,
        "--workers",
        str(workers),
    ]
    command += [
        "--benchmark",
        f"pairs={OUT / 'pairs'}",
        "--predictions",
        f"other={OUT / 'predictions'}",
    ]
    started = time.perf_counter()
    memory = []
    process = subprocess.Popen([*command, "--pictures", "0"])
    watcher = threading.Thread(target=watch, args=(process, out, memory))
    watcher.start()
    if process.wait():
        sys.exit("brewster evaluate failed; see its error above")
    seconds = time.perf_counter() - started
    watcher.join()
    return seconds, memory


def watch(process: subprocess.Popen, out: Path, memory: list[float]) -> None:
    """Appends the resident memory in KiB every second, from the first score until the process
    ends.
    """
    while process.poll() is None:
        if (out / SCORES_FILE).exists() and (out / SCORES_FILE).stat().st_size:
            memory.append(sum(resident_kib(pid) for pid in process_tree(process.pid)))
        time.sleep(1)


def process_tree(pid: int) -> list[int]:
    """Returns the ids of a process and of all its descendants. The list is empty if the process has
    ended.
    """
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(descendant for child in children for descendant in process_tree(int(child)))]


def resident_kib(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((float(line.split()[1]) for line in lines if line.startswith("VmRSS")), 0.0)


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), *map(int, sys.argv[1:]))
