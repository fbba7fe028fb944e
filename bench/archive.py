"""Separates an archive on two local Ray nodes, also if one of them is killed, and with two processes of the plain command.

    .venv/bin/python bench/archive.py [COUNT [MODEL]]

Prints the wall time and the photos per second of each run, and checks that all runs wrote the same bytes, that the index has
a row for each photo, and how many photos were separated twice because of the killed node. The photos have 480x320 pixels.
"""

from __future__ import annotations

import collections
import hashlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from brewster import Photo

OUT = Path("out/bench/archive")


def main(count: int, model: str) -> None:
    os.environ |= {"OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    shutil.rmtree(OUT, ignore_errors=True)
    manifests = write_photos(count)
    options = ["--quality", "draft", "--model", model, "--quiet", "--json"]
    started = time.perf_counter()
    plain = [start(manifest, "-o", OUT / "plain", *options) for manifest in manifests]
    failed = sum(process.wait() for process in plain)
    report("two processes of the plain command", started, count, failed)
    expected = hashes("plain")
    for name, is_killed in [("cluster", False), ("killed", True)]:
        started = time.perf_counter()
        failed = run_cluster(name, options, count // 3 if is_killed else None)
        label = "two nodes, one killed after a third" if is_killed else "two nodes"
        report(f"{label}, with the start of Ray", started, count, failed)
        check(name, expected, count)


def write_photos(count: int) -> list[Path]:
    """Writes photos, and a manifest with each half of them."""
    random, manifests = np.random.default_rng(7), []
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
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def run_cluster(name: str, options: list[str], kill_after: int | None) -> int:
    """Runs the command on two new nodes with one processor each. Kills one after a number of photos. Returns the exit code."""
    from ray.cluster_utils import Cluster  # noqa: PLC0415

    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = nodes.add_node(num_cpus=1)
    nodes.wait_for_nodes()
    process = start(OUT / "in", "-o", OUT / name / "in", "--cluster", nodes.address, *options)
    while process.poll() is None:
        time.sleep(0.1)
        if kill_after and len(list((OUT / name).rglob("*.reflection.jpg"))) >= kill_after:
            nodes.remove_node(second, allow_graceful=False)
            kill_after = None
            print("killed a node")
    nodes.shutdown()
    return process.returncode


def report(name: str, started: float, count: int, failed: int) -> None:
    seconds = time.perf_counter() - started
    print(f"{name}: {seconds:.1f} s, {count / seconds:.1f} photos/s, exit codes {failed}", flush=True)


def check(name: str, expected: dict[str, str], count: int) -> None:
    """Compares the files and the index of a run with the plain run."""
    from pyarrow import parquet  # noqa: PLC0415

    index = parquet.read_table(OUT / name / "in/index.parquet").to_pylist()
    found = {file: digest for file, digest in hashes(name).items() if not file.endswith(".parquet")}
    assert found == expected, f"{len(found)} files, {len(expected)} expected"
    assert len({row["path"] for row in index}) == len(index) == count
    statuses = collections.Counter(row["status"] for row in index)
    print(
        f"  {len(found)} files with the bytes of the plain run; rows of the index: {dict(statuses)}",
        flush=True,
    )


def hashes(name: str) -> dict[str, str]:
    """Path of a file -> its sha256."""
    return {
        str(path.relative_to(OUT / name)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in (OUT / name).rglob("*")
        if path.is_file()
    }


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400, sys.argv[2] if len(sys.argv) > 2 else "compact")
