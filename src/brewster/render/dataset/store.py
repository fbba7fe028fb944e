"""Stores rendered samples: one folder per sample, or shards (tar files) of a hundred samples, and
an index.

Writing is atomic: a file or folder is written with a hidden name, flushed to disk, and then
renamed.
"""

import contextlib
import os
import re
import tarfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from itertools import groupby, product
from pathlib import Path
from typing import Final

import brewster
from brewster.base.files import (
    TEMPORARY_PREFIX,
    atomic_path,
    discard,
    temporary_path,
    write_atomically,
)
from brewster.base.settings import parse_toml
from brewster.errors import RecipeError
from brewster.photo import write_exr_layers
from brewster.render.analytic import ghost_distance_px
from brewster.render.camera_response import DevelopedSample, develop, encode_jpeg, luminance
from brewster.render.sample import SAMPLE_IMAGES, LinearSample
from brewster.render.scene.scene import Scene

SHARD_SIZE: Final = 100
"""Number of samples in a shard."""
LIGHT_FILE = "layers.exr"
SCENE_FILE = "scene.toml"
SAMPLE_FILES: Final = (*(f"{layer}.jpg" for layer in SAMPLE_IMAGES), LIGHT_FILE, SCENE_FILE)
"""The files of a sample: five photographs, their linear light, and the scene."""

_GROUND_TRUTH_QUALITY: Final = 95

STATISTICS: Final = ("reflection_to_transmission", "overexposed_fraction", "ghost_px")
"""Statistics for the selection of samples. They are stored in every scene.toml and in the index.

`reflection_to_transmission` is the mean luminance of R divided by that of T, `overexposed_fraction`
the fraction of the pixels of I with a clipped channel, and `ghost_px` the distance between the
first two mirror images in px.
"""


def statistics(sample: LinearSample, developed: DevelopedSample) -> dict[str, float]:
    """Returns the values of STATISTICS, rounded to six significant digits."""
    reflection, transmission = (
        luminance(layer.double().mean((1, 2))) for layer in (sample.reflection, sample.transmission)
    )
    ratio = reflection / max(transmission, 1e-12)
    values = ratio, developed.overexposed_fraction, ghost_distance_px(sample.scene)
    return {name: float(f"{value:.6g}") for name, value in zip(STATISTICS, values, strict=True)}


SAMPLE_FORMAT: Final = 3
"""Version of the files of a sample. Increase it if the same job gives other files, so that no
dataset contains samples of two versions (tests/test_conventions_formats.py). Version 3 renamed keys
of scene.toml.
"""


def encode_sample(sample: LinearSample, renderer: str) -> dict[str, bytes]:
    """Encodes a sample. Returns the bytes of each of its files by name. Raises MissingExtra without
    OpenEXR.
    """
    developed = develop(sample)
    origin = {"version": brewster.__version__, "renderer": renderer}
    outcome = {**origin, **developed.camera_settings(), **statistics(sample, developed)}
    qualities = {"photo": sample.scene.camera_response.jpeg_quality}
    files = {
        f"{name}.jpg": encode_jpeg(layer, qualities.get(name, _GROUND_TRUTH_QUALITY))
        for name, layer in developed.images().items()
    }
    light = {
        name: layer.permute(1, 2, 0).float().cpu().numpy()
        for name, layer in sample.images().items()
    }
    files[LIGHT_FILE] = write_exr_layers(light, {"software": f"brewster {brewster.__version__}"})
    files[SCENE_FILE] = sample.scene.to_toml(outcome=outcome).encode()
    return files


