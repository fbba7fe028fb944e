"""A finite number of rendered samples to learn from again and again: windows of sets on disk, or live ones kept.

    stream = OnDisk([Path("out/window")], seed=7, count=300)
    stream = InMemory(Rendered(...), 300, seed=7)

Which sample fills a slot, and how it is cropped and mirrored, is a function of (seed, step, slot) alone.
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

from brewster.environments.assets import naming_file
from brewster.errors import RecipeError
from brewster.photo import Photo
from brewster.render.camera_response import jpeg, to_bytes
from brewster.rendered.store import SCENE, StoredSample, key, read_scene_of, read_set
from brewster.scene.values import Range
from brewster.srgb import to_encoded
from brewster.training.data.alpha_blend import blended_layers
from brewster.training.data.mixtures import Target, TrainingBatch, random_crop
from brewster.training.data.online import Mixing, OnlineRendered
from brewster.training.data.sample_rng import SampleRng

KEPT_BYTES: Final = 1 << 30
"""What samples may take in memory, 9 bytes a pixel: 600 of 512x384, 1,800 of 256x256, 7,200 of 128x128. Beyond, the
oldest are forgotten, and read or rendered again when their turn comes: slower, but the same."""


class RenderedSets:
    """A `Stream` of random windows, maybe mirrored, of the first `count` samples of rendered sets.

    With `mixing` "8-bit", background and mirror of a sample are blended, and the blend has been through JPEG at the
    sample's own quality, as its photo has. Threads may share it.

    Raises:
        RecipeError: a set cannot be read, or all of them together hold fewer samples.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        *,
        seed: int,
        count: int | None = None,
        crop: Range = (0.45, 1.0),
        target: Target = "background",
        mixing: Mixing = "light",
    ) -> None:
        self._entries = _first(folders, count)
        self._seed, self._crop, self._target, self._mixing = seed, crop, target, mixing
        self._kept = _TensorCache(KEPT_BYTES)

    def __len__(self) -> int:
        return len(self._entries)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """The batch of this step: `count` samples of `size` px a side.

        Raises:
            RecipeError, PhotoError: a file of a sample is missing or damaged.
        """
        rng = (SampleRng(self._seed, step, slot) for slot in range(count))
        windows = [random_crop(each, self.sample(each.randint(len(self))), self._crop, size) for each in rng]
        return TrainingBatch.of(to_encoded(torch.stack(windows)))

    def sample(self, number: int) -> Tensor:
        """Photo, target and reflection of a sample whole, as channels: (H, W, 9) sRGB uint8.

        Raises:
            RecipeError, PhotoError: a file of the sample is missing or damaged.
        """
        return self._kept.once(number, lambda: self._read(self._entries[number]))

    def _read(self, entry: StoredSample) -> Tensor:
        if self._mixing == "8-bit":
            return _blend(entry)
        return torch.cat([_picture(entry, name) for name in ("photo", self._target, "reflection")], dim=2)


class CachedRendered:
    """A `Stream` of the first `count` samples of a live one, maybe mirrored; threads may share it.

    Each is rendered once for each size and kept in 8 bits, in `most_bytes` of memory.
    """

    def __init__(self, live: OnlineRendered, count: int, *, seed: int, most_bytes: int = KEPT_BYTES) -> None:
        self._live, self._count, self._seed, self._kept = live, count, seed, _TensorCache(most_bytes)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """The batch of this step: `count` samples of `size` px a side.

        Raises:
            RecipeError: the recipe gives no possible scene, or a file is missing.
            PhotoError: a file cannot be read.
        """
        rng = (SampleRng(self._seed, step, slot) for slot in range(count))
        return TrainingBatch.of(torch.stack([self._use(each, size) for each in rng]) / 255)

    def _use(self, rng: SampleRng, size: int) -> Tensor:
        index = rng.randint(self._count)
        layers = self._kept.once((index, size), lambda: self._render(index, size))
        return layers.flip(2) if rng.bernoulli(0.5) else layers

    def _render(self, index: int, size: int) -> Tensor:
        """(9, size, size) uint8, the first time too, so that a sample never changes."""
        return (self._live.layers(index, size).clamp(0, 1) * 255).round().to(torch.uint8)


class _TensorCache:
    """Tensors that are made once, as long as there is room for them."""

    def __init__(self, most_bytes: int) -> None:
        self._tensors: dict[Hashable, Tensor] = {}
        self._bytes, self._most, self._changes = 0, most_bytes, Lock()

    def once(self, name: Hashable, make: Callable[[], Tensor]) -> Tensor:
        found = self._tensors.get(name)
        if found is None:
            found = make()
            self._keep(name, found)
        return found

    def _keep(self, name: Hashable, made: Tensor) -> None:
        with self._changes:
            if name not in self._tensors:  # or another thread was faster
                self._tensors[name] = made
                self._bytes += made.nbytes
            while self._bytes > self._most:
                self._bytes -= self._tensors.pop(next(iter(self._tensors))).nbytes


def _first(folders: Sequence[Path], count: int | None) -> list[StoredSample]:
    entries = [entry for folder in folders for entry in _entries(folder)]
    if len(entries) < (count or 1):
        raise RecipeError(
            f"{', '.join(map(str, folders))}: {len(entries)} rendered samples",
            f"the recipe learns from {count or 'at least one'}",
            "render more with a larger --count, or lower data.rendered.count",
        )
    return entries[:count]


def _entries(folder: Path) -> list[StoredSample]:
    try:
        return list(read_set(folder))
    except (OSError, ValueError, tarfile.TarError) as error:
        raise RecipeError(
            f"{folder} cannot be read ({getattr(error, 'strerror', None) or error})",
            "a folder that brewster render made",
            "name another in data.rendered.sets, or set BREWSTER_DATA to where the data lies",
        ) from error


def _blend(entry: StoredSample) -> Tensor:
    with _whole(entry, SCENE):
        scene = read_scene_of(entry)
    background, mirror = (_picture(entry, name).permute(2, 0, 1) / 255 for name in ("background", "mirror"))
    photo, *layers = blended_layers(background, mirror, scene)
    seen = Photo.open(jpeg(photo, scene.development.jpeg_quality)).pixels.copy()
    return torch.cat([torch.from_numpy(picture) for picture in (seen, *map(to_bytes, layers))], dim=2)


def _picture(entry: StoredSample, layer: str) -> Tensor:
    """One of a sample's photographs, (H, W, 3) sRGB uint8."""
    name = f"{layer}.jpg"
    with _whole(entry, name), naming_file(f"{name} of sample {key(entry.index)} in {entry.place}"):
        return torch.from_numpy(Photo.open(entry.read(name)).pixels.copy())


@contextmanager
def _whole(entry: StoredSample, name: str) -> Iterator[None]:
    try:
        yield
    except (OSError, KeyError) as error:
        raise RecipeError(
            f"{name} of sample {key(entry.index)} in {entry.place} cannot be read",
            "a sample has five pictures and a scene",
            "delete that sample and render the set again",
        ) from error
