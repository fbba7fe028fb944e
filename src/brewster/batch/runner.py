"""Separates many files. A file that cannot be separated does not stop the batch.

The tree of an input folder is mirrored in the output folder, and layers that exist already are
skipped. A batch runs in this process, or for an archive in several processes or on a cluster. Each
of them has one photo at a time in memory, and loads the model when its first photo needs it.
Without `overwrite`, a layer that exists is never written again, even if two workers separate the
same photo, so that the same command resumes a stopped run.
"""

import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final, final

from brewster.base.executors.local import Executor, SerialExecutor, run_tasks
from brewster.base.files import LAYER_FORMATS, exists, file_digest, write_atomically
from brewster.base.image_formats import format_of
from brewster.base.remote_path import Location
from brewster.batch.one_photo import separate_photo
from brewster.batch.plan import plan_files
from brewster.batch.remaining import (
    RemainingWork,
    check_has_film,
    is_finished,
    local_video,
    output_names,
)
from brewster.batch.task import Burst, FileResult, SeparationTask, display_name
from brewster.errors import BrewsterError, DiskFull, OutputError, error_prefix
from brewster.options import Options
from brewster.photo import Photo
from brewster.photo.file_info import FileInfo, lost_metadata, with_notes
from brewster.photo.in_memory import WritableFile
from brewster.separation.predictor import ProgressCallback
from brewster.separation.separation import Separation
from brewster.separation.separator import Separator

BatchProgressCallback = Callable[[int, str, float], None]
"""Called with the number of finished files, the name of the current file, and its completed
fraction, 0 to 1.

It is called before each file, several times while a file is separated in this process, and before
each layer. To stop the batch, raise KeyboardInterrupt in the callback. If it raises another
exception, the current file fails.
"""

