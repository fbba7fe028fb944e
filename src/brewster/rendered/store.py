"""A set of rendered samples on disk: one folder per sample or shards of a hundred samples, and an index.

    for entry in read_set(Path("out/window")):
        layers, scene = open_sample(entry)

Writing is atomic: a file or folder is written under a hidden name, flushed to disk, and then renamed.
"""

from __future__ import annotations

import contextlib
import os
import re
import tarfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import brewster
from brewster.errors import RecipeError
from brewster.files import TEMPORARY_PREFIX, atomic_path, discard, temporary_path, write_atomically
from brewster.photo import read_layers, write_layers
from brewster.render.analytic import ghost_distance_px
from brewster.render.camera_response import DevelopedSample, develop, encode_jpeg, luminance
from brewster.render.sample import LAYERS, LightSample
from brewster.scene.recipe_file import validated
from brewster.scene.scene import Scene

Float32 = NDArray[np.float32]

SHARD_SIZE: Final = 100
LIGHT, SCENE = "layers.exr", "scene.toml"
FILES: Final = (*(f"{layer}.jpg" for layer in LAYERS), LIGHT, SCENE)
"""The files of a sample: five photographs, their linear light, and their scene."""

_GROUND_TRUTH_QUALITY: Final = 95
_CURE: Final = "delete that sample and render the set again"


# --- encoding a sample


def _reflection_to_transmission(sample: LightSample, _: DevelopedSample) -> float:
    reflected, transmitted = (
        luminance(layer.double().mean((1, 2))) for layer in (sample.reflection, sample.transmission)
    )
    return reflected / max(transmitted, 1e-12)


STATISTICS: Final[dict[str, Callable[[LightSample, DevelopedSample], float]]] = {
    "reflection_to_transmission": _reflection_to_transmission,
    "overexposed": lambda _, developed: developed.overexposed,
    "ghost_px": lambda sample, _: ghost_distance_px(sample.scene),
}
"""Statistics for selecting samples, in every scene.toml and in the index: the ratio of mean luminances, the share of
pixels that are clipped in any channel, and the distance between the first two mirror images in px."""


def statistics(sample: LightSample, developed: DevelopedSample) -> dict[str, float]:
    """The value of each of STATISTICS, rounded to six digits."""
    return {name: float(f"{measure(sample, developed):.6g}") for name, measure in STATISTICS.items()}


SAMPLE_FORMAT: Final = 2
"""Version of the files of a sample. Increase it if the same job gives other files, so that no set contains samples of two
versions (tests/test_house_formats.py). 2: scene.toml has [camera_response] and `highlight_boost`."""


def encode_sample(sample: LightSample, renderer: str) -> dict[str, bytes]:
    """The files of a sample: name -> bytes.

    Raises:
        MissingExtra: OpenEXR is not installed.
    """
    developed = develop(sample)
    made = {"version": brewster.__version__, "renderer": renderer}
    outcome = {**made, **developed.camera_settings(), **statistics(sample, developed)}
    qualities = dict.fromkeys(LAYERS, _GROUND_TRUTH_QUALITY) | {
        "photo": sample.scene.camera_response.jpeg_quality
    }
    files = {f"{name}.jpg": encode_jpeg(layer, qualities[name]) for name, layer in developed.layers().items()}
    light = {name: layer.permute(1, 2, 0).float().cpu().numpy() for name, layer in sample.layers().items()}
    files[LIGHT] = write_layers(light, {"software": f"brewster {brewster.__version__}"})
    files[SCENE] = sample.scene.to_toml(outcome=outcome).encode()
    return files


# --- folders


