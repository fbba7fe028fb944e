"""Runs a complete evaluation: scores every method on every benchmark, and writes results, tables and an HTML report.

benchmarks = read_benchmark("nature20", Path("nature20"))
methods = [IdentityBaseline(), PredictionFolder("RDNet", Path("rdnet"))]
evaluate(benchmarks, methods, EvaluationConfig(), Path("out/evaluate"))
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, final

from brewster.benchmarks.registry import Benchmark, Case
from brewster.errors import BrewsterError, PhotoError
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import BASELINE, Method, MethodOutput, PredictionFolder, check_names
from brewster.evaluate.report.html_report import write_report
from brewster.evaluate.report.images import CaseImages, CaseTiles, method_tiles, photo_tiles, to_tiles
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

RESULTS_FILE, REPORT_FILE, INPUTS_FOLDER = "results.json", "report.html", "inputs"
MAX_REPORT_CASES: Final = 50


def evaluate(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    out: Path,
    *,
    workers: int = 1,
    max_report_cases: int = MAX_REPORT_CASES,
    on_progress: ScoreCallback = lambda _done, _total, _row: None,
) -> Results:
    """Scores and writes results.json, tables.md, table.tex, table.csv and report.html into `out`.

    With `config.size`, the reduced photos are written into `out`/inputs. Each picture is read and decoded once. There are
    two exceptions: exclusive methods, which read the cases again, and the pictures that the report shows of a benchmark
    with more than `max_report_cases` cases or of an earlier run.

    Args:
        benchmarks: as `read_benchmark` returns them.
        methods: in the order of the tables; the baseline belongs first.
        config: the settings of the evaluation.
        out: a folder for this evaluation only. A stopped run is resumed from its files.
        workers: number of processes that score in parallel.
        max_report_cases: number of cases of each benchmark in the report: the worst of the first method that is not the baseline.
        on_progress: called after each new row.

    Returns:
        The content of results.json.

    Raises:
        BrewsterError: no case or no method, shared names, ambiguous predictions, the paper's draw is not possible, or an
            optional dependency is missing.
        TargetError: `out` cannot be written.
    """
    check(benchmarks, methods, config)
    cases = [case for part in benchmarks for case in part.cases]
    with TemporaryDirectory(prefix="brewster-report-") as folder:
        complete = frozenset(part.name for part in benchmarks if len(part.cases) <= max_report_cases)
        tiles = _TileCache(Path(folder), complete, config, out / INPUTS_FOLDER)
        rows = score(
            benchmarks, methods, config, out, workers=workers, on_progress=on_progress, on_case_scored=tiles
        )
        if config.size:
            _write_missing_inputs(cases, config.size, out / INPUTS_FOLDER)
        results = summarise(benchmarks, methods, config, rows)
        for method in methods:
            if remarks := list(_method_remarks(method, cases, rows)):
                results["methods"][method.name]["remark"] = "; ".join(remarks)
        _write(results, out)
        write_report(results, _page_cases(cases, methods, rows, max_report_cases, tiles), out / REPORT_FILE)
    return results


def check(benchmarks: Sequence[Benchmark], methods: Sequence[Method], config: EvaluationConfig) -> None:
    """Checks everything that can be checked before the evaluation starts.

    Raises:
        BrewsterError: see `evaluate`.
    """
    check_names(methods)
    names = [part.name for part in benchmarks]
    for name in names:
        if names.count(name) > 1:
            raise BrewsterError(
                f"{names.count(name)} benchmarks have the name {name!r}",
                "expected unique names",
                "rename one of the folders",
            )
    if not any(part.cases for part in benchmarks):
        refused = [reason for part in benchmarks for reason in part.excluded]
        raise PhotoError(
            f"there is no pair in {', '.join(names) or 'no benchmark'}",
            "expected photos with their ground truth",
            "; ".join(refused[:5]) or "give a folder with pairs",
        )
    if config.paper:
        paper_draws(benchmarks)
    cases = [case for part in benchmarks for case in part.cases]
    for method in methods:
        if isinstance(method, PredictionFolder):
            method.check_pairing(cases)


def _method_remarks(method: Method, cases: Sequence[Case], rows: Sequence[ScoreRow]) -> Iterator[str]:
    """Signs that a prediction folder is not what it should be: copies of the ground truth, or unused pictures."""
    if not isinstance(method, PredictionFolder):
        return
    perfect = [row for row in rows if row.scores.get("psnr") == IDENTICAL_DB]
    trivial = {row.id[:2] for row in perfect if row.method == BASELINE}
    copied = [row for row in perfect if row.method == method.name and row.id[:2] not in trivial]
    if copied:
        yield f"its prediction equals the ground truth on {_pictures(len(copied))}: check the folder"
    if unused := method.count_unmatched(cases):
        yield f"{_pictures(unused)} of its folder {'fits' if unused == 1 else 'fit'} no case"


def _pictures(count: int) -> str:
    return f"{count} {'picture' if count == 1 else 'pictures'}"


def _write_missing_inputs(cases: Sequence[Case], size: int, folder: Path) -> None:
    """The reduced photos of cases that were not decoded in this run. Unreadable photos are skipped: rows report them."""
    for case in cases:
        path = _input_path(folder, case)
        if not path.exists():
            with suppress(PhotoError):
                downscale(Photo.open(case.photo.read()), size).save(path)


def _input_path(folder: Path, case: Case) -> Path:
    return folder / case.benchmark / f"{case.name}.png"


def _write(results: Results, out: Path) -> None:
    tables = {
        RESULTS_FILE: json.dumps(results, indent=1, allow_nan=False) + "\n",
        "tables.md": f"{to_markdown(results)}\n{published_to_markdown(read_published())}",
        "table.tex": to_latex(results),
        "table.csv": to_csv(results),
    }
    for name, text in tables.items():
        write_atomically(out / name, text.encode(errors="backslashreplace"), overwrite=True)


# --- pictures of the report


@final
@dataclass(frozen=True)
class _TileCache:
    """Writes what needs decoded pictures while they are in memory: the report's tiles and the reduced photos.

    Tiles are made for benchmarks of which the report shows every case. They are files, because a worker process makes
    them, and so that memory does not grow with the number of cases.
    """

    folder: Path
    benchmarks: frozenset[str]
    config: EvaluationConfig
    inputs: Path

    def __call__(self, truth: GroundTruth, predictions: Mapping[str, MethodOutput]) -> None:
        """Called once for each case that is decoded for scoring."""
        case = truth.case
        if self.config.size:
            truth.photo.save(_input_path(self.inputs, case), overwrite=True)
        if case.benchmark not in self.benchmarks:
            return
        images = _case_images(truth, predictions, self.config)
        width, height = truth.photo.size
        texts = {BASELINE: photo_tiles(images)}
        texts |= {name: method_tiles(images, name) for name in predictions if name != BASELINE}
        for method, text in texts.items():
            data = json.dumps([width, height, text], ensure_ascii=True).encode()
            self._path(case, method).write_bytes(data)

    def read(self, case: Case, methods: Sequence[str]) -> CaseTiles | None:
        """The tiles of a case with those of the methods; None if one is missing."""
        texts = {}
        width = height = 0
        for method in (BASELINE, *methods):
            path = self._path(case, method)
            if not path.exists():
                return None
            width, height, texts[method] = json.loads(path.read_bytes())
        return CaseTiles(case.benchmark, case.name, (width, height), texts.pop(BASELINE), texts)

    def _path(self, case: Case, method: str) -> Path:
        name = json.dumps([case.benchmark, case.name, method])
        return self.folder / f"{hashlib.sha256(name.encode()).hexdigest()}.json"


def _page_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    rows: Sequence[ScoreRow],
    limit: int,
    tiles: _TileCache,
) -> Iterator[CaseTiles]:
    """The cases of the report, one at a time. Those without cached tiles are read and decoded again."""
    good = {row.id: row for row in rows if not row.error}
    for case in _worst_cases(cases, methods, tiles.config, good, limit):
        scored = {
            method: row
            for method in methods
            if method.name != BASELINE and (row := good.get((case.benchmark, case.name, method.name)))
        }
        cached = tiles.read(case, [method.name for method in scored])
        if cached:
            yield cached
            continue
        try:
            truth = GroundTruth.open(case, tiles.config)
        except PhotoError:
            continue  # the tables name it
        predictions = {method.name: get_prediction(truth, method, row) for method, row in scored.items()}
        yield to_tiles(_case_images(truth, predictions, tiles.config))


def _case_images(
    truth: GroundTruth, predictions: Mapping[str, MethodOutput], config: EvaluationConfig
) -> CaseImages:
    others = {name: output for name, output in predictions.items() if name != BASELINE}
    return CaseImages(
        benchmark=truth.case.benchmark,
        name=truth.case.name,
        photo=truth.images["photo"],
        truth=truth.images["transmission"],
        region=truth.region(config.thresholds[0]),
        predictions={name: output.transmission.srgb_8bit() for name, output in others.items()},
        reflections={
            name: output.reflection.srgb_8bit() for name, output in others.items() if output.reflection
        },
        reflection_truth=truth.images.get("reflection"),
    )


def _worst_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Mapping[RowId, ScoreRow],
    limit: int,
) -> list[Case]:
    """Up to `limit` cases of each benchmark, those first that the first method failed on, then its worst scores.

    The first method is the first that is not the baseline; the scores are those of the first metric.
    """
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
