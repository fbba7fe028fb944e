"""Runs tasks on one machine: in this process, or in several processes.

    with ProcessExecutor(partial(TaskRunner, job), 8) as executor:
        for result in run_tasks(tasks.pop_next, executor):
            print(result)

Each process creates a runner once, and calls it with one task at a time.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from types import TracebackType
from typing import Any, Final, Generic, Protocol, Self, TypeVar, final

from brewster.errors import BrewsterError

ResultT = TypeVar("ResultT")

MAX_ATTEMPTS: Final = 3
"""Maximum number of attempts for a task whose worker dies. After the last attempt, the task fails."""


class Task(Protocol[ResultT]):
    """One or more items that one worker processes. A task must be picklable."""

    def split(self) -> Sequence[Self]:
        """Returns a task for each item."""

    def failed_results(self, reason: str) -> list[ResultT]:
        """Returns the results of a task that no worker could finish."""


Runner = Callable[[Any], list[ResultT]]
"""A function that runs a task and returns its results. If it raises a `BrewsterError`, the run ends."""


class Executor(AbstractContextManager[Any], Protocol[ResultT]):
    """Runs a limited number of tasks at a time.

    If the context is left with an error, the running tasks are stopped. Otherwise, the exit may wait for them, and their
    results are lost.
    """

    chunk_size: int
    """Number of items per task."""

    def has_capacity(self) -> bool:
        """Whether another task can be submitted now."""

    def is_busy(self) -> bool:
        """Whether any task is running."""

    def submit(self, task: Task[ResultT]) -> None:
        """Starts a task."""

    def wait(self) -> Sequence[ResultT]:
        """Waits until a task ends. Returns the results of finished tasks. The list is empty if a task is tried again.

        Raises:
            BrewsterError: raised by the runner.
        """


def run_tasks(
    next_task: Callable[[], Task[ResultT] | None], executor: Executor[ResultT]
) -> Iterator[ResultT]:
    """Runs tasks until there are no more, and yields their results in the order in which the tasks end.

    Args:
        next_task: returns the next task, or None if there is no task before the next result.
        executor: runs the tasks; its context is entered by the caller.

    Raises:
        BrewsterError: raised by the runner.
    """
    while True:
        task = next_task() if executor.has_capacity() else None
        if task:
            executor.submit(task)
        elif executor.is_busy():
            yield from executor.wait()
        else:
            return


# --- this process


@final
class SerialExecutor(Generic[ResultT]):
    """Runs tasks in this process, one at a time."""

    chunk_size = 1

    def __init__(self, create_runner: Callable[[], Runner[ResultT]]) -> None:
        self._create_runner = create_runner
        self._runner: Runner[ResultT] | None = None
        self._task: Task[ResultT] | None = None

    def has_capacity(self) -> bool:
        """Whether no task is stored."""
        return self._task is None

    def is_busy(self) -> bool:
        """Whether a task is stored."""
        return self._task is not None

    def submit(self, task: Task[ResultT]) -> None:
        """Stores the task. `wait` runs it."""
        self._task = task

    def wait(self) -> list[ResultT]:
        """Runs the stored task. Returns its results."""
        task, self._task = self._task, None
        self._runner = self._runner or self._create_runner()
        return self._runner(task) if task else []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Discards the stored task."""
        self._task = None


# --- several processes


@final
@dataclass(frozen=True, eq=False)
class _Worker:
    process: SpawnProcess
    pipe: Connection


@final
class ProcessExecutor(Generic[ResultT]):
    """Runs tasks in several processes, one task in each. If a process dies, another process runs its task again."""

    chunk_size = 1

    def __init__(self, create_runner: Callable[[], Runner[ResultT]], worker_count: int) -> None:
        self._create_runner, self._worker_count = create_runner, worker_count
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, Task[ResultT], int]] = {}

    def has_capacity(self) -> bool:
        """Whether a worker is idle or can be started."""
        return len(self._busy) < self._worker_count

    def is_busy(self) -> bool:
        """Whether any worker has a task."""
        return bool(self._busy)

    def submit(self, task: Task[ResultT]) -> None:
        """Sends the task to a worker."""
        self._assign(task, 1)

    def wait(self) -> list[ResultT]:
        """Returns the results of the next finished task. The list is empty if a worker has died and its task is tried again."""
        pipe = connection.wait(list(self._busy))[0]
        assert isinstance(pipe, Connection)
        worker, task, attempt = self._busy.pop(pipe)
        try:
            results: list[ResultT] | BrewsterError = pipe.recv()
        except (EOFError, OSError):
            return self._handle_dead_worker(worker, task, attempt)
        self._idle.append(worker)
        if isinstance(results, BrewsterError):
            raise results
        return results

    def _assign(self, task: Task[ResultT], attempt: int) -> None:
        worker = self._idle.pop() if self._idle else self._spawn()
        self._busy[worker.pipe] = (worker, task, attempt)
        with suppress(OSError):  # the worker is dead: its pipe is closed, which wait() detects
            worker.pipe.send(task)

    def _spawn(self) -> _Worker:
        context = get_context("spawn")
        parent_end, child_end = context.Pipe()
        process = context.Process(target=_worker_main, args=(child_end, self._create_runner), daemon=True)
        with _interrupts_blocked():
            process.start()
        child_end.close()
        return _Worker(process, parent_end)

    def _handle_dead_worker(self, worker: _Worker, task: Task[ResultT], attempt: int) -> list[ResultT]:
        worker.pipe.close()
        worker.process.join()
        if attempt < MAX_ATTEMPTS:
            self._assign(task, attempt + 1)
            return []
        return task.failed_results(
            f"the worker died {MAX_ATTEMPTS} times (exit code {worker.process.exitcode})"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes all pipes, and waits until the workers exit: at once if they are idle, otherwise after their task.

        After an error, all workers are killed.
        """
        for worker in [*self._idle, *(worker for worker, _, _ in self._busy.values())]:
            worker.pipe.close()
            if error:
                worker.process.kill()
            worker.process.join()
        self._idle.clear()
        self._busy.clear()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Blocks SIGINT in processes started within this block.

    A terminal sends Ctrl-C to all processes of a group, but only the parent process may stop its workers.
    """
    if sys.platform == "win32":  # Windows has no signal masks; _worker_main ignores Ctrl-C as soon as it runs
        yield
        return
    resource_tracker.ensure_running()  # otherwise the tracker starts within this block, and unblocks the signal
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _worker_main(pipe: Connection, create_runner: Callable[[], Runner[Any]]) -> None:
    """The main function of a worker: runs tasks until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # One processor for each worker. The ONNX backend reads this variable. If torch is already imported, the variable has no
    # effect on torch, and the runner limits its threads (see worker_setup.py).
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    exit_with_parent()  # otherwise this worker and a resumed run could work on the same task
    runner: Runner[Any] | None = None
    while True:
        try:
            task = pipe.recv()
        except (EOFError, ConnectionError):  # the parent process has closed the pipe
            return
        try:
            runner = runner or create_runner()
            results: list[Any] | BrewsterError = runner(task)
        except BrewsterError as error:
            results = error
        try:
            pipe.send(results)
        except ConnectionError:  # the parent process has closed the pipe during the task
            return


def exit_with_parent() -> None:
    """Makes this process exit when its parent process ends, even if the parent is killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent:
        parent.join()
        os._exit(1)
