"""Separates an archive: a batch in several processes or on a cluster, with an index of the results.

    tasks = plan_files("scans.parquet", "s3://bucket/clear", options)
    create_runner = partial(SeparationRunner, options)
    with RayExecutor(create_runner, "10.0.0.1:6379") as executor, IndexWriter(location("s3://bucket/clear")) as index:
        separate_in_parallel(tasks, executor, on_result=index.append)

A worker separates one photo at a time, with the code of a batch in one process (`BatchRunner`). It reads the photo and
writes the layers itself. A layer that exists is never written again, not even by two workers at the same time. So a lost
node costs only the photos that it was separating, and a run that has stopped is resumed by the same command.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import final

from brewster.errors import OutputError
from brewster.executors import Executor, run_tasks
from brewster.files import exists
from brewster.inference.batch import BatchRunner, FileResult, SeparationTask, real_path
from brewster.options import Options
from brewster.remote_path import Location


def separate_in_parallel(
    tasks: Sequence[SeparationTask],
    executor: Executor[FileResult],
    *,
    overwrite: bool = False,
    on_result: Callable[[FileResult], None] = lambda _: None,
) -> None:
    """Separates the photos of the tasks, in the order in which workers finish them.

    Args:
        tasks: the photos and the paths of their layers, from `plan_files`.
        executor: runs an `SeparationRunner` in its workers; its context is entered by the caller.
        overwrite: replace layers that exist, instead of skipping them.
        on_result: called with the result of every photo. An exception raised in it stops the run.

    Raises:
        OutputError: a layer would replace a photo of the archive, or a node cannot reach the output folder.
        ModelError: the model does not exist or is damaged.
        DeviceError: the requested device is not available.
    """
    _check_targets(tasks)
    unfinished = _unfinished(tasks, on_result, overwrite=overwrite)
    for result in run_tasks(lambda: next(unfinished, None), executor):
        on_result(result)


@final
class SeparationRunner:
    """Separates photos in a worker. The model is loaded with the first photo.

    Args:
        options: the options of the batch.
        shared_folder: the output folder on a cluster. If it is not an object store, all nodes must share it.
        overwrite: replace layers that exist.

    Raises:
        OutputError: the folder does not exist on this node.
    """

    def __init__(
        self, options: Options, shared_folder: Location | None = None, *, overwrite: bool = False
    ) -> None:
        if isinstance(shared_folder, Path) and not shared_folder.is_dir():
            raise OutputError(
                f"the folder {shared_folder} does not exist on the node {socket.gethostname()}",
                "expected a folder that all nodes share",
                "mount it on this node, or write to an object store",
            )
        self._batch, self._overwrite = BatchRunner((), options, overwrite=overwrite), overwrite

    def __call__(self, task: SeparationTask) -> list[FileResult]:
        """Separates one photo. Errors of the photo become a result with the status "failed".

        Raises:
            ModelError, DeviceError, MissingExtra: the model cannot be loaded.
        """
        result = self._batch.run(task, lambda _fraction: None)
        if result.error and not self._overwrite and _is_finished(task, exists):
            # Another worker has written the layers in the meantime: the node was slow, and its task was tried again.
            result = FileResult(task.name, "skipped")
        if not result.error:
            result.outputs = {layer: str(target) for layer, target in task.outputs.items()}
        return [result]


def _check_targets(tasks: Sequence[SeparationTask]) -> None:
    """Raises OutputError if a layer has the path of a photo. Workers cannot check this, because each has one photo only."""
    sources = {real_path(task.source) for task in tasks if isinstance(task.source, Location)}
    for task in tasks:
        for target in task.outputs.values():
            if isinstance(target, Location) and real_path(target) in sources:
                raise OutputError(
                    f"{target} is itself a photo of the batch",
                    "expected another path, because photos of the batch are never overwritten",
                    "choose another output folder",
                )


def _unfinished(
    tasks: Sequence[SeparationTask], on_result: Callable[[FileResult], None], *, overwrite: bool
) -> Iterator[SeparationTask]:
    """Yields the tasks with missing layers. The others are reported as skipped, so that no worker is needed for them."""
    listing = _FolderListing()
    for task in tasks:
        if not overwrite and _is_finished(task, listing.has):
            on_result(
                FileResult(
                    task.name, "skipped", {layer: str(target) for layer, target in task.outputs.items()}
                )
            )
        else:
            yield task


def _is_finished(task: SeparationTask, has: Callable[[Location], bool]) -> bool:
    """Whether all layers exist."""
    return all(isinstance(target, Location) and has(target) for target in task.outputs.values())


@final
class _FolderListing:
    """The names in the folder that was asked for last. One listing replaces thousands of requests to an object store."""

    def __init__(self) -> None:
        self._folder: Location | None = None
        self._names: set[str] = set()

    def has(self, path: Location) -> bool:
        """Whether the folder contains the file."""
        if path.parent != self._folder:
            self._folder = path.parent
            try:
                self._names = {entry.name for entry in path.parent.iterdir()}
            except OSError:  # the folder does not exist yet
                self._names = set()
        return path.name in self._names
