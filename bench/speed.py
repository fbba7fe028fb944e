"""Measures time and memory of the command line for a 12-megapixel JPEG, and its start-up time.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/speed.py

Prints wall time and peak memory of the process at quality `standard`, and the time of each stage,
as `--json` reports it. For comparison, the same file is decoded and encoded twice without
separation. If this takes long, the machine is busy.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from brewster import Photo

OUT = Path("out/bench")
SIZE_PX = (4000, 3000)
COPY_PROGRAM = """
import sys
from brewster import Photo
for name in ("one", "two"):
    Photo.open(sys.argv[1]).save(f"{sys.argv[2]}/{name}.jpg", overwrite=True)
"""


def main(data: Path) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    photo = make_large_photo(data)
    brewster = [sys.executable, "-m", "brewster"]
    copy_wall, _, _ = measure([sys.executable, "-c", COPY_PROGRAM, str(photo), str(OUT)])
    wall, peak, line = measure(
        [*brewster, str(photo), "-o", str(OUT), "--json", "--overwrite", "--device", "cpu"]
    )
    seconds = json.loads(line)["seconds"]
    stages = ", ".join(
        f"{name} {value:.2f} s ({value / wall:.0%})" for name, value in seconds.items()
    )
    print(f"12 megapixels: {wall:.2f} s, {peak / 2**20:.2f} GiB; {stages}")
    print(f"  only decoded and encoded twice: {copy_wall:.2f} s; ratio {wall / copy_wall:.1f}")
    help_times = sorted(measure([*brewster, "--help"])[0] for _ in range(5))
    python_times = sorted(measure([sys.executable, "-c", "pass"])[0] for _ in range(5))
    print(
        f"brewster --help: {help_times[2]:.2f} s (median of 5); python alone "
        f"{python_times[2]:.2f} s"
    )


def make_large_photo(data: Path) -> Path:
    """Writes a photo enlarged to 4000x3000. With the added noise, encoding takes as long as for a
    photo of a camera.
    """
    small = Photo.open(data / "photos/permissive/kodak24__05.jpg").pixels.astype(np.float32)
    rows, columns = (
        np.arange(side) * small.shape[axis] // side
        for axis, side in ((0, SIZE_PX[1]), (1, SIZE_PX[0]))
    )
    grain = np.random.default_rng(7).normal(0, 3, (SIZE_PX[1], SIZE_PX[0], 1))
    pixels = np.clip(small[rows][:, columns] + grain, 0, 255).astype(np.uint8)
    path = OUT / "twelve.jpg"
    Photo.from_array(pixels, encoding="srgb").save(path, overwrite=True)
    return path


def measure(command: list[str]) -> tuple[float, int, str]:
    """Runs a command. Returns the wall time in seconds, the peak memory in KiB, and the standard
    output.
    """
    peak = Path("/proc/self/clear_refs")
    if peak.exists():  # a process inherits the peak memory of its parent on Linux; "5" resets it
        peak.write_text("5")
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    output = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{' '.join(command)} failed")
    return time.perf_counter() - started, usage.ru_maxrss, output


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