def key(index: int) -> str:
    """Returns the name of a sample: the name of its folder, and the prefix of its files in a
    shard.
    """
    return f"{index:06d}"


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes the folder of a sample. An existing folder stays, because another process may have
    written it.
    """
    with atomic_path(folder) as part:
        part.mkdir(parents=True)
        for name, data in files.items():
            write_atomically(part / name, data)


def remove_partial_files(out: Path) -> None:
    """Removes the partial files of killed runs. Call it only if no other run writes to the
    folder.
    """
    for part in out.glob(f"{TEMPORARY_PREFIX}*"):
        discard(part)


def shard_name(block: int) -> str:
    """Returns the name of the shard with the samples 100 * block to 100 * block + 99."""
    return f"shard-{block:06d}.tar"


def pack(out: Path, block: int) -> None:
    """Moves the finished samples of a block from folders into its shard, whose samples stay there.
    Its members are named as in WebDataset (000007.photo.jpg), and its bytes depend only on the
    samples.
    """
    entries = list(read_block(out, block))
    if any(not entry.spans for entry in entries):
        with (
            atomic_path(out / shard_name(block)) as part,
            tarfile.open(part, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            for entry, name in product(entries, SAMPLE_FILES):
                data = entry.read(name)
                member = tarfile.TarInfo(f"{entry.name}.{name}")
                member.size = len(data)
                tar.addfile(member, BytesIO(data))
    for folder in _folders(out, block):
        hidden = temporary_path(
            folder
        )  # it is renamed first, so that no reader finds a partial sample
        with contextlib.suppress(OSError):  # another process has removed it
            folder.replace(hidden)
            discard(hidden)


def has_folders(out: Path, block: int) -> bool:
    """Whether there are folders with samples of this block. After an interruption, the shard may
    have them, too.
    """
    return next(_folders(out, block), None) is not None


@dataclass(frozen=True)
class StoredSample:
    """A finished sample. `path` is its folder or its shard. For a shard, `spans`: file name ->
    (offset, length).
    """

    index: int
    path: Path
    spans: Mapping[str, tuple[int, int]] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        """The name of the sample (see `key`)."""
        return key(self.index)

    def read(self, name: str) -> bytes:
        """Returns the bytes of a file. `name` is one of SAMPLE_FILES."""
        if not self.spans:
            return (self.path / name).read_bytes()
        offset, length = self.spans[name]
        with self.path.open("rb") as shard:
            shard.seek(offset)
            return shard.read(length)


def read_dataset(out: Path) -> Iterator[StoredSample]:
    """Yields the finished samples of a dataset from folders and shards, in the order of their
    indices.
    """
    with os.scandir(out) as found:
        names = (re.fullmatch(r"(?:shard-(\d{6,})\.tar|(\d{6,}))", item.name) for item in found)
        blocks = {int(name[1]) if name[1] else int(name[2]) // SHARD_SIZE for name in names if name}
    for block in sorted(blocks):
        yield from read_block(out, block)


def read_block(out: Path, block: int) -> Iterator[StoredSample]:
    """Yields the finished samples of a block of a hundred indices in order; the shard wins over a
    folder.
    """
    entries = {
        int(folder.name): StoredSample(int(folder.name), folder) for folder in _folders(out, block)
    }
    entries |= {entry.index: entry for entry in _members(out / shard_name(block))}
    yield from (entry for _, entry in sorted(entries.items()))


def read_scene_of(entry: StoredSample) -> Scene:
    """Reads the scene of a sample. Raises RecipeError if the scene file is damaged."""
    try:
        data = entry.read(SCENE_FILE)
    except (OSError, KeyError) as error:
        raise RecipeError(
            f"the scene of {entry.path} is missing",
            "expected a scene file",
            "delete this sample, and render the dataset again",
        ) from error
    source = f"the scene of {entry.path}"
    return parse_toml(
        Scene, data, source=source, reference="brewster render --help", ignored={"outcome"}
    )


def _folders(out: Path, block: int) -> Iterator[Path]:
    for index in range(block * SHARD_SIZE, (block + 1) * SHARD_SIZE):
        if (out / key(index)).is_dir():
            yield out / key(index)


def _members(shard: Path) -> Iterator[StoredSample]:
    if not shard.is_file():
        return
    spans: dict[int, dict[str, tuple[int, int]]] = {}
    with tarfile.open(shard, "r:") as tar:
        for member in tar:
            stem, _, name = member.name.partition(".")
            spans.setdefault(int(stem), {})[name] = (member.offset_data, member.size)
    for index, files in spans.items():
        yield StoredSample(index, shard, files)


@dataclass(frozen=True)
class StoredBurst:
    """A rendered burst. `index` is the number of the burst in its dataset. `frames` follow the
    camera's path.
    """

    index: int
    frames: tuple[StoredSample, ...]
    scenes: tuple[Scene, ...]
    """The scenes of the frames."""

    @property
    def reference(self) -> int:
        """The position of the reference frame in `frames`: the middle."""
        return len(self.frames) // 2


def read_bursts(out: Path) -> Iterator[StoredBurst]:
    """Yields the complete bursts of a dataset in order. A burst of which a frame failed or is not
    yet rendered is left out. Raises RecipeError if a sample is not a frame of a burst.
    """
    frames = ((entry, read_scene_of(entry)) for entry in read_dataset(out))
    for (index, count), group in groupby(frames, key=lambda frame: _burst_of(*frame)):
        entries, scenes = zip(*group, strict=True)
        if len(entries) == count:
            yield StoredBurst(index, entries, scenes)


def _burst_of(entry: StoredSample, scene: Scene) -> tuple[int, int]:
    if scene.burst is None:
        raise RecipeError(
            f"sample {entry.index} of {entry.path.parent} is a single photo",
            "expected the frames of bursts",
            "choose a dataset of `brewster render --burst`",
        )
    return entry.index // scene.burst.frames, scene.burst.frames
