"""Scores every method on every case, in one or several processes. A stopped run can be resumed.

    rows = score(read_benchmark("nature20", folder), [IdentityBaseline(), model], EvaluationConfig(), Path("out/evaluate"))

The file `scores.jsonl` in the output folder has one line for each new result, scored or failed. A later run reuses a line if its inputs
have not changed, and adds the columns that it does not have, such as LPIPS after its weights were missing. Each file of a
case is read once: its bytes are hashed and, if a score is missing, decoded. If an earlier run has all scores of a metric that needs
weights, the files are read twice: first to find out whether these weights are needed.
"""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import final

from brewster.benchmarks.registry import Benchmark, Case
from brewster.errors import BrewsterError
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import Method, MethodOutput, PredictionFolder, check_names
from brewster.evaluate.score_log import (
    SCORE_FORMAT_VERSION,
    SCORES_FILE,
    RowId,
    ScoreLog,
    ScoreRow,
    read_score_rows,
)
from brewster.evaluate.scoring import CaseFiles, GroundTruth, Scorer
from brewster.executors import exit_with_parent
from brewster.worker_setup import single_torch_thread

ScoreCallback = Callable[[int, int, "ScoreRow"], None]
"""Called with (done, total, row) after each new result, scored or failed."""

CaseCallback = Callable[[GroundTruth, Mapping[str, MethodOutput]], None]
"""Called with (case, method -> new prediction) after a case is scored, in the process that scored it."""


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
    logged: Mapping[RowId, ScoreRow] | None = None,
    unavailable: Collection[str] | None = None,
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
        logged: the rows of an earlier run; by default, those of scores.jsonl.
        unavailable: columns that are not computed now, from `find_unavailable`. By default, a metric whose weights are missing
            is an error.
        on_progress: called after each new row.
        on_case_scored: called once for each case with new rows. With several workers, it must be picklable.

    Returns:
        One row for each case and method, in the order of benchmarks, cases and methods. The number of workers does not
        change the order. If a method failed on a case, its row has an `error`.

    Raises:
        BrewsterError: two methods have the same name, a name is not valid for a folder, a metric is not available, or
            a worker process died.
        OutputError: `out` cannot be written.
    """
    check_names(methods)
    logged = read_score_rows(out / SCORES_FILE) if logged is None else logged
    cases = {(case.benchmark, case.name): case for benchmark in benchmarks for case in benchmark.cases}
    ids = [(*case, method.name) for case in cases for method in methods]
    if unavailable is None:
        unavailable = ()
        for prepare, _ in _missing_metrics(cases.values(), methods, config, logged):
            prepare()
    log, rows = ScoreLog(out / SCORES_FILE), dict[RowId, ScoreRow]()

    def log_rows(case_rows: Sequence[ScoreRow]) -> None:
        for row in case_rows:
            rows[row.id] = row
            if row != logged.get(row.id):
                log.write(row)
                on_progress(len(rows), len(ids), row)

    columns = tuple(column for column in config.columns() if column not in unavailable)
    state = _WorkerState({method.name: method for method in methods}, config, columns, on_case_scored)
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


def find_unavailable(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    logged: Mapping[RowId, ScoreRow],
) -> dict[str, str]:
    """Returns column -> reason, for the columns that cannot be computed on this machine, for example without weights.

    The weights of all other metrics are loaded. A metric is not tried if `logged`, the rows of an earlier run, has it for all
    cases and methods, and their inputs have not changed.
    """
    cases = [case for benchmark in benchmarks for case in benchmark.cases]
    unavailable: dict[str, str] = {}
    for prepare, columns in _missing_metrics(cases, methods, config, logged):
        try:
            prepare()
        except BrewsterError as error:
            unavailable |= dict.fromkeys(columns, str(error))
    return {column: unavailable[column] for column in config.columns() if column in unavailable}


def _missing_metrics(
    cases: Collection[Case],
    methods: Sequence[Method],
    config: EvaluationConfig,
    logged: Mapping[RowId, ScoreRow],
) -> list[tuple[Callable[[], object], list[str]]]:
    """Returns (prepare, columns) for the metrics with missing scores.

    `prepare` loads weights, for example of LPIPS. Call each `prepare` once, before the workers start. A metric is left out if
    every row of an earlier run has it and no row is outdated. The files of the cases are read only if every row has it.
    """
    columns: dict[Callable[[], object], list[str]] = {}
    for column, metric in config.columns().items():
        if metric.prepare:
            columns.setdefault(metric.prepare, []).append(column)
    ids = [(case.benchmark, case.name, method.name) for case in cases for method in methods]
    complete = {
        prepare
        for prepare, names in columns.items()
        if all(row_id in logged and set(names) <= {*logged[row_id].columns} for row_id in ids)
    }
    if complete and any(_has_outdated_row(case, methods, config, logged) for case in cases):
        complete = set()
    return [(prepare, names) for prepare, names in columns.items() if prepare not in complete]


def _has_outdated_row(
    case: Case, methods: Sequence[Method], config: EvaluationConfig, logged: Mapping[RowId, ScoreRow]
) -> bool:
    """Whether a row of an earlier run for this case cannot be reused, because its inputs have changed."""
    try:
        files = CaseFiles.read(case)
    except BrewsterError:  # the case fails without a score
        return False
    rows = (_empty_row(files, method, config, {}) for method in methods)
    return any(logged[row.id].score_key != row.score_key for row in rows)


# --- one case


@final
@dataclass(frozen=True)
class _WorkerState:
    """The data that a process needs to score cases."""

    methods: Mapping[str, Method]
    config: EvaluationConfig
    columns: tuple[str, ...]
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
    if not any(_missing_columns(row, state, task.logged) for row in rows):
        return [task.logged[row.method] for row in rows]
    try:
        truth = GroundTruth.decode(files, state.config)
    except BrewsterError as error:
        return [
            _case_failed(row, error) if _missing_columns(row, state, task.logged) else task.logged[row.method]
            for row in rows
        ]
    return _score_rows(rows, truth, task, state)


def _score_rows(
    rows: Sequence[ScoreRow], truth: GroundTruth, task: _ScoringTask, state: _WorkerState
) -> list[ScoreRow]:
    scorer, predictions = Scorer(truth, state.config), dict[str, MethodOutput]()
    scored = []
    for row in rows:
        columns = _missing_columns(row, state, task.logged)
        if not columns:
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
            is_stored = isinstance(state.methods[row.method], PredictionFolder)
            registration = scorer.registration(prediction) if is_stored else ""
            new = _scored_row(replace(row, registration=registration), truth, scorer, prediction, columns)
            scored.append(_merged(task.logged.get(row.method), new))
    if state.on_case_scored:
        state.on_case_scored(truth, predictions)
    return scored


def _empty_row(
    files: CaseFiles, method: Method, config: EvaluationConfig, logged: Mapping[str, ScoreRow]
) -> ScoreRow:
    """Returns a row without scores, with the keys that show whether a row of an earlier run can be reused."""
    case = files.case
    photo, *ground_truths = files.digests()
    # `paper_subset` selects cases for the tables, and `protocol` is a name: they change no score. `quality` is a part of the
    # keys of models, and does not affect other methods. `metrics` is left out because each row lists its own columns.
    settings = asdict(config) | dict.fromkeys(("metrics", "paper_subset", "protocol", "quality"))
    prediction_key = _digest(photo, config.short_side_px, config.size_divisor, method.key(case))
    score_key = _digest(prediction_key, ground_truths, settings, case.rendered, SCORE_FORMAT_VERSION)
    row = ScoreRow(case.benchmark, case.name, method.name, prediction_key, score_key)
    logged_row = logged.get(method.name)
    if logged_row and logged_row.prediction_key == prediction_key:
        return replace(row, digest=logged_row.digest)
    return row


def _missing_columns(row: ScoreRow, state: _WorkerState, logged: Mapping[str, ScoreRow]) -> list[str]:
    """Returns the columns that a row of an earlier run does not have, or all columns if its inputs have changed."""
    old = logged.get(row.method)
    known = old.columns if old and old.score_key == row.score_key else ()
    return [column for column in state.columns if column not in known]


def _scored_row(
    row: ScoreRow, truth: GroundTruth, scorer: Scorer, prediction: MethodOutput, columns: Sequence[str]
) -> ScoreRow:
    width, height = truth.photo.size
    return replace(
        row,
        scores=scorer.score(prediction, columns),
        columns=tuple(columns),
        seconds=prediction.seconds,
        digest=prediction.digest,
        width=width,
        height=height,
        region_share=scorer.region_share,
    )


def _merged(old: ScoreRow | None, new: ScoreRow) -> ScoreRow:
    """Returns the new row with the scores of an earlier run, if the inputs have not changed."""
    if old is None or old.score_key != new.score_key:
        return new
    seconds = old.seconds if new.seconds is None else new.seconds
    return replace(new, scores=old.scores | new.scores, columns=(*old.columns, *new.columns), seconds=seconds)


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
        for future in futures:
            if not future.cancelled() and not future.exception():
                on_rows(future.result())
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_worker_state: list[_WorkerState] = []  # empty, or with one element in a worker process


def _initialize_worker(state: _WorkerState) -> None:
    # Only the parent process handles Ctrl-C, so that the workers can finish their current case.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    exit_with_parent()
    _worker_state.append(state)


def _score_case_in_worker(task: _ScoringTask) -> list[ScoreRow]:
    with single_torch_thread():
        return _score_case(task, _worker_state[0])