def key(index: int) -> str:
    """The name of a sample: that of its folder, and the prefix of its files in a shard."""
    return f"{index:06d}"


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes the folder of a sample. If another process wrote it first, that folder stays: its content is the same.

    Raises:
        TargetError: the file or folder cannot be written, for example because the disk is full.
    """
    with atomic_path(folder) as part:
        part.mkdir(parents=True)
        for name, data in files.items():
            write_atomically(part / name, data)


def remove_partial_files(out: Path) -> None:
    """Removes partial files of killed runs. No other run may be writing to the folder."""
    for part in out.glob(f"{TEMPORARY_PREFIX}*"):
        discard(part)


# --- shards


def shard_name(block: int) -> str:
    """The name of the shard with the samples from index 100 * block."""
    return f"shard-{block:06d}.tar"


def pack(out: Path, block: int) -> None:
    """Moves the finished folders of a block into its shard, which keeps the samples that it has.

    Members are named as WebDataset expects (000007.photo.jpg). The bytes depend on the samples only.

    Raises:
        TargetError: the file or folder cannot be written, for example because the disk is full.
    """
    entries = list(read_block(out, block))
    if any(not entry.spans for entry in entries):
        with (
            atomic_path(out / shard_name(block)) as part,
            tarfile.open(part, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            for entry in entries:
                _add(tar, entry)
    for folder in _folders(out, block):
        _remove(folder)


def has_folders(out: Path, block: int) -> bool:
    """Whether samples of this block are in folders, finished or left over from packing."""
    return next(_folders(out, block), None) is not None


def _add(tar: tarfile.TarFile, entry: StoredSample) -> None:
    for name in FILES:
        data, member = entry.read(name), tarfile.TarInfo(f"{key(entry.index)}.{name}")
        member.size = len(data)
        tar.addfile(member, BytesIO(data))


def _remove(folder: Path) -> None:
    """Removes the folder of a sample. It is renamed first, so that no reader sees a partial sample."""
    doomed = temporary_path(folder)
    with contextlib.suppress(OSError):  # another process has removed it
        folder.replace(doomed)
        discard(doomed)


# --- reading


@dataclass(frozen=True)
class StoredSample:
    """A finished sample. `place` is its folder, or a shard that has its files at `spans` (offset, length)."""

    index: int
    place: Path
    spans: Mapping[str, tuple[int, int]] = field(default_factory=dict, repr=False)

    def read(self, name: str) -> bytes:
        """The bytes of one of FILES."""
        if not self.spans:
            return (self.place / name).read_bytes()
        offset, length = self.spans[name]
        with self.place.open("rb") as shard:
            shard.seek(offset)
            return shard.read(length)


def read_set(out: Path) -> Iterator[StoredSample]:
    """The finished samples of a set, from folders and shards, in the order of their indices."""
    for block in _blocks(out):
        yield from read_block(out, block)


def read_block(out: Path, block: int) -> Iterator[StoredSample]:
    """The finished samples of a block of a hundred indices, in order. A sample in the shard replaces its folder."""
    entries = {int(folder.name): StoredSample(int(folder.name), folder) for folder in _folders(out, block)}
    entries |= {entry.index: entry for entry in _members(out / shard_name(block))}
    yield from (entry for _, entry in sorted(entries.items()))


def open_sample(entry: StoredSample) -> tuple[dict[str, Float32], Scene]:
    """Reads a sample.

    Returns: its five images by name, each (H, W, 3) in linear light, and its scene.

    Raises:
        MissingExtra: OpenEXR is not installed.
        PhotoError: its image file is damaged.
        RecipeError: its scene file is damaged.
    """
    light = read_layers(entry.read(LIGHT))
    return {name: light[name] for name in LAYERS}, read_scene_of(entry)


def read_scene_of(entry: StoredSample) -> Scene:
    """The scene of a sample.

    Raises:
        RecipeError: its scene file is damaged.
    """
    try:
        table = tomllib.loads(entry.read(SCENE).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(
            f"the scene of {entry.place} is not TOML", "expected a scene file", _CURE
        ) from error
    values = {name: table[name] for name in table if name != "outcome"}
    return validated(Scene, values, source=f"the scene of {entry.place}", reference="brewster render --help")


def _blocks(out: Path) -> list[int]:
    """The numbers of the blocks with at least one finished sample."""
    with os.scandir(out) as found:
        names = (re.fullmatch(r"(?:shard-(\d{6,})\.tar|(\d{6,}))", item.name) for item in found)
        return sorted({int(name[1]) if name[1] else int(name[2]) // SHARD_SIZE for name in names if name})


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
