"""Locations of encoded images (files, and images of rendered samples in folders and shards), and
cases of images.
"""

from __future__ import annotations

import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final

from brewster.errors import MissingExtra, PhotoError, UnreadablePhoto, read_errors

if TYPE_CHECKING:
    from brewster.render.dataset.store import StoredSample


@final
@dataclass(frozen=True)
class ImageFile:
    """The location of an encoded image: a file, or the `span` of a tar shard, (offset, length) in
    bytes.
    """

    path: Path
    span: tuple[int, int] | None = None

    def read(self) -> bytes:
        """Returns the encoded bytes of the image. Raises UnreadablePhoto if the file cannot be
        read, or ends in the span.
        """
        offset, length = self.span or (0, -1)
        cure = "restore the file or its permissions, and run again"
        with read_errors(self, UnreadablePhoto, "expected a complete image file", cure):
            with self.path.open("rb") as file:
                file.seek(offset)
                data = file.read(length)
            if len(data) < length:
                raise OSError(f"the file has only {len(data)} of {length} bytes")
        return data

    def __str__(self) -> str:
        return f"{self.path}" if self.span is None else f"{self.path} from byte {self.span[0]}"


@final
@dataclass(frozen=True)
class Case:
    """A photo to separate, with its ground truth, whose `name` is unique within the benchmark.

    Cases with the same `scene` show the same objects, so they are not statistically independent; it
    equals `name` if it is unknown. `relative_path` is that of the photo below the benchmark folder,
    without the suffix and with forward slashes. `ground_truth` is the transmission. If `rendered`
    is True, it is the background without the glass, and `reflection` is the light that the glass
    adds. `frames` are those of a burst in order; `photo` is the middle one.
    """

    benchmark: str
    name: str
    scene: str
    relative_path: str
    photo: ImageFile
    ground_truth: ImageFile
    reflection: ImageFile | None = None
    rendered: bool = False
    frames: tuple[ImageFile, ...] = ()


def read_samples(folder: Path) -> list[StoredSample]:
    """Returns the samples of a rendered dataset. Raises PhotoError if it is none, and MissingExtra
    without torch.
    """
    try:
        from brewster.render.dataset.store import read_dataset  # noqa: PLC0415  (needs torch, an optional dependency)

        entries = list(read_dataset(folder))
        if not entries:
            raise ValueError("it has no samples")  # noqa: TRY301
    except ImportError as error:
        expected = "expected torch, which brewster needs to read rendered datasets"
        raise MissingExtra.for_extra("render", "torch is not installed", expected) from error
    except (OSError, tarfile.TarError, ValueError) as error:
        raise PhotoError(
            f"{folder} is not a rendered dataset ({error})",
            "expected the folders 000000, 000001 ... or files such as shard-000000.tar",
            "give the path of an output folder of `brewster render`",
        ) from error
    return entries


def files_of(entry: StoredSample, names: Sequence[str]) -> list[ImageFile]:
    """Returns the files of a rendered sample that exist, in the order of `names`."""
    if entry.spans:
        return [ImageFile(entry.path, entry.spans[name]) for name in names if name in entry.spans]
    return [ImageFile(entry.path / name) for name in names if (entry.path / name).exists()]
