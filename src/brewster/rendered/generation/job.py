"""Renders a set: the job, the schedule of its tasks, and the lock. The executors are in `workers` and `ray_cluster`.

    job = RenderJob(Path("out/window"), read_scene_recipe("window"), read_catalog([], [])[0], seed=7)
    build(job, range(1000), ProcessExecutor(job, 8))

A sample depends on (job, index) only and is written atomically by the process that rendered it. So existing samples are
finished, a killed run can resume without other state, and memory and time per sample do not grow with the count.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol, final

import filelock
import tomli_w

from brewster.errors import BrewsterError, DeviceError, MissingExtra, TargetError
from brewster.files import write_atomically
from brewster.rendered import store
from brewster.rendered.generation.preview import write_index
from brewster.scene.recipe import SceneRecipe
from brewster.scene.sampler import Catalog

RECORD: Final = "set.toml"
_LOCK: Final = ".lock"
FATAL: Final = (TargetError, MissingExtra, DeviceError)
"""Errors that every sample would raise; they end the run."""


@final
@dataclass(frozen=True)
class RenderJob:
    """What to render, and where. Any other value, except of `out` and `folders`, gives another set.

    `renderer` is a name in workers.RENDERERS or "module:function". `folders` hold the files of the catalog.
    """

    out: Path
    recipe: SceneRecipe
    catalog: Catalog
    seed: int = 0
    renderer: str = "analytic"
    folders: tuple[Path, ...] = ()

    def record(self) -> dict[str, Any]:
        """The values that the bytes of the set depend on, for set.toml."""
        return {
            "format": store.SAMPLE_FORMAT,
            "renderer": self.renderer,
            "seed": self.seed,
            "catalog": hashlib.sha256(self.catalog.model_dump_json().encode()).hexdigest(),
            "recipe": self.recipe.model_dump(mode="json", exclude_none=True),
        }


@final
@dataclass(frozen=True)
class RenderTask:
    """Indices of samples to render, or of blocks of a hundred samples to pack into shards."""

    kind: Literal["render", "pack"]
    indices: tuple[int, ...]

    def failed_results(self, why: str) -> list[RenderResult]:
        """The results if no worker could finish the task."""
        message = f"{why}; a sample must fit into memory; use fewer --workers, or a smaller --size."
        first = 1 if self.kind == "render" else store.SHARD_SIZE
        return [
            RenderResult(number * first, "failed", error=message, kind="WorkerLost")
            for number in self.indices
        ]


@final
@dataclass(frozen=True)
class RenderResult:
    """The result for one sample or, if packing failed, for the first sample of its block.

    `kind` is the name of the error's class. `fatal` is the error itself if it ends the run.
    """

    index: int
    status: Literal["rendered", "skipped", "failed"]
    seconds: float = 0.0
    error: str | None = None
    kind: str | None = None
    fatal: BrewsterError | None = None


ResultCallback = Callable[[RenderResult], None]


class Executor(AbstractContextManager[Any], Protocol):
    """Runs tasks, a limited number at a time. Leaving the context ends the running tasks."""

    chunk: int
    """The number of samples per task."""

    def has_capacity(self) -> bool:
        """Whether another task can be submitted now."""

    def is_busy(self) -> bool:
        """Whether any task is running."""

    def submit(self, task: RenderTask) -> None:
        """Starts a task."""

    def wait(self) -> Sequence[RenderResult]:
        """Waits for an event. Returns: the results of finished tasks, possibly none."""


def build(
    job: RenderJob,
    indices: range,
    executor: Executor,
    *,
    shards: bool = False,
    report: ResultCallback = lambda _: None,
) -> None:
    """Renders the missing samples, packs them into shards on request, and writes the index.

    A sample that fails is reported and skipped. The next call tries it again.

    Args:
        job: what to render, and where.
        indices: the indices of the samples.
        executor: runs the tasks.
        shards: whether to pack each hundred samples into a tar file.
        report: called with the result of every sample.

    Raises:
        TargetError: the folder holds something else, another run is writing there, the disk is full or read-only.
        MissingExtra, DeviceError: the renderer cannot run here.
    """
    with _exclusive_lock(job.out):
        _check_record(job)
        store.remove_partial_files(job.out)
        try:
            with executor:
                _run_tasks(
                    _Schedule(job.out, indices, executor.chunk, shards=shards, report=report), executor
                )
        finally:
            store.remove_partial_files(job.out)
        write_index(job.out)


def _run_tasks(schedule: _Schedule, executor: Executor) -> None:
    while True:
        task = schedule.next() if executor.has_capacity() else None
        if task:
            executor.submit(task)
        elif executor.is_busy():
            for result in executor.wait():
                if result.fatal:
                    raise result.fatal
                schedule.record_result(result)
        else:
            return


@final
class _Schedule:
    """The remaining tasks, block by block: missing samples to render, and complete blocks to pack."""

    def __init__(
        self, out: Path, indices: range, chunk: int, *, shards: bool, report: ResultCallback
    ) -> None:
        self._out, self._indices, self._chunk = out, indices, chunk
        self._shards, self._report = shards, report
        self._packs: deque[int] = deque()
        self._left: dict[int, int] = {}
        """Block -> number of samples to render before it can be packed."""
        self._renders = self._plan_tasks()

    def next(self) -> RenderTask | None:
        """The next task; None if there is none, or none before another result."""
        return RenderTask("pack", (self._packs.popleft(),)) if self._packs else next(self._renders, None)

    def record_result(self, result: RenderResult) -> None:
        """Counts a result. When all samples of a block are rendered, the block is scheduled for packing."""
        block = result.index // store.SHARD_SIZE
        if result.status == "failed":
            self._left.pop(block, None)
        elif block in self._left:
            self._left[block] -= 1
            if self._left[block] == 0:
                del self._left[block]
                self._packs.append(block)
        self._report(result)

    def _plan_tasks(self) -> Iterator[RenderTask]:
        size, wanted = store.SHARD_SIZE, self._indices
        for block in range(wanted.start // size, -(-wanted.stop // size)):
            present = {entry.index for entry in store.read_block(self._out, block)}
            here = range(max(wanted.start, block * size), min(wanted.stop, (block + 1) * size))
            missing = [index for index in here if index not in present]
            if self._shards and missing:
                self._left[block] = len(missing)
            elif self._shards and store.has_folders(self._out, block):
                yield RenderTask("pack", (block,))
            for index in here:
                if index in present:
                    self._report(RenderResult(index, "skipped"))
            for at in range(0, len(missing), self._chunk):
                yield RenderTask("render", tuple(missing[at : at + self._chunk]))


# --- one set, one job, one run at a time


@contextmanager
def _exclusive_lock(out: Path) -> Iterator[None]:
    """Holds the lock of the folder. It is released by the operating system if the process is killed."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / _LOCK).touch()
    except OSError as error:
        raise TargetError(
            f"{out} cannot be written to ({error.strerror})",
            "expected a folder for the set",
            "name another one",
        ) from error
    lock = filelock.FileLock(out / _LOCK, blocking=False, fallback_to_soft=False)
    _acquire(lock, out)
    try:
        yield
    finally:
        lock.release()


