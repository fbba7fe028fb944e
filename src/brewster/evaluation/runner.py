"""Scores every method on every case, in one or several processes. A stopped run can be resumed.

`scores.jsonl` in the output folder has one line for each new result, scored or failed. A later run
reuses a line if its inputs have not changed and it has all columns. Each file of a case is read
once: its bytes are hashed and, if a score is missing, decoded.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final, final

from brewster.base.executors.local import (
    ProcessExecutor,
    SerialExecutor,
    run_tasks,
    single_torch_thread,
)
from brewster.errors import BrewsterError, OutputError
from brewster.evaluation.benchmarks.image_files import Case
from brewster.evaluation.benchmarks.registry import Benchmark
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import Method, MethodOutput, PredictionFolder
from brewster.evaluation.scoring import CaseFiles, GroundTruth, Scorer

SCORES_FILE: Final = "scores.jsonl"
SCORE_FORMAT_VERSION: Final = 5
"""Increase this version when the scores of a prediction or the fields of `ScoreRow` change. Rows of
other versions are scored again. test_conventions_formats checks the scores.
"""

RowId = tuple[str, str, str]


@final
@dataclass(frozen=True)
class ScoreRow:
    """The scores of one method on one case, or the error; a line of scores.jsonl has these fields.

    `score_key` and `prediction_key` are digests of all inputs of the scores and of the prediction,
    which are reused if it is unchanged. `columns` were computed; those that are not in `scores` do
    not apply to the case. `registration` says how a prediction of a folder is flipped or shifted.
    `digest`: SHA-256 of its files, if it has some.
    """

    benchmark: str
    case: str
    method: str
    prediction_key: str
    score_key: str
    scores: dict[str, float | None] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    error: str | None = None
    seconds: float | None = None
    digest: str | None = None
    width: int = 0
    height: int = 0
    region_share: float = 0.0
    registration: str = ""

    @property
    def id(self) -> RowId:
        """(benchmark, case, method)."""
        return self.benchmark, self.case, self.method


def append_row(path: Path, row: ScoreRow) -> None:
    """Appends a line to scores.jsonl, which the first call creates. Raises OutputError if it cannot
    be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - 1))
            # a killed run can leave an incomplete line, which must not swallow this one
            newline = b"" if file.read(1) in (b"", b"\n") else b"\n"
            file.write(newline + json.dumps(asdict(row)).encode() + b"\n")
    except OSError as error:
        raise OutputError(
            f"{path} was not written ({error.strerror or error})",
            "expected a writable output folder",
            "free disk space or choose another folder with -o, and run again (scores that were "
            "saved are reused)",
        ) from error


def read_score_rows(path: Path) -> dict[RowId, ScoreRow]:
    """Returns the last row for each id. Skips rows with errors, incomplete lines and lines with
    other fields. A row may be outdated: the caller compares its `score_key`.
    """
    rows = {}
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        try:
            values = json.loads(line)
            row = ScoreRow(**(values | {"columns": tuple(values["columns"])}))
        except (ValueError, TypeError, LookupError):
            continue
        if not row.error:
            rows[row.id] = row
    return rows


INPUTS_FOLDER: Final = "inputs"
"""The folder of the resized photos, if `EvaluationConfig.resizes`."""

ScoreCallback = Callable[[int, int, ScoreRow], None]
"""Called with (done, total, row) after each new result, scored or failed."""


def score(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    out: Path,
    *,
    workers: int = 1,
    on_progress: ScoreCallback = lambda _done, _total, _row: None,
) -> tuple[list[ScoreRow], dict[str, str]]:
    """Runs every method on every case and scores the predictions. Reuses the rows of an earlier run
    if nothing changed.

    Exclusive methods run last, one after another, in this process. Returns one row for each case
    and method, in the order of benchmarks, cases and methods, with an `error` if the method failed;
    and column -> reason for the columns that this machine cannot compute, for example without
    weights. Raises BrewsterError if a worker process died, and OutputError if `out` cannot be
    written.
    """
    logged = read_score_rows(out / SCORES_FILE)
    cases = [case for benchmark in benchmarks for case in benchmark.cases]
    ids = [(case.benchmark, case.name, method.name) for case in cases for method in methods]
    unavailable = _find_unavailable(config)
    rows = dict[RowId, ScoreRow]()

    def run(names: list[str], workers: int) -> None:
        tasks = iter([_Task(case, names) for case in cases])
        with (
            SerialExecutor(create_scorer)
            if workers == 1
            else ProcessExecutor(create_scorer, workers) as executor
        ):
            for row in run_tasks(partial(next, tasks, None), executor):
                rows[row.id] = row
                if row != logged.get(row.id):
                    append_row(out / SCORES_FILE, row)
                    on_progress(len(rows), len(ids), row)

    columns = tuple(column for column in config.columns() if column not in unavailable)
    by_name = {method.name: method for method in methods}
    create_scorer = partial(_CaseScorer, by_name, config, columns, logged, out)
    if together := [method.name for method in methods if not method.exclusive]:
        run(together, workers)
    for method in methods:
        if method.exclusive:
            run([method.name], 1)
    found = [rows[row_id] for row_id in ids]
    lacking = {
        column: reason
        for column, reason in unavailable.items()
        if any(column not in row.columns for row in found if not row.error)
    }
    return found, lacking


