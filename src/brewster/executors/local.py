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
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Final, Generic, Protocol, Self, TypeVar, final

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
class ProcessExecutor(Generic[ResultT]):
    """Runs tasks in several processes, one task in each. If a process dies, another process runs its task again.

    Each process is a pool of its own, because the death of one breaks its whole pool.
    """

    chunk_size = 1

    def __init__(self, create_runner: Callable[[], Runner[ResultT]], worker_count: int) -> None:
        self._create_runner, self._worker_count = create_runner, worker_count
        self._processes: dict[ProcessPoolExecutor, BaseProcess] = {}
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[list[ResultT]], tuple[ProcessPoolExecutor, Task[ResultT], int]] = {}

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
        future = next(iter(wait(self._busy, return_when=FIRST_COMPLETED).done))
        pool, task, attempt = self._busy.pop(future)
        try:
            results = future.result()
        except BrokenProcessPool:
            exit_code = self._processes.pop(pool).exitcode
            if attempt < MAX_ATTEMPTS:
                self._assign(task, attempt + 1)
                return []
            return task.failed_results(f"the worker died {MAX_ATTEMPTS} times (exit code {exit_code})")
        self._idle.append(pool)
        return results

    def _assign(self, task: Task[ResultT], attempt: int) -> None:
        others = active_children()
        with _interrupts_blocked():  # the first task starts the process
            pool = self._idle.pop() if self._idle else self._new_pool()
            try:
                future = pool.submit(_run_task, self._create_runner, task)
            except BrokenProcessPool:  # the process died while it was idle
                self._processes.pop(pool)
                pool = self._new_pool()
                future = pool.submit(_run_task, self._create_runner, task)
        for process in active_children():
            if process not in others:
                self._processes[pool] = process
        self._busy[future] = (pool, task, attempt)

    def _new_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, get_context("spawn"), _start_worker)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Waits until the workers exit: at once if they are idle, otherwise after their task.

        After an error, all workers are killed.
        """
        for pool, process in self._processes.items():
            if error:
                process.kill()
            pool.shutdown()
        self._processes.clear()
        self._idle.clear()
        self._busy.clear()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Blocks SIGINT in processes started within this block.

    A terminal sends Ctrl-C to all processes of a group, but only the parent process may stop its workers.
    """
    if sys.platform == "win32":  # Windows has no signal masks; _start_worker ignores Ctrl-C
        yield
        return
    resource_tracker.ensure_running()  # otherwise the tracker starts within this block, and unblocks the signal
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # One processor for each worker. The ONNX backend reads this variable. If torch is already imported, the variable has no
    # effect on torch, and the runner limits its threads (see worker_setup.py).
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    exit_with_parent()  # otherwise this worker and a resumed run could work on the same task


_runner: Runner[Any] | None = None
"""The runner of a worker, which is created for its first task."""


def _run_task(create_runner: Callable[[], Runner[Any]], task: Task[Any]) -> list[Any]:
    global _runner  # noqa: PLW0603  (a worker process has one runner)
    _runner = _runner or create_runner()
    return _runner(task)


def exit_with_parent() -> None:
    """Makes this process exit when its parent process ends, even if the parent is killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent:
        parent.join()
        os._exit(1)
