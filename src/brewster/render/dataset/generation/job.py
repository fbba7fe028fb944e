"""Renders datasets: the job, and the schedule of its tasks. The executors are in
`brewster.base.executors`.

A sample depends only on the job and its index. The process that renders a sample writes it
atomically. Therefore every existing sample is complete, and a killed run needs no other state to
resume. Memory and time per sample do not depend on the number of samples.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, final

import tomli_w

from brewster.base.executors.local import Executor, run_tasks
from brewster.base.files import exclusive_lock, write_atomically
from brewster.base.settings import flatten
from brewster.errors import DeviceError, MissingExtra, OutputError, read_errors
from brewster.render.dataset import store
from brewster.render.dataset.generation.preview import write_index
from brewster.render.scene.recipe import SceneRecipe
from brewster.render.scene.sampler import Catalog

RECORD_FILE: Final = "set.toml"
FATAL_ERRORS: Final = (OutputError, MissingExtra, DeviceError)
"""Errors that occur for every sample. They end the run."""


@final
@dataclass(frozen=True)
class RenderJob:
    """The dataset to render. All values except the folder `out` and `folders` determine the bytes
    of the dataset.

    `renderer` is a name in workers.RENDERERS or "module:function". `folders` contain the files of
    the catalog.
    """

    out: Path
    recipe: SceneRecipe
    catalog: Catalog
    seed: int = 0
    renderer: str = "analytic"
    folders: tuple[Path, ...] = ()

    def record(self) -> dict[str, Any]:
        """Returns the values that determine the bytes of the dataset, for set.toml."""
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
    """A task for a worker: to render a sample ("render"), or to pack a hundred samples into a shard
    ("pack").

    `index` is that of the sample, or of the first sample of the block.
    """

    kind: Literal["render", "pack"]
    index: int

    def failed_results(self, reason: str) -> list[RenderResult]:
        """Returns the failed result of a task that no worker could finish."""
        error = (
            f"{reason}; expected a sample that fits into memory; use fewer --workers, or a "
            "smaller --size."
        )
        return [RenderResult(self.index, "failed", error=error, kind="WorkerLost")]


@final
@dataclass(frozen=True)
class RenderResult:
    """The result for one sample. If packing fails, it is the result for the first sample of the
    block.

    `kind` is the class name of the error.
    """

    index: int
    status: Literal["rendered", "skipped", "failed"]
    seconds: float = 0.0
    error: str | None = None
    kind: str | None = None


ResultCallback = Callable[[RenderResult], None]


def build(
    job: RenderJob,
    indices: range,
    executor: Executor[RenderResult],
    *,
    shards: bool = False,
    report: ResultCallback = lambda _: None,
) -> None:
    """Renders the missing samples of a dataset, packs them into shards if `shards` is True, and
    writes the index.

    A sample that fails is reported and skipped. The next call renders it again. `report` is called
    with the result of every sample. Raises FATAL_ERRORS: OutputError for a folder with other
    content or another writer, or a full disk.
    """
    with exclusive_lock(job.out):
        _check_record(job)
        store.remove_partial_files(job.out)
        try:
            with executor:
                schedule = _Schedule(job.out, indices, shards=shards, report=report)
                for result in run_tasks(schedule.next, executor):
                    schedule.record_result(result)
        finally:
            store.remove_partial_files(job.out)
        write_index(job.out)


@final
class _Schedule:
    """Schedules tasks block by block: missing samples to render, and blocks without missing samples
    to pack.
    """

    def __init__(self, out: Path, indices: range, *, shards: bool, report: ResultCallback) -> None:
        self._out = out
        self._indices = indices
        self._shards = shards
        self._report = report
        self._blocks_to_pack: deque[int] = deque()
        self._remaining: dict[int, int] = {}
        """For each block, the number of samples that must be rendered before the block is packed.
        """
        self._render_tasks = self._plan_tasks()

    def next(self) -> RenderTask | None:
        """Returns the next task. Returns None after the last task, and if no task can start before
        the next result.
        """
        if self._blocks_to_pack:
            return RenderTask("pack", self._blocks_to_pack.popleft() * store.SHARD_SIZE)
        return next(self._render_tasks, None)

    def record_result(self, result: RenderResult) -> None:
        """Records a result. When all samples of a block are rendered, the block is scheduled for
        packing.
        """
        block = result.index // store.SHARD_SIZE
        if result.status == "failed":
            self._remaining.pop(block, None)
        elif block in self._remaining:
            self._remaining[block] -= 1
            if self._remaining[block] == 0:
                del self._remaining[block]
                self._blocks_to_pack.append(block)
        self._report(result)

    def _plan_tasks(self) -> Iterator[RenderTask]:
        size = store.SHARD_SIZE
        requested = self._indices
        for block in range(requested.start // size, -(-requested.stop // size)):
            existing = {entry.index for entry in store.read_block(self._out, block)}
            in_block = range(
                max(requested.start, block * size), min(requested.stop, (block + 1) * size)
            )
            missing = [index for index in in_block if index not in existing]
            if self._shards and missing:
                self._remaining[block] = len(missing)
            elif self._shards and store.has_folders(self._out, block):
                yield RenderTask("pack", block * size)
            for index in in_block:
                if index in existing:
                    self._report(RenderResult(index, "skipped"))
            yield from (RenderTask("render", index) for index in missing)


# --- the lock and the record of a dataset: a dataset has one job, and only one run at a time
# writes to it


def _check_record(job: RenderJob) -> None:
    """Writes the record of the job into a new dataset, or compares it with the record of an
    existing dataset.
    """
    path = job.out / RECORD_FILE
    text = tomli_w.dumps(job.record())
    if not path.exists():
        if foreign := next(
            (entry for entry in job.out.iterdir() if not entry.name.startswith(".")), None
        ):
            raise OutputError(
                f"{job.out} contains {foreign.name}, but no rendered dataset",
                "expected an empty folder or a rendered dataset",
                "choose a new folder",
            )
        write_atomically(path, text.encode())
        return
    expected = "expected the record of a dataset"
    cure = "choose another folder"
    with read_errors(path, OutputError, expected, cure, (tomllib.TOMLDecodeError,)):
        existing = dict(flatten(tomllib.loads(path.read_text("utf-8"))))
    requested = dict(flatten(tomllib.loads(text)))
    # A key that is newer than the dataset has its default, which changes no sample.
    plain = SceneRecipe(name="", about="").model_dump(mode="json", exclude_none=True)
    defaults = dict(flatten({"recipe": plain}))
    for name in existing | requested:
        old = existing.get(name, defaults.get(name, "not set"))
        new = requested.get(name, "not set")
        if old != new:
            raise OutputError(
                f"{job.out} contains another dataset: its {name} is {old}, and {new} was requested",
                "expected the settings of that dataset, or a new folder",
                "choose another folder, or use the same settings",
            )
