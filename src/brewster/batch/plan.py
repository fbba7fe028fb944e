"""Finds the photos of a batch, and plans a task for each photo with the paths of its layers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from typing import Final, Literal, final

from brewster.batch.layer_names import name_layers
from brewster.batch.manifest import ManifestRow, is_manifest, read_manifest
from brewster.errors import PhotoError, counted
from brewster.files import absolute, check_output_folder, images_in
from brewster.image_formats import SUFFIXES, is_video
from brewster.inference.assessment import Assessment
from brewster.inference.burst_report import BurstReport
from brewster.options import DEFAULT_FRAMES, BurstMethod, Options
from brewster.photo.in_memory import BinaryFile, WritableFile
from brewster.remote_path import Location, location

_STREAM_NAME: Final = "-"
_DEFAULT_OPTIONS: Final = Options()


@final
@dataclass(frozen=True)
class Burst:
    """Several photos of one window, or a video. The photo of the task is the reference photo, or the video."""

    photos: tuple[Location, ...]
    """The photos in the order in which they were taken, or one video."""
    reference: int | None
    """The index of the photo that is separated; None for the middle one."""
    frames: int
    """The number of frames that are chosen from a video."""
    method: BurstMethod = "auto"
    swap: bool = False
    """Whether the measured layers are exchanged."""

    @property
    def is_from_video(self) -> bool:
        """Whether the photos are the frames of a video."""
        return is_video(self.photos[0])

    @property
    def photo_count(self) -> int:
        """The number of photos, or of frames that are chosen from a video."""
        return self.frames if self.is_from_video else len(self.photos)


@final
@dataclass(frozen=True)
class SeparationTask:
    """One photo, and the output of each of its layers: a path, a URL or a stream."""

    source: Location | BinaryFile
    outputs: Mapping[str, Location | WritableFile]
    """The output of each layer, by layer name (`transmission`, `reflection` or `confidence`)."""
    row: ManifestRow | None = None
    """The first row of a manifest that has the path of the photo, or None if there is none."""
    burst: Burst | None = None
    """The photos that show the same window, or None if the photo is separated alone."""

    @property
    def name(self) -> str:
        """The path of the photo as the caller passed it, or `-` for a stream."""
        return display_name(self.source)

    @property
    def inputs(self) -> tuple[Location | BinaryFile, ...]:
        """The files of the photos: those of the burst, or the photo."""
        return self.burst.photos if self.burst else (self.source,)

    def failed_results(self, reason: str) -> list[FileResult]:
        """Returns the result of a photo that no worker could separate."""
        cure = "use fewer workers for each node, or a smaller photo"
        return [FileResult(self.name).failed(f"{reason}; expected a photo that fits into memory; {cure}.")]


@final
@dataclass
class FileResult:
    """The result for one photo. `brewster --json` prints its fields as one line."""

    source: str
    """The path of the photo as the caller passed it, or `-` for a stream."""
    status: Literal["separated", "skipped", "planned", "failed"] = "separated"
    """`skipped`: all layers exist already. `planned`: a dry run would write `outputs`."""
    outputs: dict[str, str] = field(default_factory=dict)
    """The path of each layer by layer name, or `-` for a stream. If the photo failed, the layers that were written before. If it is
    planned, the missing layers."""
    model: str | None = None
    model_sha256: str | None = None
    """The digest of the model file."""
    photo_sha256: str | None = None
    """The digest of the photo's file."""
    device: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of the steps `decode`, `network`, `upsampling` and `encode`."""
    # see the fields of `Separation` with the same names
    residual: float | None = None
    reconstruction_error: float | None = None
    assessment: Assessment | None = None
    reflection_is_derived: bool = False
    next_step: str | None = None
    burst: BurstReport | None = None
    note: str | None = None
    """What changed when the photo was read, such as a conversion of CMYK colours, or None."""
    error: str | None = None
    """The error message, or None."""

    def failed(self, error: object) -> FileResult:
        """Sets the status "failed" and the error message. Returns the result itself."""
        self.status, self.error = "failed", str(error)
        return self


def plan_files(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options = _DEFAULT_OPTIONS,
    *,
    skipped: list[Location] | None = None,
) -> list[SeparationTask]:
    """Finds the photos, and returns a task for each photo with the paths of its layers.

    For the first three arguments, see `separate_files`. The files in the folders without the suffix of an
    image, such as videos, get no task: they are appended to `skipped`, except hidden files.

    Raises:
        PhotoError: the sources contain no photo.
        ManifestError: a manifest is not a table, or a row of it is not a path.
        OutputError: two layers would have the same path, or the output folder cannot be written to.
    """
    given = [sources] if isinstance(sources, str | os.PathLike) else sources
    paths = [location(source) for source in given]
    folder = None if output is None else location(output)
    skipped = [] if skipped is None else skipped
    rows: dict[Location, ManifestRow] = {}
    images = _images(paths, folder, skipped, rows)
    tasks = [
        SeparationTask(image, outputs, rows.get(image)) for image, outputs in name_layers(images, options)
    ]
    _check_found(tasks, paths, skipped, folder)
    return tasks


def _images(
    paths: Iterable[Location],
    folder: Location | None,
    skipped: list[Location],
    rows: dict[Location, ManifestRow],
) -> Iterator[tuple[Location, Location]]:
    """Yields the photos with the folders of their layers. Enters the rows of manifests into `rows`."""
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
    """Checks that there is a task, and that the output folder can be written to. Raises PhotoError and OutputError."""
    if not tasks:
        videos = sum(map(is_video, skipped))
        counts = (("video", videos), ("other file", len(skipped) - videos))
        found = ", ".join(counted(number, kind) for kind, number in counts if number)
        raise PhotoError(
            f"there is no photo in {', '.join(map(str, paths))}{f' ({found})' if found else ''}",
            f"expected files with one of the suffixes {' '.join(SUFFIXES)}",
            "pass the path of the file itself, or choose another folder",
        )
    if folder is not None:
        check_output_folder(folder)


def plan_bursts(
    sources: Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options = _DEFAULT_OPTIONS,
    *,
    reference: int | None = None,
    frames: int = DEFAULT_FRAMES,
    method: BurstMethod = "auto",
    swap: bool = False,
) -> list[SeparationTask]:
    """Groups photos into bursts, and returns a task for each burst with the paths of the layers of its reference photo.

    The photos that are given by name are one burst, in their order, and so are the photos of each folder, in the order
    of their names, and each video. `reference` is the index of the reference photo in each burst, by default the middle
    one; `frames` is the number of frames that are chosen from a video; for `method` and `swap`, see `brewster.separate_burst`. Raises PhotoError if there is no photo, or none
    with the index `reference`, and OutputError as `plan_files`."""
    given = [location(source) for source in sources]
    folder = None if output is None else location(output)
    skipped: list[Location] = []
    rows: dict[Location, ManifestRow] = {}
    groups: dict[object, list[tuple[Location, Location]]] = {}
    seen = set[str]()
    for source in given:
        for image, image_folder in _images([source], folder, skipped, rows):
            group = image if is_video(image) else "given" if image == source else image.parent
            # Repeated names stay, because --reference counts them
            if group == "given" or absolute(image) not in seen:
                groups.setdefault(group, []).append((image, image_folder))
            seen.add(absolute(image))
    _check_found(groups, given, skipped, folder)
    bursts, named = {}, []
    for images in groups.values():
        photos = tuple(image for image, _ in images)
        burst = Burst(photos, reference, frames, method, swap)
        if reference is not None and not 0 <= reference < burst.photo_count:
            raise PhotoError(
                f"photo {reference + 1} is the reference of a burst of {counted(burst.photo_count, 'photo')} ({photos[0]})",
                f"expected a number from 1 to {burst.photo_count}",
                "correct --reference (in Python reference, which begins at 0), or leave it out for the middle photo",
            )
        index = len(photos) // 2 if reference is None or burst.is_from_video else reference
        bursts[absolute(photos[index])] = burst
        named.append(images[index])
    return [
        SeparationTask(image, outputs, rows.get(image), bursts[absolute(image)])
        for image, outputs in name_layers(named, options)
    ]


def display_name(source_or_target: object) -> str:
    """Returns the path or the URL, or `-` for a stream."""
    return str(source_or_target) if isinstance(source_or_target, Location) else _STREAM_NAME
