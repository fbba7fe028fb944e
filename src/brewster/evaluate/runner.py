"""Scores every method on every case, in one or several processes. A stopped run can be resumed.

    rows = score(read_benchmark("nature20", folder), [IdentityBaseline(), model], EvaluationConfig(), Path("out/evaluate"))

The file `scores.jsonl` in the output folder has one line for each scored prediction. A later run reuses a line if its inputs
have not changed. Each file of a case is read once: its bytes are hashed and, if a score is missing, decoded.
"""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, final

from brewster.benchmarks.registry import Benchmark, Case
from brewster.errors import BrewsterError, TargetError
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import Method, MethodOutput, check_names
from brewster.evaluate.scoring import CaseFiles, GroundTruth, Scorer
from brewster.executors import exit_with_parent
from brewster.worker_setup import single_torch_thread

SCORES_FILE: Final = "scores.jsonl"
SCORE_FORMAT_VERSION: Final = 3
"""Increase this version when the scores of a prediction or the fields of `ScoreRow` change. Rows of other versions are
scored again. test_house_formats checks the scores."""

ScoreCallback = Callable[[int, int, "ScoreRow"], None]
"""Called with (done, total, row) after each prediction that was scored."""

CaseCallback = Callable[[GroundTruth, Mapping[str, MethodOutput]], None]
"""Called with (case, method -> new prediction) after a case is scored, in the process that scored it."""

RowId = tuple[str, str, str]


@final
@dataclass(frozen=True)
class ScoreRow:
    """The scores of one method on one case, or the error. These are also the fields of a line of scores.jsonl.

    `score_key` is a digest of all inputs of the scores, `prediction_key` of all inputs of the prediction. A score or a
    prediction is reused if its key is unchanged. `digest` is the SHA-256 of the files of the prediction, if it has any.
    """

    benchmark: str
    case: str
    method: str
    prediction_key: str
    score_key: str
    scores: dict[str, float | None] = field(default_factory=dict)
    error: str | None = None
    seconds: float | None = None
    digest: str | None = None
    width: int = 0
    height: int = 0
    region_share: float = 0.0

    @property
    def id(self) -> RowId:
        """(benchmark, case, method)."""
        return self.benchmark, self.case, self.method


@final
@dataclass(frozen=True)
class _ScoringTask:
    """A case, the names of the methods to score on it, and the rows of earlier runs by method."""

    case: Case
    methods: tuple[str, ...]
    logged: Mapping[str, ScoreRow]


def score(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    out: Path,
    *,
    workers: int = 1,
    on_progress: ScoreCallback = lambda _done, _total, _row: None,
    on_case_scored: CaseCallback | None = None,
) -> list[ScoreRow]:
    """Runs every method on every case and scores the predictions. Reuses the rows of an earlier run if nothing changed.

    Exclusive methods run last, one after another, in this process. Each of them reads the cases again.

    Args:
        benchmarks: the benchmarks, as `read_benchmark` returns them.
        methods: the methods. Their names must be unique.
        config: the settings of the evaluation.
        out: the folder of scores.jsonl.
        workers: the number of processes that score in parallel.
        on_progress: called after each new row.
        on_case_scored: called once for each case with new rows. With several workers, it must be picklable.

    Returns:
        One row for each case and method, in the order of benchmarks, cases and methods. The number of workers does not
        change the order. If a method failed on a case, its row has an `error`.

    Raises:
        BrewsterError: two methods have the same name, a name is not valid for a folder, a metric is not available, or
            a worker process died.
        TargetError: `out` cannot be written.
    """
    check_names(methods)
    logged = _read_log(out / SCORES_FILE)
    cases = {(case.benchmark, case.name): case for benchmark in benchmarks for case in benchmark.cases}
    ids = [(*case, method.name) for case in cases for method in methods]
    _prepare_metrics(config, ids, logged)
    log, rows = _ScoreLog(out / SCORES_FILE), dict[RowId, ScoreRow]()

    def log_rows(case_rows: Sequence[ScoreRow]) -> None:
        for row in case_rows:
            rows[row.id] = row
            if row != logged.get(row.id):
                log.write(row)
                on_progress(len(rows), len(ids), row)

    state = _WorkerState({method.name: method for method in methods}, config, on_case_scored)
    parallel_methods = [method.name for method in methods if not method.exclusive]
    _run_tasks(_tasks(cases.values(), parallel_methods, logged), state, log_rows, workers)
    for method in methods:
        if method.exclusive:
            _run_tasks(_tasks(cases.values(), [method.name], logged), state, log_rows, 1)
    return [rows[row_id] for row_id in ids]


