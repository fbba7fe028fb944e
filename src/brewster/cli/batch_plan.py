"""Finds the photos of `brewster separate` and the files of their layers, and checks the
arguments.
"""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import click

from brewster.base.files import FOLDERS_OF_PROGRAMS, LAYER_FORMATS, check_output_folder
from brewster.base.image_formats import WRITABLE, ImageFormat, format_of, is_video
from brewster.base.remote_path import Location, location, path_of_file_url
from brewster.cli.terminal import write_out
from brewster.errors import VIDEO_CURE, counted
from brewster.options import Options

if TYPE_CHECKING:
    from brewster.batch import SeparationTask
    from brewster.photo.in_memory import WritableFile

_MAX_NAMES: Final = 10
"""Maximum number of file names in a message."""


def local_path(text: str) -> str:
    """Returns the path in an argument that is a file:// address or has quotes around it. File
    managers and some terminals pass a dropped file in this form. The name of an existing file is
    never changed.
    """
    if os.path.lexists(text):
        return text
    if len(text) > 2 and text[0] == text[-1] and text[0] in "'\"":
        text = text[1:-1]
    return path_of_file_url(text) if text.startswith("file://") else text


def skipped_files(files: Sequence[Location]) -> Iterator[str]:
    """Yields a line about the folders of programs, one about the videos, and one about all other
    files without the suffix of an image.
    """
    if folders := [file for file in files if file.name in FOLDERS_OF_PROGRAMS]:
        yield (
            f"{listed(folders, 'folder')} skipped: expected photos, not the thumbnails or the "
            "deleted files of a program; pass the folder by its name"
        )
        files = [file for file in files if file not in folders]
    others = [file for file in files if not is_video(file) and not format_of(file)]
    if special := [file for file in files if format_of(file)]:
        yield (
            f"{listed(special, 'special file')} skipped: expected regular files, not pipes, "
            "sockets or devices; pass a pipe by its name"
        )
    if videos := [file for file in files if is_video(file)]:
        yield f"{listed(videos, 'video')} skipped: {VIDEO_CURE}"
    if others:
        suffixes = Counter(file.suffix.lower() or "without a suffix" for file in others)
        counts = [f"{number} {suffix}" for suffix, number in suffixes.most_common()]
        yield (
            f"{counted(len(others), 'other file')} skipped ({_shortened(counts)}), for example "
            f"{others[0]}: expected the suffix of an image; convert photos of other formats, or "
            "pass the path of an image whose suffix is another"
        )


def listed(names: Sequence[object], noun: str) -> str:
    """Returns `2 videos (a.mp4, b.mov)`, with at most `_MAX_NAMES` names."""
    return f"{counted(len(names), noun)} ({_shortened(names)})"


def _shortened(names: Sequence[object]) -> str:
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f"{', '.join(map(str, names[:_MAX_NAMES]))}{more}"


def is_single_output(photos: Sequence[str], output: str | None) -> bool:
    """Whether only one layer can be written, because it is written to standard output or to an
    image file (-o).
    """
    is_folder = output is None or output.endswith(("/", os.sep)) or Path(output).is_dir()
    return (
        "-" in photos
        or output == "-"
        or (not is_folder and format_of(Path(output or "")) is not None)
    )


def plan(
    photos: Sequence[str],
    output: str | None,
    options: Options,
    skipped: list[Location] | None = None,
) -> list[SeparationTask]:
    """Returns a task for each photo in the files and folders, as `plan_files`, also for standard
    input and output and for an image file as output. Raises click.UsageError if the arguments
    contradict each other.
    """
    from brewster.batch import plan_files  # noqa: PLC0415  (imports ONNX Runtime and pyvips)

    if is_single_output(photos, output):
        return [_plan_single_output(photos, output, options)]
    check_output(photos, output)
    return plan_files(photos, output, options, skipped=skipped)


def _plan_single_output(
    photos: Sequence[str], output: str | None, options: Options
) -> SeparationTask:
    from brewster.batch import SeparationTask  # noqa: PLC0415
    from brewster.batch.plan import task_of  # noqa: PLC0415

    if len(photos) > 1 or Path(photos[0]).is_dir():
        raise click.UsageError(
            "Give exactly one photo if it is standard input, or if -o is standard output or an "
            "image file."
        )
    if len(options.layers) > 1:
        raise click.UsageError(
            "Only one layer can be written to standard output or to an image file (-o): choose "
            "it with --layers."
        )
    if output not in (None, "-"):
        _check_format(format_of(Path(output)), options)
    source = _StandardStream() if photos[0] == "-" else location(photos[0])
    target = _StandardStream() if output in (None, "-") else location(output)
    if not isinstance(target, _StandardStream):
        check_output_folder(target.parent)
    outputs: dict[str, Location | WritableFile] = {options.layers[0]: target}
    if isinstance(source, _StandardStream):
        return SeparationTask(source, outputs)
    return task_of(source, outputs, frames=options.frames)


def _check_format(image_format: ImageFormat | None, options: Options) -> None:
    """Checks that the format of the image file given with -o can be written, and that --format and
    --additive match it.
    """
    if image_format is None:
        raise click.UsageError(
            "If the photo is standard input, -o must be an image file such as clear.jpg, or be "
            "left out."
        )
    layer = options.layers[0]
    name = image_format.name
    if not image_format.is_writable and LAYER_FORMATS.get(layer) != name:
        raise click.UsageError(
            f"brewster cannot write {name.upper()}: choose another suffix for -o."
        )
    if layer != "confidence" and options.format_name(layer, name) != name:
        raise click.UsageError(
            f"The output file (-o) is a {name} file, but --format, --additive or --layers "
            "requires another format."
        )


def check_output(photos: Sequence[str], output: str | None) -> None:
    """Raises click.UsageError if -o is an existing file, or ends in the suffix of a format that
    cannot be written.
    """
    # os.path and not pathlib, which raises for names that are too long
    if output is None or "://" in output:
        return
    if os.path.isfile(Path(output)):  # noqa: PTH113
        raise click.UsageError(
            f"-o is the existing file {output}; expected a folder, or an image file such as "
            "clear.jpg for a single layer; choose another name."
        )
    if output.endswith(("/", os.sep)) or len(photos) > 1:
        return
    suffix = Path(output).suffix
    is_folder = os.path.isdir(output) or os.path.isdir(photos[0])  # noqa: PTH112
    if re.fullmatch(r"\.[A-Za-z][A-Za-z0-9]{1,4}", suffix) and not is_folder:
        raise click.UsageError(
            f"-o ends in {suffix}, but brewster writes no format with this suffix. Choose one of "
            f"{', '.join(row.suffixes[0] for row in WRITABLE.values())}. If -o is a folder, add "
            f"{os.sep} at its end."
        )


@final
class _StandardStream:
    """Reads a photo from standard input, or writes a layer to standard output."""

    def read(self) -> bytes:
        return sys.stdin.buffer.read()

    def write(self, data: bytes) -> None:
        write_out(data)
