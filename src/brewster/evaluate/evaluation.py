"""Runs an evaluation: scores every method on every benchmark, and writes results, tables and an HTML report."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, final
from urllib.parse import quote

from brewster.benchmarks.image_files import Case, ImageFile
from brewster.benchmarks.pairing import join_names
from brewster.benchmarks.registry import Benchmark
from brewster.errors import BrewsterError, PhotoError, counted
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import (
    BASELINE,
    Method,
    MethodOutput,
    ModelMethod,
    PredictionFolder,
    check_names,
)
from brewster.evaluate.report.html_report import write_report
from brewster.evaluate.report.images import CaseThumbnails, to_thumbnails
from brewster.evaluate.report.latex import to_latex
from brewster.evaluate.report.published import read_published
from brewster.evaluate.report.published import to_markdown as published_to_markdown
from brewster.evaluate.report.tables import scores_to_csv, to_csv, to_markdown
from brewster.evaluate.results import Results, paper_subsets, summarise
from brewster.evaluate.runner import ScoreCallback, get_prediction, score
from brewster.evaluate.score_log import RowId, ScoreRow
from brewster.evaluate.scoring import GroundTruth, resize
from brewster.files import write_atomically
from brewster.metrics import IDENTICAL_DB
from brewster.photo import Photo

_BROWSER_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp", ".avif", ".gif", ".bmp")
RESULTS_FILE, REPORT_FILE, INPUTS_FOLDER = "results.json", "report.html", "inputs"
SCORES_TABLE_FILE: Final = "scores.csv"
PICTURES_FOLDER: Final = "pictures"
"""The folder of full-size copies for the report, of images that a browser cannot open in the user's own folders."""
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
    """Scores the methods. Writes results.json, scores.csv, tables.md, table.tex, table.csv and report.html into `out`,
    and the photos into `out`/inputs if they are resized. Returns the content of results.json.

    A metric whose weights are missing is left out, and "unavailable" in the results says why; the next run adds it. A
    stopped run is resumed from the files in `out`, a folder for this evaluation only. Each image is read and decoded
    once, unless an earlier run has scored it, an exclusive method needs it, or the benchmark has more than
    `max_report_cases` cases.

    `methods` are in the order of the tables; the first one should be the baseline. The report has at most
    `max_report_cases` cases of each benchmark: those with the worst scores of the first other method. With `intervals`,
    table.tex has the confidence intervals. Raises BrewsterError as `check`, and OutputError if `out` cannot be
    written."""
    check(benchmarks, methods, config)
    cases = [case for benchmark in benchmarks for case in benchmark.cases]
    with TemporaryDirectory(prefix="brewster-report-") as folder:
        complete = frozenset(part.name for part in benchmarks if len(part.cases) <= max_report_cases)
        by_name = {method.name: method for method in methods}
        thumbnails = _ThumbnailCache(Path(folder), complete, config, out, by_name)
        rows, unavailable = score(
            benchmarks,
            methods,
            config,
            out,
            workers=workers,
            on_progress=on_progress,
            on_case_scored=thumbnails,
        )
        if config.resizes:
            for case in cases:  # that this run did not decode
                path = _input_path(out / INPUTS_FOLDER, case)
                if not path.exists():
                    with suppress(PhotoError):  # an unreadable photo has a row with the error
                        resize(Photo.open(case.photo.read()), config).save(path)
        results = summarise(benchmarks, methods, config, rows, unavailable)
        for method in methods:
            if remarks := list(_method_remarks(method, cases, rows)):
                results["methods"][method.name]["remark"] = "; ".join(remarks)
        tables = {
            RESULTS_FILE: json.dumps(results, indent=1, allow_nan=False) + "\n",
            "tables.md": f"{to_markdown(results)}\n{published_to_markdown(read_published())}",
            "table.tex": to_latex(results, intervals=intervals),
            "table.csv": to_csv(results),
            SCORES_TABLE_FILE: scores_to_csv(results),
        }
        for name, text in tables.items():
            write_atomically(out / name, text.encode(errors="backslashreplace"), overwrite=True)
        report_cases = _report_cases(cases, methods, rows, max_report_cases, thumbnails)
        write_report(results, report_cases, out / REPORT_FILE)
    return results


def check(benchmarks: Sequence[Benchmark], methods: Sequence[Method], config: EvaluationConfig) -> None:
    """Checks everything that can be checked before the evaluation starts. Raises BrewsterError if there is no case or no
    method, names are not unique, an image matches two cases, or the paper's subsets need scenes that the names do not identify."""
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


def _method_remarks(method: Method, cases: Sequence[Case], rows: Sequence[ScoreRow]) -> Iterator[str]:
    """Yields remarks on a folder: predictions that equal the ground truth, are flipped or shifted, or belong to no case."""
    if not isinstance(method, PredictionFolder):
        return
    identical = [row for row in rows if row.scores.get("psnr") == IDENTICAL_DB]
    unchanged = {row.id[:2] for row in identical if row.method == BASELINE}
    copied = [row for row in identical if row.method == method.name and row.id[:2] not in unchanged]
    if copied:
        yield f"the predictions equal the ground truth for {counted(len(copied), 'image')}: check the folder"
    misregistered = [row for row in rows if row.method == method.name and row.registration]
    if misregistered:
        named = join_names([f"{row.benchmark}/{row.case} is {row.registration}" for row in misregistered])
        yield f"{counted(len(misregistered), 'image')} of {len(cases)} not registered with the photo: {named}"
    if unmatched := method.count_unmatched(cases):
        yield f"{counted(unmatched, 'image')} in the folder {'matches' if unmatched == 1 else 'match'} no case"


