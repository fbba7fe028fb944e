"""Runs an evaluation: scores every method on every benchmark, and writes results, tables and an
HTML report.
"""

import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, final
from urllib.parse import quote

from brewster.base.files import write_atomically
from brewster.errors import BrewsterError, PhotoError, counted
from brewster.evaluation.benchmarks.image_files import Case
from brewster.evaluation.benchmarks.pairing import join_names
from brewster.evaluation.benchmarks.registry import Benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import BASELINE, Method, PredictionFolder, check_names
from brewster.evaluation.report.html_report import write_report
from brewster.evaluation.report.images import CaseThumbnails, to_thumbnails
from brewster.evaluation.report.tables import scores_to_csv, to_latex, to_markdown
from brewster.evaluation.results import Results, paper_subsets, summarise
from brewster.evaluation.runner import (
    RowId,
    ScoreCallback,
    ScoreRow,
    get_prediction,
    input_path,
    score,
)
from brewster.evaluation.scoring import GroundTruth, resize
from brewster.metrics import IDENTICAL_DB
from brewster.photo import Photo

_BROWSER_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp", ".avif", ".gif", ".bmp")
RESULTS_FILE = "results.json"
REPORT_FILE = "report.html"
SCORES_TABLE_FILE: Final = "scores.csv"
PICTURES_FOLDER: Final = "pictures"
"""The folder of full-size copies for the report, of images that a browser cannot open in the user's
own folders.
"""
MAX_REPORT_CASES: Final = 50
"""The default maximum of cases per benchmark in the report."""


def evaluate(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    out: Path,
    *,
    workers: int = 1,
    max_report_cases: int = MAX_REPORT_CASES,
    intervals: bool = False,
    on_progress: ScoreCallback = lambda _done, _total, _row: None,
) -> Results:
    """Scores the methods. Writes results.json, scores.csv, tables.md, table.tex and report.html
    into `out`, and the photos into `out`/inputs if they are resized. Returns the content of
    results.json.

    A metric whose weights are missing is left out, and "unavailable" in the results says why; the
    next run adds it. A stopped run is resumed from the files in `out`, a folder for this evaluation
    only.

    `methods` are in the order of the tables; the first one should be the baseline. The report has
    at most `max_report_cases` cases of each benchmark: those with the worst scores of the first
    other method. With `intervals`, table.tex has the confidence intervals. Raises BrewsterError as
    `check`, and OutputError.
    """
    check(benchmarks, methods, config)
    cases = [case for benchmark in benchmarks for case in benchmark.cases]
    rows, unavailable = score(
        benchmarks, methods, config, out, workers=workers, on_progress=on_progress
    )
    if config.resizes:
        for case in cases:  # that this run did not decode
            if not (path := input_path(out, case)).exists():
                with suppress(PhotoError):  # an unreadable photo has a row with the error
                    resize(Photo.open(case.photo.read()), config).save(path)
    results = summarise(benchmarks, methods, config, rows, unavailable)
    for method in methods:
        if remarks := list(_method_remarks(method, cases, rows)):
            results["methods"][method.name]["remark"] = "; ".join(remarks)
    tables = {
        RESULTS_FILE: json.dumps(results, indent=1, allow_nan=False) + "\n",
        "tables.md": to_markdown(results),
        "table.tex": to_latex(results, intervals=intervals),
        SCORES_TABLE_FILE: scores_to_csv(results),
    }
    for name, text in tables.items():
        write_atomically(out / name, text.encode(errors="backslashreplace"), overwrite=True)
    scored_rows = {row.id: row for row in rows if not row.error}
    worst = _worst_cases(cases, methods, config, scored_rows, max_report_cases)
    others = {method.name: method for method in methods if method.name != BASELINE}
    thumbnails = _ReportImages(others, config, scored_rows, out).thumbnails(worst)
    write_report(results, thumbnails, out / REPORT_FILE)
    return results


def check(
    benchmarks: Sequence[Benchmark], methods: Sequence[Method], config: EvaluationConfig
) -> None:
    """Checks everything that can be checked before the evaluation starts. Raises BrewsterError if
    there is no case or no method, names are not unique, an image matches two cases, or the names do
    not identify the paper's scenes.
    """
    check_names(methods)
    names = [benchmark.name for benchmark in benchmarks]
    for name, count in Counter(names).items():
        if count > 1:
            happened = f"{count} benchmarks have the name {name!r}"
            raise BrewsterError(happened, "expected unique names", "rename one of the folders")
    if not any(benchmark.cases for benchmark in benchmarks):
        reasons = [reason for benchmark in benchmarks for reason in benchmark.excluded]
        raise PhotoError(
            f"there is no case in {', '.join(names) or 'no benchmark'}",
            "expected photos with their ground truth",
            "; ".join(reasons[:5]) or "choose a folder with photos and their ground truth",
        )
    if config.paper_subset:
        paper_subsets(benchmarks)
    cases = [case for benchmark in benchmarks for case in benchmark.cases]
    for method in methods:
        if isinstance(method, PredictionFolder):
            method.check_pairing(cases)


