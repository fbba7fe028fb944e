"""Scores the shipped models on the full-size development pairs, with two baselines: the unprocessed
input, and fast-reflection-removal 1.1 (Yang et al. 2019), which runs in a separate environment.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/quality.py

The scores are computed by the code of `brewster evaluate`. out/bench/quality/report.html shows
every image.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from brewster import Photo
from brewster.evaluation.benchmarks.image_files import Case
from brewster.evaluation.benchmarks.registry import read_benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.evaluation import evaluate
from brewster.evaluation.methods import IdentityBaseline, ModelMethod, PredictionFolder
from brewster.evaluation.report.tables import tables_to_markdown
from brewster.evaluation.runner import SCORES_FILE
from brewster.separation.models.zoo import MODELS

OUT = Path("out/bench/quality")
FRR_WORKER = Path(__file__).parent / "frr_worker.py"
FRR_ENVIRONMENT = Path("out/bench/frr-venv")
FRR_PACKAGES = ["fast-reflection-removal==1.1", "numpy<2", "scipy", "matplotlib"]


def main(data: Path) -> None:
    folders = {"nature20": data / "real/dev/nature", "real20": data / "real/dev/real"}
    parts = [part for name, folder in folders.items() for part in read_benchmark(name, folder)]
    cases = [case for part in parts for case in part.cases]
    frr_seconds = run_frr(cases)
    models = [ModelMethod(name, name, OUT / "predictions" / name, device="cpu") for name in MODELS]
    (OUT / SCORES_FILE).unlink(
        missing_ok=True
    )  # stored scores are not computed again, so their times are not measured
    timed = {}
    results = evaluate(
        parts,
        [IdentityBaseline(), *models, PredictionFolder("fast-reflection-removal", OUT / "frr")],
        EvaluationConfig(),
        OUT,
        on_progress=lambda _done, _total, row: timed.setdefault(row.method, []).append(row),
    )
    print(tables_to_markdown(results))
    for model in models:
        megapixels = sum(row.width * row.height for row in timed[model.name]) / 1e6
        model_seconds = sum(row.seconds for row in timed[model.name])
        print(
            f"{model.name}: {model_seconds / megapixels:.2f} s per megapixel on these small images"
        )
    print(f"fast-reflection-removal: {frr_seconds:.2f} s per megapixel")


def run_frr(cases: list[Case]) -> float:
    """Writes the predictions of fast-reflection-removal at its recommended h = 0.11. Returns
    seconds per megapixel.
    """
    python = FRR_ENVIRONMENT / "bin/python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", FRR_ENVIRONMENT], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *FRR_PACKAGES], check=True)
    worker = subprocess.Popen(
        [python, FRR_WORKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    exchange = OUT / "frr.npy"
    exchange.parent.mkdir(parents=True, exist_ok=True)

    def separate(case: Case) -> np.ndarray:
        np.save(exchange, Photo.open(case.photo.read()).srgb_8bit())
        print(exchange, file=worker.stdin, flush=True)
        if worker.stdout.readline() != "done\n":
            sys.exit(
                "fast-reflection-removal failed; expected the line 'done'; see its error above"
            )
        return np.load(exchange)

    separate(cases[0])  # the first call includes its imports
    started = time.perf_counter()
    megapixels = 0.0
    for case in cases:
        transmission = Photo.from_array(separate(case), encoding="srgb")
        transmission.save(OUT / "frr" / case.benchmark / f"{case.name}.png", overwrite=True)
        megapixels += transmission.size[0] * transmission.size[1] / 1e6
    return (time.perf_counter() - started) / megapixels


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]))
