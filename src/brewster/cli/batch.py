"""Runs `brewster separate` and prints its output: progress, one line for each photo, a summary.

The photos are separated by `brewster.batch.runner`, or in several processes or on a cluster by
`brewster.batch.parallel`.
"""

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, final

from brewster.cli.batch_plan import listed
from brewster.cli.terminal import (
    interrupts,
    one_line,
    print_error,
    print_status,
    progress,
    write_out,
)
from brewster.errors import INSTALL_COMMAND, ModelError
from brewster.models import zoo
from brewster.options import Options
from brewster.remote_path import location

if TYPE_CHECKING:
    from brewster.batch import FileResult, SeparationTask
    from brewster.batch.index import IndexWriter
    from brewster.executors import Executor


@final
@dataclass(frozen=True)
class BatchCommand:
    """The options of a batch. `run` separates the photos and prints the results."""

    options: Options
    output: str | None = None
    overwrite: bool = False
    dry_run: bool = False
    as_json: bool = False
    quiet: bool = False
    contact_sheet: Path | None = None
    workers: int | None = None
    cluster: str | None = None
    writes_index: bool = False

    def run(self, tasks: Sequence[SeparationTask]) -> bool:
        """Separates all photos and prints the results.

        The results are not kept in memory, because an archive can have millions of photos.

        Returns:
            Whether no photo failed.

        Raises:
            BrewsterError: see `separate_tasks` and `separate_in_parallel`.
        """
        summary, started = _Summary(), time.perf_counter()
        try:
            with (
                self._index_writer() as index,
                progress(len(tasks), shown=not (self.quiet or self.as_json)) as update_progress,
            ):

                def on_result(result: FileResult) -> None:
                    if result.error:
                        interrupts.raise_pending()  # a Ctrl-C that Python dropped may have caused the error
                    if index:
                        index.append(result)
                    summary.add(result, has_contact_sheet=self.contact_sheet is not None)
                    self._print_result(result)
                    update_progress(summary.counts.total(), result.source)
                    interrupts.raise_pending()

                if self._is_parallel:
                    self._separate_in_parallel(tasks, on_result)
                else:
                    self._separate(tasks, on_result, update_progress)
            if self.contact_sheet and not self.dry_run:
                self._write_contact_sheet(self.contact_sheet, summary.contact_sheet_rows)
        finally:
            # All photos have a result. `separate_tasks` may still raise, after the last photo.
            if summary.counts.total() == len(tasks):
                self._print_summary(summary, time.perf_counter() - started)
        return not summary.counts["failed"]

    @property
    def _is_parallel(self) -> bool:
        return bool(self.workers or self.cluster) and not self.dry_run

    def _separate(
        self,
        tasks: Sequence[SeparationTask],
        on_result: Callable[[FileResult], None],
        update_progress: Callable[[float, str], None],
    ) -> None:
        from brewster.batch.runner import separate_tasks  # noqa: PLC0415

        def on_progress(done: int, name: str, fraction: float) -> None:
            interrupts.raise_pending()
            update_progress(done + fraction, name)

        for result in separate_tasks(
            tasks, self.options, overwrite=self.overwrite, dry_run=self.dry_run, on_progress=on_progress
        ):
            on_result(result)

    def _separate_in_parallel(
        self, tasks: Sequence[SeparationTask], on_result: Callable[[FileResult], None]
    ) -> None:
        from brewster.batch.parallel import SeparationRunner, separate_in_parallel  # noqa: PLC0415
        from brewster.executors import ProcessExecutor  # noqa: PLC0415

        shared_folder = location(self.output) if self.cluster and self.output else None
        create_runner = partial(SeparationRunner, self.options, shared_folder, overwrite=self.overwrite)
        executor: Executor[FileResult] = ProcessExecutor(create_runner, self.workers or 1)
        if self.cluster:
            from brewster.executors.ray_cluster import RayExecutor  # noqa: PLC0415

            executor = RayExecutor(create_runner, self.cluster, self.workers)
        with executor:
            separate_in_parallel(tasks, executor, overwrite=self.overwrite, on_result=on_result)

    def _index_writer(self) -> AbstractContextManager[IndexWriter | None]:
        from brewster.batch.index import IndexWriter  # noqa: PLC0415

        is_written = (self.writes_index or self.cluster) and self.output and not self.dry_run
        return IndexWriter(location(self.output or "")) if is_written else nullcontext()

    def _print_result(self, result: FileResult) -> None:
        """Prints the line of a result: JSON on standard output, or a status line on standard error."""
        outputs = ", ".join(result.outputs.values())
        if self.as_json:
            write_out(_json_line(result))
        elif result.status == "planned":
            write_out(f"{one_line(result.source)} -> {one_line(outputs)}\n".encode())
        if self.quiet or result.error:
            return
        if result.status == "skipped":
            # A parallel batch does not read an existing layer a second time to compare its options with the current ones,
            # because that takes time.
            different_options = "" if self._is_parallel else self._different_options(result)
            note = f", made with other options ({different_options})" if different_options else ""
            print_status(
                f"{result.source}: skipped, because all of its layers exist{note} (--overwrite replaces them)"
            )
        elif result.status == "separated":
            verdict = result.assessment.verdict if result.assessment else ""
            hint = ": check the layers" if verdict == "doubtful" else ""
            seconds = sum(result.seconds.values())
            print_status(f"{result.source} -> {outputs} ({seconds:.1f} s, {verdict}{hint})")
            if result.burst:
                print_status(f"  {result.burst.method}: {result.burst.message}")

    def _different_options(self, result: FileResult) -> str:
        """Returns the options in the metadata of the existing layers that differ from the options of this batch."""
        from brewster.inference.layer_history import history_step  # noqa: PLC0415
        from brewster.photo.history import PROGRAM, recorded_parameters  # noqa: PLC0415

        options = self.options
        expected = history_step(
            "", strength=options.strength, quality=options.quality, additive=options.additive
        ) | {"model": _model_name(options.model)}
        metadata = (recorded_parameters(Path(path), PROGRAM) for path in result.outputs.values())
        recorded_options = next((parameters for parameters in metadata if parameters), {})
        return ", ".join(
            f"{name}={recorded_options[name]}"
            for name, value in expected.items()
            if value is not None and recorded_options.get(name, value) != value
        )

    def _print_summary(self, summary: _Summary, seconds: float) -> None:
        if summary.counts.total() > 1 and not self.quiet:
            order = ("separated", "planned", "skipped", "failed")
            totals = ", ".join(
                f"{summary.counts[status]} {status}" for status in order if summary.counts[status]
            )
            folder = f"in {self.output}" if self.output else "next to the photos"
            layers = f"; the layers are {folder}" if summary.counts.keys() & {"separated", "skipped"} else ""
            print_status(totals if self.dry_run else f"{totals} in {_duration(seconds)}{layers}")
        for message in summary.error_messages():
            print_error(message)

    def _write_contact_sheet(self, path: Path, rows: list[tuple[Path, list[Path]]]) -> None:
        """Writes the contact sheet of the photos whose layers are files, in the order of their names."""
        from brewster.photo.contact_sheet import write_contact_sheets  # noqa: PLC0415

        for sheet in write_contact_sheets(
            path,
            sorted(rows) if self._is_parallel else rows,
            self.options.max_pixels,
            overwrite=self.overwrite,
        ):
            if not self.quiet:
                print_status(f"contact sheet: {sheet}")


