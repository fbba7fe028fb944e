"""Who renders a set: this process, or several of them, each with one thread, each writing what it has made.

One thread each: torch sums in another order with more, and the bytes of a sample would depend on the machine.
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
from brewster.render.sample import LightSample
from brewster.rendered import store
from brewster.rendered.generation.job import FATAL, RenderJob, RenderResult, RenderTask
from brewster.scene.sampler import draw
from brewster.scene.scene import Scene, read_scene
from brewster.worker_setup import end_with_parent, one_thread

Renderer = Callable[[Scene, Assets], LightSample]

RENDERERS: Final = {
    "analytic": "brewster.render.analytic:render",
    "mitsuba": "brewster.render.mitsuba.renderer:trace",
}
"""What makes a sample of a scene -> the module and function that do it."""

MAX_ATTEMPTS: Final = 3
"""How often a task may cost a worker its life before it is given up."""


@final
class TaskRunner:
    """Does the tasks of a job, one after another; what fails becomes a result."""

    def __init__(self, job: RenderJob) -> None:
        self._job, self._assets = job, Assets(job.folders)

    def __call__(self, task: RenderTask) -> list[RenderResult]:
        """The results of rendering; packing has none unless it fails."""
        if task.kind == "render":
            return [self._attempt(index, lambda index=index: self._render(index)) for index in task.indices]  # type: ignore[misc]
        tried = [
            self._attempt(block * store.SHARD_SIZE, lambda block=block: store.pack(self._job.out, block))  # type: ignore[misc]
            for block in task.indices
        ]
        return [result for result in tried if result.error]

    def _render(self, index: int) -> None:
        folder = self._job.out / store.key(index)
        if not folder.is_dir():  # a task that is tried again may be half done
            scene = draw(self._job.recipe, self._job.catalog, self._job.seed, index)
            sample = find_renderer(self._job.renderer)(scene, self._assets)
            store.write_folder(folder, store.encode_sample(sample, self._job.renderer))

    def _attempt(self, index: int, work: Callable[[], None]) -> RenderResult:
        started = time.perf_counter()
        try:
            work()
        except BrewsterError as error:
            fatal = error if isinstance(error, FATAL) else None
            return RenderResult(index, "failed", error=str(error), kind=type(error).__name__, fatal=fatal)
        except MemoryError:
            return RenderResult(
                index, "failed", error="it does not fit into memory; use fewer --workers", kind="MemoryError"
            )
        except Exception as bug:  # noqa: BLE001  (one sample must not cost the others)
            message = f"brewster stumbled ({type(bug).__name__}: {bug}); please report it"
            return RenderResult(index, "failed", error=message, kind=type(bug).__name__)
        return RenderResult(index, "rendered", time.perf_counter() - started)


def find_renderer(name: str) -> Renderer:
    """A renderer by its name in RENDERERS, or as "module:function"."""
    module, _, function = RENDERERS.get(name, name).partition(":")
    found: Renderer = getattr(importlib.import_module(module), function)
    return found


def render_again(path: Path, folder: Path, folders: Sequence[Path] = (), renderer: str | None = None) -> None:
    """Renders a scene file into a folder of its own, by the renderer that it names unless one is given.

    Raises:
        RecipeError: the scene cannot be read, or a file that it needs is missing.
        TargetError: the folder holds something already, or cannot be written.
    """
    scene = read_scene(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise TargetError(f"{folder} is taken", "nothing is overwritten unasked", "name a new folder with -o")
    chosen = renderer or _recorded_renderer(path)
    with one_thread():
        sample = find_renderer(chosen)(scene, Assets(folders))
        store.write_folder(folder, store.encode_sample(sample, chosen))


def _recorded_renderer(path: Path) -> str:
    """The renderer that a scene file names; one of ours, as a file may not choose what code is run."""
    name = tomllib.loads(path.read_text("utf-8")).get("outcome", {}).get("renderer", "analytic")
    if name not in RENDERERS:
        raise RecipeError(
            f"{path} was rendered by {name!r}", f"one of {', '.join(RENDERERS)}", "choose it with --renderer"
        )
    return str(name)


# --- this process


@final
class SerialExecutor:
    """Runs tasks in this process."""

    chunk = 1

    def __init__(self, job: RenderJob) -> None:
        self._runner, self._threads = TaskRunner(job), one_thread()
        self._task: RenderTask | None = None

    def has_capacity(self) -> bool:
        """Whether nothing is to do."""
        return self._task is None

    def is_busy(self) -> bool:
        """Whether something is to do."""
        return self._task is not None

    def submit(self, task: RenderTask) -> None:
        """Keeps the task until somebody waits for it."""
        self._task = task

    def wait(self) -> list[RenderResult]:
        """Does the task."""
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
    """Processes that do one task at a time; one that dies is replaced, and its task is tried again."""

    chunk = 1

    def __init__(self, job: RenderJob, count: int) -> None:
        self._job, self._count = job, count
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, RenderTask, int]] = {}

    def has_capacity(self) -> bool:
        """Whether a worker is idle, or could still be hired."""
        return len(self._busy) < self._count

    def is_busy(self) -> bool:
        """Whether any worker works."""
        return bool(self._busy)

    def submit(self, task: RenderTask) -> None:
        """Gives the task to a worker."""
        self._assign(task, 1)

    def wait(self) -> list[RenderResult]:
        """The results of the next worker that is done; none if it died and another one tries."""
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
        with suppress(OSError):  # it is dead: its pipe ends, which wait() will notice
            worker.pipe.send(task)

    def _spawn(self) -> _Worker:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_worker_main, args=(theirs, self._job), daemon=True)
        with _interrupts_blocked():
            process.start()
        theirs.close()
        return _Worker(process, ours)

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
        """Idle workers go home when their pipe ends; others are stopped in what they do."""
        for worker in [*self._idle, *(worker for worker, _, _ in self._busy.values())]:
            worker.pipe.close()
            if error:
                worker.process.kill()
            worker.process.join()
        self._idle.clear()
        self._busy.clear()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Processes started here never see Ctrl-C, which a terminal sends to all: who started them will stop them."""
    if sys.platform == "win32":  # it has no signal masks; _worker_main ignores Ctrl-C as soon as it runs
        yield
        return
    resource_tracker.ensure_running()  # or it would start below, and lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _worker_main(pipe: Connection, job: RenderJob) -> None:
    """A worker's life: tasks until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()  # the next run may be at the same sample
    runner = TaskRunner(job)
    with one_thread(), suppress(EOFError):
        while True:
            pipe.send(runner(pipe.recv()))
