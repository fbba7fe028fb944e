"""Finds the photos of a batch, and plans a task for each photo with the paths of its layers.

No two photos have a layer with the same path. The names of a photo that is separated alone do not
depend on other files in its folder.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from typing import Final

from brewster.base import image_formats
from brewster.base.files import absolute, check_output_folder, images_in
from brewster.base.remote_path import Location, is_video_file, location
from brewster.batch.layer_names import name_layers, name_videos
from brewster.batch.manifest import ManifestRow, is_manifest, read_manifest
from brewster.batch.task import Burst, SeparationTask, is_animation_file
from brewster.errors import BrewsterError, PhotoError, counted
from brewster.options import FILM_AUTO, FILM_NO, Options
from brewster.photo.in_memory import BinaryFile, WritableFile

_DEFAULT_OPTIONS: Final = Options()


def plan_files(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options = _DEFAULT_OPTIONS,
    *,
    skipped: list[Location] | None = None,
) -> list[SeparationTask]:
    """Finds the photos, and returns a task for each photo with the paths of its layers.

    A film that is given by name is separated as a burst.

    Args:
        sources: photos, folders and manifests, as for `separate_files`.
        output: the folder for the layers; None writes each layer next to its photo.
        options: the layers and their format.
        skipped: a list to which the files in the folders are appended that have no suffix of an
            image, such as videos, and so get no task. Hidden files and the films of photos are left
            out.

    Raises:
        PhotoError: the sources contain no photo.
        ManifestError: a manifest is not a table, or a row of it is not a path.
        OutputError: two layers would have the same path, or the output folder cannot be written to.
        BrewsterError: the options name a film, and there are several photos; or they are for all
            frames of a film, which `plan_bursts` plans.
    """
    if options.all_frames:
        raise BrewsterError(
            "all frames were requested of files that are separated for themselves",
            "expected a film",
            "pass it to `brewster burst --all-frames`, or to brewster.film.separate_video",
        )
    given = [sources] if isinstance(sources, str | os.PathLike) else sources
    paths = [location(source) for source in given]
    folder = None if output is None else location(output)
    skipped = [] if skipped is None else skipped
    rows: dict[Location, ManifestRow] = {}
    images = _images(paths, folder, skipped, rows)
    tasks = [
        task_of(image, files, rows.get(image), frames=options.frames)
        for image, files in name_layers(images, options)
    ]
    _check_found(tasks, paths, skipped, folder)
    if options.film not in (FILM_AUTO, FILM_NO) and len(tasks) > 1:
        raise BrewsterError(
            f"the film {options.film} was given for {counted(len(tasks), 'photo')}",
            "expected one photo, because a film shows one window",
            "separate that photo alone, or leave the film out: each photo uses its own",
        )
    skipped[:] = _without_films_of_photos(skipped, [task.source for task in tasks])
    return tasks


def task_of(
    source: Location,
    outputs: Mapping[str, Location | WritableFile],
    row: ManifestRow | None = None,
    *,
    frames: int,
) -> SeparationTask:
    """Returns the task of a file that is separated for itself: a photo, or a film.

    Args:
        source: the file.
        outputs: the output of each layer.
        row: its row in a manifest.
        frames: the number of frames to choose from a film.
    """
    burst = Burst((source,), frames) if is_video_file(source) else None
    return SeparationTask(source, outputs, row, burst)


def _without_films_of_photos(
    files: Iterable[Location], photos: Iterable[Location | BinaryFile]
) -> list[Location]:
    """Returns the files without those that have the name of a photo in their folder: its film, or
    a file of the same picture such as .AAE.
    """
    names = {(photo.parent, photo.stem) for photo in photos if isinstance(photo, Location)}
    return [
        file for file in files if not {(file.parent, file.stem), (file.parent, file.name)} & names
    ]


def _images(
    paths: Iterable[Location],
    folder: Location | None,
    skipped: list[Location],
    rows: dict[Location, ManifestRow],
) -> Iterator[tuple[Location, Location]]:
    """Yields the photos with the folders of their layers. Enters the rows of manifests into
    `rows`.
    """
    for path in paths:
        if not is_manifest(path):
            yield from images_in(path, folder, skipped=skipped)
            continue
        for row, image, image_folder in read_manifest(path, folder):
            rows.setdefault(image, row)
            yield image, image_folder


def _check_found(
    tasks: Sized, paths: Sequence[Location], skipped: Sequence[Location], folder: Location | None
) -> None:
    """Checks that there is a task, and that the output folder can be written to. Raises PhotoError
    and OutputError.
    """
    if not tasks:
        videos = sum(map(image_formats.is_video, skipped))
        counts = (("video", videos), ("other file", len(skipped) - videos))
        found = ", ".join(counted(number, kind) for kind, number in counts if number)
        raise PhotoError(
            f"there is no photo in {', '.join(map(str, paths))}{f' ({found})' if found else ''}",
            f"expected files with one of the suffixes {' '.join(image_formats.SUFFIXES)}",
            "pass the path of the file itself, or choose another folder",
        )
    if folder is not None:
        check_output_folder(folder)


def plan_bursts(
    sources: Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options = _DEFAULT_OPTIONS,
) -> list[SeparationTask]:
    """Groups photos into bursts, and returns a task for each burst with the paths of the layers of
    its reference photo.

    The photos that are given by name are one burst, in their order, and so are the photos of each
    folder, in the order of their names, and each video. An animation (GIF, PNG, WebP, AVIF) that is
    given by name is a video.
    With the option `all_frames`, the layers are videos, see `brewster.film.separate_video`.

    Raises:
        PhotoError: there is no photo, or none with the number `reference`; or there is a photo that
            is no video, with `all_frames`.
        OutputError: as `plan_files`.
        BrewsterError: an option cannot be used with `all_frames`.
    """
    reference = options.reference
    if options.all_frames:
        _check_for_all_frames(options)
    given = [location(source) for source in sources]
    folder = None if output is None else location(output)
    skipped: list[Location] = []
    rows: dict[Location, ManifestRow] = {}
    groups: dict[object, list[tuple[Location, Location]]] = {}
    seen = set[str]()
    for source in given:
        for image, image_folder in _images([source], folder, skipped, rows):
            is_own_group = is_video_file(image) or (image == source and is_animation_file(image))
            group = image if is_own_group else "given" if image == source else image.parent
            # Repeated names stay, because --reference counts them
            if group == "given" or absolute(image) not in seen:
                groups.setdefault(group, []).append((image, image_folder))
            seen.add(absolute(image))
    _check_found(groups, given, skipped, folder)
    bursts = {}
    named = []
    for images in groups.values():
        photos = tuple(image for image, _ in images)
        burst = Burst(photos, options.frames)
        if options.all_frames and not burst.is_from_video:
            raise PhotoError(
                f"all frames were requested, but {photos[0]} is a photo",
                "expected a video",
                "pass a video, or leave --all-frames out (in Python all_frames)",
            )
        if reference and reference > burst.photo_count:
            raise PhotoError(
                f"photo {reference} is the reference of a burst of "
                f"{counted(burst.photo_count, 'photo')} ({photos[0]})",
                f"expected a number from 1 to {burst.photo_count}",
                "correct --reference, or leave it out for the middle photo",
            )
        index = reference - 1 if reference and not burst.is_from_video else len(photos) // 2
        bursts[absolute(photos[index])] = burst
        named.append(images[index])
    names = name_videos(named, options) if options.all_frames else name_layers(named, options)
    return [
        SeparationTask(image, files, rows.get(image), bursts[absolute(image)])
        for image, files in names
    ]


def _check_for_all_frames(options: Options) -> None:
    """Raises BrewsterError if an option cannot be used for all frames of a video."""
    given = {
        "method single": options.method == "single",
        "mask": options.mask is not None,
        "additive": options.additive,
        "format": options.format is not None,
        "layers": not set(options.layers) <= {"transmission", "reflection"},
    }
    if names := [name for name, is_given in given.items() if is_given]:
        raise BrewsterError(
            f"all frames were requested with {', '.join(names)}",
            "expected the layers transmission and reflection, measured by the motion and written "
            "as videos",
            f"leave {', '.join(names)} out, or separate a single frame",
        )