def _acquire(lock: filelock.BaseFileLock, out: Path) -> None:
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise TargetError(
            f"another run is writing in {out}",
            "only one run can write at a time",
            "wait for it, or name another folder",
        ) from error
    except OSError as error:
        raise TargetError(
            f"{out} cannot be locked ({error.strerror})",
            "locks keep two runs from writing to the same set",
            "name a folder on a file system with locks",
        ) from error


def _check_record(job: RenderJob) -> None:
    """Writes the record of the job into a new set, or compares it with the record of an existing set."""
    path, text = job.out / RECORD, tomli_w.dumps(job.record())
    if not path.exists():
        _check_is_set(job.out)
        write_atomically(path, text.encode())
        return
    present, requested = dict(_flatten(_read_record(path))), dict(_flatten(tomllib.loads(text)))
    for name in {**present, **requested}:
        old, new = present.get(name, "not set"), requested.get(name, "not set")
        if old != new:
            raise TargetError(
                f"{job.out} holds another set: its {name} is {old}, and {new} was requested",
                "a folder holds one set only",
                "name another folder, or use the same settings",
            )


def _read_record(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TargetError(
            f"{path} cannot be read ({error})", "expected the record of a set", "name another folder"
        ) from error


def _check_is_set(out: Path) -> None:
    foreign = next((path for path in out.iterdir() if not path.name.startswith(".")), None)
    if foreign:
        raise TargetError(
            f"{out} holds {foreign.name} and is no set",
            "expected an empty folder or a set",
            "name a new folder",
        )


def _flatten(table: dict[str, Any], before: str = "") -> Iterator[tuple[str, object]]:
    """Yields (dotted name, value) for every value of nested tables."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