def _method_remarks(
    method: Method, cases: Sequence[Case], rows: Sequence[ScoreRow]
) -> Iterator[str]:
    """Yields remarks on a folder: predictions that equal the truth, are flipped or shifted, or
    belong to no case.
    """
    if not isinstance(method, PredictionFolder):
        return
    identical = [row for row in rows if row.scores.get("psnr") == IDENTICAL_DB]
    unchanged = {row.id[:2] for row in identical if row.method == BASELINE}
    copied = [row for row in identical if row.method == method.name and row.id[:2] not in unchanged]
    if copied:
        yield (
            f"the predictions equal the ground truth for {counted(len(copied), 'image')}: "
            "check the folder"
        )
    misregistered = [row for row in rows if row.method == method.name and row.registration]
    if misregistered:
        named = join_names(
            [f"{row.benchmark}/{row.case} is {row.registration}" for row in misregistered]
        )
        yield (
            f"{counted(len(misregistered), 'image')} of {len(cases)} not registered with the "
            f"photo: {named}"
        )
    if unmatched := method.count_unmatched(cases):
        yield (
            f"{counted(unmatched, 'image')} in the folder "
            f"{'matches' if unmatched == 1 else 'match'} no case"
        )


@final
@dataclass(frozen=True)
class _ReportImages:
    """Makes the thumbnails of the report, with links to the files at full size."""

    methods: Mapping[str, Method]
    config: EvaluationConfig
    rows: Mapping[RowId, ScoreRow]
    out: Path

    def thumbnails(self, cases: Iterable[Case]) -> Iterator[CaseThumbnails]:
        for case in cases:
            try:
                truth = GroundTruth.open(case, self.config)
            except PhotoError:
                continue  # the row of the case has this error, and the tables show it
            outputs = {
                name: get_prediction(truth, method, row)
                for name, method in self.methods.items()
                if (row := self.rows.get((case.benchmark, case.name, name)))
            }
            link = partial(self._link, case)
            yield to_thumbnails(truth, outputs, truth.region(self.config.threshold), link)

    def _link(self, case: Case, method: str, layer: str, photo: Photo) -> str:
        """Writes a PNG file if a browser cannot open the file. `method` is "" for the benchmark."""
        path = self._file(case, method, layer)
        if path is None or path.suffix.lower() not in _BROWSER_SUFFIXES:
            name = f"{method}.{layer}.png" if method else f"{layer}.png"
            path = self.out / PICTURES_FOLDER / case.benchmark / case.name / name
            write_atomically(path, photo.encode("png", depth=8), overwrite=True)
        try:
            relative = os.path.relpath(path, self.out)
        except ValueError:  # on Windows, a path on another drive
            return path.resolve().as_uri()
        return quote(os.fsencode(relative.replace(os.sep, "/")))

    def _file(self, case: Case, method: str, layer: str) -> Path | None:
        if method:
            return self.methods[method].files(case).get(layer)
        if self.config.resizes:
            return input_path(self.out, case) if layer == "photo" else None
        sources = {
            "photo": case.photo,
            "transmission": case.ground_truth,
            "reflection": case.reflection,
        }
        source = sources[layer]
        return source.path if source and source.span is None else None


def _worst_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Mapping[RowId, ScoreRow],
    limit: int,
) -> list[Case]:
    """Returns up to `limit` cases of each benchmark: errors of the method after the baseline, then
    its worst scores.
    """
    method = next((method.name for method in methods if method.name != BASELINE), BASELINE)
    column, metric = next(iter(config.columns().items()))

    def sort_key(case: Case) -> float:
        row = rows.get((case.benchmark, case.name, method))
        if row is None:
            is_readable = any((case.benchmark, case.name, other.name) in rows for other in methods)
            return -math.inf if is_readable else math.inf
        score = row.scores.get(column)
        return math.inf if score is None else score if metric.higher_is_better else -score

    worst = []
    for name in dict.fromkeys(case.benchmark for case in cases):
        worst += sorted((case for case in cases if case.benchmark == name), key=sort_key)[:limit]
    return worst
