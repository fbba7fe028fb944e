"""Separates many files. A file that cannot be separated does not stop the batch.

The tree of an input folder is mirrored in the output folder, and layers that exist already are skipped. Only one photo
is in memory at a time. The model is loaded when the first photo needs it."""

from __future__ import annotations

import hashlib
import io
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from brewster.batch.plan import (
    Burst,
    FileResult,
    SeparationTask,
    display_name,
    plan_files,
)
from brewster.errors import BrewsterError, DiskFull, OutputError, UnreadablePhoto, error_prefix
from brewster.files import LAYER_FORMATS, check_output_folder, exists, is_same_file, write_atomically
from brewster.image_formats import HEAD_BYTES, format_of
from brewster.inference.burst_report import burst_photo_name, check_photo_count
from brewster.inference.predictor import ProgressCallback
from brewster.inference.separation import Separation
from brewster.inference.separator import Separator
from brewster.options import Options
from brewster.photo import Photo, Source
from brewster.photo.decode import known_format
from brewster.photo.file_info import lost_metadata, with_notes
from brewster.photo.history import find_layer_of_another_photo
from brewster.photo.in_memory import BinaryFile, WritableFile
from brewster.remote_path import Location, RemotePath, check_not_video, check_readable, read_image

BatchProgressCallback = Callable[[int, str, float], None]
"""Called with the number of finished files, the name of the current file, and its completed fraction, 0 to 1.

It is called before each file, several times while a file is separated, and before each layer is written. To stop the batch,
raise KeyboardInterrupt in the callback. If it raises another exception while a file is separated, this file fails.
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

    Layers are named after their photo (`a.transmission.jpg` for `a.jpg`). They never replace a photo of the batch. If
    all layers of a photo exist, the photo is skipped. If some of its layers exist, only the missing layers are written.
    If an existing layer was made from another photo, the photo fails. Each file is written atomically. If a photo
    fails, its result has the status `failed`, and the batch continues.

    Args:
        sources: photos, folders that are searched recursively for photos, and manifests (CSV or Parquet tables with
            the column `path`). Each source can be a URL of an object store, such as s3://bucket/folder.
        output: the folder for the layers. It mirrors the tree below each source folder. By default, each layer is
            written next to its photo.
        options: layers, strength, quality, format and so on, the same as the options of the command line.
        separator: the model. By default, it is loaded with `options` when the first photo needs it.
        overwrite: whether layers that exist are replaced instead of skipped.
        dry_run: if true, no file is written and no model is loaded. The results contain the paths of the missing layers. A
            photo that cannot be read completely, or is of an unsupported kind, fails as in a real run. In an object store, only the
            existence of a photo is checked, with one request.
        on_progress: see `BatchProgressCallback`.

    Returns:
        An iterator over one result per photo, in a stable order. Each photo is separated when the iterator reaches it.

    Raises:
        PhotoError: the sources contain no photo.
        ManifestError: a manifest is not a table, or a row of it is not a path.
        OutputError: the layers of two photos would have the same path, or the output folder cannot be created or written to.
        ModelError: the model does not exist or is damaged (raised during iteration).
        DeviceError: the requested device is not available (raised during iteration).
        DiskFull: the disk is full (raised after the result of the photo whose layers could not be written).
        Exception: an unexpected exception, which is a bug in brewster. The result of its photo has the status `failed`, and
            the first such exception is raised again after the last photo."""
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
    on_progress: BatchProgressCallback = lambda _done, _name, _fraction: None,
) -> Iterator[FileResult]:
    """Separates the photos of the tasks. For the other arguments, results and errors, see `separate_files`."""
    inputs, unexpected = input_paths(tasks, options), None
    for done, task in enumerate(tasks):
        on_progress(done, task.name, 0.0)
        result = FileResult(task.name)
        try:
            check_outputs(task, inputs)
            outputs = _missing_outputs(task, overwrite=overwrite)
            _check_folders(outputs.values())
            if task.burst or (outputs and dry_run):
                _check_inputs(task, options.max_pixels if dry_run else None)
        except BrewsterError as error:
            yield result.failed(error)
            continue
        if not outputs or dry_run:
            result.status = "planned" if outputs else "skipped"
            result.outputs = _names(outputs or task.outputs)
            yield result
            continue
        # This is not in a try block, because no photo can be separated without a model: a model error ends the batch.
        separator = separator or Separator.load(**options.load_options())
        try:
            missing, progress = replace(task, outputs=outputs), partial(on_progress, done, task.name)
            separate_task(missing, options, separator, result, overwrite=overwrite, on_progress=progress)
            result.outputs = _names(task.outputs)  # also the layers that existed before
        except DiskFull as error:  # the next photos would fail, too
            yield result.failed(error)
            with error_prefix(task.name):
                raise
        except BrewsterError as error:
            result.failed(error)
        except MemoryError:
            result.failed(
                "the photo does not fit into memory; expected more free memory; close other programs, or make the photo smaller.",
            )
        except Exception as error:  # noqa: BLE001  (raised again after the last photo)
            # only the first, because each traceback keeps its photo in memory
            unexpected = unexpected or error
            result.failed(f"internal error in brewster ({type(error).__name__}: {error}); please report it")
        yield result
    if unexpected:
        raise unexpected


