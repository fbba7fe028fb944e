"""Streams of a finite number of rendered samples: crops of datasets on disk, or a cache of samples rendered online.

    stream = RenderedDatasets([Path("out/window")], seed=7, count=300)
    stream = CachedRendered(OnlineRendered(...), 300, seed=7)

The sample in a slot, its crop and whether it is mirrored depend on (seed, step, slot) only.
"""

from __future__ import annotations

import tarfile
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Final

import torch
from torch import Tensor

from brewster.environments.assets import add_file_name_to_errors
from brewster.errors import RecipeError
from brewster.photo import Photo
from brewster.render.camera_response import encode_jpeg, to_uint8
from brewster.rendered.store import SCENE_FILE, StoredSample, key, read_dataset, read_scene_of
from brewster.scene.values import Range
from brewster.srgb import to_encoded
from brewster.training.data.alpha_blend import blended_layers
from brewster.training.data.data_recipe import BlendSpace, Target
from brewster.training.data.mixtures import TrainingBatch, random_crop
from brewster.training.data.online import OnlineRendered
from brewster.training.data.sample_rng import SampleRng

CACHE_BYTES: Final = 1 << 30
"""Memory for cached samples, 9 bytes per pixel: 600 samples of 512x384, 1,800 of 256x256 or 7,200 of 128x128. When it is full,
the oldest samples are dropped. When such a sample is drawn again, it is read or rendered again, with the same result."""


class RenderedDatasets:
    """A `Stream` of random crops of the first `count` samples of rendered datasets, mirrored at random. It is thread-safe.

    With `blend_space` "srgb", the photo is a blend of the sample's background and mirror image. The blend is compressed
    as JPEG with the same quality as the photo of the sample.

    Raises:
        RecipeError: a dataset cannot be read, or all datasets together have fewer than `count` samples.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        *,
        seed: int,
        count: int | None = None,
        crop: Range = (0.45, 1.0),
        target: Target = "background",
        blend_space: BlendSpace = "linear",
    ) -> None:
        self._entries = _first_entries(folders, count)
        self._seed, self._crop, self._target, self._blend_space = seed, crop, target, blend_space
        self._cache = _TensorCache(CACHE_BYTES)

    def __len__(self) -> int:
        return len(self._entries)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """Returns the batch of this step: `count` samples with sides of `size` px.

        Raises:
            RecipeError, PhotoError: a file of a sample is missing or damaged.
        """
        rngs = (SampleRng(self._seed, step, slot) for slot in range(count))
        crops = [random_crop(each, self.sample(each.randint(len(self))), self._crop, size) for each in rngs]
        return TrainingBatch.from_layers(to_encoded(torch.stack(crops)))

    def sample(self, number: int) -> Tensor:
        """Returns photo, target and reflection of a whole sample as channels: (H, W, 9) sRGB uint8.

        Raises:
            RecipeError, PhotoError: a file of the sample is missing or damaged.
        """
        return self._cache.get_or_create(number, lambda: self._read(self._entries[number]))

    def _read(self, entry: StoredSample) -> Tensor:
        if self._blend_space == "srgb":
            return _blended_sample(entry)
        return torch.cat([_read_image(entry, name) for name in ("photo", self._target, "reflection")], dim=2)


class CachedRendered:
    """A `Stream` of the first `count` samples of `source`, mirrored at random. It is thread-safe.

    Each sample is rendered once per size and cached in 8 bits, in at most `max_bytes` of memory.
    """

    def __init__(
        self, source: OnlineRendered, count: int, *, seed: int, max_bytes: int = CACHE_BYTES
    ) -> None:
        self._source, self._count, self._seed, self._cache = source, count, seed, _TensorCache(max_bytes)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """Returns the batch of this step: `count` samples with sides of `size` px.

        Raises:
            RecipeError: no valid scene can be drawn from the recipe, or a file is missing.
            PhotoError: a file cannot be decoded.
        """
        rngs = (SampleRng(self._seed, step, slot) for slot in range(count))
        return TrainingBatch.from_layers(torch.stack([self._sample(each, size) for each in rngs]) / 255)

    def _sample(self, rng: SampleRng, size: int) -> Tensor:
        index = rng.randint(self._count)
        layers = self._cache.get_or_create((index, size), lambda: self._render(index, size))
        return layers.flip(2) if rng.bernoulli(0.5) else layers

    def _render(self, index: int, size: int) -> Tensor:
        """Renders a sample as (9, size, size) uint8. The sample has these 8-bit values also when it is first used."""
        return (self._source.layers(index, size).clamp(0, 1) * 255).round().to(torch.uint8)


class _TensorCache:
    """A thread-safe cache of tensors with a limit in bytes. The oldest tensors are dropped first."""

    def __init__(self, max_bytes: int) -> None:
        self._tensors: dict[Hashable, Tensor] = {}
        self._bytes, self._max_bytes, self._lock = 0, max_bytes, Lock()

    def get_or_create(self, name: Hashable, create: Callable[[], Tensor]) -> Tensor:
        found = self._tensors.get(name)
        if found is None:
            found = create()
            self._insert(name, found)
        return found

    def _insert(self, name: Hashable, tensor: Tensor) -> None:
        with self._lock:
            if name not in self._tensors:  # another thread may have inserted it
                self._tensors[name] = tensor
                self._bytes += tensor.nbytes
            while self._bytes > self._max_bytes:
                self._bytes -= self._tensors.pop(next(iter(self._tensors))).nbytes


def _first_entries(folders: Sequence[Path], count: int | None) -> list[StoredSample]:
    entries = [entry for folder in folders for entry in _entries(folder)]
    if len(entries) < (count or 1):
        raise RecipeError(
            f"{', '.join(map(str, folders))}: {len(entries)} rendered samples",
            f"expected at least {count or 1}, the count of the recipe",
            "render more with a larger --count, or lower data.rendered.count",
        )
    return entries[:count]


def _entries(folder: Path) -> list[StoredSample]:
    try:
        return list(read_dataset(folder))
    except (OSError, ValueError, tarfile.TarError) as error:
        raise RecipeError(
            f"{folder} cannot be read ({getattr(error, 'strerror', None) or error})",
            "expected a folder that brewster render wrote",
            "choose another folder in data.rendered.datasets, or set BREWSTER_DATA to the folder of the data",
        ) from error


def _blended_sample(entry: StoredSample) -> Tensor:
    with _file_errors(entry, SCENE_FILE):
        scene = read_scene_of(entry)
    background, mirror = (
        _read_image(entry, name).permute(2, 0, 1) / 255 for name in ("background", "mirror")
    )
    photo, *layers = blended_layers(background, mirror, scene)
    compressed = Photo.open(encode_jpeg(photo, scene.camera_response.jpeg_quality)).pixels.copy()
    return torch.cat([torch.from_numpy(image) for image in (compressed, *map(to_uint8, layers))], dim=2)


def _read_image(entry: StoredSample, layer: str) -> Tensor:
    """Reads a layer of a sample, (H, W, 3) sRGB uint8."""
    name = f"{layer}.jpg"
    with (
        _file_errors(entry, name),
        add_file_name_to_errors(f"{name} of sample {key(entry.index)} in {entry.path}"),
    ):
        return torch.from_numpy(Photo.open(entry.read(name)).pixels.copy())


@contextmanager
def _file_errors(entry: StoredSample, name: str) -> Iterator[None]:
    try:
        yield
    except (OSError, KeyError) as error:
        raise RecipeError(
            f"{name} of sample {key(entry.index)} in {entry.path} cannot be read",
            "expected a sample with five images and a scene",
            "delete the sample and render the dataset again",
        ) from error
