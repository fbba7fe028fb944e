"""Separate many files: the folder tree is mirrored, finished layers are skipped, and one bad file does not stop the rest.

    for result in separate_files("holiday", "clear"):
        print(result.source, result.status, result.error)

Only one photo is in memory at a time. The model is loaded when the first photo needs it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, Literal, Protocol, final

from brewster.errors import BrewsterError, PhotoError, TargetError
from brewster.files import find, write_atomically
from brewster.image_formats import SUFFIXES, format_of
from brewster.inference.separator import Separator
from brewster.options import Options

BatchProgressCallback = Callable[[int, str, float], None]
"""Called with the number of files that are done, the name of the current file, and the share of it that is done, 0 to 1.

It is called before each file, several times while a file is separated, and before each layer is written. To stop the
batch from it, raise KeyboardInterrupt: any other exception counts as a failure of the current file.
"""

_STREAM_NAME: Final = "-"
_DEFAULT_OPTIONS: Final = Options()


class InputStream(Protocol):
    """Anything that the bytes of one photo can be read from, such as an open binary file."""

    def read(self) -> bytes:
        """All of the bytes."""


class OutputStream(Protocol):
    """Anything that the bytes of one encoded layer can be written to, such as an open binary file."""

    def write(self, data: bytes, /) -> object:
        """Writes all of the bytes."""


@final
@dataclass(frozen=True)
class SeparationTask:
    """One photo, and where each of its layers is written: a path or a stream."""

    source: Path | InputStream
    targets: Mapping[str, Path | OutputStream]
    """Layer name (`transmission`, `reflection` or `confidence`) to its target."""

    @property
    def name(self) -> str:
        """The path of the photo as it was given, or `-` for a stream."""
        return _display_name(self.source)


@final
@dataclass
class FileResult:
    """What happened to one photo. It is the line that `brewster --json` prints."""

    source: str
    """The path of the photo as it was given, or `-` for a stream."""
    status: Literal["separated", "skipped", "planned", "failed"] = "separated"
    """`skipped`: all layers exist already. `planned`: a dry run would write `outputs`."""
    outputs: dict[str, str] = field(default_factory=dict)
    """Layer name to path, or to `-` for a stream. A failed photo has the layers that were written before the failure."""
    model: str | None = None
    sha256: str | None = None
    """The checksum of the model file."""
    device: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of each step: decode, network, detail, encode."""
    residual: float | None = None
    """See `Separation.residual`."""
    reconstruction_error: float | None = None
    """See `Separation.reconstruction_error`."""
    doubtful: bool = False
    """See `Separation.doubtful`."""
    error: str | None = None
    """The message of the failure, or None."""


def separate_files(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options = _DEFAULT_OPTIONS,
    separator: Separator | None = None,
    *,
    overwrite: bool = False,
    dry_run: bool = False,
    on_progress: BatchProgressCallback = lambda _done, _name, _fraction: None,
) -> Iterator[FileResult]:
    """Separates files and folders of photos, and writes the layers as files.

    Layers are named after their photo (`a.jpg`: `a.transmission.jpg`) and are never written over a photo of the batch.
    A photo whose layers all exist is skipped. If some exist, only the missing ones are written. Each file is written
    atomically. A photo that fails gives a result with status `failed`, and the next photo follows.

    Args:
        sources: photos, or folders that are searched recursively for photos.
        output: the folder for the layers, in which the tree below each source folder is mirrored; by default, each
            layer is written next to its photo.
        options: layers, strength, quality, format and so on, the same as the options of the command line.
        separator: the model; by default, it is loaded from `options` when the first photo needs it.
        overwrite: replace layers that exist, instead of skipping them.
        dry_run: write nothing, and load no model; the results say what would be written.
        on_progress: see `BatchProgressCallback`.

    Returns:
        An iterator of one result per photo, in a stable order. Each photo is separated when its result is requested.

    Raises:
        PhotoError: the sources contain no photo.
        TargetError: two photos would be written under the same name.
        ModelError: the model does not exist or is damaged (raised during iteration).
        DeviceError: the requested device is not available (raised during iteration).
        Exception: an unexpected exception, which is a bug in brewster. Its photo gets a result with status `failed`,
            and the first such exception is raised again after the last photo.
    """
    tasks = plan_files(sources, output, options)
    return separate_tasks(
        tasks, options, separator, overwrite=overwrite, dry_run=dry_run, on_progress=on_progress
    )


def plan_files(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options = _DEFAULT_OPTIONS,
) -> list[SeparationTask]:
    """Finds the photos, and chooses the file name of each layer. See `separate_files` for the arguments.

    Raises:
        PhotoError: the sources contain no photo.
        TargetError: two photos would be written under the same name.
    """
    paths = [Path(sources)] if isinstance(sources, str | os.PathLike) else [*map(Path, sources)]
    tasks = [
        SeparationTask(
            found.source,
            {layer: found.target(layer, options.suffix(layer, found.source)) for layer in options.layers},
        )
        for found in find(paths, None if output is None else Path(output))
    ]
    if not tasks:
        raise PhotoError(
            f"there is no picture in {', '.join(map(str, paths))}",
            f"in folders, files are recognised by their suffix ({' '.join(SUFFIXES)})",
            "name the file itself, or another folder",
        )
    return tasks