def _input_path(folder: Path, case: Case) -> Path:
    return folder / case.benchmark / f"{case.name}.png"


# --- images of the report


@final
@dataclass(frozen=True)
class _ThumbnailCache:
    """Writes the thumbnails of the report and the resized photos while a case is decoded. It stores the thumbnails of
    `benchmarks`, of which the report shows all cases. They are stored in files, because worker processes create
    them, and because memory must not grow with the number of cases."""

    folder: Path
    benchmarks: frozenset[str]
    config: EvaluationConfig
    out: Path
    methods: Mapping[str, Method]

    def __call__(self, truth: GroundTruth, predictions: Mapping[str, MethodOutput]) -> None:
        """Stores the thumbnails and the resized photo of a case. `score` calls this after it has scored the case."""
        case = truth.case
        if self.config.resizes:
            truth.photo.save(_input_path(self.out / INPUTS_FOLDER, case), overwrite=True)
        if case.benchmark not in self.benchmarks:
            return
        thumbnails = self.create(truth, predictions)
        for method, images in thumbnails.methods.items():
            path = self._path(case, method)
            path.write_text(json.dumps([thumbnails.size, thumbnails.embedded_size, images]))

    def read(self, case: Case, methods: Sequence[str]) -> CaseThumbnails | None:
        """Returns the stored thumbnails of a case and the methods, or None if a file is missing."""
        paths = {method: self._path(case, method) for method in (BASELINE, *methods)}
        if not all(path.exists() for path in paths.values()):
            return None
        stored = {method: json.loads(path.read_text()) for method, path in paths.items()}
        thumbnails = {method: images for method, (*_, images) in stored.items()}
        size, embedded_size, _ = stored[BASELINE]
        return CaseThumbnails(case.benchmark, case.name, size, embedded_size, thumbnails)

    def create(self, truth: GroundTruth, predictions: Mapping[str, MethodOutput]) -> CaseThumbnails:
        """Returns the thumbnails of a case, with links to files at full size."""
        others = {name: output for name, output in predictions.items() if name != BASELINE}
        region = truth.region(self.config.thresholds[0])
        return to_thumbnails(truth, others, region, dict(self._links(truth, others)))

    def _links(
        self, truth: GroundTruth, predictions: Mapping[str, MethodOutput]
    ) -> Iterator[tuple[tuple[str, str], str]]:
        case = truth.case
        sources = {"photo": case.photo, "transmission": case.ground_truth, "reflection": case.reflection}
        for layer, image in truth.images.items():
            source = None if self.config.resizes else sources[layer]
            if self.config.resizes and layer == "photo":
                source = ImageFile(_input_path(self.out / INPUTS_FOLDER, case))
            yield (layer, ""), self._link(case, source, Photo.from_array(image, encoding="srgb"), layer)
        for name, output in predictions.items():
            method = self.methods[name]
            files = method.files(case) if isinstance(method, ModelMethod | PredictionFolder) else {}
            for layer, photo in (("transmission", output.transmission), ("reflection", output.reflection)):
                if photo:
                    source = ImageFile(files[layer]) if layer in files else None
                    yield (layer, name), self._link(case, source, photo, f"{name}.{layer}")

    def _link(self, case: Case, source: ImageFile | None, photo: Photo, name: str) -> str:
        """Returns the URL of a file, relative to the report. Writes a PNG file if a browser cannot open the source."""
        path = source.path if source and source.span is None else None
        if path is None or path.suffix.lower() not in _BROWSER_SUFFIXES:
            path = self.out / PICTURES_FOLDER / case.benchmark / case.name / f"{name}.png"
            write_atomically(path, photo.encode("png", depth=8), overwrite=True)
        try:
            relative = os.path.relpath(path, self.out)
        except ValueError:  # on Windows, a path on another drive
            return path.resolve().as_uri()
        return quote(relative.replace(os.sep, "/"))

    def _path(self, case: Case, method: str) -> Path:
        name = json.dumps([case.benchmark, case.name, method])
        return self.folder / f"{hashlib.sha256(name.encode()).hexdigest()}.json"


def _report_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    rows: Sequence[ScoreRow],
    limit: int,
    thumbnails: _ThumbnailCache,
) -> Iterator[CaseThumbnails]:
    """Yields the cases of the report. Cases without stored thumbnails are read and decoded again."""
    scored_rows = {row.id: row for row in rows if not row.error}
    for case in _worst_cases(cases, methods, thumbnails.config, scored_rows, limit):
        method_rows = {
            method: row
            for method in methods
            if method.name != BASELINE and (row := scored_rows.get((case.benchmark, case.name, method.name)))
        }
        if cached := thumbnails.read(case, [method.name for method in method_rows]):
            yield cached
            continue
        try:
            truth = GroundTruth.open(case, thumbnails.config)
        except PhotoError:
            continue  # the row of the case has this error, and the tables show it
        predictions = {method.name: get_prediction(truth, method, row) for method, row in method_rows.items()}
        yield thumbnails.create(truth, predictions)


def _worst_cases(
    cases: Sequence[Case],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Mapping[RowId, ScoreRow],
    limit: int,
) -> list[Case]:
    """Returns up to `limit` cases of each benchmark: errors of the first method after the baseline first, then its worst scores."""
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