def _tasks(
    cases: Iterable[Case], methods: Sequence[str], logged: Mapping[RowId, ScoreRow]
) -> list[_ScoringTask]:
    def logged_rows(case: Case) -> dict[str, ScoreRow]:
        ids = ((case.benchmark, case.name, method) for method in methods)
        return {row_id[2]: logged[row_id] for row_id in ids if row_id in logged}

    return [_ScoringTask(case, tuple(methods), logged_rows(case)) for case in cases] if methods else []


def _prepare_metrics(
    config: EvaluationConfig, ids: Sequence[RowId], logged: Mapping[RowId, ScoreRow]
) -> None:
    """Calls `Metric.prepare`, which loads the weights of LPIPS, for example.

    It is called before the workers start, so that it runs once and its error stops the evaluation. It is not called for a
    metric that has a score in every row of an earlier run.
    """
    columns: dict[Callable[[], object], set[str]] = {}
    for column, metric in config.columns().items():
        if metric.prepare:
            columns.setdefault(metric.prepare, set()).add(column)
    for prepare, names in columns.items():
        if any(row_id not in logged or not names & logged[row_id].scores.keys() for row_id in ids):
            prepare()


# --- one case


@final
@dataclass(frozen=True)
class _WorkerState:
    """The data that a process needs to score cases."""

    methods: Mapping[str, Method]
    config: EvaluationConfig
    on_case_scored: CaseCallback | None


def _score_case(task: _ScoringTask, state: _WorkerState) -> list[ScoreRow]:
    """Returns the rows of a case. Decodes its images only if a row of an earlier run cannot be reused."""
    case = task.case
    try:
        files = CaseFiles.read(case)
    except BrewsterError as error:
        rows = [ScoreRow(case.benchmark, case.name, name, "", "") for name in task.methods]
        return [_case_failed(row, error) for row in rows]
    rows = [_empty_row(files, state.methods[name], state.config, task.logged) for name in task.methods]
    if all(_is_scored(row, task.logged) for row in rows):
        return [task.logged[row.method] for row in rows]
    try:
        truth = GroundTruth.decode(files, state.config)
    except BrewsterError as error:
        return [
            task.logged[row.method] if _is_scored(row, task.logged) else _case_failed(row, error)
            for row in rows
        ]
    return _score_rows(rows, truth, task, state)


def _score_rows(
    rows: Sequence[ScoreRow], truth: GroundTruth, task: _ScoringTask, state: _WorkerState
) -> list[ScoreRow]:
    scorer, predictions = Scorer(truth, state.config), dict[str, MethodOutput]()
    scored = []
    for row in rows:
        if _is_scored(row, task.logged):
            scored.append(task.logged[row.method])
            continue
        try:
            prediction = get_prediction(truth, state.methods[row.method], row)
            truth.check(prediction, row.method)
        except BrewsterError as error:
            scored.append(_method_failed(row, str(error)))
        except Exception as error:  # noqa: BLE001  (a crash on one image must not stop the evaluation)
            scored.append(_method_failed(row, f"{type(error).__name__}: {error}"))
        else:
            predictions[row.method] = prediction
            scored.append(_scored_row(row, truth, scorer, prediction))
    if state.on_case_scored:
        state.on_case_scored(truth, predictions)
    return scored


def _empty_row(
    files: CaseFiles, method: Method, config: EvaluationConfig, logged: Mapping[str, ScoreRow]
) -> ScoreRow:
    """Returns a row without scores, with the keys that show whether a row of an earlier run can be reused."""
    case = files.case
    photo, *ground_truths = files.digests()
    # `paper` selects cases for the tables and changes no score. `quality` is a part of the keys of models, and does not
    # affect other methods.
    settings = asdict(config) | {"paper": None, "quality": None}
    prediction_key = _digest(photo, config.size, method.key(case))
    score_key = _digest(prediction_key, ground_truths, settings, case.rendered, SCORE_FORMAT_VERSION)
    row = ScoreRow(case.benchmark, case.name, method.name, prediction_key, score_key)
    logged_row = logged.get(method.name)
    if logged_row and logged_row.prediction_key == prediction_key:
        return replace(row, digest=logged_row.digest)
    return row


