"""Runs tasks on one machine: in this process, or in several processes.

    with ProcessExecutor(partial(TaskRunner, job), 8) as executor:
        for result in run_tasks(tasks.pop_next, executor):
            print(result)

Each process creates a runner once, and calls it with one task at a time.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from typing import Any, Final, Protocol, TypeVar, final

ResultT = TypeVar("ResultT")

MAX_ATTEMPTS: Final = 3
"""Maximum number of attempts for a task whose worker dies. After the last attempt, the task fails.
"""


class Task(Protocol[ResultT]):
    """What one worker processes at a time. A task must be picklable."""

    def failed_results(self, reason: str) -> list[ResultT]:
        """Returns the results of a task that no worker could finish."""


Runner = Callable[[Any], list[ResultT]]
"""A function that runs a task and returns its results. If it raises a `BrewsterError`, the run
ends.
"""


class Executor(AbstractContextManager[Any], Protocol[ResultT]):
    """Starts tasks. `run_tasks` waits for them, and starts those again whose worker was lost.

    If the context is left with an error, the running tasks are stopped. Otherwise, the exit may
    wait for them, and their results are lost.
    """

    attempts: int = 1
    """How often `run_tasks` starts a task whose worker is lost."""

    def capacity(self) -> int:
        """The number of tasks that may run now."""

    def start(self, task: Task[ResultT]) -> Future[list[ResultT]]:
        """Starts a task, and returns its results."""

    def lost_reason(self, error: Exception) -> str:
        """Returns how the worker was lost, or raises the exception if it is that of the runner."""


def run_tasks(
    next_task: Callable[[], Task[ResultT] | list[ResultT] | None], executor: Executor[ResultT]
) -> Iterator[ResultT]:
    """Runs tasks until there are no more, and yields their results in the order in which the tasks
    end.

    `next_task` returns the next task, or the results of a task that needs no worker, or None if
    there is no task before the next result. Raises the errors of the runner.
    """
    running: dict[Future[list[ResultT]], tuple[Task[ResultT], int]] = {}
    while True:
        while len(running) < executor.capacity() and (task := next_task()):
            if isinstance(task, list):
                yield from task
            else:
                running[executor.start(task)] = task, 1
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task, attempt = running.pop(future)
            try:
                results = future.result()
            except Exception as error:  # noqa: BLE001  (raised again if no worker was lost)
                reason = executor.lost_reason(error)
                results = []
                if attempt < executor.attempts:
                    running[executor.start(task)] = task, attempt + 1
                else:
                    results = task.failed_results(reason)
            yield from results


@final
class SerialExecutor(Executor[ResultT]):
    """Runs tasks in this process, one at a time."""

    def __init__(self, create_runner: Callable[[], Runner[ResultT]]) -> None:
        self._create_runner = create_runner
        self._runner: Runner[ResultT] | None = None

    def capacity(self) -> int:
        """One task."""
        return 1

    def start(self, task: Task[ResultT]) -> Future[list[ResultT]]:
        """Runs a task. Its exceptions are raised at once."""
        self._runner = self._runner or self._create_runner()
        future: Future[list[ResultT]] = Future()
        future.set_result(self._runner(task))
        return future

    def lost_reason(self, error: Exception) -> str:
        """Raises the exception: there is no worker."""
        raise error

    def __exit__(self, *_: object) -> None:
        """Does nothing."""


@final
class ProcessExecutor(Executor[ResultT]):
    """Runs tasks in several processes, one task in each. If a process dies, another process runs
    its task again.

    Each process is a pool of its own, because the death of one breaks its whole pool.
    """

    attempts = MAX_ATTEMPTS

    def __init__(self, create_runner: Callable[[], Runner[ResultT]], worker_count: int) -> None:
        self._create_runner = create_runner
        self._worker_count = worker_count
        self._processes: dict[ProcessPoolExecutor, BaseProcess] = {}
        self._idle: list[ProcessPoolExecutor] = []
        self._broken: list[ProcessPoolExecutor] = []

    def capacity(self) -> int:
        """One task for each worker."""
        return self._worker_count

    def start(self, task: Task[ResultT]) -> Future[list[ResultT]]:
        """Sends the task to an idle worker, or to a new one."""
        others = active_children()
        with _interrupts_blocked():  # the first task starts the process
            new = (
                None if self._idle else ProcessPoolExecutor(1, get_context("spawn"), _start_worker)
            )
            pool = new or self._idle.pop()
            try:
                future = pool.submit(run_in_worker, self._create_runner, task)
            except BrokenProcessPool:  # the process died while it was idle
                self._processes.pop(pool)
                return self.start(task)
        for process in active_children():
            if process not in others:
                self._processes[pool] = process

        def release(future: Future[list[ResultT]]) -> None:
            """Keeps the pool for the next task. Called in a thread of the pool when its task
            ends.
            """
            is_broken = isinstance(future.exception(), BrokenProcessPool)
            (self._broken if is_broken else self._idle).append(pool)

        future.add_done_callback(release)
        return future

    def lost_reason(self, error: Exception) -> str:
        """Returns the exit code of the worker that died."""
        if not isinstance(error, BrokenProcessPool):
            raise error
        pool = self._broken.pop()
        pool.shutdown()
        return (
            f"the worker died {self.attempts} times (exit code "
            f"{self._processes.pop(pool).exitcode})"
        )

    def __exit__(self, _kind: object, error: object, _trace: object) -> None:
        """Waits until the workers exit: at once if they are idle, or after their task. After an
        error, kills them.
        """
        for pool, process in self._processes.items():
            if error:
                process.kill()
            pool.shutdown()
        self._processes.clear()
        self._idle.clear()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Blocks Ctrl-C in processes that start within this block, because only the parent process may
    stop its workers.
    """
    if sys.platform == "win32":  # Windows has no signal masks; _start_worker ignores Ctrl-C
        yield
        return
    # Otherwise the tracker starts within this block, and unblocks the signal
    resource_tracker.ensure_running()
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # One processor for each worker: the ONNX backend reads this variable, and torch, if it is not
    # imported yet; else the runner limits its threads with `single_torch_thread`.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Otherwise this worker and a resumed run could work on the same task
    threading.Thread(target=_exit_with_parent, daemon=True).start()


_runner: Runner[Any] | None = None
"""The runner of a worker, which is created for its first task."""


def run_in_worker(create_runner: Callable[[], Runner[Any]], task: Task[Any]) -> list[Any]:
    """Runs a task in this process with its runner, which is created for the first task: a model is
    read once.
    """
    global _runner  # noqa: PLW0603  (a worker process has one runner)
    _runner = _runner or create_runner()
    return _runner(task)


def _exit_with_parent() -> None:
    """Waits until the parent process ends, even if it is killed, and then ends this process."""
    if parent := parent_process():
        parent.join()
        os._exit(1)


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Limits torch to one thread in the block, because rounding errors of sums depend on the number
    of threads.
    """
    import torch  # noqa: PLC0415  (slow to import, and needed here only)

    previous_count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(previous_count)