def separate_tasks(
    tasks: Sequence[SeparationTask],
    options: Options = _DEFAULT_OPTIONS,
    separator: Separator | None = None,
    *,
    overwrite: bool = False,
    dry_run: bool = False,
    on_progress: BatchProgressCallback = lambda _done, _name, _fraction: None,
) -> Iterator[FileResult]:
    """Separates the photos of a plan. Arguments, results and errors are those of `separate_files`."""
    batch = _Batch(tasks, options, separator, overwrite=overwrite, dry_run=dry_run)
    for done, task in enumerate(tasks):
        on_progress(done, task.name, 0.0)
        yield batch.run(task, partial(on_progress, done, task.name))
    if batch.unexpected_error:
        raise batch.unexpected_error


class _Batch:
    """The settings of a batch, its lazily loaded model, and the first unexpected exception."""

    def __init__(
        self,
        tasks: Sequence[SeparationTask],
        options: Options,
        separator: Separator | None,
        *,
        overwrite: bool,
        dry_run: bool,
    ) -> None:
        self.unexpected_error: Exception | None = None
        self._options, self._separator = options, separator
        self._overwrite, self._dry_run = overwrite, dry_run
        self._sources = {os.path.realpath(task.source) for task in tasks if isinstance(task.source, Path)}

    def run(self, task: SeparationTask, on_progress: Callable[[float], None]) -> FileResult:
        """Separates one photo; a failure is in the result."""
        result = FileResult(task.name)
        try:
            targets = self._targets_to_write(task)
        except BrewsterError as error:
            return _failed(result, error)
        if not targets or self._dry_run:
            result.status = "planned" if targets else "skipped"
            result.outputs = {
                layer: _display_name(target) for layer, target in (targets or task.targets).items()
            }
            return result
        # Outside the try: no photo can be separated without a model, so its errors end the batch.
        self._separator = separator = self._separator or Separator.load(**self._options.load_options())
        result.model, result.sha256, result.device = separator.name, separator.sha256, separator.device
        try:
            self._separate(separator, SeparationTask(task.source, targets), result, on_progress)
        except BrewsterError as error:
            return _failed(result, error)
        except MemoryError:
            return _failed(
                result, "the photo does not fit into memory; free some memory, or reduce the photo"
            )
        except Exception as error:  # noqa: BLE001  (raised again after the last photo)
            self.unexpected_error = (
                self.unexpected_error or error
            )  # only the first: the traceback of each keeps its photo in memory
            return _failed(
                result, f"internal error in brewster ({type(error).__name__}: {error}); please report it"
            )
        return result

    def _targets_to_write(self, task: SeparationTask) -> dict[str, Path | OutputStream]:
        """The layers that must be written, with their targets.

        Raises:
            TargetError: a layer would be written over a photo of the batch.
        """
        for target in task.targets.values():
            if isinstance(target, Path) and self._is_source(target, task.source):
                raise TargetError(
                    f"{target} is itself a photo to separate",
                    "photos of the batch are never overwritten",
                    "choose another name",
                )
        return {
            layer: target
            for layer, target in task.targets.items()
            if not isinstance(target, Path) or self._overwrite or not os.path.lexists(target)
        }

    def _is_source(self, target: Path, source: Path | InputStream) -> bool:
        if os.path.realpath(target) in self._sources:
            return True
        try:  # unlike realpath, samefile finds hard links
            return isinstance(source, Path) and target.samefile(source)
        except OSError:  # one of them does not exist
            return False

    def _separate(
        self,
        separator: Separator,
        task: SeparationTask,
        result: FileResult,
        on_progress: Callable[[float], None],
    ) -> None:
        path = task.source if isinstance(task.source, Path) else None
        photo = task.source if isinstance(task.source, Path) else task.source.read()
        separation = separator(photo, on_progress=on_progress, **self._options.call_options())
        result.seconds, result.residual = dict(separation.seconds), separation.residual
        result.reconstruction_error, result.doubtful = separation.reconstruction_error, separation.doubtful
        started = time.perf_counter()
        for layer, target in task.targets.items():
            target_format = format_of(target) if isinstance(target, Path) else None
            source_format = separation.photo.file_info.container
            container = target_format.name if target_format else self._options.container(layer, source_format)
            encoded = getattr(separation, layer).encode(container)
            on_progress(1.0)
            if isinstance(target, Path):
                write_atomically(target, encoded, overwrite=self._overwrite, source=path)
            else:
                target.write(encoded)
            result.outputs[layer] = _display_name(target)
        result.seconds["encode"] = time.perf_counter() - started


def _display_name(source_or_target: object) -> str:
    return str(source_or_target) if isinstance(source_or_target, Path) else _STREAM_NAME


def _failed(result: FileResult, error: object) -> FileResult:
    result.status, result.error = "failed", str(error)
    return result