def _is_scored(row: ScoreRow, logged: Mapping[str, ScoreRow]) -> bool:
    return row.method in logged and logged[row.method].score_key == row.score_key


def _scored_row(row: ScoreRow, truth: GroundTruth, scorer: Scorer, prediction: MethodOutput) -> ScoreRow:
    width, height = truth.photo.size
    return replace(
        row,
        scores=scorer.score(prediction),
        seconds=prediction.seconds,
        digest=prediction.digest,
        width=width,
        height=height,
        region_share=scorer.region_share,
    )


def get_prediction(truth: GroundTruth, method: Method, row: ScoreRow) -> MethodOutput:
    """Returns the stored prediction if it has the digest of the row, else a new prediction.

    Raises:
        BrewsterError: the method failed.
    """
    cached = method.cached(truth.case) if row.digest else None
    return cached if cached and cached.digest == row.digest else method.predict(truth.case, truth.photo)


def _case_failed(row: ScoreRow, error: BrewsterError) -> ScoreRow:
    return replace(row, error=f"{row.benchmark}/{row.case}: {error}")


def _method_failed(row: ScoreRow, error: str) -> ScoreRow:
    return replace(row, error=f"{row.method} failed on {row.benchmark}/{row.case}: {error}")


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


# --- all cases

RowsCallback = Callable[[Sequence[ScoreRow]], None]


def _run_tasks(
    tasks: Sequence[_ScoringTask], state: _WorkerState, on_rows: RowsCallback, workers: int
) -> None:
    """Runs the tasks in this process or in several worker processes. Calls `on_rows` after each task.

    Each process computes metrics with one thread, so that the scores do not depend on the number of workers.
    """
    if workers == 1:
        with single_torch_thread():
            for task in tasks:
                on_rows(_score_case(task, state))
        return
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _initialize_worker, (state,))
    futures = {pool.submit(_score_case_in_worker, task) for task in tasks}
    try:
        for future in as_completed(set(futures)):
            futures.remove(future)
            on_rows(future.result())
    except BrokenProcessPool as error:
        raise BrewsterError(
            "a worker process died",
            "expected it to finish (it was killed, or the memory was exhausted)",
            "run again with fewer workers (the finished scores are saved)",
        ) from error
    except KeyboardInterrupt:
        pool.shutdown(cancel_futures=True)
        for rows in _finished(futures):
            on_rows(rows)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _finished(futures: set[Future[list[ScoreRow]]]) -> Iterator[list[ScoreRow]]:
    return (future.result() for future in futures if not future.cancelled() and not future.exception())


_worker_state: list[_WorkerState] = []  # empty, or with one element in a worker process


def _initialize_worker(state: _WorkerState) -> None:
    # Only the parent process handles Ctrl-C, so that the workers can finish their current case.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    exit_with_parent()
    _worker_state.append(state)


def _score_case_in_worker(task: _ScoringTask) -> list[ScoreRow]:
    with single_torch_thread():
        return _score_case(task, _worker_state[0])


# --- the log


@final
class _ScoreLog:
    """The file scores.jsonl. The first call of `write` creates it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, row: ScoreRow) -> None:
        """Appends a line.

        Raises:
            TargetError: the file cannot be written.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("ab+") as file:
                file.write(self._missing_newline(file) + json.dumps(asdict(row)).encode() + b"\n")
        except OSError as error:
            raise TargetError(
                f"{self._path} was not written ({error.strerror or error})",
                "expected a writable output folder",
                "free disk space or choose another folder with -o, and run again (the finished scores are saved)",
            ) from error

    def _missing_newline(self, file: Any) -> bytes:  # noqa: ANN401  (the type that open returns)
        """Returns a newline if the file does not end with one: a killed run can leave an incomplete line."""
        if not file.seek(0, 2):
            return b""
        file.seek(-1, 2)
        return b"" if file.read(1) == b"\n" else b"\n"


def _read_log(path: Path) -> dict[RowId, ScoreRow]:
    """Returns the last row for each id. Skips rows with errors, incomplete lines and lines of other versions."""
    rows = {}
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        try:
            row = ScoreRow(**json.loads(line))
        except (ValueError, TypeError):
            continue
        if not row.error:
            rows[row.id] = row
    return rows
