"""Runs `brewster separate` and prints its output: progress, one line for each photo, a summary.

The photos are separated by `brewster.inference.batch`.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final

import click

from brewster.cli.terminal import (
    interrupts,
    one_line,
    print_error,
    print_status,
    progress,
    standard_output,
    write_out,
)
from brewster.image_formats import ImageFormat, format_of
from brewster.options import Options
from brewster.remote_path import location

if TYPE_CHECKING:
    from brewster.inference import FileResult, SeparationTask


def is_single_output(photos: Sequence[str], output: str | None) -> bool:
    """Whether only one layer can be written, because its target is standard output or one image file (-o)."""
    return "-" in photos or output == "-" or _is_image_file(output)


def plan(photos: Sequence[str], output: str | None, options: Options) -> list[SeparationTask]:
    """Lists the photos in files and folders, each with the targets of its layers.

    Raises:
        click.UsageError: the arguments contradict each other.
        TargetError: two photos would be written under the same name.
        PhotoError: the files and folders contain no photo.
    """
    from brewster.inference import plan_files  # noqa: PLC0415  (imports ONNX Runtime and pyvips)

    if is_single_output(photos, output):
        return [_plan_single_output(photos, output, options)]
    return plan_files(photos, output, options)


def _plan_single_output(photos: Sequence[str], output: str | None, options: Options) -> SeparationTask:
    from brewster.inference import SeparationTask  # noqa: PLC0415

    if len(photos) > 1 or Path(photos[0]).is_dir():
        raise click.UsageError(
            "With standard input, standard output or an image file as the target (-o), give exactly one photo."
        )
    if len(options.layers) > 1:
        raise click.UsageError(
            "Standard output and an image file as the target (-o) take one layer: choose it with --layers."
        )
    if output not in (None, "-"):
        _check_format(format_of(Path(output)), options)
    source = _StandardStream() if photos[0] == "-" else location(photos[0])
    target = _StandardStream() if output in (None, "-") else location(output)
    return SeparationTask(source, {options.layers[0]: target})


def _check_format(image_format: ImageFormat | None, options: Options) -> None:
    """Checks that the format of the image file given with -o can be written, and that --format and --additive match it.

    Raises:
        click.UsageError: the format is unknown or cannot be written, or the options require another format.
    """
    if image_format is None:
        raise click.UsageError(
            "With standard input, -o takes an image file such as clear.jpg, or is left out."
        )
    name = image_format.name
    if not image_format.is_writable:
        raise click.UsageError(f"brewster cannot write {name.upper()}: choose another suffix for -o.")
    if options.layers != ("confidence",) and options.container(options.layers[0], name) != name:
        raise click.UsageError(
            f"The target of -o is a {name} file, but --format or --additive requires another format."
        )


def _is_image_file(output: str | None) -> bool:
    return (
        output is not None
        and not output.endswith(("/", os.sep))
        and format_of(Path(output)) is not None
        and not Path(output).is_dir()
    )


@final
class _StandardStream:
    """Standard input as the source of a photo, standard output as the target of a layer."""

    def read(self) -> bytes:
        """The bytes of the photo."""
        return sys.stdin.buffer.read()

    def write(self, data: bytes) -> None:
        """Writes the encoded layer.

        Raises:
            TargetError: standard output cannot be written.
        """
        write_out(data)


@final
@dataclass(frozen=True)
class BatchCommand:
    """The options of a batch. `run` separates the photos and prints the results."""

    options: Options
    overwrite: bool = False
    dry_run: bool = False
    as_json: bool = False
    quiet: bool = False

    def run(self, tasks: Sequence[SeparationTask]) -> bool:
        """Separates all photos and prints the results.

        Returns:
            Whether no photo failed.

        Raises:
            ModelError: the model does not exist or is damaged.
            DeviceError: the requested device is not available.
        """
        results: list[FileResult] = []
        try:
            self._separate(tasks, results)
        finally:
            if len(results) == len(
                tasks
            ):  # true also if `separate_tasks` raises an unexpected exception after the last photo
                self._print_summary(results)
        return all(result.error is None for result in results)

    def _separate(self, tasks: Sequence[SeparationTask], results: list[FileResult]) -> None:
        """Separates the photos in order, appends the result of each to `results`, and prints it."""
        from brewster.inference.batch import separate_tasks  # noqa: PLC0415

        shares_terminal = self.as_json and standard_output.stream.isatty()
        with progress(len(tasks), shown=not self.quiet and not shares_terminal) as update_progress:

            def on_progress(done: int, name: str, fraction: float) -> None:
                interrupts.raise_pending()
                update_progress(done + fraction, name)

            for result in separate_tasks(
                tasks, self.options, overwrite=self.overwrite, dry_run=self.dry_run, on_progress=on_progress
            ):
                if result.error:
                    interrupts.raise_pending()  # a Ctrl-C that Python dropped may have caused the error
                results.append(result)
                self.print_result(result)
                interrupts.raise_pending()

    def print_result(self, result: FileResult) -> None:
        """Prints the line of a result: JSON on standard output, or a status line on standard error."""
        outputs = ", ".join(result.outputs.values())
        if self.as_json:
            write_out(_json_line(result))
        elif result.status == "planned":
            write_out(f"{one_line(result.source)} -> {one_line(outputs)}\n".encode())
        if self.quiet or result.error:
            return
        if result.status == "skipped":
            print_status(f"{result.source}: skipped, all of its layers exist (--overwrite replaces them)")
        elif result.status == "separated":
            verdict = result.assessment.verdict if result.assessment else ""
            hint = ": check the layers" if verdict == "doubtful" else ""
            seconds = sum(result.seconds.values())
            print_status(f"{result.source} -> {outputs} ({seconds:.1f} s, {verdict}{hint})")

    def _print_summary(self, results: Sequence[FileResult]) -> None:
        counts: Counter[str] = Counter(result.status for result in results)
        if len(results) > 1 and not self.quiet:
            order = ("separated", "planned", "skipped", "failed")
            print_status(", ".join(f"{counts[status]} {status}" for status in order if counts[status]))
        for result in results:
            if result.error:
                print_error(error_text(result))


def error_text(result: FileResult) -> str:
    """Returns the error message of a photo, which begins with its path."""
    has_source = str(result.error).startswith(f"{result.source} ")
    return str(result.error) if has_source else f"{result.source}: {result.error}"


def _json_line(result: FileResult) -> bytes:
    values = asdict(result)
    values["seconds"] = {name: round(seconds, 4) for name, seconds in result.seconds.items()}
    return f"{json.dumps(values)}\n".encode()
