"""The results of `brewster separate`, and how they are printed: one line for each photo, and a summary."""

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import KW_ONLY, asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, final, get_args

from brewster.cli.batch_plan import listed
from brewster.cli.terminal import interrupts, one_line, print_error, print_status, progress, write_out
from brewster.errors import INSTALL_COMMAND, DiskFull, ModelError, counted
from brewster.models import zoo
from brewster.models.published_networks import PUBLISHED_NETWORKS
from brewster.options import Options
from brewster.remote_path import Location, location

if TYPE_CHECKING:
    from brewster.batch import FileResult, SeparationTask
    from brewster.batch.index import CsvReport, IndexWriter
    from brewster.batch.plan import Burst
    from brewster.executors.local import Executor


@final
@dataclass
class BatchReport:
    """Prints a line for each result, and at the end a summary, and writes the contact sheet and the index. The summary
    is printed if all `count` photos have a result, also after an error. The results are not kept in memory, because
    an archive can have millions of photos."""

    options: Options
    output: str | None
    count: int
    _: KW_ONLY
    dry_run: bool
    as_json: bool
    quiet: bool
    overwrite: bool
    is_parallel: bool = False
    contact_sheet: Path | None = None
    report: Path | None = None
    counts: Counter[str] = field(default_factory=Counter)
    _verdicts: Counter[str] = field(default_factory=Counter)
    _next_steps: dict[str, str] = field(default_factory=dict)
    """By verdict."""
    _contact_sheet_rows: list[tuple[Location, list[Location]]] = field(default_factory=list)
    _errors: list[str] = field(default_factory=list)
    _sources_by_shared_error: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    _skipped: dict[str, tuple[int, str]] = field(default_factory=dict)
    """The number of skipped photos, and the last one, by the options of their layers that differ from those of this batch."""
    _bursts: dict[str, Burst] = field(default_factory=dict)
    _tables: list[IndexWriter | CsvReport] = field(default_factory=list)
    _started: float = field(default_factory=time.perf_counter)

    def run(
        self,
        tasks: Sequence[SeparationTask],
        *,
        workers: int | None = None,
        cluster: str | None = None,
        has_index: bool = False,
    ) -> int:
        """Separates the photos or bursts of the tasks, and prints their results. Returns the exit code."""
        from brewster.batch import separate_tasks  # noqa: PLC0415  (imports ONNX Runtime and pyvips)
        from brewster.batch.parallel import separate_in_parallel  # noqa: PLC0415

        self._bursts = {task.name: task.burst for task in tasks if task.burst}
        self._announce_time(tasks)
        with ExitStack() as stack:
            stack.push(self._finish)
            if has_index and self.output and not self.dry_run:
                from brewster.batch.index import IndexWriter  # noqa: PLC0415

                self._tables.append(stack.enter_context(closing(IndexWriter(location(self.output)))))
            if self.report and not self.dry_run:
                from brewster.batch.index import CsvReport  # noqa: PLC0415

                self._tables.append(stack.enter_context(closing(CsvReport(self.report))))
            is_shown = not (self.quiet or self.as_json)
            update_progress = stack.enter_context(progress(self.count, shown=is_shown))
            overwrite, dry_run = self.overwrite, self.dry_run
            if self.is_parallel:
                executor = stack.enter_context(self._executor(workers, cluster))
                results = separate_in_parallel(tasks, executor, overwrite=overwrite)
            else:
                results = separate_tasks(
                    tasks,
                    self.options,
                    overwrite=overwrite,
                    dry_run=dry_run,
                    on_progress=lambda done, name, fraction: update_progress(done + fraction, name),
                )
            for result in results:
                self.add(result)
                update_progress(self.counts.total(), result.source)
        return 1 if self.counts["failed"] else 0

    def _announce_time(self, tasks: Sequence[SeparationTask]) -> None:
        """With a published network, prints how long the photos without layers take."""
        from brewster.files import exists  # noqa: PLC0415

        network = PUBLISHED_NETWORKS.get(self.options.model)
        if not network or self.quiet or self.dry_run:
            return
        has_layers = (
            all(isinstance(path, Location) and exists(path) for path in task.outputs.values())
            for task in tasks
        )
        left = len(tasks) if self.overwrite else sum(not done for done in has_layers)
        seconds, measured = network.seconds_per_photo(self.options.quality)
        print_status(f"{counted(left, 'photo')}, about {_duration(left * seconds)} ({measured})")

    def _executor(self, workers: int | None, cluster: str | None) -> Executor[FileResult]:
        from brewster.batch.parallel import SeparationRunner  # noqa: PLC0415
        from brewster.executors.local import ProcessExecutor  # noqa: PLC0415

        shared_folder = location(self.output) if cluster and self.output else None
        create_runner = partial(SeparationRunner, self.options, shared_folder, overwrite=self.overwrite)
        if not cluster:
            return ProcessExecutor(create_runner, workers or 1)
        from brewster.executors.ray_cluster import RayExecutor  # noqa: PLC0415

        return RayExecutor(create_runner, cluster, workers)

    def _finish(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        """Writes the contact sheet of the photos whose layers are files if there was no error, and prints the summary. A full disk
        is one error, with the numbers of the photos that are finished and left."""
        if isinstance(error, DiskFull):
            finished = self.counts["separated"] + self.counts["skipped"]
            cause = error.__context__  # a table of this batch cannot be written, either
            while cause:
                error.happened = cause.happened if isinstance(cause, DiskFull) else error.happened
                cause = cause.__context__
            self._errors = [text for text in self._errors if error.happened not in text]
            error.cure = (
                "free some space, and run the same command again: "
                f"{finished:,} of {counted(self.count, 'photo')} are finished, {self.count - finished:,} left"
            )
        try:
            if kind is None and self.contact_sheet and not self.dry_run:
                from brewster.photo.contact_sheet import write_contact_sheets  # noqa: PLC0415

                rows = sorted(self._contact_sheet_rows) if self.is_parallel else self._contact_sheet_rows
                limit, overwrite = self.options.max_pixels, self.overwrite
                for sheet in write_contact_sheets(self.contact_sheet, rows, limit, overwrite=overwrite):
                    if not self.quiet:
                        print_status(f"contact sheet: {sheet}")
        finally:
            if self.counts.total() == self.count or isinstance(error, DiskFull):
                self._print_summary()

    def add(self, result: FileResult) -> None:
        """Counts a result, and prints its line: JSON on standard output, or a status line on standard error."""
        if result.error:
            interrupts.raise_pending()  # a Ctrl-C that Python dropped may have caused the error
        for table in self._tables:
            table.append(result)
        self.counts[result.status] += 1
        if result.assessment and result.status == "separated":
            self._verdicts[result.assessment.verdict] += 1
            if result.next_step and not result.burst:
                self._next_steps[result.assessment.verdict] = result.next_step
        # The folder of the photos, where the layers belong, cannot be written to
        about_folder = f"{Path(result.source).parent.absolute()} was not written "
        if result.error and (INSTALL_COMMAND in result.error or result.error.startswith(about_folder)):
            self._sources_by_shared_error[result.error].append(result.source)
        elif result.error:
            has_source = result.error.startswith(f"{result.source} ") or f": {result.source} " in result.error
            self._errors.append(result.error if has_source else f"{result.source}: {result.error}")
        elif self.contact_sheet and "-" not in (result.source, *result.outputs.values()):
            self._contact_sheet_rows.append(
                (location(result.source), [*map(location, result.outputs.values())])
            )
        self._print(result)

    def _print(self, result: FileResult) -> None:
        outputs = ", ".join(result.outputs.values())
        if self.as_json:
            seconds = {name: round(duration, 4) for name, duration in result.seconds.items()}
            write_out(f"{json.dumps(asdict(result) | {'seconds': seconds})}\n".encode())
        elif result.status == "planned":
            write_out(f"{one_line(result.source)} -> {one_line(outputs)}\n".encode())
        if self.quiet or result.error:
            return
        if result.status == "skipped":
            # A parallel batch does not read an existing layer a second time to compare its options with the current ones,
            # because that takes time.
            different_options = "" if self.is_parallel else self._different_options(result)
            number, _ = self._skipped.get(different_options, (0, ""))
            self._skipped[different_options] = number + 1, result.source
        elif result.status == "separated":
            frames = counted(result.frames_written or 0, "frame")
            verdict = result.assessment.verdict if result.assessment else frames
            hint = ": check the layers" if verdict == "doubtful" else ""
            print_status(
                f"{result.source} -> {outputs} ({sum(result.seconds.values()):.1f} s, {verdict}{hint})"
            )
            if result.note:
                print_status(f"  {result.note}")
            if result.burst:
                print_status(
                    f"  {result.burst.method}: {result.burst.message} {result.next_step or ''}".rstrip()
                )

    def _different_options(self, result: FileResult) -> str:
        """Returns the options in the metadata of the existing layers that differ from the options of this batch."""
        from brewster.photo.history import PROGRAM, recorded_parameters, separation_parameters  # noqa: PLC0415

        names = ("strength", "quality", "additive", "mask", "hints")
        expected = separation_parameters(**{name: getattr(self.options, name) for name in names})
        burst = self._bursts.get(result.source)
        expected["burst"] = f"{burst.photo_count} photos" if burst else "no"
        expected |= {"requested": burst.method, "swapped": "yes" if burst.swap else "no"} if burst else {}
        metadata = (recorded_parameters(Path(path), PROGRAM) for path in result.outputs.values())
        recorded = next((parameters for parameters in metadata if parameters), {})
        with suppress(ModelError):  # the model is unknown
            if not zoo.is_diffusion_model(self.options.model):
                expected["model"] = zoo.find_model(self.options.model).name
            elif recorded.get("model") in zoo.MODELS:
                # The name of a diffusion model is known only after loading, but it is none of these
                expected["model"] = self.options.model
        if burst and burst.is_from_video and recorded.get("burst", "no") != "no":
            del expected["burst"]  # a short video has fewer frames than --frames
        different = {name for name, value in expected.items() if recorded.get(name, value) != value}
        return ", ".join(f"{name}={recorded[name]}" for name in expected if name in different)

    def _print_summary(self) -> None:
        """Prints the counts, the time and the errors. Photos with the same cause share a message."""
        for different_options, (number, source) in self._skipped.items():
            photos = source if number == 1 else counted(number, "photo")
            note = f", made with other options ({different_options})" if different_options else ""
            if not note and (self.options.mask or self.options.hints):
                note = ", perhaps made with another mask or other hints"
            print_status(f"{photos}: skipped, because all layers exist{note} (--overwrite replaces them)")
        if self.counts.total() > 1 and not self.quiet:
            order = ("separated", "planned", "skipped", "failed")
            totals = ", ".join(f"{self.counts[status]} {status}" for status in order if self.counts[status])
            folder = f"in {self.output}" if self.output else "next to the photos"
            layers = f"; the layers are {folder}" if self.counts.keys() & {"separated", "skipped"} else ""
            seconds = time.perf_counter() - self._started
            print_status(totals if self.dry_run else f"{totals} in {_duration(seconds)}{layers}")
        if self._verdicts.total() > 1 and not self.quiet:
            from brewster.inference.assessment import Verdict  # noqa: PLC0415

            verdicts = (
                f"{self._verdicts[name]:,} {name}" for name in get_args(Verdict) if self._verdicts[name]
            )
            print_status(f"{', '.join(verdicts)}: list them with --json or --report FILE.csv")
        for verdict, step in self._next_steps.items() if not self.quiet else ():
            print_status(f"{verdict}: {step}")
        for message in self._errors:
            print_error(message)
        for message, sources in self._sources_by_shared_error.items():
            print_error(f"{sources[0] if len(sources) == 1 else listed(sources, 'photo')}: {message}")


def _duration(seconds: float) -> str:
    """Returns `4.2 s`, `3 min 5 s` or `2 h 40 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
