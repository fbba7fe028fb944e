"""Runs render tasks on one machine: in this process, or in several processes.

Every process uses one torch thread. With several threads, the order of sums depends on the number of cores, and so do the
bytes of a sample.
"""

from __future__ import annotations

import importlib
import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import TracebackType
from typing import Final, Self, final

from brewster.environments.assets import Assets
from brewster.errors import BrewsterError, RecipeError, TargetError
from brewster.render.sample import LinearSample
from brewster.rendered import store
from brewster.rendered.generation.job import FATAL_ERRORS, RenderJob, RenderResult, RenderTask
from brewster.scene.sampler import draw
from brewster.scene.scene import Scene, read_scene
from brewster.worker_setup import exit_with_parent, single_torch_thread

Renderer = Callable[[Scene, Assets], LinearSample]

RENDERERS: Final = {
    "analytic": "brewster.render.analytic:render",
    "mitsuba": "brewster.render.mitsuba.renderer:trace",
}
"""Name of a renderer -> its module and function."""

MAX_ATTEMPTS: Final = 3
"""Maximum number of workers that may die at the same task. Then the task fails."""


@final
class TaskRunner:
    """Runs the tasks of a job in this process. Errors become results with the status "failed"."""

    def __init__(self, job: RenderJob) -> None:
        self._job, self._assets = job, Assets(job.folders)

    def __call__(self, task: RenderTask) -> list[RenderResult]:
        """Runs a task. Returns the results of all samples; for packing, only those of failures."""
        if task.kind == "render":
            return [self._attempt(index, lambda index=index: self._render(index)) for index in task.indices]  # type: ignore[misc]
        results = [
            self._attempt(block * store.SHARD_SIZE, lambda block=block: store.pack(self._job.out, block))  # type: ignore[misc]
            for block in task.indices
        ]
        return [result for result in results if result.error]

    def _render(self, index: int) -> None:
        folder = self._job.out / store.key(index)
        if not folder.is_dir():  # a worker that died may have finished a part of the task
            scene = draw(self._job.recipe, self._job.catalog, self._job.seed, index)
            sample = find_renderer(self._job.renderer)(scene, self._assets)
            store.write_folder(folder, store.encode_sample(sample, self._job.renderer))

    def _attempt(self, index: int, work: Callable[[], None]) -> RenderResult:
        started = time.perf_counter()
        try:
            work()
        except BrewsterError as error:
            fatal = error if isinstance(error, FATAL_ERRORS) else None
            return RenderResult(index, "failed", error=str(error), kind=type(error).__name__, fatal=fatal)
        except MemoryError:
            return RenderResult(
                index,
                "failed",
                error="the sample does not fit into memory; use fewer --workers",
                kind="MemoryError",
            )
        except Exception as bug:  # noqa: BLE001  (a bug in one sample must not end the run)
            message = f"internal error ({type(bug).__name__}: {bug}); please report it"
            return RenderResult(index, "failed", error=message, kind=type(bug).__name__)
        return RenderResult(index, "rendered", time.perf_counter() - started)


def find_renderer(name: str) -> Renderer:
    """Imports a renderer by its name in RENDERERS, or by "module:function"."""
    module, _, function = RENDERERS.get(name, name).partition(":")
    renderer: Renderer = getattr(importlib.import_module(module), function)
    return renderer


