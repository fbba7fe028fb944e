"""Renders a set: what there is to do, in which order, and when it may begin; `workers` and `cluster` do it.

    job = Job(Path("out/window"), read_scene_recipe("window"), read_catalog([], [])[0], seed=7)
    build(job, range(1000), Workers(job, 8))

A sample is a function of (job, index) alone and is written whole by the process that rendered it. So what is there
is done, a killed run needs no memory, and neither memory nor the cost of a sample grows with the count.
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
"""Errors that the next sample would meet too: they end the run."""


@final
@dataclass(frozen=True)
class RenderJob:
    """What is rendered, and where. But for the folders, another value makes another set.

    `renderer` is one of workers.RENDERERS or "module:function"; `folders` hold the files of the catalog.
    """

    out: Path
    recipe: SceneRecipe
    catalog: Catalog
    seed: int = 0
    renderer: str = "analytic"
    folders: tuple[Path, ...] = ()

    def record(self) -> dict[str, Any]:
        """The values that a set's bytes depend on, for set.toml."""
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
    """Samples to render, by index, or blocks of a hundred to pack into their shards."""

    kind: Literal["render", "pack"]
    indices: tuple[int, ...]

    def failed_results(self, why: str) -> list[RenderResult]:
        """The results if nobody could finish it."""
        message = f"{why}; a sample must fit into memory; use fewer --workers, or a smaller --size."
        first = 1 if self.kind == "render" else store.SHARD_SIZE
        return [
            RenderResult(number * first, "failed", error=message, kind="WorkerLost")
            for number in self.indices
        ]


@final
@dataclass(frozen=True)
class RenderResult:
    """What became of a sample (or, if packing failed, of its block).

    `kind` is the class of the error; `fatal` is the error itself if it ends the run.
    """

    index: int
    status: Literal["rendered", "skipped", "failed"]
    seconds: float = 0.0
    error: str | None = None
    kind: str | None = None
    fatal: BrewsterError | None = None


ResultCallback = Callable[[RenderResult], None]


class Executor(AbstractContextManager[Any], Protocol):
    """Does tasks somewhere, a bounded number at a time; what it has begun ends with the context."""

    chunk: int
    """How many samples make a task."""

    def has_capacity(self) -> bool:
        """Whether it would begin one more now."""

    def is_busy(self) -> bool:
        """Whether a task is under way."""

    def submit(self, task: RenderTask) -> None:
        """Begins a task."""

    def wait(self) -> Sequence[RenderResult]:
        """Waits until something happens; the results of what was finished, if anything was."""


def build(
    job: RenderJob,
    indices: range,
    executor: Executor,
    *,
    shards: bool = False,
    report: ResultCallback = lambda _: None,
) -> None:
    """Renders the samples that are not there yet, moves them into shards if asked, and writes the index.

    A sample that fails is reported and left out; the same call tries it again.

    Raises:
        TargetError: the folder holds something else, another run is writing there, or it is full or read-only.
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
    """What is still to do, block by block: the samples that are missing, and the shards that are complete."""

    def __init__(
        self, out: Path, indices: range, chunk: int, *, shards: bool, report: ResultCallback
    ) -> None:
        self._out, self._indices, self._chunk = out, indices, chunk
        self._shards, self._report = shards, report
        self._packs: deque[int] = deque()
        self._left: dict[int, int] = {}
        """Block -> how many of its samples are still to be rendered before it can be packed."""
        self._renders = self._plan_tasks()

    def next(self) -> RenderTask | None:
        """The next task; None if there is none, or none until a result is noted."""
        return RenderTask("pack", (self._packs.popleft(),)) if self._packs else next(self._renders, None)

    def record_result(self, result: RenderResult) -> None:
        """Learns what became of a sample; with its last one, a block can be packed, unless one has failed."""
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
    """Holds the folder's lock, which is released by the operating system if the process is killed."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / _LOCK).touch()
    except OSError as error:
        raise TargetError(
            f"{out} cannot be written to ({error.strerror})", "a folder for the set", "name another one"
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
            f"another run is writing in {out}", "one writes at a time", "wait for it, or name another folder"
        ) from error
    except OSError as error:
        raise TargetError(
            f"{out} cannot be locked ({error.strerror})",
            "the file system must know locks, or two runs could mix",
            "name a folder on another one",
        ) from error


def _check_record(job: RenderJob) -> None:
    """Records the job in a new set; in one that is there, the job must be the same."""
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
                "a folder holds one set",
                "name another folder, or ask for the same",
            )


def _read_record(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TargetError(
            f"{path} cannot be read ({error})", "it records what the folder holds", "name another folder"
        ) from error


def _check_is_set(out: Path) -> None:
    foreign = next((path for path in out.iterdir() if not path.name.startswith(".")), None)
    if foreign:
        raise TargetError(
            f"{out} holds {foreign.name} and is no set", "a set has a folder of its own", "name a new folder"
        )


def _flatten(table: dict[str, Any], before: str = "") -> Iterator[tuple[str, object]]:
    """Every value in nested tables with its dotted name."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
