"""`brewster evaluate` with all metrics on 500 images of 540x400: images per second with one and two workers, and
whether memory stays constant.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/evaluate.py [COUNT]
"""

import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from brewster import Photo
from brewster.evaluate.runner import SCORES_FILE
from brewster.srgb import to_encoded

OUT = Path("out/bench/evaluate")
SIZE = (540, 400)


def main(data: Path, count: int = 500) -> None:
    make_pairs(data, count)
    seconds = {}
    for workers in (1, 2):
        out = OUT / f"workers-{workers}"
        shutil.rmtree(out, ignore_errors=True)
        seconds[workers], memory = measure(out, workers)
        first, last = (
            max(some) / 2**20 for some in (memory[: len(memory) // 4], memory[-len(memory) // 4 :])
        )
        rate = count / seconds[workers]
        print(
            f"{workers} workers: {rate:.2f} images per second, all metrics, the unprocessed input and one folder"
        )
        print(f"  memory of all processes: {first:.2f} GiB in the first quarter, {last:.2f} GiB in the last")
    print(f"two workers are {seconds[1] / seconds[2]:.2f} times as fast as one")
    same = (OUT / "workers-1/results.json").read_bytes() == (OUT / "workers-2/results.json").read_bytes()
    print(f"their results.json files are {'equal' if same else 'NOT EQUAL'}")


def make_pairs(data: Path, count: int) -> None:
    """Writes triplets and the outputs of another method, mixed from photos."""
    photos = sorted((data / "photos/permissive").glob("*.jpg"))
    rng = np.random.default_rng(7)
    for i in range(count):
        if (OUT / "theirs" / f"{i}.png").exists():
            continue
        behind, mirrored = (Photo.open(photos[(i + step) % len(photos)]).resized(*SIZE) for step in (0, 17))
        reflection = 0.3 * rng.uniform() * mirrored
        layers = {
            "blended": 0.9 * behind + reflection,
            "transmission": behind,
            "reflection": reflection,
            "../theirs": 0.95 * behind + 0.3 * reflection,
        }
        for role, light in layers.items():
            pixels = np.rint(255 * to_encoded(np.clip(light, 0, 1))).astype(np.uint8)
            Photo.from_array(pixels, encoding="srgb").save(OUT / "pairs" / role / f"{i}.png", overwrite=True)


def measure(out: Path, workers: int) -> tuple[float, list[float]]:
    """Wall time, and the resident memory of all processes in KiB, every second after the first image is scored."""
    command = [sys.executable, "-m", "brewster", "evaluate", "--quiet", "-o", out, "--workers", str(workers)]
    command += ["--benchmark", f"pairs={OUT / 'pairs'}", "--predictions", f"theirs={OUT / 'theirs'}"]
    started, memory = time.perf_counter(), []
    process = subprocess.Popen([*command, "--pictures", "0"])
    watcher = threading.Thread(target=watch, args=(process, out, memory))
    watcher.start()
    if process.wait():
        sys.exit("brewster evaluate failed; see its error above")
    taken = time.perf_counter() - started
    watcher.join()
    return taken, memory


def watch(process: subprocess.Popen, out: Path, memory: list[float]) -> None:
    while process.poll() is None:
        if (out / SCORES_FILE).exists() and (out / SCORES_FILE).stat().st_size:
            memory.append(sum(resident_kib(pid) for pid in process_tree(process.pid)))
        time.sleep(1)


def process_tree(pid: int) -> list[int]:
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
