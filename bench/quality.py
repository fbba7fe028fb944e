"""PSNR and SSIM on the development pairs, full pictures, every model beside doing nothing and beside
fast-reflection-removal 1.1 (Yang et al. 2019), which runs in an environment of its own.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/quality.py

Metrics on 8-bit sRGB at the truth's size, as stated in brewster.metrics. Writes out/bench/*.png to look at.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brewster import Photo, Separator
from brewster.light import to_encoded
from brewster.metrics import psnr, ssim
from brewster.models.zoo import MODELS

OUT = Path("out/bench")
PEER = Path(__file__).parent / "peer.py"
PEER_ENVIRONMENT = Path("out/bench/peer-venv")
PEER_PACKAGES = ["fast-reflection-removal==1.1", "numpy<2", "scipy", "matplotlib"]


@dataclass(frozen=True)
class Pair:
    folder: str
    photo: Path
    truth: Path


Method = Callable[[Pair], np.ndarray]


def main(data: Path) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    pairs = find_pairs(data)
    methods: dict[str, Method] = {"doing nothing": lambda pair: pixels(pair.photo)}
    methods |= {name: model(name) for name in MODELS}
    methods["fast-reflection-removal"] = peer(pairs)
    answers = {name: run(method, pairs) for name, method in methods.items()}
    print(f"\n{'method':26}{'folder':8}  PSNR   gain  SSIM    gain   worse  s/MP")
    for name, (pictures, seconds) in answers.items():
        table(name, pairs, pictures, seconds, answers["doing nothing"][0])
    sheets(pairs, answers["doing nothing"][0], answers["compact"][0])


def find_pairs(data: Path) -> list[Pair]:
    pairs = []
    for folder in ("nature", "real"):
        for photo in sorted((data / "real/dev" / folder / "blended").iterdir()):
            (truth,) = (data / "real/dev" / folder).glob(f"transmission*/{photo.stem}.*")
            pairs.append(Pair(folder, photo, truth))
    return pairs


def pixels(path: Path) -> np.ndarray:
    return Photo.open(path).pixels


def model(name: str) -> Method:
    separator = Separator.load(name, device="cpu")
    return lambda pair: separator(pair.photo).transmission.pixels


def peer(pairs: list[Pair]) -> Method:
    """The peer's outputs, made by its own code in its own environment, its recommended h = 0.11."""
    python = PEER_ENVIRONMENT / "bin/python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", PEER_ENVIRONMENT], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PEER_PACKAGES], check=True)
    worker = subprocess.Popen([python, PEER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(pair: Pair) -> np.ndarray:
        target = OUT / "peer.npy"
        np.save(target, pixels(pair.photo))
        print(target, file=worker.stdin, flush=True)
        if worker.stdout.readline() != "done\n":
            sys.exit("the peer failed: see its error above")
        return np.load(target)

    ask(pairs[0])  # imports are not part of its time
    return ask


def run(method: Method, pairs: list[Pair]) -> tuple[list[np.ndarray], float]:
    """Every answer, and the mean seconds per megapixel."""
    method(pairs[0])
    pictures, seconds, megapixels = [], 0.0, 0.0
    for pair in pairs:
        started = time.perf_counter()
        pictures.append(method(pair))
        seconds += time.perf_counter() - started
        megapixels += pictures[-1].shape[0] * pictures[-1].shape[1] / 1e6
    return pictures, seconds / megapixels


def table(name: str, pairs: list[Pair], pictures: list, seconds: float, inputs: list) -> None:
    for folder in ("nature", "real"):
        scores = np.array([
            [psnr(picture, truth), psnr(given, truth), ssim(picture, truth), ssim(given, truth)]
            for pair, picture, given in zip(pairs, pictures, inputs, strict=True)
            if pair.folder == folder
            for truth in [pixels(pair.truth)]
        ])  # fmt: skip
        worse = int((scores[:, 0] < scores[:, 1]).sum())
        p, p0, s, s0 = scores.mean(axis=0)
        print(
            f"{name:26}{folder:8} {p:6.2f} {p - p0:+6.2f}  {s:.4f} {s - s0:+.4f} {worse:3}/{len(scores)}  {seconds:.2f}"
        )
        if os.environ.get("BENCH_PICTURES"):
            names = [pair.photo.name for pair in pairs if pair.folder == folder]
            for row, picture in zip(scores, names, strict=True):
                print(
                    f"    {picture:14} {row[1]:6.2f} {row[0] - row[1]:+6.2f} dB   SSIM {row[3]:.4f} {row[2] - row[3]:+.4f}"
                )


def sheets(pairs: list[Pair], inputs: list, answers: list) -> None:
    """One sheet a folder: photo, transmission and truth in each cell."""
    for folder in ("nature", "real"):
        cells = [
            np.concatenate([fit(picture) for picture in (given, answer, pixels(pair.truth))], axis=1)
            for pair, given, answer in zip(pairs, inputs, answers, strict=True)
            if pair.folder == folder
        ]
        rows = [np.concatenate(cells[i : i + 2], axis=1) for i in range(0, len(cells), 2)]
        sheet = OUT / f"dev-{folder}.png"
        Photo.from_array(np.concatenate(rows), encoding="srgb").save(sheet, overwrite=True)
        print(f"photo | transmission | truth: {sheet}")


def fit(picture: np.ndarray) -> np.ndarray:
    small = Photo.from_array(picture, encoding="srgb").small(300, 200)
    return np.rint(to_encoded(np.clip(small, 0, 1)) * 255).astype(np.uint8)


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
