"""Decides what is left to do for each photo of a batch, before its photo is read.

The file of each layer is looked for once. A photo has nothing to do, some layers to write, or an
error: a layer would replace a photo, was made from another photo, or has a folder that cannot be
written to. `SeparationRunner` then writes the layers that are left, and asks nothing again.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import final

from brewster.base.files import check_output_folder, exists, is_same_file
from brewster.base.remote_path import Location, RemotePath, check_not_video, check_readable
from brewster.batch.task import Burst, FileResult, SeparationTask, display_name
from brewster.errors import BrewsterError, OutputError, UnreadablePhoto, error_prefix
from brewster.options import Options
from brewster.photo import Photo
from brewster.photo.history import find_layer_of_another_photo
from brewster.photo.in_memory import BinaryFile, WritableFile
from brewster.separation.burst_report import burst_photo_name, check_photo_count
from brewster.separation.used_film import find_used_film


@final
class RemainingWork:
    """What is left to do for the photos of a batch.

    Args:
        tasks: all tasks of the batch, whose photos no layer may replace.
        options: the options of the separation.
        overwrite: whether layers that exist are replaced instead of kept.
        dry_run: whether the photos are read instead of separated.
    """

    def __init__(
        self,
        tasks: Sequence[SeparationTask],
        options: Options,
        *,
        overwrite: bool,
        dry_run: bool,
    ) -> None:
        self._inputs = input_paths(tasks, options)
        self._options = options
        self._overwrite = overwrite
        self._dry_run = dry_run
        self._has = _file_finder()

    def of(self, task: SeparationTask) -> SeparationTask | FileResult:
        """Returns the task with the names of the layers that are kept, or its result if there is
        nothing to separate: it is skipped, failed, or in a dry run planned.

        Args:
            task: one of the tasks of the batch.
        """
        outputs = task.outputs
        kept = frozenset[str]() if self._overwrite else existing_layers(task, self._has)
        task = replace(task, kept=kept)
        try:
            _check_conflicts(task, self._inputs)
            _check_layers(task.source, [outputs[layer] for layer in outputs if layer in kept])
            if not task.missing:
                return FileResult(task.name, "skipped", output_names(outputs))
            _check_folders(task.missing.values())
            if not self._dry_run:
                return task
            _check_inputs(task, self._options)
        except BrewsterError as error:
            return FileResult(task.name).failed(error)
        return FileResult(task.name, "planned", output_names(task.missing))


def existing_layers(task: SeparationTask, has: Callable[[Location], bool]) -> frozenset[str]:
    """Returns the names of the layers of a task whose files exist, as `has` tells."""
    return frozenset(
        layer
        for layer, target in task.outputs.items()
        if isinstance(target, Location) and has(target)
    )


def is_finished(task: SeparationTask) -> bool:
    """Whether all layers of a task are files that exist."""
    return len(existing_layers(task, exists)) == len(task.outputs)


def _file_finder() -> Callable[[Location], bool]:
    """Lists whole folders of an object store, because a listing replaces thousands of requests."""

    @lru_cache(maxsize=1)
    def names(folder: RemotePath) -> set[str]:
        return {entry.name for entry in folder.iterdir()}

    return lambda path: (
        path.name in names(path.parent) if isinstance(path, RemotePath) else exists(path)
    )


def _check_folders(outputs: Iterable[Location | WritableFile]) -> None:
    """Checks that existing folders of layers can be written to: no photo is separated in vain.
    Raises OutputError.
    """
    for folder in {output.parent.absolute() for output in outputs if isinstance(output, Path)}:
        if folder.is_dir() and not os.access(folder, os.W_OK):
            check_output_folder(folder)  # raises the error with the reason


def _check_inputs(task: SeparationTask, options: Options) -> None:
    """Checks for a dry run that the files of a task can be read, and are neither too few nor too
    many for a burst. Local photos are decoded. The frames of a video are not read.
    """
    for index, file in enumerate(task.inputs):
        name = burst_photo_name(task.inputs, index) if len(task.inputs) > 1 else None
        with error_prefix(name), error_prefix(task.row):
            if task.burst and task.burst.is_from_video:
                local_video(task.burst)
            elif isinstance(file, Location):
                check_readable(file)
                check_not_video(file)
                if isinstance(file, Path) and file.is_file():  # a pipe can be opened only once
                    Photo.open(file, max_pixels=options.max_pixels)
    if task.burst and task.burst.is_one_photo:
        check_has_film(task, options.film)
    elif task.burst:
        check_photo_count(task.burst.photo_count, options.method)


def check_has_film(task: SeparationTask, choice: str) -> None:
    """Checks that the only photo of a burst contains a film. Raises PhotoError."""
    source = str(task.source) if isinstance(task.source, Path) else None
    if find_used_film(source, choice).film is None:
        check_photo_count(1)


def local_video(burst: Burst) -> Path:
    """Returns the path of the video of a burst. Raises UnreadablePhoto if it is not on this
    machine, or cannot be read.
    """
    video = burst.photos[0]
    if isinstance(video, RemotePath):
        happened = f"{video} is a video in an object store"
        raise UnreadablePhoto(
            happened, "expected a video on this machine", "download the video first"
        )
    check_readable(video)
    return video


def input_paths(tasks: Iterable[SeparationTask], options: Options) -> frozenset[str]:
    """Returns the paths of all photos of the tasks, and of the mask and the hints, as
    `real_paths`.
    """
    photos = (file for task in tasks for file in task.inputs)
    return real_paths(photos) | real_paths([options.mask, options.hints])


def _check_conflicts(task: SeparationTask, inputs: Set[str]) -> None:
    """Checks that no layer would replace one of the `inputs` of the batch, from `input_paths`.
    Raises OutputError if a layer has the path of an input, or is a hard link to a photo of the
    task.
    """
    for target in task.outputs.values():
        if not isinstance(target, Location):
            continue
        is_own_photo = any(
            is_same_file(target, file) for file in task.inputs if isinstance(file, Location)
        )
        if is_own_photo or inputs & real_paths([target]):
            raise OutputError(
                f"{target} is itself a photo of the batch, or its mask or hints",
                "expected another path, because these are never overwritten",
                "choose another name or folder",
            )


def _check_layers(source: Location | BinaryFile, layers: Iterable[Location | WritableFile]) -> None:
    """Streams are not checked (they are read once), nor stores (two more requests for each
    photo).
    """
    files = (path for path in layers if isinstance(path, Path))
    if isinstance(source, Path) and (layer := find_layer_of_another_photo(source, files)):
        raise OutputError(
            f"{layer} was made from another photo, or from another version of {source}",
            "expected layers of this photo, or no files with their names",
            "choose another folder with -o, or replace the layers with --overwrite (in Python "
            "overwrite=True)",
        )


def output_names(outputs: Mapping[str, Location | WritableFile]) -> dict[str, str]:
    """Returns the paths of layers as texts, `-` for a stream."""
    return {layer: display_name(target) for layer, target in outputs.items()}


def real_paths(files: Iterable[object]) -> frozenset[str]:
    """Returns the absolute paths of the files without symbolic links, and URLs unchanged. Streams
    are left out.
    """
    found = (file for file in files if isinstance(file, Location))
    return frozenset(
        str(file) if isinstance(file, RemotePath) else os.path.realpath(file) for file in found
    )
