"""Runs `brewster separate` and prints its output: progress, one line for each photo, a summary.

The photos are separated by `brewster.inference.batch`.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

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
from brewster.errors import ModelError
from brewster.files import LAYER_FORMATS, find_videos
from brewster.image_formats import WRITABLE, ImageFormat, format_of
from brewster.models import zoo
from brewster.options import Options
from brewster.remote_path import location, path_of_file_url

if TYPE_CHECKING:
    from brewster.inference import FileResult, SeparationTask


_MAX_NAMES: Final = 10
"""Maximum number of file names in a message."""


def local_path(text: str) -> str:
    """Returns the path in an argument that is a file:// address or has quotes around it.

    File managers and some terminals pass a dropped file in this form. The name of an existing file is never changed.
    """
    if os.path.lexists(text):
        return text
    if len(text) > 2 and text[0] == text[-1] and text[0] in "'\"":
        text = text[1:-1]
    return path_of_file_url(text) if text.startswith("file://") else text


def skipped_videos(photos: Sequence[str]) -> str | None:
    """Returns a line about the videos in the folders, or None if the folders contain no video."""
    videos = find_videos(map(location, photos))
    if not videos:
        return None
    return f"{_counted(videos, 'video')} skipped: brewster separates photos; extract single images first, for example with ffmpeg"


def _counted(names: Sequence[object], kind: str) -> str:
    """Returns `2 videos (a.mp4, b.mov)`, with at most `_MAX_NAMES` names."""
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f"{len(names)} {kind}{'s' * (len(names) != 1)} ({', '.join(map(str, names[:_MAX_NAMES]))}{more})"


def is_single_output(photos: Sequence[str], output: str | None) -> bool:
    """Whether only one layer can be written, because it is written to standard output or to an image file (-o)."""
    return "-" in photos or output == "-" or _is_image_file(output)


def plan(photos: Sequence[str], output: str | None, options: Options) -> list[SeparationTask]:
    """Returns a task for each photo in the files and folders. A task contains the paths of the photo and of its layers.

    Raises:
        click.UsageError: the arguments contradict each other.
        OutputError: the layers of two photos would have the same path.
        PhotoError: the files and folders contain no photo.
    """
    from brewster.inference import plan_files  # noqa: PLC0415  (imports ONNX Runtime and pyvips)

    if is_single_output(photos, output):
        return [_plan_single_output(photos, output, options)]
    _check_output_folder(photos, output)
    return plan_files(photos, output, options)


def _plan_single_output(photos: Sequence[str], output: str | None, options: Options) -> SeparationTask:
    from brewster.inference import SeparationTask  # noqa: PLC0415

    if len(photos) > 1 or Path(photos[0]).is_dir():
        raise click.UsageError(
            "Give exactly one photo if it is standard input, or if -o is standard output or an image file."
        )
    if len(options.layers) > 1:
        raise click.UsageError(
            "Only one layer can be written to standard output or to an image file (-o): choose it with --layers."
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
            "If the photo is standard input, -o must be an image file such as clear.jpg, or be left out."
        )
    name = image_format.name
    layer = options.layers[0]
    if not image_format.is_writable and LAYER_FORMATS.get(layer) != name:
        raise click.UsageError(f"brewster cannot write {name.upper()}: choose another suffix for -o.")
    if layer != "confidence" and options.container(layer, name) != name:
        raise click.UsageError(
            f"The output file (-o) is a {name} file, but --format, --additive or --layers requires another format."
        )


def _check_output_folder(photos: Sequence[str], output: str | None) -> None:
    """Checks that -o for a single photo is not an image file of an unknown format.

    Raises:
        click.UsageError: -o ends in an unknown suffix, and is not an existing folder.
    """
    if output is None or output.endswith(("/", os.sep)) or len(photos) > 1:
        return
    suffix = Path(output).suffix
    if (
        re.fullmatch(r"\.[A-Za-z][A-Za-z0-9]{1,4}", suffix)
        and not os.path.isdir(output)  # noqa: PTH112  (Path.is_dir raises for names that are too long)
        and not os.path.isdir(photos[0])  # noqa: PTH112
    ):
        raise click.UsageError(
            f"-o ends in {suffix}, but brewster writes no format with this suffix. Choose one of "
            f"{', '.join(row.suffixes[0] for row in WRITABLE.values())}. If -o is a folder, add {os.sep} at its end."
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
    """Reads a photo from standard input, or writes a layer to standard output."""

    def read(self) -> bytes:
        """Returns the bytes of the photo."""
        return sys.stdin.buffer.read()

    def write(self, data: bytes) -> None:
        """Writes the encoded layer.

        Raises:
            OutputError: standard output cannot be written.
        """
        write_out(data)


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

    def run(self, tasks: Sequence[SeparationTask]) -> bool:
        """Separates all photos and prints the results.

        Returns:
            Whether no photo failed.

        Raises:
            ModelError: the model does not exist or is damaged.
            DeviceError: the requested device is not available.
        """
        results: list[FileResult] = []
        started = time.perf_counter()
        try:
            self._separate(tasks, results)
            if self.contact_sheet and not self.dry_run:
                self._write_contact_sheet(self.contact_sheet, results)
        finally:
            # This is also true if `separate_tasks` raises an unexpected exception after the last photo.
            if len(results) == len(tasks):
                self._print_summary(results, time.perf_counter() - started)
        return all(result.error is None for result in results)

    def _separate(self, tasks: Sequence[SeparationTask], results: list[FileResult]) -> None:
        """Separates the photos in order. Appends each result to `results` and prints it."""
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
            other = self._other_options(result)
            made = f", made with other options ({other})" if other else ""
            print_status(
                f"{result.source}: skipped, because all of its layers exist{made} (--overwrite replaces them)"
            )
        elif result.status == "separated":
            verdict = result.assessment.verdict if result.assessment else ""
            hint = ": check the layers" if verdict == "doubtful" else ""
            seconds = sum(result.seconds.values())
            print_status(f"{result.source} -> {outputs} ({seconds:.1f} s, {verdict}{hint})")

    def _other_options(self, result: FileResult) -> str:
        """Returns the options in the metadata of the existing layers that differ from the options of this batch."""
        from brewster.inference.separator import PROGRAM, history_step  # noqa: PLC0415
        from brewster.photo.history import recorded_parameters  # noqa: PLC0415

        options = self.options
        expected = history_step(
            "", strength=options.strength, quality=options.quality, additive=options.additive
        ) | {"model": _model_name(options.model)}
        recorded = (recorded_parameters(Path(path), PROGRAM) for path in result.outputs.values())
        made = next((parameters for parameters in recorded if parameters), {})
        return ", ".join(
            f"{name}={made[name]}"
            for name, value in expected.items()
            if value is not None and made.get(name, value) != value
        )

    def _print_summary(self, results: Sequence[FileResult], seconds: float) -> None:
        counts: Counter[str] = Counter(result.status for result in results)
        if len(results) > 1 and not self.quiet:
            order = ("separated", "planned", "skipped", "failed")
            totals = ", ".join(f"{counts[status]} {status}" for status in order if counts[status])
            folder = f"in {self.output}" if self.output else "next to the photos"
            print_status(
                totals if self.dry_run else f"{totals} in {_duration(seconds)}; the layers are {folder}"
            )
        for message in _error_messages(results):
            print_error(message)

    def _write_contact_sheet(self, path: Path, results: Sequence[FileResult]) -> None:
        """Writes the contact sheet of the photos whose layers are files."""
        from brewster.photo.contact_sheet import write_contact_sheets  # noqa: PLC0415

        rows = [
            (Path(result.source), [Path(output) for output in result.outputs.values()])
            for result in results
            if result.error is None and result.source != "-" and "-" not in result.outputs.values()
        ]
        for sheet in write_contact_sheets(path, rows, self.options.max_pixels):
            if not self.quiet:
                print_status(f"contact sheet: {sheet}")


def _model_name(model: str) -> str | None:
    """Returns the model name that the metadata of its layers contain, or None if the model must be loaded to know the name."""
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


def error_text(result: FileResult) -> str:
    """Returns the error message of a photo, which begins with its path."""
    has_source = str(result.error).startswith(f"{result.source} ")
    return str(result.error) if has_source else f"{result.source}: {result.error}"


def _error_messages(results: Iterable[FileResult]) -> list[str]:
    """Returns a message for each failed photo. There is one message for all photos that need the same missing extra."""
    messages, without_extra = [], defaultdict(list)
    for result in results:
        if result.error and "pip install 'brewster[" in result.error:
            without_extra[result.error].append(result.source)
        elif result.error:
            messages.append(error_text(result))
    grouped = (
        f"{sources[0] if len(sources) == 1 else _counted(sources, 'photo')}: {error}"
        for error, sources in without_extra.items()
    )
    return [*messages, *grouped]


def _json_line(result: FileResult) -> bytes:
    values = asdict(result)
    values["seconds"] = {name: round(seconds, 4) for name, seconds in result.seconds.items()}
    return f"{json.dumps(values)}\n".encode()
