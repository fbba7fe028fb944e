"""Every method answers every case and is scored, in one process or several, resumable.

    rows = score(read_benchmark("nature20", folder), [Nothing(), model], Protocol(), Path("out/evaluate"))

`scores.jsonl` in the folder gains a line for each answer as it is scored; a run that was stopped reads them and goes on.
"""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, final

from brewster.benchmarks.registry import Benchmark, Case
from brewster.errors import BrewsterError, TargetError
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import Method, MethodOutput, refuse_names
from brewster.evaluate.scoring import GroundTruth, Scorer
from brewster.worker_setup import exit_with_parent, single_torch_thread

SCORES: Final = "scores.jsonl"
SCORE_FORMAT: Final = 2
"""Raised when the same answers come to score differently, so that they are scored again; see test_house_formats."""

Report = Callable[[int, int, "ScoreRow"], None]
"""Called with (done, of how many, the row) after every answer that was scored."""

Place = tuple[str, str, str]


@final
@dataclass(frozen=True)
class ScoreRow:
    """What became of one method's answer to one case.

    `key` is a digest of all that the scores depend on, `answer_key` of all that the answer does: where it is equal,
    nothing need be done again. `digest` is the digest of the answer's files, where it lies on the disk.
    """

    benchmark: str
    case: str
    method: str
    answer_key: str
    key: str
    scores: dict[str, float | None] = field(default_factory=dict)
    error: str | None = None
    seconds: float | None = None
    digest: str | None = None
    width: int = 0
    height: int = 0
    region_share: float = 0.0

    @property
    def place(self) -> Place:
        """Benchmark, case and method: where it stands in the results."""
        return self.benchmark, self.case, self.method


@final
@dataclass(frozen=True)
class _ScoringTask:
    """A case, and the rows that are to be filled; `digest` of a row says which answer on the disk is the right one."""

    case: Case
    rows: tuple[ScoreRow, ...]


def score(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    protocol: EvaluationConfig,
    out: Path,
    *,
    workers: int = 1,
    report: Report = lambda _done, _of, _row: None,
) -> list[ScoreRow]:
    """Has every method answer every case and scores the answers; those that `out` knows already are not made again.

    Methods that need the memory for themselves go through all cases one after another, when the others are done.
    A method that fails on a case gives a row with an `error`; the others are scored. Rows come in the order of
    benchmarks, cases and methods, the same for any number of workers.

    Raises:
        BrewsterError: methods' names are shared or unfit, a part of brewster is missing, or a worker died.
        TargetError: `out` cannot be written.
    """
    refuse_names(methods)
    known = _read(out / SCORES)
    cases = {(case.benchmark, case.name): case for part in benchmarks for case in part.cases}
    wanted = [row for case in cases.values() for row in _rows(case, methods, protocol, known)]
    rows = {row.place: known[row.place] for row in wanted if _is_scored(row, known)}
    todo = [row for row in wanted if row.place not in rows]
    exclusive = [method.name for method in methods if method.exclusive]
    tasks = list(_tasks(cases, [row for row in todo if row.method not in exclusive]))
    later = [
        task for name in exclusive for task in _tasks(cases, [row for row in todo if row.method == name])
    ]
    for metric in protocol.columns().values() if todo else ():
        if metric.prepare:  # here, once: weights may have to be fetched, or be missing
            metric.prepare()
    log = _Log(out / SCORES)

    def take(made: Sequence[ScoreRow]) -> None:
        for row in made:
            log.write(row)
            rows[row.place] = row
            report(len(rows), len(wanted), row)

    _run(tasks, methods, protocol, take, workers)
    _run(later, methods, protocol, take, 1)
    return [rows[row.place] for row in wanted]


def _rows(
    case: Case, methods: Sequence[Method], protocol: EvaluationConfig, known: Mapping[Place, ScoreRow]
) -> Iterator[ScoreRow]:
    """Rows without scores; their keys are digests of all that they depend on."""
    photo, *truths = (
        hashlib.sha256(file.read()).hexdigest() if file else ""
        for file in (case.photo, case.transmission, case.reflection)
    )
    asked = asdict(protocol) | {"paper": None, "quality": None}
    for method in methods:
        answer_key = _digest(photo, protocol.size, method.key(case))
        key = _digest(answer_key, truths, asked, case.rendered, SCORE_FORMAT)
        row = ScoreRow(case.benchmark, case.name, method.name, answer_key, key)
        before = known.get(row.place)
        is_answered = before and before.answer_key == answer_key
        yield replace(row, digest=before.digest) if before and is_answered else row


def _tasks(cases: Mapping[tuple[str, str], Case], todo: Sequence[ScoreRow]) -> Iterator[_ScoringTask]:
    """Case by case."""
    for place, rows in groupby(todo, lambda row: row.place[:2]):
        yield _ScoringTask(cases[place], tuple(rows))


