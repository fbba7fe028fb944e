"""A whole evaluation: score every method on every benchmark, and write results, tables and a page.

benchmarks = read_benchmark("nature20", Path("nature20"))
evaluate(benchmarks, [Nothing(), Predictions("RDNet", Path("rdnet"))], Protocol(), Path("out/evaluate"))
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from brewster.benchmarks.registry import Benchmark, Case
from brewster.errors import BrewsterError, PhotoError
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import BASELINE, Method, MethodOutput, PredictionFolder, check_names
from brewster.evaluate.report.html_report import CaseImages, write_report
from brewster.evaluate.report.latex import to_latex
from brewster.evaluate.report.published import read_published
from brewster.evaluate.report.published import to_markdown as published_to_markdown
from brewster.evaluate.report.tables import to_csv, to_markdown
from brewster.evaluate.results import Results, paper_draws, summarise
from brewster.evaluate.runner import RowId, ScoreCallback, ScoreRow, get_prediction, score
from brewster.evaluate.scoring import GroundTruth, downscale
from brewster.files import write_atomically
from brewster.metrics import IDENTICAL_DB
from brewster.photo import Photo

RESULTS, PAGE, INPUTS = "results.json", "report.html", "inputs"
PICTURES_SHOWN: Final = 50


def evaluate(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    out: Path,
    *,
    workers: int = 1,
    shown: int = PICTURES_SHOWN,
    on_progress: ScoreCallback = lambda _done, _of, _row: None,
) -> Results:
    """Scores and writes results.json, tables.md, table.tex, table.csv and report.html into `out`.

    Where the protocol reduces photos, they are in `out`/inputs as methods see them.

    Args:
        benchmarks: as `read_benchmark` gives them.
        methods: in the order of the tables; "input (unprocessed)" belongs first.
        protocol: the choices of the run.
        out: a folder of this evaluation's own; a run that was stopped goes on from what lies there.
        workers: processes that score at once.
        shown: how many pictures of each benchmark the page shows, the worst of the first method that does something.
        report: called after every answer.

    Raises:
        BrewsterError: there is nothing to compare, names are shared, predictions could be paired wrongly, the paper's
            draw is impossible, or a part of brewster is missing.
        TargetError: `out` cannot be written.
    """
    check(benchmarks, methods, config)
    cases = [case for part in benchmarks for case in part.cases]
    if config.size:
        _write_inputs(cases, config.size, out / INPUTS)
    rows = score(benchmarks, methods, config, out, workers=workers, on_progress=on_progress)
    results = summarise(benchmarks, methods, config, rows)
    for method in methods:
        if remarks := list(_method_remarks(method, cases, rows)):
            results["methods"][method.name]["remark"] = "; ".join(remarks)
    _write(results, out)
    write_report(results, _page_cases(cases, methods, config, rows, shown), out / PAGE)
    return results


def check(benchmarks: Sequence[Benchmark], methods: Sequence[Method], config: EvaluationConfig) -> None:
    """Refuses what cannot be measured as asked, before anything is.

    Raises:
        BrewsterError: see `evaluate`.
    """
    check_names(methods)
    names = [part.name for part in benchmarks]
    for name in names:
        if names.count(name) > 1:
            raise BrewsterError(
                f"{names.count(name)} benchmarks are called {name!r}",
                "each once",
                "rename one of the folders",
            )
    if not any(part.cases for part in benchmarks):
        refused = [reason for part in benchmarks for reason in part.refused]
        raise PhotoError(
            f"there is no pair in {', '.join(names) or 'no benchmark'}",
            "a photo and its truth",
            "; ".join(refused[:5]) or "name a folder that has some",
        )
    if config.paper:
        paper_draws(benchmarks)
    cases = [case for part in benchmarks for case in part.cases]
    for method in methods:
        if isinstance(method, PredictionFolder):
            method.check_pairing(cases)


def _method_remarks(method: Method, cases: Sequence[Case], rows: Sequence[ScoreRow]) -> Iterator[str]:
    """What is odd about a method's answers."""
    if not isinstance(method, PredictionFolder):
        return
    perfect = [row for row in rows if row.scores.get("psnr") == IDENTICAL_DB]
    trivial = {row.id[:2] for row in perfect if row.method == BASELINE}
    copied = [row for row in perfect if row.method == method.name and row.id[:2] not in trivial]
    if copied:
        yield f"its answer is the truth itself on {_pictures(len(copied))}: are these its own?"
    if unused := method.unused(cases):
        yield f"no case is answered by {_pictures(unused)} of its folder"


def _pictures(count: int) -> str:
    return f"{count} {'picture' if count == 1 else 'pictures'}"


def _write_inputs(cases: Sequence[Case], size: int, folder: Path) -> None:
    """The photos as methods see them, for those that answer elsewhere; what cannot be read is told when it is scored."""
    for case in cases:
        with suppress(PhotoError):
            photo = downscale(Photo.open(case.photo.read()), size)
            photo.save(folder / case.benchmark / f"{case.name}.png", overwrite=True)


def _write(results: Results, out: Path) -> None:
    tables = {
        RESULTS: json.dumps(results, indent=1, allow_nan=False) + "\n",
        "tables.md": f"{to_markdown(results)}\n{published_to_markdown(read_published())}",
        "table.tex": to_latex(results),
        "table.csv": to_csv(results),
    }
    for name, text in tables.items():
        write_atomically(out / name, text.encode(errors="backslashreplace"), overwrite=True)


# --- what the page shows


def _page_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Sequence[ScoreRow],
    limit: int,
) -> Iterator[CaseImages]:
    """The pictures, read again one case at a time."""
    good = {row.id: row for row in rows if not row.error}
    for case in _worst_cases(cases, methods, config, good, limit):
        try:
            truth = GroundTruth.open(case, config)
        except PhotoError:
            continue  # named in the tables already
        predictions = {
            method.name: get_prediction(truth, method, row)
            for method in methods
            if method.name != BASELINE and (row := good.get((case.benchmark, case.name, method.name)))
        }
        yield _case_images(truth, predictions, config)


def _case_images(
    truth: GroundTruth, predictions: dict[str, MethodOutput], config: EvaluationConfig
) -> CaseImages:
    return CaseImages(
        benchmark=truth.case.benchmark,
        name=truth.case.name,
        photo=truth.pictures["photo"],
        truth=truth.pictures["transmission"],
        region=truth.region(config.thresholds[0]),
        predictions={name: prediction.transmission.srgb_8bit() for name, prediction in predictions.items()},
        reflections={
            name: prediction.reflection.srgb_8bit()
            for name, prediction in predictions.items()
            if prediction.reflection
        },
        reflection_truth=truth.pictures.get("reflection"),
    )


def _worst_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Mapping[RowId, ScoreRow],
    limit: int,
) -> list[Case]:
    """So many cases of each benchmark: what the first method that does something failed on, then its worst in the first metric."""
    method = next((method.name for method in methods if method.name != BASELINE), BASELINE)
    column, metric = next(iter(config.columns().items()))

    def merit(case: Case) -> float:
        row = rows.get((case.benchmark, case.name, method))
        if row is None:
            is_readable = any((case.benchmark, case.name, other.name) in rows for other in methods)
            return -math.inf if is_readable else math.inf
        score = row.scores.get(column)
        return math.inf if score is None else score if metric.higher_is_better else -score

    chosen = []
    for name in dict.fromkeys(case.benchmark for case in cases):
        chosen += sorted((case for case in cases if case.benchmark == name), key=merit)[:limit]
    return chosen
