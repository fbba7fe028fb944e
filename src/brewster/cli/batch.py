"""Photos one after another: what is finished is passed over, what fails is named at the end, the rest is done.

One photo is in memory at a time. The model is loaded when the first photo needs it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import click

from brewster.cli.terminal import (
    Advance,
    interrupts,
    one_line,
    print_error,
    print_status,
    progress,
    standard_output,
    write_out,
)
from brewster.errors import BrewsterError, PhotoError, TargetError
from brewster.files import SUFFIXES, find, write_atomically
from brewster.options import Options

if TYPE_CHECKING:
    from brewster.inference import Separator


@final
@dataclass(frozen=True)
class BatchItem:
    """A photo and where its layers go; None stands for standard input and standard output."""

    source: Path | None
    targets: dict[str, Path | None]

    @property
    def name(self) -> str:
        """The photo as it was named."""
        return "-" if self.source is None else str(self.source)


@final
@dataclass
class BatchResult:
    """What became of a photo: a line of `--json`."""

    source: str
    status: Literal["separated", "skipped", "planned", "failed"] = "separated"
    outputs: dict[str, str] = field(default_factory=dict)
    model: str | None = None
    sha256: str | None = None
    device: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    residual: float | None = None
    reconstruction_error: float | None = None
    doubtful: bool = False
    error: str | None = None


# --- what there is to do


def goes_to_one_file(photos: Sequence[str], output: str | None) -> bool:
    """Whether there is place for one layer only: standard output, or a picture named with -o."""
    return "-" in photos or output == "-" or _names_a_picture(output)


def plan(photos: Sequence[str], output: str | None, options: Options) -> list[BatchItem]:
    """The photos in the files and folders named, each with the files for its layers.

    Raises:
        click.UsageError: what was asked for does not go together.
        TargetError: two photos would be written under one name.
        PhotoError: there is no photo at all.
    """
    if goes_to_one_file(photos, output):
        return [_plan_one(photos, output, options)]
    tasks = [
        BatchItem(
            job.source,
            {layer: job.target(layer, options.suffix(layer, job.source)) for layer in options.layers},
        )
        for job in find(map(Path, photos), None if output is None else Path(output))
    ]
    if not tasks:
        raise PhotoError(
            f"there is no picture in {', '.join(photos)}",
            f"files are taken from folders by their names ({' '.join(SUFFIXES)})",
            "name the file itself, or another folder",
        )
    return tasks


def _plan_one(photos: Sequence[str], output: str | None, options: Options) -> BatchItem:
    if len(photos) > 1 or Path(photos[0]).is_dir():
        raise click.UsageError("Standard input, standard output and a picture named with -o take one photo.")
    if len(options.layers) > 1:
        raise click.UsageError(
            "Standard output and a picture named with -o take one layer: choose it with --layers."
        )
    target = None
    if output not in (None, "-"):
        target = Path(output)
        _refuse_container(SUFFIXES.get(target.suffix.lower()), options)
    source = None if photos[0] == "-" else Path(photos[0])
    return BatchItem(source, {options.layers[0]: target})


def _refuse_container(container: str | None, options: Options) -> None:
    """A picture named with -o has its container; --format and --additive may not ask for another."""
    if container is None:
        raise click.UsageError("With standard input, -o names a picture (such as clear.jpg), or is left out.")
    if container == "gif":
        raise click.UsageError("brewster writes no GIF.")
    if options.layers != ("confidence",) and options.container(options.layers[0], container) != container:
        raise click.UsageError(f"-o names a {container} picture, but --format or --additive ask for another.")


def _names_a_picture(output: str | None) -> bool:
    return (
        output is not None
        and not output.endswith(("/", os.sep))
        and Path(output).suffix.lower() in SUFFIXES
        and not Path(output).is_dir()
    )


# --- doing it


@final
@dataclass
class SeparationBatch:
    """How the photos are to be done."""

    options: Options
    overwrite: bool = False
    dry_run: bool = False
    as_json: bool = False
    quiet: bool = False

    def run(self, tasks: Sequence[BatchItem]) -> bool:
        """Does them all and tells; whether all went well.

        Raises:
            ModelError: no such model, or a damaged one.
            DeviceError: the asked device is not there.
        """
        entries: list[BatchResult] = []
        bugs: list[Exception] = []
        self._sources = {os.path.realpath(task.source) for task in tasks if task.source}
        talks_over_bar = self.as_json and standard_output.stream.isatty()
        with progress(len(tasks), shown=not self.quiet and not talks_over_bar) as advance:
            for task in tasks:
                advance(len(entries), task.name)
                self._show_progress = partial(_show_progress, advance, len(entries), task.name)
                entry = self._do(task, bugs)
                if entry.error:
                    interrupts.raise_pending()  # a dropped Ctrl-C may be all that was wrong
                entries.append(entry)
                self._tell(entry)
                interrupts.raise_pending()
        self._sum_up(entries)
        if bugs:
            raise bugs[0]  # ours, not the user's: the rest was done first, now it is shown whole
        return all(entry.error is None for entry in entries)

    @cached_property
    def _separator(self) -> Separator:
        from brewster.inference import Separator  # noqa: PLC0415  (wakes ONNX Runtime and pyvips)

        return Separator.load(**self.options.load())

    def _do(self, task: BatchItem, bugs: list[Exception]) -> BatchResult:
        entry = BatchResult(task.name)
        try:
            missing = self._missing(task)
        except BrewsterError as error:
            return _failed(entry, error)
        if not missing or self.dry_run:
            entry.status = "planned" if missing else "skipped"
            entry.outputs = {layer: str(path or "-") for layer, path in (missing or task.targets).items()}
            return entry
        separator = self._separator  # without a model no photo can be done: its errors end the batch
        entry.model, entry.sha256, entry.device = separator.name, separator.sha256, separator.device
        try:
            self._separate(task.source, missing, entry)
        except BrewsterError as error:
            return _failed(entry, error)
        except MemoryError:
            return _failed(entry, "the photo does not fit into memory; free some, or make it smaller")
        except Exception as bug:  # noqa: BLE001  (raised again after the other photos)
            bugs.append(bug)
            del bugs[1:]  # each one keeps its photo in memory
            return _failed(entry, f"brewster stumbled ({type(bug).__name__}: {bug}); please report it")
        return entry

    def _missing(self, task: BatchItem) -> dict[str, Path | None]:
        """The layers that are still to be written.

        Raises:
            TargetError: one would be written over a photo.
        """
        for target in task.targets.values():
            if target is not None and self._is_source(target, task.source):
                raise TargetError(
                    f"{target} is itself a photo to separate",
                    "sources are never touched",
                    "choose another name",
                )
        return {
            layer: target
            for layer, target in task.targets.items()
            if target is None or self.overwrite or not os.path.lexists(target)
        }

    def _is_source(self, target: Path, source: Path | None) -> bool:
        if os.path.realpath(target) in self._sources:
            return True
        try:
            return source is not None and target.samefile(source)
        except OSError:  # one of them is not there
            return False

    def _separate(self, source: Path | None, targets: dict[str, Path | None], entry: BatchResult) -> None:
        photo = source or sys.stdin.buffer.read()
        separation = self._separator(photo, on_progress=self._show_progress, **self.options.call())
        entry.seconds, entry.residual = dict(separation.seconds), separation.residual
        entry.reconstruction_error, entry.doubtful = separation.reconstruction_error, separation.doubtful
        started = time.perf_counter()
        for layer, target in targets.items():
            own = separation.photo.file_info.container
            container = SUFFIXES[target.suffix.lower()] if target else self.options.container(layer, own)
            data = getattr(separation, layer).encode(container)
            interrupts.raise_pending()
            if target is None:
                write_out(data)
            else:
                write_atomically(target, data, overwrite=self.overwrite, source=source)
            entry.outputs[layer] = str(target or "-")
        entry.seconds["encode"] = time.perf_counter() - started

    def _tell(self, entry: BatchResult) -> None:
        outputs = ", ".join(entry.outputs.values())
        if self.as_json:
            write_out(_json_line(entry))
        elif entry.status == "planned":
            write_out(f"{one_line(entry.source)} -> {one_line(outputs)}\n".encode())
        if self.quiet or entry.error:
            return
        if entry.status == "skipped":
            print_status(f"{entry.source}: skipped, its layers are there (--overwrite makes them again)")
        elif entry.status == "separated":
            print_status(f"{entry.source} -> {outputs} ({sum(entry.seconds.values()):.1f} s)")
            if entry.doubtful:
                print_status(
                    f"{entry.source}: doubtful, the model redrew the photo (reconstruction_error {entry.reconstruction_error:.2f}): look at it"
                )

    def _sum_up(self, entries: Sequence[BatchResult]) -> None:
        counts = dict.fromkeys(("separated", "planned", "skipped", "failed"), 0)
        for entry in entries:
            counts[entry.status] += 1
        if len(entries) > 1 and not self.quiet:
            print_status(", ".join(f"{count} {status}" for status, count in counts.items() if count))
        for entry in entries:
            if entry.error:
                is_named = entry.error.startswith(f"{entry.source} ")
                print_error(entry.error if is_named else f"{entry.source}: {entry.error}")


def _show_progress(advance: Advance, before: int, name: str, share: float) -> None:
    """A large model takes minutes for a photo: the bar moves between two of them, too, and Ctrl-C is heeded."""
    interrupts.raise_pending()
    advance(before + share, name)


def _failed(entry: BatchResult, error: object) -> BatchResult:
    entry.status, entry.error = "failed", str(error)
    return entry


def _json_line(entry: BatchResult) -> bytes:
    said = asdict(entry)
    said["seconds"] = {name: round(seconds, 4) for name, seconds in entry.seconds.items()}
    return f"{json.dumps(said)}\n".encode()