_DEFAULT_OPTIONS: Final = Options()


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

    Layers are named after their photo (`a.transmission.jpg` for `a.jpg`). They never replace a
    photo of the batch. If all layers of a photo exist, the photo is skipped. If some of its layers
    exist, only the missing layers are written. If an existing layer was made from another photo,
    the photo fails. Each file is written atomically. If a photo fails, its result has the status
    `failed`, and the batch continues.

    Args:
        sources: photos, folders that are searched recursively for photos, and manifests (CSV or
            Parquet tables with the column `path`). Each source can be a URL of an object store,
            such as s3://bucket/folder.
        output: the folder for the layers. It mirrors the tree below each source folder. By default,
            each layer is written next to its photo.
        options: layers, strength, quality, format and so on, the same as the options of the command
            line.
        separator: the model. By default, it is loaded with `options` when the first photo needs it.
        overwrite: whether layers that exist are replaced instead of skipped.
        dry_run: if true, no file is written and no model is loaded. The results contain the paths
            of the missing layers. A photo that cannot be read completely, or is of an unsupported
            kind, fails as in a real run. In an object store, only the existence of a photo is
            checked, with one request.
        on_progress: see `BatchProgressCallback`.

    Returns:
        An iterator over one result per photo, in a stable order. Each photo is separated when the
            iterator reaches it.

    Raises:
        PhotoError: the sources contain no photo.
        ManifestError: a manifest is not a table, or a row of it is not a path.
        OutputError: the layers of two photos would have one path, or the output folder cannot be
            created or written to.
        ModelError: the model does not exist or is damaged (raised during iteration).
        DeviceError: the requested device is not available (raised during iteration).
        DiskFull: the disk is full (raised after the result of the photo whose layers could not be
            written).
        Exception: an unexpected exception, which is a bug in brewster. The result of its photo has
            the status `failed`, and the first such exception is raised again after the last photo.
    """
    tasks = plan_files(sources, output, options)
    return separate_tasks(
        tasks, options, separator, overwrite=overwrite, dry_run=dry_run, on_progress=on_progress
    )


def separate_tasks(
    tasks: Sequence[SeparationTask],
    options: Options = _DEFAULT_OPTIONS,
    separator: Separator | None = None,
    *,
    overwrite: bool = False,
    dry_run: bool = False,
    executor: Executor[FileResult] | None = None,
    on_progress: BatchProgressCallback = lambda _done, _name, _fraction: None,
) -> Iterator[FileResult]:
    """Separates the photos of the tasks. For results and errors, see `separate_files`.

    Args:
        tasks: those of `plan_files`.
        options: the options of the separation.
        separator: the model; None loads it with `options` when the first photo needs it.
        overwrite: whether layers that exist are replaced instead of skipped.
        dry_run: if true, no file is written and no model is loaded.
        executor: runs a `SeparationRunner` with the same `overwrite` in its workers; None is this
            process. The caller enters its context. The results then come in the order in which
            workers finish them.
        on_progress: see `BatchProgressCallback`.
    """
    remaining = RemainingWork(tasks, options, overwrite=overwrite, dry_run=dry_run)
    done = 0
    unexpected: Exception | None = None

    def report(fraction: float) -> None:
        on_progress(done, tasks[done].name, fraction)

    def unfinished() -> Iterator[SeparationTask | list[FileResult]]:
        nonlocal done
        for done, task in enumerate(tasks):  # noqa: B007  (`report` reads it)
            if not executor:
                report(0.0)
            left = remaining.of(task)
            yield [left] if isinstance(left, FileResult) else left

    runner = partial(SeparationRunner, options, separator, overwrite=overwrite, on_progress=report)
    for result in run_tasks(partial(next, unfinished(), None), executor or SerialExecutor(runner)):
        error = result.exception
        result.exception = None  # its traceback keeps a photo in memory
        yield result
        if isinstance(error, DiskFull):  # the next photos would fail, too
            with error_prefix(result.source):
                raise error
        if error and not isinstance(error, BrewsterError | MemoryError):
            unexpected = unexpected or error
    if unexpected:
        raise unexpected


@final
class SeparationRunner:
    """Separates photos, one at a time. The model is loaded when the first photo needs it. Raises
    OutputError if the `shared_folder`, the output folder on a cluster, is not an object store and
    does not exist on this node.
    """

    def __init__(
        self,
        options: Options,
        separator: Separator | None = None,
        *,
        overwrite: bool = False,
        shared_folder: Location | None = None,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> None:
        if isinstance(shared_folder, Path) and not shared_folder.is_dir():
            raise OutputError(
                f"the folder {shared_folder} does not exist on the node {socket.gethostname()}",
                "expected a folder that all nodes share",
                "mount it on this node, or write to an object store",
            )
        self._options = options
        self._separator = separator
        self._overwrite = overwrite
        self._on_progress = on_progress

    def __call__(self, task: SeparationTask) -> list[FileResult]:
        """Separates one photo. If the photo fails, its result has the status "failed". Raises
        ModelError, DeviceError or MissingExtra if the model cannot be loaded, because no photo can
        be separated without it.
        """
        result = FileResult(task.name)
        self._separator = self._separator or Separator.load(**self._options.load_options())
        skipped = FileResult(task.name, "skipped", output_names(task.outputs))
        try:
            self._separate(task, self._separator, result)
        except Exception as error:  # noqa: BLE001  (an unexpected one is raised at the end of the batch)
            # A slow worker: another one got the same task, and has written the videos meanwhile
            if isinstance(error, OutputError) and not self._overwrite and is_finished(task):
                return [skipped]
            return [result.failed(error)]
        if not result.outputs:  # another worker has written all layers in the meantime
            return [skipped]
        result.outputs = output_names(task.outputs)  # also the layers that existed before
        return [result]

    def _separate(self, task: SeparationTask, separator: Separator, result: FileResult) -> None:
        """Separates one photo, writes its layers, and enters both into the result."""
        result.model = separator.name
        result.model_sha256 = separator.sha256
        result.device = separator.device
        options = self._options
        on_progress = self._on_progress
        if task.burst and options.all_frames:
            self._separate_video(task, task.burst, separator, result)
            return
        if task.burst and task.burst.is_one_photo:
            check_has_film(task, options.film)
        if task.burst and not task.burst.is_one_photo:
            with error_prefix(task.row):
                separation, result.photo_sha256 = self._separate_burst(task.burst, separator)
        else:
            with error_prefix(task.row):
                separation = separate_photo(
                    task.source,
                    separator,
                    film=options.film,
                    method=options.method,
                    swap=options.swap,
                    on_progress=on_progress,
                    **options.call_options(),
                )
        photo_info = separation.photo.file_info
        result.enter(separation.record)
        started = time.perf_counter()
        formats = {
            layer: self._format_name(layer, target, photo_info)
            for layer, target in task.missing.items()
        }
        images = [getattr(separation, layer) for layer in formats]
        del separation  # the encoders need the memory of the photo
        encoded = _encoded(images, [*formats.values()])
        for layer, target in task.missing.items():
            on_progress(1.0)
            if self._write(target, next(encoded)):
                result.outputs[layer] = display_name(target)
        notes = {
            lost: None
            for layer, format_name in formats.items()
            if layer not in LAYER_FORMATS and (lost := lost_metadata(photo_info, format_name))
        }
        result.note = with_notes(photo_info, *notes).note
        result.seconds["encode"] = time.perf_counter() - started

    def _write(self, target: Location | WritableFile, data: bytes) -> bool:
        """Writes a layer. Returns whether it was written: a layer is kept that another worker has
        written in the meantime.
        """
        if not isinstance(target, Location):
            target.write(data)
            return True
        try:
            write_atomically(target, data, overwrite=self._overwrite)
        except OutputError:
            if self._overwrite or not exists(target):
                raise
            return False
        return True

    def _format_name(
        self, layer: str, target: Location | WritableFile, photo_info: FileInfo
    ) -> str:
        """Returns the format of a layer: that of the suffix of its file, or for a stream that of
        the options.
        """
        target_format = format_of(target) if isinstance(target, Location) else None
        if target_format:
            return target_format.name
        return self._options.format_name(layer, photo_info.format_name)

    def _separate_burst(self, burst: Burst, separator: Separator) -> tuple[Separation, str | None]:
        """Returns the separation, and the digest of a video; that of a photo is in its
        `file_info`.
        """
        from brewster.film import read_video, separate_burst  # noqa: PLC0415  (imports numba)

        digest = None
        options = self._options
        photos: Sequence[Photo | Location] = burst.photos
        if burst.is_from_video:
            video = local_video(burst)
            digest = file_digest(video, "sha256")
            photos = read_video(video, options.frames, max_pixels=options.max_pixels)
        separation = separate_burst(
            photos,
            reference=options.reference_index,
            separator=separator,
            method=options.method,
            swap=options.swap,
            on_progress=self._on_progress,
            **options.call_options(),
        )
        return separation, digest

    def _separate_video(
        self, task: SeparationTask, burst: Burst, separator: Separator, result: FileResult
    ) -> None:
        """Separates all frames of a video, writes the layers, and enters both into the result."""
        from brewster.film import separate_video  # noqa: PLC0415  (imports numba)

        video = local_video(burst)
        options = self._options
        result.photo_sha256 = file_digest(video, "sha256")
        targets = {layer: Path(str(target)) for layer, target in task.missing.items()}
        separation = separate_video(
            video,
            targets.get("transmission"),
            targets.get("reflection"),
            frames=options.frames,
            reference=options.reference_index,
            separator=separator,
            method=options.method,
            swap=options.swap,
            strength=options.strength,
            hints=options.hints,
            max_pixels=options.max_pixels,
            overwrite=self._overwrite,
            on_progress=self._on_progress,
        )
        result.burst = separation.burst
        result.note = separation.note
        result.seconds = dict(separation.seconds)
        result.frames_written = separation.frames
        result.outputs = output_names(task.missing)
        result.next_step = separation.burst.next_step


def _encoded(images: Sequence[Photo], formats: Sequence[str]) -> Iterator[bytes]:
    """Yields the files of the layers. A second thread encodes the others while this one encodes
    the first, because this one can use the memory again that it has freed.
    """
    with ThreadPoolExecutor(1) as pool:
        others = [
            pool.submit(image.encode, format_name)
            for image, format_name in zip(images[1:], formats[1:], strict=True)
        ]
        yield images[0].encode(formats[0])
        for other in others:
            yield other.result()