def separate_task(
    task: SeparationTask,
    options: Options,
    separator: Separator,
    result: FileResult,
    *,
    overwrite: bool,
    on_progress: ProgressCallback,
) -> None:
    """Separates one photo, writes its layers, and enters both into the result. Raises BrewsterError if the photo cannot
    be read or separated, or a layer cannot be written."""
    result.model, result.model_sha256, result.device = separator.name, separator.sha256, separator.device
    if task.burst and task.burst.all_frames:
        _separate_video(
            task, task.burst, separator, options, result, overwrite=overwrite, on_progress=on_progress
        )
        return
    if task.burst:
        photo, separation = _separate_burst(task.burst, separator, options, on_progress)
    else:
        with error_prefix(task.row):
            photo = read_content(task.source)
        separation = separator(photo, on_progress=on_progress, **options.call_options())
    result.photo_sha256, result.burst = _sha256(photo), separation.burst
    result.seconds, result.residual = dict(separation.seconds), separation.residual
    result.assessment, photo_info = separation.assessment, separation.photo.file_info
    result.reconstruction_error = separation.reconstruction_error
    result.reflection_is_derived, result.next_step = separation.reflection_is_derived, separation.next_step
    started, notes = time.perf_counter(), dict[str, None]()
    for layer, target in task.outputs.items():
        target_format = format_of(target) if isinstance(target, Location) else None
        format_name = (
            target_format.name if target_format else options.format_name(layer, photo_info.format_name)
        )
        encoded = getattr(separation, layer).encode(format_name)
        if layer not in LAYER_FORMATS and (lost := lost_metadata(photo_info, format_name)):
            notes[lost] = None
        on_progress(1.0)
        if isinstance(target, Location):
            write_atomically(target, encoded, overwrite=overwrite)
        else:
            target.write(encoded)
        result.outputs[layer] = display_name(target)
    result.note = with_notes(photo_info, *notes).note
    result.seconds["encode"] = time.perf_counter() - started


def _check_folders(outputs: Iterable[Location | WritableFile]) -> None:
    """Checks that existing folders of the layers can be written to, so that no photo is separated in vain. Raises OutputError."""
    for folder in {output.parent.absolute() for output in outputs if isinstance(output, Path)}:
        if folder.is_dir() and not os.access(folder, os.W_OK):
            check_output_folder(folder)  # raises the error with the reason


def _check_inputs(task: SeparationTask, max_pixels: int | None) -> None:
    """Checks that the files of a task can be read and start like an image, and are neither too few nor too many for a burst. With
    `max_pixels`, local photos are decoded. The frames of a video are not read."""
    for index, file in enumerate(task.inputs):
        name = burst_photo_name(task.inputs, index) if len(task.inputs) > 1 else None
        with error_prefix(name), error_prefix(task.row):
            _check_input(file, max_pixels, is_video=bool(task.burst and task.burst.is_from_video))
    if task.burst:
        check_photo_count(task.burst.photo_count)


def _check_input(file: Location | BinaryFile, max_pixels: int | None, *, is_video: bool) -> None:
    if isinstance(file, Location):
        check_readable(file)
        if is_video and isinstance(file, RemotePath):
            happened = f"{file} is a video in an object store"
            raise UnreadablePhoto(happened, "expected a video on this machine", "download the video first")
        if is_video:
            return
        check_not_video(file)
    if not isinstance(file, Path) or not file.is_file():  # a pipe can be opened only once
        return
    if max_pixels:
        Photo.open(file, max_pixels=max_pixels)
    else:
        with file.open("rb") as opened:
            known_format(opened.read(HEAD_BYTES))


def _missing_outputs(task: SeparationTask, *, overwrite: bool) -> dict[str, Location | WritableFile]:
    """Returns the layers that must be written, with their outputs. The others must have been made from this photo."""
    outputs = task.outputs.items()
    kept = {name: out for name, out in outputs if not overwrite and isinstance(out, Location) and exists(out)}
    _check_layers(task.source, kept.values())
    return {name: out for name, out in outputs if name not in kept}