def _is_scored(row: ScoreRow, known: Mapping[Place, ScoreRow]) -> bool:
    return row.place in known and known[row.place].key == row.key


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


# --- one case


def _do(task: _ScoringTask, methods: Mapping[str, Method], protocol: EvaluationConfig) -> list[ScoreRow]:
    """Scores all answers to a case."""
    try:
        truth = GroundTruth.open(task.case, protocol)
    except BrewsterError as error:
        return [replace(row, error=f"{row.benchmark}/{row.case}: {error}") for row in task.rows]
    judge = Scorer(truth, protocol)
    return [_scored(row, truth, judge, methods[row.method]) for row in task.rows]


def _scored(row: ScoreRow, truth: GroundTruth, judge: Scorer, method: Method) -> ScoreRow:
    try:
        answer = find_answer(truth, method, row)
        truth.check(answer, method.name)
    except BrewsterError as error:
        return _failed(row, str(error))
    except Exception as error:  # noqa: BLE001  (a model that stumbles over one picture must not stop the others)
        return _failed(row, f"{type(error).__name__}: {error}")
    width, height = truth.photo.size
    return replace(
        row,
        scores=judge.score(answer),
        seconds=answer.seconds,
        digest=answer.digest,
        width=width,
        height=height,
        region_share=judge.region_share,
    )


def find_answer(truth: GroundTruth, method: Method, row: ScoreRow) -> MethodOutput:
    """The answer that lies on the disk, if it is the one that the row knows; else a new one.

    Raises:
        BrewsterError: what the method raises.
    """
    kept = method.cached(truth.case) if row.digest else None
    return kept if kept and kept.digest == row.digest else method.answer(truth.case, truth.photo)


def _failed(row: ScoreRow, error: str) -> ScoreRow:
    return replace(row, error=f"{row.method} failed on {row.benchmark}/{row.case}: {error}")


# --- all cases

Take = Callable[[Sequence[ScoreRow]], None]


def _run(
    tasks: Sequence[_ScoringTask],
    methods: Sequence[Method],
    protocol: EvaluationConfig,
    take: Take,
    workers: int,
) -> None:
    """Does the tasks here, or in so many processes, and hands their rows over as they come.

    Each process uses one thread for metrics, so that all give equal numbers.
    """
    named = {method.name: method for method in methods}
    if workers == 1:
        with single_torch_thread():
            for task in tasks:
                take(_do(task, named, protocol))
        return
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (named, protocol))
    waiting = {pool.submit(_do_here, task) for task in tasks}
    try:
        for future in as_completed(set(waiting)):
            waiting.remove(future)
            take(future.result())
    except BrokenProcessPool as error:
        raise BrewsterError(
            "a worker process died",
            "it was killed, or out of memory",
            "run again with fewer workers: scores are kept",
        ) from error
    except KeyboardInterrupt:
        pool.shutdown(cancel_futures=True)
        for rows in _finished(waiting):
            take(rows)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _finished(futures: set[Future[list[ScoreRow]]]) -> Iterator[list[ScoreRow]]:
    return (future.result() for future in futures if not future.cancelled() and not future.exception())


_process: dict[str, Any] = {}


def _begin(methods: dict[str, Method], protocol: EvaluationConfig) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which lets a case be finished
    exit_with_parent()
    _process.update(methods=methods, protocol=protocol)


def _do_here(task: _ScoringTask) -> list[ScoreRow]:
    with single_torch_thread():
        return _do(task, _process["methods"], _process["protocol"])


# --- the log


@final
class _Log:
    """The file that a stopped run goes on from; it is made with the first row."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, row: ScoreRow) -> None:
        """Adds a line.

        Raises:
            TargetError: it cannot be written.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("ab+") as file:
                file.write(self._separator(file) + json.dumps(asdict(row)).encode() + b"\n")
        except OSError as error:
            raise TargetError(
                f"{self._path} was not written ({error.strerror or error})",
                "a run needs a folder of its own",
                "free some space or name another folder with -o, and run again: what is scored is kept",
            ) from error

    def _separator(self, file: Any) -> bytes:  # noqa: ANN401  (what open gives)
        """A killed run may have left half a line."""
        if not file.seek(0, 2):
            return b""
        file.seek(-1, 2)
        return b"" if file.read(1) == b"\n" else b"\n"


def _read(path: Path) -> dict[Place, ScoreRow]:
    """The last row of earlier runs at each place; failures, half lines and lines of other versions are passed over."""
    rows = {}
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        try:
            row = ScoreRow(**json.loads(line))
        except (ValueError, TypeError):
            continue
        if not row.error:
            rows[row.place] = row
    return rows
