"""Benchmarks times methods: every case answered and scored, in one process or several, resumable.

    results = evaluate(read_benchmark("nature20", folder), [Nothing(), model], Protocol(), Path("out/evaluate"))

`scores.jsonl` in the folder gains a line for each answer as it is scored; a run that was stopped reads them and goes on.
`results.json` is made from them at the end: the same for any number of workers and any order of work.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, final

from brewster.dataset.benchmarks import Benchmark, Case
from brewster.errors import BrewsterError, TargetError
from brewster.evaluate.judge import Judge, Truth
from brewster.evaluate.methods import Answer, Method, refuse_shared_names
from brewster.evaluate.protocol import Protocol
from brewster.metrics import Lpips

SCORES: Final = "scores.jsonl"

Report = Callable[[int, int, "Row"], None]
"""Called with (done, of how many, the row) after every answer that was scored."""


@final
@dataclass(frozen=True)
class Row:
    """What became of one method's answer to one case.

    `key` is a digest of all that the scores depend on, `answer_key` of all that the answer does: where it is equal,
    nothing need be done again.
    """

    benchmark: str
    case: str
    method: str
    answer_key: str
    key: str
    scores: dict[str, float | None] = field(default_factory=dict)
    error: str | None = None
    seconds: float | None = None
    width: int = 0
    height: int = 0
    region_share: float = 0.0

    @property
    def place(self) -> tuple[str, str, str]:
        """Benchmark, case and method: where it stands in the results."""
        return self.benchmark, self.case, self.method


@final
@dataclass(frozen=True)
class _Task:
    """A case, and the methods whose answers to it are to be scored."""

    case: Case
    rows: tuple[Row, ...]
    answered: frozenset[str]
    """The methods whose answers are kept on the disk, from an earlier run that asked for other metrics."""


def score(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    protocol: Protocol,
    out: Path,
    *,
    workers: int = 1,
    report: Report = lambda _done, _of, _row: None,
) -> list[Row]:
    """Has every method answer every case and scores the answers; those that `out` knows already are not made again.

    A method that fails on a case gives a row with an `error`; the others are scored. Rows come in the order of
    benchmarks, cases and methods.

    Raises:
        BrewsterError: two methods or benchmarks share a name, or a part of brewster is missing.
        TargetError: `out` cannot be written.
    """
    refuse_shared_names(methods)
    cases = {(case.benchmark, case.name): case for part in benchmarks for case in part.cases}
    wanted = [_row(case, method, protocol) for case in cases.values() for method in methods]
    known = _read(out / SCORES)
    rows = {
        row.place: known[row.place]
        for row in wanted
        if row.place in known and known[row.place].key == row.key
    }
    tasks = [
        _Task(cases[place], todo, frozenset(row.method for row in todo if _is_answered(row, known)))
        for place, group in groupby(wanted, lambda row: row.place[:2])
        if (todo := tuple(row for row in group if row.place not in rows))
    ]
    if tasks and any(name.startswith("lpips") for name in protocol.metrics):
        Lpips.load()  # here, once: its weights may have to be fetched, or be missing
    with _log(out) as log, _workers(workers, methods, protocol) as run:
        for made in run(tasks):
            for row in made:
                log(row)
                rows[row.place] = row
                report(len(rows), len(wanted), row)
    return [rows[row.place] for row in wanted]


def _is_answered(row: Row, known: Mapping[tuple[str, str, str], Row]) -> bool:
    return row.place in known and known[row.place].answer_key == row.answer_key


def _row(case: Case, method: Method, protocol: Protocol) -> Row:
    """A row without scores; its keys are digests of all that they depend on."""
    photo, *truths = (
        hashlib.sha256(file.read()).hexdigest() if file else ""
        for file in (case.photo, case.transmission, case.reflection)
    )
    answer_key = _digest(photo, protocol.size, method.key(case))
    asked = asdict(protocol) | {"paper": None, "quality": None}
    return Row(
        benchmark=case.benchmark,
        case=case.name,
        method=method.name,
        answer_key=answer_key,
        key=_digest(answer_key, truths, asked, case.rendered),
    )


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


# --- the work


def _do(task: _Task, methods: dict[str, Method], protocol: Protocol) -> list[Row]:
    """Scores one case."""
    try:
        truth = Truth.open(task.case, protocol)
        judge = Judge(truth, protocol)
    except BrewsterError as error:
        return [_failed(row, error) for row in task.rows]
    return [_scored(row, truth, judge, methods[row.method], row.method in task.answered) for row in task.rows]


def _scored(row: Row, truth: Truth, judge: Judge, method: Method, is_kept: bool) -> Row:
    try:
        answer = _answer(truth, method, is_kept)
        truth.check(answer, method.name)
    except BrewsterError as error:
        return _failed(row, error)
    except Exception as error:  # noqa: BLE001  (a model that stumbles over one picture must not stop the others)
        return _failed(
            row, f"{method.name} failed on {row.benchmark}/{row.case}: {type(error).__name__}: {error}"
        )
    width, height = truth.photo.size
    return _with(
        row,
        scores=judge.score(answer),
        seconds=answer.seconds,
        width=width,
        height=height,
        region_share=judge.region_share,
    )


def _answer(truth: Truth, method: Method, is_kept: bool) -> Answer:
    kept = method.kept(truth.case) if is_kept else None
    return kept or method.answer(truth.case, truth.photo)


def _failed(row: Row, error: object) -> Row:
    return _with(row, error=str(error))


def _with(row: Row, **changes: Any) -> Row:  # noqa: ANN401  (fields of Row)
    return Row(**{**asdict(row), **changes})


# --- processes

Run = Callable[[Sequence[_Task]], Iterator[list[Row]]]


@contextmanager
def _workers(count: int, methods: Sequence[Method], protocol: Protocol) -> Iterator[Run]:
    """Runs tasks here, or in so many processes; each uses one thread for metrics, so that all give equal numbers."""
    named = {method.name: method for method in methods}
    if count == 1:
        with _one_thread():
            yield lambda tasks: (_do(task, named, protocol) for task in tasks)
        return
    with ProcessPoolExecutor(count, get_context("spawn"), _begin, (named, protocol)) as pool:

        def run(tasks: Sequence[_Task]) -> Iterator[list[Row]]:
            futures = [pool.submit(_do_here, task) for task in tasks]
            try:
                yield from (future.result() for future in as_completed(futures))
            finally:
                pool.shutdown(wait=False, cancel_futures=True)

        yield run


_process: dict[str, Any] = {}


def _begin(methods: dict[str, Method], protocol: Protocol) -> None:
    _process.update(methods=methods, protocol=protocol)


def _do_here(task: _Task) -> list[Row]:
    with _one_thread():
        return _do(task, _process["methods"], _process["protocol"])


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch sums in another order with more threads."""
    try:
        import torch  # noqa: PLC0415  (PSNR and SSIM do without it)
    except ImportError:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# --- the log


@contextmanager
def _log(out: Path) -> Iterator[Callable[[Row], None]]:
    """Adds rows to the log; each is on its way to the disk before the next."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with (out / SCORES).open("a") as file:
            if file.tell() and not (out / SCORES).read_bytes().endswith(b"\n"):
                file.write("\n")  # a killed run may have left half a line

            def log(row: Row) -> None:
                file.write(json.dumps(asdict(row)) + "\n")
                file.flush()

            yield log
            os.fsync(file.fileno())
    except OSError as error:
        raise TargetError(
            f"{out / SCORES} was not written ({error.strerror or error})",
            "a run needs a folder of its own",
            "free some space or name another folder with -o, and run again: what is scored is kept",
        ) from error


def _read(path: Path) -> dict[tuple[str, str, str], Row]:
    """The last row of earlier runs at each place; failures, half lines and lines of other versions are passed over."""
    rows = {}
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            row = Row(**json.loads(line))
        except (ValueError, TypeError):
            continue
        if not row.error:
            rows[row.place] = row
    return rows
