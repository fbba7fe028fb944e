"""The results of `brewster separate`, and how they are printed: one line for each photo, and a
summary.
"""

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, final, get_args

from brewster.base.remote_path import Location, location
from brewster.cli.batch_plan import listed
from brewster.cli.extras import EXTRAS, missing_packages
from brewster.cli.terminal import (
    interrupts,
    one_line,
    print_error,
    print_status,
    progress,
    write_out,
)
from brewster.errors import DiskFull, ModelError, counted
from brewster.options import FILM_AUTO, FILM_NO, Options
from brewster.separation import registry
from brewster.separation.models.published_networks import PUBLISHED_NETWORKS

if TYPE_CHECKING:
    from brewster.base.executors.local import Executor
    from brewster.batch import FileResult, SeparationTask
    from brewster.batch.task import Burst


_MAX_SEARCHED: Final = 200
"""How many photos of a batch are searched for films before it begins, to announce its time."""
_FILM_SECONDS: Final = 3, 15
"""How long the film of a photo takes on two cores if it shows nothing, and if it separates the
photo, see dev/notes/phone-photos.md.
"""


@final
@dataclass
class BatchReport:
    """Prints a line for each result, and at the end a summary. The results are not kept in memory,
    because an archive can have millions of photos.
    """

    options: Options
    output: str | None
    _: KW_ONLY
    dry_run: bool
    as_json: bool
    quiet: bool
    overwrite: bool
    is_parallel: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    _verdicts: Counter[str] = field(default_factory=Counter)
    _next_steps: dict[str, str] = field(default_factory=dict)
    """By verdict."""
    _errors: dict[tuple[str, str], list[str]] = field(default_factory=lambda: defaultdict(list))
    """The sources by the message, and by the source itself unless the cause is not in the photo."""
    _skipped: dict[str, tuple[int, str]] = field(default_factory=dict)
    """The number of skipped photos, and the last one, by the options of their layers that differ
    from those of this batch.
    """
    _started: float = field(default_factory=time.perf_counter)

    def run(
        self,
        tasks: Sequence[SeparationTask],
        *,
        workers: int | None = None,
        cluster: str | None = None,
        report: Path | None = None,
        contact_sheet: Path | None = None,
    ) -> int:
        """Separates the photos or bursts of the tasks, prints their results, and writes the report
        and the contact sheet. Returns the exit code. The summary is printed if all photos have a
        result, also after an error.
        """
        from brewster.batch import separate_tasks  # noqa: PLC0415  (imports ONNX Runtime and pyvips)

        self.is_parallel = bool(workers or cluster) and not self.dry_run
        self._announce_time(tasks)
        self._announce_films(tasks)
        self._announce_preparation(tasks)
        bursts = {task.name: task.burst for task in tasks if task.burst}
        sheet_rows = list[tuple[Location, list[Location]]]()
        is_shown = not (self.quiet or self.as_json)
        with ExitStack() as stack:
            stack.push(partial(self._finish, len(tasks)))
            table = None
            if report and not self.dry_run:
                from brewster.batch.report import CsvReport  # noqa: PLC0415

                table = stack.enter_context(
                    closing(CsvReport(report))
                )  # it is written also after an error
            executor = (
                stack.enter_context(self._executor(workers, cluster)) if self.is_parallel else None
            )
            with progress(len(tasks), shown=is_shown) as update_progress:
                for result in separate_tasks(
                    tasks,
                    self.options,
                    overwrite=self.overwrite,
                    dry_run=self.dry_run,
                    executor=executor,
                    on_progress=lambda done, name, part: update_progress(done + part, name),
                ):
                    if result.error:
                        # A Ctrl-C that Python dropped may have caused the error
                        interrupts.raise_pending()
                    if table:
                        table.append(result)
                    if contact_sheet and not result.error:
                        layers = [*map(location, result.outputs.values())]
                        sheet_rows.append((location(result.source), layers))
                    self.add(result, bursts.get(result.source))
                    update_progress(self.counts.total(), result.source)
            if contact_sheet and not self.dry_run:
                self._write_contact_sheets(contact_sheet, sheet_rows)
        return 1 if self.counts["failed"] else 0

    def _write_contact_sheets(
        self, path: Path, rows: list[tuple[Location, list[Location]]]
    ) -> None:
        from brewster.photo.contact_sheet import write_contact_sheets  # noqa: PLC0415

        ordered = sorted(rows) if self.is_parallel else rows
        labelled = ((str(source), (source, *layers)) for source, layers in ordered)
        for sheet in write_contact_sheets(
            path, labelled, self.options.max_pixels, overwrite=self.overwrite
        ):
            if not self.quiet:
                print_status(f"contact sheet: {sheet}")

    def _announce_films(self, tasks: Sequence[SeparationTask]) -> None:
        """Prints how many photos of a batch contain a film, and how long that takes."""
        if self.quiet or self.dry_run or len(tasks) < 2 or self.options.film != FILM_AUTO:
            return
        if missing_packages(EXTRAS["burst"]):
            return
        from brewster.separation.used_film import find_used_film  # noqa: PLC0415

        photos = (task for task in tasks if not task.burst and isinstance(task.source, Path))
        left = self._left(photos)
        looked_at = [*islice(left, _MAX_SEARCHED)]
        films = sum(find_used_film(task.source, FILM_AUTO).film is not None for task in looked_at)
        if films:
            of = f"the first {_MAX_SEARCHED} photos" if any(left) else "photos"
            print_status(
                f"{films} of {len(looked_at)} {of} contain a film, which takes "
                f"{_FILM_SECONDS[0]} to {_FILM_SECONDS[1]} s more for each (--film no leaves the "
                "films out)"
            )

    def _announce_time(self, tasks: Sequence[SeparationTask]) -> None:
        """With a published network, prints how long the photos without layers take."""
        network = PUBLISHED_NETWORKS.get(self.options.model)
        if not network or self.quiet or self.dry_run:
            return
        left = sum(1 for _ in self._left(tasks))
        seconds, measured = network.seconds_per_photo(self.options.quality)
        print_status(f"{counted(left, 'photo')}, about {_duration(left * seconds)} ({measured})")

    def _announce_preparation(self, tasks: Sequence[SeparationTask]) -> None:
        """Says that the first burst after an installation that is separated by its motion takes
        longer.
        """
        if self.quiet or self.dry_run or missing_packages(EXTRAS["burst"]):
            return
        if self.options.method not in ("auto", "motion"):
            return
        if any(self._left(task for task in tasks if task.burst)):
            from brewster.film.motion.compilation import is_compiled  # noqa: PLC0415  (imports numba)

            if not is_compiled():
                print_status("the first separation by motion takes about 10 s more, once")

    def _left(self, tasks: Iterable[SeparationTask]) -> Iterator[SeparationTask]:
        """Yields the tasks that have layers to write."""
        from brewster.batch.remaining import is_finished  # noqa: PLC0415

        return (task for task in tasks if self.overwrite or not is_finished(task))

    def _executor(self, workers: int | None, cluster: str | None) -> Executor[FileResult]:
        from brewster.base.executors.local import ProcessExecutor  # noqa: PLC0415
        from brewster.batch.runner import SeparationRunner  # noqa: PLC0415

        shared_folder = location(self.output) if cluster and self.output else None
        if isinstance(
            shared_folder, Path
        ):  # the workers expect it: without it, a node has not mounted it
            shared_folder.mkdir(parents=True, exist_ok=True)
        create_runner = partial(
            SeparationRunner, self.options, overwrite=self.overwrite, shared_folder=shared_folder
        )
        if not cluster:
            return ProcessExecutor(create_runner, workers or 1)
        from brewster.base.executors.ray_cluster import RayExecutor  # noqa: PLC0415

        return RayExecutor(create_runner, cluster, workers)

    def _finish(
        self,
        count: int,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _trace: object,
    ) -> None:
        """Prints the summary. A full disk is one error, with the numbers of the photos that are
        finished and left.
        """
        if isinstance(error, DiskFull):
            finished = self.counts["separated"] + self.counts["skipped"]
            cause = error.__context__  # a table of this batch cannot be written, either
            while cause:
                error.happened = cause.happened if isinstance(cause, DiskFull) else error.happened
                cause = cause.__context__
            error.cure = (
                "free some space, and run the same command again: "
                f"{finished:,} of {counted(count, 'photo')} are finished, {count - finished:,} left"
            )
        if self.counts.total() == count or isinstance(error, DiskFull):
            self._print_summary()

    def add(self, result: FileResult, burst: Burst | None = None) -> None:
        """Counts a result, and prints its line: JSON on standard output, or a status line on
        standard error.
        """
        self.counts[result.status] += 1
        interrupts.has_finished_work |= result.status in ("separated", "skipped")
        if result.assessment and result.status == "separated":
            self._verdicts[result.assessment.verdict] += 1
            if result.next_step and not result.burst:
                self._next_steps[result.assessment.verdict] = result.next_step
        if (
            result.error and result.kind != "DiskFull"
        ):  # which ends the batch, and is printed at its end
            is_shared = result.kind in ("MissingExtra", "OutputError")
            self._errors[result.error, "" if is_shared else result.source].append(result.source)
        self._print(result, burst)

    def _print(self, result: FileResult, burst: Burst | None) -> None:
        outputs = ", ".join(result.outputs.values())
        if self.as_json:
            write_out(f"{json.dumps(result.as_dict())}\n".encode())
        elif result.status == "planned":
            write_out(f"{one_line(result.source)} -> {one_line(outputs)}\n".encode())
        if self.quiet or result.error:
            return
        if result.status == "skipped":
            # A parallel batch does not read an existing layer a second time to compare its options
            # with the current ones, because that takes time.
            different_options = "" if self.is_parallel else self._different_options(result, burst)
            number, _ = self._skipped.get(different_options, (0, ""))
            self._skipped[different_options] = number + 1, result.source
        elif result.status == "separated":
            frames = counted(result.frames_written or 0, "frame")
            verdict = result.assessment.verdict if result.assessment else frames
            hint = ": check the layers" if verdict == "doubtful" else ""
            print_status(
                f"{result.source} -> {outputs} ({sum(result.seconds.values()):.1f} s, "
                f"{verdict}{hint})"
            )
            if result.note:
                print_status(f"  {result.note}")
            if result.burst:
                message = f"{result.burst.message} {result.next_step or ''}".rstrip()
                print_status(f"  {result.burst.method}: {message}")

    def _different_options(self, result: FileResult, burst: Burst | None) -> str:
        """Returns the options in the metadata of the existing layers that differ from the options
        of this batch.
        """
        from brewster.photo.history import PROGRAM, recorded_parameters, separation_parameters  # noqa: PLC0415

        names = ("strength", "quality", "additive", "mask", "hints")
        expected = separation_parameters(**{name: getattr(self.options, name) for name in names})
        expected["burst"] = f"{burst.photo_count} photos" if burst else "no"
        if burst:
            expected |= {
                "requested": self.options.method,
                "swapped": "yes" if self.options.swap else "no",
            }
        metadata = (recorded_parameters(Path(path), PROGRAM) for path in result.outputs.values())
        recorded = next((parameters for parameters in metadata if parameters), {})
        with suppress(ModelError):  # the model is unknown
            expected["model"] = registry.find(self.options.model).name
        if burst is None or burst.is_one_photo:  # a phone may have recorded a film around it
            is_by_film = "film" in recorded and self.options.film != FILM_NO
        else:
            is_by_film = burst.is_from_video and recorded.get("burst", "no") != "no"
        if is_by_film:
            del expected["burst"]  # the number of frames follows from the film
        different = {name for name, value in expected.items() if recorded.get(name, value) != value}
        return ", ".join(f"{name}={recorded[name]}" for name in expected if name in different)

    def _print_summary(self) -> None:
        """Prints the counts, the time and the errors. Photos with the same cause share a
        message.
        """
        for different_options, (number, source) in self._skipped.items():
            photos = source if number == 1 else counted(number, "photo")
            note = f", made with other options ({different_options})" if different_options else ""
            if not note and (self.options.mask or self.options.hints):
                note = ", perhaps made with another mask or other hints"
            print_status(
                f"{photos}: skipped, because all layers exist{note} (--overwrite replaces them)"
            )
        if self.counts.total() > 1 and not self.quiet:
            order = ("separated", "planned", "skipped", "failed")
            totals = ", ".join(
                f"{self.counts[status]} {status}" for status in order if self.counts[status]
            )
            folder = f"in {self.output}" if self.output else "next to the photos"
            layers = (
                f"; the layers are {folder}"
                if self.counts.keys() & {"separated", "skipped"}
                else ""
            )
            seconds = time.perf_counter() - self._started
            print_status(totals if self.dry_run else f"{totals} in {_duration(seconds)}{layers}")
        if self._verdicts.total() > 1 and not self.quiet:
            from brewster.separation.assessment import Verdict  # noqa: PLC0415

            verdicts = (
                f"{self._verdicts[name]:,} {name}"
                for name in get_args(Verdict)
                if self._verdicts[name]
            )
            print_status(f"{', '.join(verdicts)}: list them with --json or --report FILE.csv")
        for verdict, step in self._next_steps.items() if not self.quiet else ():
            print_status(f"{verdict}: {step}")
        for (message, _), sources in self._errors.items():
            named = sources[0] if len(sources) == 1 else listed(sources, "photo")
            has_source = message.startswith(f"{named} ") or f": {named} " in message
            print_error(message if has_source else f"{named}: {message}")


def _duration(seconds: float) -> str:
    """Returns `4.2 s`, `3 min 5 s` or `2 h 40 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