@final
class _Summary:
    """The counts and errors of a batch."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.contact_sheet_rows: list[tuple[Path, list[Path]]] = []
        self._errors: list[str] = []
        self._sources_by_missing_extra: defaultdict[str, list[str]] = defaultdict(list)

    def add(self, result: FileResult, *, has_contact_sheet: bool) -> None:
        """Counts a result."""
        self.counts[result.status] += 1
        if result.error and INSTALL_COMMAND in result.error:
            self._sources_by_missing_extra[result.error].append(result.source)
        elif result.error:
            self._errors.append(_error_text(result))
        elif has_contact_sheet and "-" not in (result.source, *result.outputs.values()):
            self.contact_sheet_rows.append((Path(result.source), [*map(Path, result.outputs.values())]))

    def error_messages(self) -> list[str]:
        """Returns a message for each failed photo. Photos that need the same missing extra share a message."""
        grouped = (
            f"{sources[0] if len(sources) == 1 else listed(sources, 'photo')}: {error}"
            for error, sources in self._sources_by_missing_extra.items()
        )
        return [*self._errors, *grouped]


def _model_name(model: str) -> str | None:
    """Returns the name under which the metadata of layers record this model.

    Returns None if the model is unknown, or if its name is known only after loading.
    """
    try:
        return None if zoo.is_diffusion_model(model) else zoo.find_model(model).name
    except ModelError:
        return None


def _duration(seconds: float) -> str:
    """Returns `4.2 s`, `3 min 5 s` or `2 h 40 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def _error_text(result: FileResult) -> str:
    """Returns the error message of a photo, with its path in front if the message does not begin with it or with its row."""
    error = str(result.error)
    has_source = error.startswith(f"{result.source} ") or f": {result.source} " in error
    return error if has_source else f"{result.source}: {error}"


def _json_line(result: FileResult) -> bytes:
    values = asdict(result)
    values["seconds"] = {name: round(seconds, 4) for name, seconds in result.seconds.items()}
    return f"{json.dumps(values)}\n".encode()
