"""Finds the photos of a batch, and plans a task for each photo with the paths of its layers.

No two photos have a layer with the same path. The names of a photo that is separated alone do not
depend on other files in its folder.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, final

from brewster.base import image_formats
from brewster.base.files import SeparationPaths, absolute, check_output_folder, images_in
from brewster.base.remote_path import Location, is_video_file, location
from brewster.batch.manifest import ManifestRow, is_manifest, read_manifest
from brewster.errors import BrewsterError, OutputError, PhotoError, counted
from brewster.options import FILM_AUTO, FILM_NO, BurstMethod, BurstOptions, Options
from brewster.photo.in_memory import BinaryFile, WritableFile
from brewster.separation.record import SeparationRecord

_STREAM_NAME: Final = "-"
_DEFAULT_OPTIONS: Final = Options()
_DEFAULT_BURST_OPTIONS: Final = BurstOptions()
_ANIMATIONS: Final = frozenset({".png", ".apng", ".webp", ".avif"})
"""The suffixes of photos that may be animations."""
_HEAD_BYTES: Final = 65_536


@final
@dataclass(frozen=True)
class Burst:
    """Several photos of one window, or a video. The photo of the task is the reference photo, or
    the video.
    """

    photos: tuple[Location, ...]
    """The photos in the order in which they were taken, or one video."""
    options: BurstOptions

    @property
    def is_from_video(self) -> bool:
        """Whether the photos are the frames of a video, or of an animation."""
        return is_video_file(self.photos[0]) or (
            len(self.photos) == 1 and _is_animation(self.photos[0])
        )

    @property
    def is_one_photo(self) -> bool:
        """Whether this is one photo, which is separated by the film that its phone recorded."""
        return len(self.photos) == 1 and not self.is_from_video

    @property
    def photo_count(self) -> int:
        """The number of photos, or of frames that are chosen from a video."""
        return self.options.frames if self.is_from_video else len(self.photos)


@final
@dataclass(frozen=True)
class SeparationTask:
    """One photo, and the output of each of its layers: a path, a URL or a stream."""

    source: Location | BinaryFile
    """The path or URL of the photo, or a stream."""
    outputs: Mapping[str, Location | WritableFile]
    """The output of each layer, by layer name (`transmission`, `reflection` or `confidence`)."""
    row: ManifestRow | None = None
    """The first row of a manifest that has the path of the photo, or None if there is none."""
    burst: Burst | None = None
    """The photos that show the same window, or None if the photo is separated alone."""
    kept: frozenset[str] = frozenset()
    """The names of the layers that exist and are not written again."""

    @property
    def missing(self) -> dict[str, Location | WritableFile]:
        """The outputs of the layers that are to be written."""
        return {layer: target for layer, target in self.outputs.items() if layer not in self.kept}

    @property
    def name(self) -> str:
        """The path of the photo as the caller passed it, or `-` for a stream."""
        return display_name(self.source)

    @property
    def inputs(self) -> tuple[Location | BinaryFile, ...]:
        """The files of the photos: those of the burst, or the photo."""
        return self.burst.photos if self.burst else (self.source,)

    def failed_results(self, reason: str) -> list[FileResult]:
        """Returns the result of a photo that no worker could separate.

        Args:
            reason: what happened to the workers, the first part of the error message.
        """
        cure = "use fewer workers for each node, or a smaller photo"
        return [
            FileResult(self.name).failed(
                BrewsterError(reason, "expected a photo that fits into memory", cure)
            )
        ]


@final
@dataclass
class FileResult(SeparationRecord):
    """The result for one photo. `brewster --json` prints its fields as one line. If the photo was
    not separated, those of the `SeparationRecord` are empty.
    """

    source: str
    """The path of the photo as the caller passed it, or `-` for a stream."""
    status: Literal["separated", "skipped", "planned", "failed"] = "separated"
    """`skipped`: all layers exist already. `planned`: a dry run would write `outputs`."""
    outputs: dict[str, str] = field(default_factory=dict)
    """The path of each layer by layer name, `-` for a stream; of a failed photo, those written
    before; of a planned one, those missing.
    """
    frames_written: int | None = None
    """The number of frames of each video, if all frames of a film were separated."""
    error: str | None = None
    """The error message, or None."""
    kind: str | None = None
    """The name of the class of the error, such as UnreadablePhoto, or None."""
    exception: Exception | None = field(default=None, repr=False, compare=False)
    """The error on its way to the end of a batch. It is None in all results that a batch returns.
    """

    def as_dict(self) -> dict[str, Any]:
        """Returns the values in the types of JSON, without the exception, the photo first."""
        plain = replace(self, exception=None)  # some exceptions cannot be copied
        values = super(FileResult, plain).as_dict()
        del values["exception"]
        return {name: values.pop(name) for name in ("source", "status", "outputs")} | values

    def failed(self, error: Exception) -> FileResult:
        """Sets the status "failed" and the error. Returns the result itself.

        Args:
            error: the exception that ended the separation of this photo.
        """
        self.status = "failed"
        self.error = str(error)
        self.kind = type(error).__name__
        self.exception = error
        if isinstance(error, MemoryError):
            self.error = (
                "the photo does not fit into memory; expected more free memory; "
                "close other programs, or make the photo smaller."
            )
        elif not isinstance(error, BrewsterError):
            self.error = f"internal error in brewster ({self.kind}: {error}); please report it"
        return self


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
        BrewsterError: the options name a film, and there are several photos.
    """
    given = [sources] if isinstance(sources, str | os.PathLike) else sources
    paths = [location(source) for source in given]
    folder = None if output is None else location(output)
    skipped = [] if skipped is None else skipped
    rows: dict[Location, ManifestRow] = {}
    images = _images(paths, folder, skipped, rows)
    tasks = [
        task_of(image, files, rows.get(image)) for image, files in name_layers(images, options)
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
    source: Location, outputs: Mapping[str, Location | WritableFile], row: ManifestRow | None = None
) -> SeparationTask:
    """Returns the task of a file that is separated for itself: a photo, or a film.

    Args:
        source: the file.
        outputs: the output of each layer.
        row: its row in a manifest.
    """
    burst = Burst((source,), _DEFAULT_BURST_OPTIONS) if is_video_file(source) else None
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
    burst_options: BurstOptions = _DEFAULT_BURST_OPTIONS,
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
    all_frames = burst_options.all_frames
    reference = burst_options.reference
    if all_frames:
        _check_for_all_frames(options, burst_options.method)
    given = [location(source) for source in sources]
    folder = None if output is None else location(output)
    skipped: list[Location] = []
    rows: dict[Location, ManifestRow] = {}
    groups: dict[object, list[tuple[Location, Location]]] = {}
    seen = set[str]()
    for source in given:
        for image, image_folder in _images([source], folder, skipped, rows):
            is_own_group = is_video_file(image) or (image == source and _is_animation(image))
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
        burst = Burst(photos, burst_options)
        if all_frames and not burst.is_from_video:
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
    names = _name_videos(named, options) if all_frames else name_layers(named, options)
    return [
        SeparationTask(image, files, rows.get(image), bursts[absolute(image)])
        for image, files in names
    ]


