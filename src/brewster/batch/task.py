"""The task and the result of one photo of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, final

from brewster.base import image_formats
from brewster.base.remote_path import Location, is_video_file
from brewster.batch.manifest import ManifestRow
from brewster.errors import BrewsterError
from brewster.photo.in_memory import BinaryFile, WritableFile
from brewster.separation.record import SeparationRecord

_STREAM_NAME: Final = "-"
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
    frames: int
    """The number of frames to choose from a video; see `Options.frames`."""

    @property
    def is_from_video(self) -> bool:
        """Whether the photos are the frames of a video, or of an animation."""
        return is_video_file(self.photos[0]) or (
            len(self.photos) == 1 and is_animation_file(self.photos[0])
        )

    @property
    def is_one_photo(self) -> bool:
        """Whether this is one photo, which is separated by the film that its phone recorded."""
        return len(self.photos) == 1 and not self.is_from_video

    @property
    def photo_count(self) -> int:
        """The number of photos, or of frames that are chosen from a video."""
        return self.frames if self.is_from_video else len(self.photos)


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


def is_animation_file(path: Location) -> bool:
    """Whether a file is an animation, by its first bytes; in an object store, by its suffix."""
    suffix = path.suffix.lower()
    if suffix not in _ANIMATIONS or not isinstance(
        path, Path
    ):  # films in object stores are refused
        return suffix == ".gif"
    with suppress(OSError), path.open("rb") as file:
        return image_formats.is_animation(file.read(_HEAD_BYTES))
    return False


def display_name(source_or_target: object) -> str:
    """Returns the path or the URL, or `-` for a stream."""
    return str(source_or_target) if isinstance(source_or_target, Location) else _STREAM_NAME