def _separate_burst(
    burst: Burst, separator: Separator, options: Options, on_progress: Callable[[float], None]
) -> tuple[Path | bytes, Separation]:
    """Returns the file of the reference photo, or the video, and the separation."""
    from brewster.burst import read_video, separate_burst  # noqa: PLC0415  (imports numba)

    photos: Sequence[Source]
    if burst.is_from_video:
        video = Path(burst.photos[0])
        file: Path | bytes = video
        photos = read_video(video, burst.frames, max_pixels=options.max_pixels)
    else:
        contents = [read_content(photo) for photo in burst.photos]
        file = contents[len(contents) // 2 if burst.reference is None else burst.reference]
        photos = contents
    separation = separate_burst(
        photos,
        reference=burst.reference,
        separator=separator,
        method=burst.method,
        swap=burst.swap,
        on_progress=on_progress,
        **options.call_options(),
    )
    return file, separation


def _separate_video(
    task: SeparationTask,
    burst: Burst,
    separator: Separator,
    options: Options,
    result: FileResult,
    *,
    overwrite: bool,
    on_progress: ProgressCallback,
) -> None:
    """Separates all frames of a video, writes the layers, and enters both into the result."""
    from brewster.burst import separate_video  # noqa: PLC0415  (imports numba)

    video = Path(burst.photos[0])
    targets = {layer: Path(str(target)) for layer, target in task.outputs.items()}
    call = options.call_options()
    separation = separate_video(
        video,
        targets.get("transmission"),
        targets.get("reflection"),
        frames=burst.frames,
        reference=burst.reference,
        separator=separator,
        method=burst.method,
        swap=burst.swap,
        overwrite=overwrite,
        on_progress=on_progress,
        **{name: call[name] for name in ("strength", "quality", "hints", "max_pixels")},
    )
    result.photo_sha256, result.burst, result.note = _sha256(video), separation.burst, separation.note
    result.seconds, result.frames_written = dict(separation.seconds), separation.frames
    result.next_step = separation.burst.next_step
    result.outputs = _names(task.outputs)


def input_paths(tasks: Iterable[SeparationTask], options: Options = _DEFAULT_OPTIONS) -> frozenset[str]:
    """Returns the paths of all photos of the tasks, and of the mask and the hints, as `real_paths`."""
    photos = (file for task in tasks for file in task.inputs)
    return real_paths(photos) | real_paths([options.mask, options.hints])


def check_outputs(task: SeparationTask, inputs: Set[str]) -> None:
    """Checks that no layer would replace one of the `inputs` of the batch, from `input_paths`. Raises OutputError if a layer has
    the path of an input, or is a hard link to a photo of the task."""
    for target in task.outputs.values():
        if not isinstance(target, Location):
            continue
        is_own_photo = any(is_same_file(target, file) for file in task.inputs if isinstance(file, Location))
        if is_own_photo or inputs & real_paths([target]):
            raise OutputError(
                f"{target} is itself a photo of the batch, or its mask or hints",
                "expected another path, because these are never overwritten",
                "choose another name or folder",
            )


def skipped_result(task: SeparationTask) -> FileResult:
    """Returns the result of a photo whose layers all exist: skipped, or failed if they were made from another photo."""
    try:
        _check_layers(task.source, task.outputs.values())
    except OutputError as error:
        return FileResult(task.name).failed(error)
    return FileResult(task.name, "skipped", _names(task.outputs))


def _names(outputs: Mapping[str, Location | WritableFile]) -> dict[str, str]:
    return {layer: display_name(target) for layer, target in outputs.items()}


def _check_layers(source: Location | BinaryFile, layers: Iterable[Location | WritableFile]) -> None:
    """Streams are not checked (they are read once), nor stores (two more requests for each photo)."""
    files = (path for path in layers if isinstance(path, Path))
    if isinstance(source, Path) and (layer := find_layer_of_another_photo(source, files)):
        raise OutputError(
            f"{layer} was made from another photo, or from another version of {source}",
            "expected layers of this photo, or no files with their names",
            "choose another folder with -o, or replace the layers with --overwrite (in Python overwrite=True)",
        )


def read_content(source: Location | BinaryFile) -> Path | bytes:
    """Returns what a `Separator` reads: the path of a local file that can be opened, or the bytes of a URL or stream.
    Raises UnreadablePhoto if the file does not exist, is a folder, or cannot be opened or read, and UnsupportedPhoto
    if the file has the suffix of a video."""
    if isinstance(source, Path):
        check_readable(source)
        check_not_video(source)
        return source if source.is_file() else read_image(source)  # a pipe can be read only once
    return read_image(source) if isinstance(source, RemotePath) else source.read()


def _sha256(photo: Path | bytes) -> str | None:
    try:
        with io.BytesIO(photo) if isinstance(photo, bytes) else photo.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:  # the photo was deleted or moved after it was read
        return None


def real_paths(files: Iterable[object]) -> frozenset[str]:
    """Returns the absolute paths of the files without symbolic links, and URLs unchanged. Streams are left out."""
    found = (file for file in files if isinstance(file, Location))
    return frozenset(str(file) if isinstance(file, RemotePath) else os.path.realpath(file) for file in found)
