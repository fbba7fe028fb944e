"""Measures `brewster serve` with 8 clients and 50 photos (or COUNT), compared with the command line
on the same photos.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/serve.py [COUNT]

Each photo is sent twice. The script prints the ratio of the throughputs, and the memory of the
server at the start, in the middle and at the end. The bytes of every response must be equal to
those of the file that the command line writes for the same photo.
"""

import json
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from threading import Thread

PHOTOS = int(sys.argv[1]) if len(sys.argv) > 1 else 50
CLIENTS = 8
OPTIONS = {"layers": "transmission", "quality": "draft"}
BREWSTER = [sys.executable, "-m", "brewster"]


def main(data: Path) -> None:
    photos = sorted((data / "photos/permissive").glob("*.jpg"))[:PHOTOS]
    with tempfile.TemporaryDirectory() as folder:
        from_command, seconds = separate_by_command(photos, Path(folder))
    with RunningServer() as (url, process):
        post(url, photos[0])  # loads the model before the measurement starts
        memory = [resident_mb(process)]
        served = []
        for _ in range(2):
            started = time.perf_counter()
            results = separate_by_clients(url, photos)
            served.append(time.perf_counter() - started)
            memory.append(resident_mb(process))
            check_results(results, from_command)
    print(f"{PHOTOS} photos by {CLIENTS} clients, twice: {2 * PHOTOS / sum(served):.2f} per second")
    ratio = 2 * seconds / sum(served)
    print(
        f"  the command line on the same photos: {PHOTOS / seconds:.2f} per second; ratio "
        f"{ratio:.2f}"
    )
    print(f"  server's memory after 1, {PHOTOS + 1} and {2 * PHOTOS + 1} photos: ", end="")
    print(", ".join(f"{amount:.0f} MB" for amount in memory))
    print("  no result is missing, and all are equal to the files of the command line")


def check_results(results: dict[str, bytes], expected: dict[str, bytes]) -> None:
    """Exits with an error if a result is missing or differs from that of the command line."""
    wrong = [name for name, data in expected.items() if results.get(name) != data]
    if wrong or len(expected) != PHOTOS:
        sys.exit(
            f"of {len(expected)} results, these are missing or wrong: "
            f"{', '.join(wrong) or 'none'}; expected {PHOTOS}"
        )


def separate_by_command(photos: list[Path], folder: Path) -> tuple[dict[str, bytes], float]:
    """Returns the files that one run of the command writes, by photo, and the wall time of the run
    in seconds.
    """
    options = [part for name, value in OPTIONS.items() for part in (f"--{name}", value)]
    started = time.perf_counter()
    command = [
        *BREWSTER,
        *map(str, photos),
        "-o",
        str(folder),
        *options,
        "--json",
        "--device",
        "cpu",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds = time.perf_counter() - started
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    written = {
        Path(row["source"]).name: Path(row["outputs"]["transmission"]).read_bytes() for row in rows
    }
    return written, seconds


class RunningServer:
    """A context manager that runs `brewster serve`; `with` binds the URL and the process of the
    server.
    """

    def __enter__(self) -> tuple[str, subprocess.Popen]:
        command = [*BREWSTER, "serve", "--port", "0", "--device", "cpu"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        return self.process.stdout.readline().strip(), self.process

    def __exit__(self, *_: object) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait()
        self.process.stdout.close()


def separate_by_clients(url: str, photos: list[Path]) -> dict[str, bytes]:
    """Separates all photos. Each client sends its next photo when it has the response to the
    previous one.
    """
    pending = queue.SimpleQueue()
    results = {}
    for photo in photos:
        pending.put(photo)

    def client() -> None:
        while True:
            try:
                photo = pending.get_nowait()
            except queue.Empty:
                return
            results[photo.name] = post(url, photo)

    threads = [Thread(target=client) for _ in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def post(url: str, photo: Path) -> bytes:
    """Sends a photo as form data. Returns the body of the response."""
    fields = [
        f'--x\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{value}\r\n'
        for name, value in OPTIONS.items()
    ]
    head = f'--x\r\nContent-Disposition: form-data; name="photo"; filename="{photo.name}"\r\n\r\n'
    body = "".join([*fields, head]).encode() + photo.read_bytes() + b"\r\n--x--\r\n"
    request = urllib.request.Request(
        f"{url}separate", body, {"Content-Type": "multipart/form-data; boundary=x"}
    )
    with urllib.request.urlopen(request) as response:
        return response.read()


def resident_mb(process: subprocess.Popen) -> float:
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