def _is_animation(path: Location) -> bool:
    suffix = path.suffix.lower()
    if suffix not in _ANIMATIONS or not isinstance(
        path, Path
    ):  # films in object stores are refused
        return suffix == ".gif"
    with suppress(OSError), path.open("rb") as file:
        return image_formats.is_animation(file.read(_HEAD_BYTES))
    return False


def _check_for_all_frames(options: Options, method: BurstMethod) -> None:
    """Raises BrewsterError if an option cannot be used for all frames of a video."""
    given = {
        "method single": method == "single",
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


def _name_videos(
    films: Sequence[tuple[Location, Location]], options: Options
) -> list[tuple[Location, dict[str, Location]]]:
    """Returns the films with the paths of layers: `a.transmission.mp4`; with an `a.mov`,
    `a.mp4.transmission.mp4`.
    """
    stems = Counter((folder, film.stem) for film, folder in films)
    named = list[tuple[Location, dict[str, Location]]]()
    for film, folder in films:
        stem = film.stem if stems[folder, film.stem] == 1 else film.name
        suffix = film.suffix if film.suffix.lower() in image_formats.WRITABLE_VIDEOS else ".mp4"
        named.append(
            (film, {layer: folder / f"{stem}.{layer}{suffix}" for layer in options.layers})
        )
    return named


def display_name(source_or_target: object) -> str:
    """Returns the path or the URL, or `-` for a stream."""
    return str(source_or_target) if isinstance(source_or_target, Location) else _STREAM_NAME


_SUFFIX_RANKS: Final = {suffix: rank for rank, suffix in enumerate(image_formats.SUFFIXES)}


def name_layers(
    images: Iterable[tuple[Location, Location]], options: Options
) -> list[tuple[Location, dict[str, Location]]]:
    """Returns the images with the paths of their layers, from pairs of an image and the folder of
    its layers, as `images_in` yields them. An image that occurs several times is included once.

    `a.jpg` gives `a.transmission.jpg`, and `a.png` gives `a.transmission.png`. If a layer of two
    images of a folder would have the same path, as their confidence, the image whose suffix comes
    first in `SUFFIXES` keeps it, and the other one uses its full name: `a.confidence.png` and
    `a.png.confidence.png`. Therefore `a.jpg` has the same names in all batches, whichever files are
    added to its folder. Only an image whose name has no image suffix comes before: its full name is
    its short name. Raises OutputError if layers of images of two folders would have the same path.
    """
    found: dict[str, SeparationPaths] = {}
    targets: dict[str, dict[str, Location]] = {}
    for image, folder in images:
        if (key := absolute(image)) not in found:
            found[key], targets[key] = SeparationPaths(image, folder, _content_format(image)), {}

    def naming_rank(key: str) -> tuple[int, int, str]:
        # Images without an image suffix are first, then short stems: `a.jpg` is the stem of
        # `a.jpg.png`.
        image = found[key].source
        rank = _SUFFIX_RANKS.get(image.suffix.lower())
        return (0, 0, image.name) if rank is None else (len(image.stem), rank, image.name)

    in_naming_order = sorted(found, key=naming_rank)
    for layer in options.layers:
        owners: dict[str, Location] = {}
        for key in in_naming_order:
            paths = found[key]
            suffix = options.suffix(layer, paths.suffix)
            target = paths.target(layer, suffix)
            owner = owners.get(_case_insensitive(target))
            if owner and owner.parent == paths.source.parent:
                target = paths.target(layer, suffix, has_full_name=True)
            owner = owners.setdefault(_case_insensitive(target), paths.source)
            if owner is not paths.source:
                raise OutputError(
                    f"{owner} and {paths.source} would both be written as {target}",
                    "expected a separate output name for each image",
                    "pass their parent folder, whose tree is mirrored, or use different output "
                    "folders",
                )
            targets[key][layer] = target
    return [(found[key].source, targets[key]) for key in found]


def _content_format(image: Location) -> image_formats.ImageFormat | None:
    """Only of local files without an image suffix: for a store, the requests would take hours."""
    if image_formats.format_of(image) or not isinstance(image, Path) or not os.path.isfile(image):  # noqa: PTH113
        return None
    try:
        with image.open("rb") as file:
            return image_formats.format_of_content(file.read(image_formats.HEAD_BYTES))
    except OSError:  # the separation opens the image later, and reports the error
        return None


def _case_insensitive(target: Location) -> str:
    """Returns the absolute path with a suffix in lower case: `a.transmission.JPG` and `.jpg` are
    one on Windows.
    """
    root, suffix = os.path.splitext(absolute(target))  # noqa: PTH122  (faster than pathlib for millions of paths)
    return root + suffix.lower()
