"""The shipped model on the development pairs, full pictures, beside the unprocessed input and beside fast-reflection-removal
1.1 (Yang et al. 2019), which runs in an environment of its own.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/quality.py

`brewster evaluate` does the measuring; out/bench/quality/report.html shows every picture.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from brewster import Photo
from brewster.benchmarks.registry import Case, read_benchmark
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.evaluation import evaluate
from brewster.evaluate.methods import IdentityBaseline, ModelMethod, PredictionFolder
from brewster.evaluate.report.tables import overview
from brewster.evaluate.runner import SCORES
from brewster.models.zoo import MODELS

OUT = Path("out/bench/quality")
PEER = Path(__file__).parent / "peer.py"
PEER_ENVIRONMENT = Path("out/bench/peer-venv")
PEER_PACKAGES = ["fast-reflection-removal==1.1", "numpy<2", "scipy", "matplotlib"]


def main(data: Path) -> None:
    folders = {"nature20": data / "real/dev/nature", "real20": data / "real/dev/real"}
    parts = [part for name, folder in folders.items() for part in read_benchmark(name, folder)]
    cases = [case for part in parts for case in part.cases]
    seconds = run_peer(cases)
    models = [ModelMethod(name, name, OUT / "predictions" / name, device="cpu") for name in MODELS]
    (OUT / SCORES).unlink(missing_ok=True)  # times are measured anew
    timed = {}
    results = evaluate(
        parts,
        [IdentityBaseline(), *models, PredictionFolder("fast-reflection-removal", OUT / "peer")],
        EvaluationConfig(),
        OUT,
        on_progress=lambda _done, _of, row: timed.setdefault(row.method, []).append(row),
    )
    print(overview(results))
    for model in models:
        megapixels = sum(row.width * row.height for row in timed[model.name]) / 1e6
        taken = sum(row.seconds for row in timed[model.name])
        print(f"{model.name}: {taken / megapixels:.2f} s a megapixel on these small pictures")
    print(f"fast-reflection-removal: {seconds:.2f} s a megapixel")


def run_peer(cases: list[Case]) -> float:
    """Leaves the peer's outputs, at its recommended h = 0.11, as predictions; its seconds a megapixel."""
    python = PEER_ENVIRONMENT / "bin/python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", PEER_ENVIRONMENT], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PEER_PACKAGES], check=True)
    worker = subprocess.Popen([python, PEER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    exchange = OUT / "peer.npy"
    exchange.parent.mkdir(parents=True, exist_ok=True)

    def ask(case: Case) -> np.ndarray:
        np.save(exchange, Photo.open(case.photo.read()).srgb_8bit())
        print(exchange, file=worker.stdin, flush=True)
        if worker.stdout.readline() != "done\n":
            sys.exit("the peer failed: see its error above")
        return np.load(exchange)

    ask(cases[0])  # imports are not part of its time
    started, megapixels = time.perf_counter(), 0.0
    for case in cases:
        answer = Photo.from_array(ask(case), encoding="srgb")
        answer.save(OUT / "peer" / case.benchmark / f"{case.name}.png", overwrite=True)
        megapixels += answer.size[0] * answer.size[1] / 1e6
    return (time.perf_counter() - started) / megapixels


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
