"""Runs `brewster separate` in several processes or on a cluster, and prints its output.

The photos are separated by `brewster.inference.parallel_batch`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, final

from brewster.cli.batch import BatchCommand, error_text
from brewster.cli.terminal import interrupts, print_error, print_status, progress, standard_output
from brewster.options import Options
from brewster.remote_path import Location, location

if TYPE_CHECKING:
    from brewster.executors import Executor, Runner
    from brewster.inference import FileResult
    from brewster.inference.index import IndexWriter


@final
@dataclass(frozen=True)
class ParallelBatchCommand:
    """The options of a batch in several processes or on a cluster. `run` separates the photos and prints the results."""

    options: Options
    output: str | None
    cluster: str | None = None
    workers: int | None = None
    index: bool = False
    overwrite: bool = False
    as_json: bool = False
    quiet: bool = False

    def run(self, photos: Sequence[str]) -> bool:
        """Separates all photos and prints the results. Results are not stored, because a batch can have millions of photos.

        Returns:
            Whether no photo failed.

        Raises:
            BrewsterError: see `plan_files` and `separate_in_parallel`.
        """
        from brewster.inference.batch import plan_files  # noqa: PLC0415  (imports ONNX Runtime and pyvips)
        from brewster.inference.parallel_batch import SeparationRunner, separate_in_parallel  # noqa: PLC0415

        folder = None if self.output is None else _absolute(self.output)
        tasks = plan_files([_absolute(photo) for photo in photos], folder, self.options)
        shared_folder = folder if self.cluster else None
        create_runner = partial(SeparationRunner, self.options, shared_folder, overwrite=self.overwrite)
        counts: Counter[str] = Counter()
        printer = BatchCommand(self.options, as_json=self.as_json, quiet=self.quiet)
        shares_terminal = self.as_json and standard_output.stream.isatty()
        with (
            self._index(folder) as index,
            self._executor(create_runner) as executor,
            progress(len(tasks), shown=not self.quiet and not shares_terminal) as update_progress,
        ):

            def report(result: FileResult) -> None:
                if index:
                    index.append(result)
                counts[result.status] += 1
                printer.print_result(result)
                if result.error:
                    print_error(error_text(result))
                update_progress(counts.total(), result.source)
                interrupts.raise_pending()

            separate_in_parallel(tasks, executor, overwrite=self.overwrite, report=report)
        if not self.quiet:
            print_status(", ".join(f"{count} {status}" for status, count in sorted(counts.items())))
        return not counts["failed"]

    def _index(self, folder: Location | None) -> AbstractContextManager[IndexWriter | None]:
        from brewster.inference.index import IndexWriter  # noqa: PLC0415

        return IndexWriter(folder) if folder is not None and (self.index or self.cluster) else nullcontext()

    def _executor(self, create_runner: Callable[[], Runner[FileResult]]) -> Executor[FileResult]:
        from brewster.executors import ProcessExecutor, SerialExecutor  # noqa: PLC0415

        if self.cluster:
            from brewster.executors.ray_cluster import RayExecutor  # noqa: PLC0415

            return RayExecutor(create_runner, self.cluster, self.workers)
        return ProcessExecutor(create_runner, self.workers) if self.workers else SerialExecutor(create_runner)


def _absolute(path: str) -> Location:
    """Returns the absolute path or the URL, because workers may have other working folders."""
    found = location(path)
    return Path(os.path.abspath(found)) if isinstance(found, Path) else found  # noqa: PTH100  (keeps links)