def _find_unavailable(config: EvaluationConfig) -> dict[str, str]:
    """Loads the weights of the metrics. Returns column -> reason for the metrics whose weights
    cannot be loaded.
    """
    reasons = {}
    for column, metric in config.columns().items():
        try:
            _ = metric.prepare and metric.prepare()
        except BrewsterError as error:
            reasons[column] = str(error)
    return reasons


@final
@dataclass(frozen=True)
class _Task:
    case: Case
    names: list[str]

    def failed_results(self, reason: str) -> list[ScoreRow]:
        raise BrewsterError(
            f"a worker process died on {self.case.benchmark}/{self.case.name} ({reason})",
            "expected it to finish (it was killed, or the memory was exhausted)",
            "run again with fewer workers (the finished scores are saved)",
        )


@final
@dataclass(frozen=True)
class _CaseScorer:
    """Scores the methods on one case, with one thread, so that the scores do not depend on the
    number of workers.
    """

    methods: Mapping[str, Method]
    config: EvaluationConfig
    columns: tuple[str, ...]
    logged: Mapping[RowId, ScoreRow]
    out: Path

    @single_torch_thread()
    def __call__(self, task: _Task) -> list[ScoreRow]:
        """Returns the rows of a case. Decodes its images only if a row of an earlier run cannot be
        reused.
        """
        case = task.case
        rows = [ScoreRow(case.benchmark, case.name, name, "", "") for name in task.names]
        try:
            files = CaseFiles.read(case)
            rows = [
                _empty_row(files, self.methods[name], self.config, self.logged)
                for name in task.names
            ]
            if all(map(self._is_complete, rows)):
                return [self.logged[row.id] for row in rows]
            truth = GroundTruth.decode(files, self.config)
        except BrewsterError as error:
            reason = f"{case.benchmark}/{case.name}: {error}"
            return [
                self.logged[r.id] if self._is_complete(r) else replace(r, error=reason)
                for r in rows
            ]
        if self.config.resizes:
            truth.photo.save(input_path(self.out, case), overwrite=True)
        scorer = Scorer(truth, self.config)
        return [
            self.logged[r.id] if self._is_complete(r) else self._score(r, scorer, truth)
            for r in rows
        ]

    def _is_complete(self, row: ScoreRow) -> bool:
        """Whether an earlier run has computed all scores of a row from the same inputs."""
        old = self.logged.get(row.id)
        return (
            old is not None and old.score_key == row.score_key and {*self.columns} <= {*old.columns}
        )

    def _score(self, row: ScoreRow, scorer: Scorer, truth: GroundTruth) -> ScoreRow:
        method = self.methods[row.method]
        try:
            prediction = get_prediction(truth, method, row)
            truth.check(prediction, row.method)
        except Exception as error:  # noqa: BLE001  (a crash on one image must not stop the evaluation)
            reason = (
                str(error)
                if isinstance(error, BrewsterError)
                else f"{type(error).__name__}: {error}"
            )
            return replace(
                row, error=f"{row.method} failed on {row.benchmark}/{row.case}: {reason}"
            )
        return replace(
            row,
            scores=scorer.score(prediction, self.columns),
            columns=self.columns,
            seconds=row.seconds if prediction.seconds is None else prediction.seconds,
            digest=prediction.digest,
            width=truth.photo.size[0],
            height=truth.photo.size[1],
            region_share=scorer.region_share,
            registration=scorer.registration(prediction)
            if isinstance(method, PredictionFolder)
            else "",
        )


def input_path(out: Path, case: Case) -> Path:
    """Returns the file of a resized photo, for methods that run elsewhere."""
    return out / INPUTS_FOLDER / case.benchmark / f"{case.name}.png"


def _empty_row(
    files: CaseFiles, method: Method, config: EvaluationConfig, logged: Mapping[RowId, ScoreRow]
) -> ScoreRow:
    """Returns a row without scores, with the keys that show whether a row of an earlier run can be
    reused.
    """
    case = files.case
    photo, *ground_truths = files.digests()
    # `paper_subset` selects cases for the tables, and `protocol` is a name: they change no score.
    # `quality` is in the keys of models, and does not affect other methods. `metrics` is left out:
    # each row lists its own columns.
    settings = asdict(config) | dict.fromkeys(("metrics", "paper_subset", "protocol", "quality"))
    prediction_key = _digest(photo, config.short_side_px, config.size_divisor, method.key(case))
    score_key = _digest(
        prediction_key, ground_truths, settings, case.rendered, SCORE_FORMAT_VERSION
    )
    row = ScoreRow(case.benchmark, case.name, method.name, prediction_key, score_key)
    old = logged.get(row.id)
    if old and old.prediction_key == prediction_key:
        return replace(row, digest=old.digest, seconds=old.seconds)
    return row


def get_prediction(truth: GroundTruth, method: Method, row: ScoreRow) -> MethodOutput:
    """Returns the stored prediction if it has the digest of the row, else a new prediction. Raises
    BrewsterError.
    """
    cached = method.cached(truth.case) if row.digest else None
    return (
        cached
        if cached and cached.digest == row.digest
        else method.predict(truth.case, truth.photo)
    )


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]
