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

from brewster.dataset import sets
from brewster.dataset.build.job import FATAL, Job, Result, Task
from brewster.errors import BrewsterError, RecipeError, TargetError
from brewster.processes import end_with_parent, one_thread
from brewster.render.sample import Sample
from brewster.scene.sampler import draw
from brewster.scene.scene import Scene, read_scene
from brewster.worlds.assets import Assets

Renderer = Callable[[Scene, Assets], Sample]

RENDERERS: Final = {"pane": "brewster.render.pane:render", "tracer": "brewster.render.tracer:trace"}
"""What makes a sample of a scene -> the module and function that do it."""

TRIES: Final = 3
"""How often a task may cost a worker its life before it is given up."""


@final
class Hand:
    """Does the tasks of a job, one after another; what fails becomes a result."""

    def __init__(self, job: Job) -> None:
        self._job, self._assets = job, Assets(job.folders)

    def __call__(self, task: Task) -> list[Result]:
        """The results of rendering; packing has none unless it fails."""
        if task.do == "render":
            return [self._attempt(index, lambda index=index: self._render(index)) for index in task.numbers]  # type: ignore[misc]
        tried = [
            self._attempt(block * sets.SHARD_SIZE, lambda block=block: sets.pack(self._job.out, block))  # type: ignore[misc]
            for block in task.numbers
        ]
        return [result for result in tried if result.error]

    def _render(self, index: int) -> None:
        folder = self._job.out / sets.key(index)
        if not folder.is_dir():  # a task that is tried again may be half done
            scene = draw(self._job.recipe, self._job.catalog, self._job.seed, index)
            sample = find_renderer(self._job.renderer)(scene, self._assets)
            sets.write_folder(folder, sets.encode_sample(sample, self._job.renderer))

    def _attempt(self, index: int, work: Callable[[], None]) -> Result:
        started = time.perf_counter()
        try:
            work()
        except BrewsterError as error:
            fatal = error if isinstance(error, FATAL) else None
            return Result(index, "failed", error=str(error), kind=type(error).__name__, fatal=fatal)
        except MemoryError:
            return Result(
                index, "failed", error="it does not fit into memory; use fewer --workers", kind="MemoryError"
            )
        except Exception as bug:  # noqa: BLE001  (one sample must not cost the others)
            told = f"brewster stumbled ({type(bug).__name__}: {bug}); please report it"
            return Result(index, "failed", error=told, kind=type(bug).__name__)
        return Result(index, "rendered", time.perf_counter() - started)


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
    chosen = renderer or _renderer_of(path)
    with one_thread():
        sample = find_renderer(chosen)(scene, Assets(folders))
        sets.write_folder(folder, sets.encode_sample(sample, chosen))


def _renderer_of(path: Path) -> str:
    """The renderer that a scene file names; one of ours, as a file may not choose what code is run."""
    name = tomllib.loads(path.read_text("utf-8")).get("outcome", {}).get("renderer", "pane")
    if name not in RENDERERS:
        raise RecipeError(
            f"{path} was rendered by {name!r}", f"one of {', '.join(RENDERERS)}", "choose it with --renderer"
        )
    return str(name)


# --- this process


@final
class Here:
    """A crew of one: this process."""

    chunk = 1

    def __init__(self, job: Job) -> None:
        self._hand, self._threads = Hand(job), one_thread()
        self._task: Task | None = None

    def has_room(self) -> bool:
        """Whether nothing is to do."""
        return self._task is None

    def is_busy(self) -> bool:
        """Whether something is to do."""
        return self._task is not None

    def submit(self, task: Task) -> None:
        """Keeps the task until somebody waits for it."""
        self._task = task

    def wait(self) -> list[Result]:
        """Does the task."""
        task, self._task = self._task, None
        return self._hand(task) if task else []

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
class Workers:
    """Processes that do one task at a time; one that dies is replaced, and its task is tried again."""

    chunk = 1

    def __init__(self, job: Job, count: int) -> None:
        self._job, self._count = job, count
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, Task, int]] = {}

    def has_room(self) -> bool:
        """Whether a worker is idle, or could still be hired."""
        return len(self._busy) < self._count

    def is_busy(self) -> bool:
        """Whether any worker works."""
        return bool(self._busy)

    def submit(self, task: Task) -> None:
        """Gives the task to a worker."""
        self._give(task, 1)

    def wait(self) -> list[Result]:
        """The results of the next worker that is done; none if it died and another one tries."""
        pipe = connection.wait(list(self._busy))[0]
        assert isinstance(pipe, Connection)
        worker, task, tries = self._busy.pop(pipe)
        try:
            results: list[Result] = pipe.recv()
        except (EOFError, OSError):
            return self._bury(worker, task, tries)
        self._idle.append(worker)
        return results

    def _give(self, task: Task, tries: int) -> None:
        worker = self._idle.pop() if self._idle else self._hire()
        self._busy[worker.pipe] = (worker, task, tries)
        with suppress(OSError):  # it is dead: its pipe ends, which wait() will notice
            worker.pipe.send(task)

    def _hire(self) -> _Worker:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._job), daemon=True)
        with _deaf_to_interrupts():
            process.start()
        theirs.close()
        return _Worker(process, ours)

    def _bury(self, worker: _Worker, task: Task, tries: int) -> list[Result]:
        worker.pipe.close()
        worker.process.join()
        if tries < TRIES:
            self._give(task, tries + 1)
            return []
        return task.lost(f"its worker died {TRIES} times (exit code {worker.process.exitcode})")

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
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes started here never see Ctrl-C, which a terminal sends to all: who started them will stop them."""
    if sys.platform == "win32":  # it has no signal masks; _serve ignores Ctrl-C as soon as it runs
        yield
        return
    resource_tracker.ensure_running()  # or it would start below, and lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection, job: Job) -> None:
    """A worker's life: tasks until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()  # the next run may be at the same sample
    hand = Hand(job)
    with one_thread(), suppress(EOFError):
        while True:
            pipe.send(hand(pipe.recv()))
