"""Separates an archive: a batch in several processes or on a cluster.

A worker separates one photo at a time, as a batch in one process does: it reads the photo and writes the layers.
Without `overwrite`, a layer that exists is never written again, even if two workers separate the same photo. If a node
is lost, only its photos are separated again. The same command resumes a stopped run."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import final

from brewster.batch.plan import FileResult, SeparationTask
from brewster.batch.runner import check_outputs, input_paths, separate_tasks, skipped_result
from brewster.errors import OutputError
from brewster.executors.local import Executor, run_tasks
from brewster.files import exists
from brewster.inference.separator import Separator
from brewster.options import Options
from brewster.remote_path import Location


def separate_in_parallel(
    tasks: Sequence[SeparationTask], executor: Executor[FileResult], *, overwrite: bool = False
) -> Iterator[FileResult]:
    """Separates the photos of the tasks, and yields the results in the order in which workers finish them. The caller
    enters the context of the executor, which runs a `SeparationRunner` in its workers; both need the same `overwrite`.
    Raises OutputError if a layer would replace a photo of the archive, or a node cannot reach the output folder, and
    ModelError, DeviceError or DiskFull."""
    inputs, has = input_paths(tasks), _file_finder()
    for task in tasks:  # a worker cannot check this, because it does not get the paths of all photos
        check_outputs(task, inputs)
    finished: list[FileResult] = []

    def unfinished() -> Iterator[SeparationTask]:
        for task in tasks:
            if not overwrite and _is_finished(task, has):
                finished.append(skipped_result(task))  # without a worker
            else:
                yield task

    next_task = partial(next, unfinished(), None)
    for result in run_tasks(next_task, executor):
        yield from finished
        finished.clear()
        yield result
    yield from finished


@final
class SeparationRunner:
    """Separates photos in a worker. The model is loaded when the first photo is separated. Raises OutputError if the
    `shared_folder`, the output folder on a cluster, is not an object store and does not exist on this node."""

    def __init__(
        self, options: Options, shared_folder: Location | None = None, *, overwrite: bool = False
    ) -> None:
        if isinstance(shared_folder, Path) and not shared_folder.is_dir():
            raise OutputError(
                f"the folder {shared_folder} does not exist on the node {socket.gethostname()}",
                "expected a folder that all nodes share",
                "mount it on this node, or write to an object store",
            )
        self._options, self._overwrite = options, overwrite
        self._separator: Separator | None = None

    def __call__(self, task: SeparationTask) -> list[FileResult]:
        """Separates one photo. If the photo fails, its result has the status "failed". Raises ModelError, DeviceError
        or MissingExtra if the model cannot be loaded, and DiskFull."""
        self._separator = self._separator or Separator.load(**self._options.load_options())
        (result,) = separate_tasks([task], self._options, self._separator, overwrite=self._overwrite)
        if result.error and not self._overwrite and _is_finished(task, exists):
            # This worker was slow, and another worker got the same task and has already written the layers.
            result = skipped_result(task)
        return [result]


def _is_finished(task: SeparationTask, has: Callable[[Location], bool]) -> bool:
    return all(isinstance(target, Location) and has(target) for target in task.outputs.values())


def _file_finder() -> Callable[[Location], bool]:
    """Lists whole folders, because a listing replaces thousands of requests to an object store."""

    @lru_cache(maxsize=1)
    def names(folder: Location) -> set[str]:
        try:
            return {entry.name for entry in folder.iterdir()}
        except OSError:  # the folder does not exist yet
            return set()

    return lambda path: path.name in names(path.parent)