def render_again(path: Path, folder: Path, folders: Sequence[Path] = (), renderer: str | None = None) -> None:
    """Renders a scene file into a new folder, by default with the renderer that is recorded in the file.

    Raises:
        RecipeError: the scene cannot be read, or a file of the scene is missing.
        TargetError: the folder is not empty, or cannot be written.
    """
    scene = read_scene(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise TargetError(
            f"{folder} exists", "expected a new or empty folder", "choose another folder with -o"
        )
    chosen = renderer or _recorded_renderer(path)
    with single_torch_thread():
        sample = find_renderer(chosen)(scene, Assets(folders))
        store.write_folder(folder, store.encode_sample(sample, chosen))


def _recorded_renderer(path: Path) -> str:
    """Returns the renderer that is recorded in a scene file. It must be in RENDERERS, so that a file cannot run other code."""
    name = tomllib.loads(path.read_text("utf-8")).get("outcome", {}).get("renderer", "analytic")
    if name not in RENDERERS:
        raise RecipeError(
            f"{path} was rendered by {name!r}",
            f"expected one of {', '.join(RENDERERS)}",
            "choose a renderer with --renderer",
        )
    return str(name)


# --- this process


@final
class SerialExecutor:
    """Runs tasks in this process, one at a time."""

    chunk_size = 1

    def __init__(self, job: RenderJob) -> None:
        self._runner, self._threads = TaskRunner(job), single_torch_thread()
        self._task: RenderTask | None = None

    def has_capacity(self) -> bool:
        """Whether no task is stored."""
        return self._task is None

    def is_busy(self) -> bool:
        """Whether a task is stored."""
        return self._task is not None

    def submit(self, task: RenderTask) -> None:
        """Stores the task. `wait` runs it."""
        self._task = task

    def wait(self) -> list[RenderResult]:
        """Runs the stored task. Returns its results."""
        task, self._task = self._task, None
        return self._runner(task) if task else []

    def __enter__(self) -> Self:
        self._threads.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._threads.__exit__(kind, error, trace)


# --- several processes


@final
@dataclass(frozen=True, eq=False)
class _Worker:
    process: SpawnProcess
    pipe: Connection


@final
class ProcessExecutor:
    """Runs tasks in several processes, one task in each. If a process dies, another one runs its task again."""

    chunk_size = 1

    def __init__(self, job: RenderJob, count: int) -> None:
        self._job, self._count = job, count
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, RenderTask, int]] = {}

    def has_capacity(self) -> bool:
        """Whether a worker is idle or can be started."""
        return len(self._busy) < self._count

    def is_busy(self) -> bool:
        """Whether any worker has a task."""
        return bool(self._busy)

    def submit(self, task: RenderTask) -> None:
        """Sends the task to a worker."""
        self._assign(task, 1)

    def wait(self) -> list[RenderResult]:
        """Returns the results of the next finished task; none if a worker has died and its task is tried again."""
        pipe = connection.wait(list(self._busy))[0]
        assert isinstance(pipe, Connection)
        worker, task, attempt = self._busy.pop(pipe)
        try:
            results: list[RenderResult] = pipe.recv()
        except (EOFError, OSError):
            return self._handle_dead_worker(worker, task, attempt)
        self._idle.append(worker)
        return results

    def _assign(self, task: RenderTask, attempt: int) -> None:
        worker = self._idle.pop() if self._idle else self._spawn()
        self._busy[worker.pipe] = (worker, task, attempt)
        with suppress(OSError):  # the worker is dead: its pipe is closed, which wait() detects
            worker.pipe.send(task)

    def _spawn(self) -> _Worker:
        context = get_context("spawn")
        parent_end, child_end = context.Pipe()
        process = context.Process(target=_worker_main, args=(child_end, self._job), daemon=True)
        with _interrupts_blocked():
            process.start()
        child_end.close()
        return _Worker(process, parent_end)

    def _handle_dead_worker(self, worker: _Worker, task: RenderTask, attempt: int) -> list[RenderResult]:
        worker.pipe.close()
        worker.process.join()
        if attempt < MAX_ATTEMPTS:
            self._assign(task, attempt + 1)
            return []
        return task.failed_results(
            f"its worker died {MAX_ATTEMPTS} times (exit code {worker.process.exitcode})"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes all pipes. Idle workers exit when their pipe closes. After an error, all workers are killed."""
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
    resource_tracker.ensure_running()  # otherwise it starts within this block, and unblocks the signal
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _worker_main(pipe: Connection, job: RenderJob) -> None:
    """Main function of a worker: runs tasks until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    exit_with_parent()  # otherwise it and a resumed run could render the same sample
    runner = TaskRunner(job)
    with single_torch_thread(), suppress(EOFError):
        while True:
            pipe.send(runner(pipe.recv()))
