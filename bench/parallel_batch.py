"""Separates many photos with two processes, on two local Ray nodes, and on two nodes of which one
is killed.

    .venv/bin/python bench/parallel_batch.py [COUNT [MODEL]]

The script prints the wall time, the photos per second and the CPU-seconds of all processes of each
run. On a busy machine, compare the CPU-seconds. It checks that all runs wrote the same bytes, and
that there is a result for each photo. The photos have 480x320 pixels.
"""

from __future__ import annotations

import collections
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil

from brewster import Photo

OUT = Path("out/bench/archive")
RESULTS = "results.jsonl"


def main(count: int, model: str) -> None:
    os.environ |= {"OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    shutil.rmtree(OUT, ignore_errors=True)
    manifests = write_photos(count)
    options = ["--quality", "draft", "--model", model, "--quiet", "--json"]
    meter = Meter()
    plain = [start(manifest, "-o", OUT / "plain", *options) for manifest in manifests]
    while any(process.poll() is None for process in plain):
        meter.poll()
    meter.report(
        "two processes of the plain command", count, [process.returncode for process in plain]
    )
    expected = hashes("plain")
    for name, is_killed in [("cluster", False), ("killed", True)]:
        meter = Meter()
        code = run_cluster(name, options, count // 3 if is_killed else None, meter)
        label = "two nodes, one killed after a third" if is_killed else "two nodes"
        meter.report(f"{label}, with the start of Ray", count, [code])
        check(name, expected, count)


def write_photos(count: int) -> list[Path]:
    """Writes photos, and a manifest with each half of them."""
    random = np.random.default_rng(7)
    manifests = []
    (OUT / "in").mkdir(parents=True)
    for number in range(count):
        blocks = random.integers(0, 256, (20, 30, 3), np.uint8)
        photo = Photo.from_array(np.kron(blocks, np.ones((16, 16, 1), np.uint8)), encoding="srgb")
        photo.save(OUT / f"in/{number:06d}.jpg")
    for half in range(2):
        manifests.append(OUT / f"half-{half}.csv")
        manifests[-1].write_text(
            "\n".join(["path", *(f"in/{number:06d}.jpg" for number in range(half, count, 2))])
        )
    return manifests


def start(*arguments: object) -> subprocess.Popen[bytes]:
    """Starts `brewster separate`."""
    command = [sys.executable, "-m", "brewster", "separate", *map(str, arguments)]
    with (OUT / RESULTS).open("wb") as results:
        return subprocess.Popen(command, stdout=results)


def run_cluster(name: str, options: list[str], kill_after: int | None, meter: Meter) -> int:
    """Runs the command on two new nodes with one processor each. Returns the exit code.

    If `kill_after` is set, one node is killed after this number of photos.
    """
    from ray.cluster_utils import Cluster  # noqa: PLC0415

    nodes = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    second = nodes.add_node(num_cpus=1)
    nodes.wait_for_nodes()
    process = start(OUT / "in", "-o", OUT / name / "in", "--cluster", nodes.address, *options)
    while process.poll() is None:
        meter.poll()
        if kill_after and len(list((OUT / name).rglob("*.reflection.jpg"))) >= kill_after:
            nodes.remove_node(second, allow_graceful=False)
            kill_after = None
            print("killed a node")
    nodes.shutdown()
    return process.returncode


class Meter:
    """Measures the wall time since its creation, and the CPU time of the child processes at the
    last `poll`.
    """

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._cpu_seconds = dict[int, float]()

    def poll(self) -> None:
        """Waits a moment, and reads the CPU times."""
        time.sleep(0.3)
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):  # the process has just ended
                times = child.cpu_times()
                self._cpu_seconds[child.pid] = times.user + times.system

    def report(self, name: str, count: int, codes: list[int]) -> None:
        """Prints the result."""
        seconds = time.perf_counter() - self._started
        cpu = sum(self._cpu_seconds.values())
        rate = f"{count / seconds:.2f} photos/s, {cpu:.0f} CPU-s"
        print(f"{name}: {seconds:.0f} s, {rate}, exit codes {codes}", flush=True)


def check(name: str, expected: dict[str, str], count: int) -> None:
    """Compares the files and the results of a run with the plain run."""
    results = [json.loads(line) for line in (OUT / RESULTS).read_text().splitlines()]
    found = hashes(name)
    assert found == expected, f"{len(found)} files, {len(expected)} expected"
    assert len({row["source"] for row in results}) == len(results) == count
    statuses = collections.Counter(row["status"] for row in results)
    print(
        f"  {len(found)} files with the bytes of the plain run; results: {dict(statuses)}",
        flush=True,
    )


def hashes(name: str) -> dict[str, str]:
    """Returns the sha256 of each file of a run by its path."""
    return {
        str(path.relative_to(OUT / name)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in (OUT / name).rglob("*")
        if path.is_file()
        and not path.name.startswith(".")  # a killed worker may leave a partial file
    }


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 400,
        sys.argv[2] if len(sys.argv) > 2 else "compact",
    )
