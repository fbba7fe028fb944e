"""A stream of rendered samples: crops of datasets.

The sample in a slot, its crop and whether it is mirrored depend on (seed, step, slot) only. With
the blend space "srgb", the photo is an 8-bit mixture of background T and mirror image R: the
baseline of the paper's ablation (Table 4, Figure 7), which RDNet blends as I = alpha T + beta R - T
o R, where o is the element-wise product.
"""

import tarfile
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from random import Random
from typing import Final

import torch
from torch import Tensor

from brewster.base.cache import ByteLimitedCache
from brewster.base.settings import Range
from brewster.errors import RecipeError, error_prefix, read_errors
from brewster.photo import Photo
from brewster.photo.srgb import to_encoded
from brewster.render.camera_response import encode_jpeg, to_uint8
from brewster.render.dataset.store import SCENE_FILE, StoredSample, read_dataset, read_scene_of
from brewster.render.scene.scene import Scene
from brewster.training.data.data_recipe import BlendSpace, Target
from brewster.training.data.mixtures import TrainingBatch, random_crop
from brewster.training.data.sample_rng import SampleRng

CACHE_BYTES: Final = 1 << 30
"""Memory for cached samples, 9 bytes per pixel: 600 samples of 512x384, 1,800 of 256x256 or 7,200
of 128x128. When it is full, the least recently used samples are dropped, and read again.
"""
ALPHA: Final = (0.8, 1.0)
BETA: Final = (0.4, 1.0)


class RenderedDatasets:
    """A `Stream` of random crops of the first `count` samples of rendered datasets, mirrored at
    random. Thread-safe.

    Blends are compressed as JPEG like the photo of the sample. Raises RecipeError for unreadable or
    too few samples.
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
        entries = [entry for folder in folders for entry in _entries(folder)]
        if len(entries) < (count or 1):
            raise RecipeError(
                f"{', '.join(map(str, folders))}: {len(entries)} rendered samples",
                f"expected at least {count or 1}, the count of the recipe",
                "render more with a larger --count, or lower data.rendered.count",
            )
        self._entries = entries[:count]
        self._seed = seed
        self._crop = crop
        self._target = target
        self._blend_space = blend_space
        self._cache = ByteLimitedCache[Tensor](CACHE_BYTES)

    def __len__(self) -> int:
        return len(self._entries)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """See `Stream`."""
        rngs = (SampleRng(self._seed, step, slot) for slot in range(count))
        crops = [
            random_crop(each, self.sample(each.randint(len(self))), self._crop, size)
            for each in rngs
        ]
        return TrainingBatch.from_layers(to_encoded(torch.stack(crops)))

    def sample(self, number: int) -> Tensor:
        """Returns photo, target and reflection of a whole sample as channels: (H, W, 9) sRGB
        uint8.
        """
        return self._cache.get_or_create(number, lambda: self._read(self._entries[number]))

    def _read(self, entry: StoredSample) -> Tensor:
        if self._blend_space == "srgb":
            return _blended_sample(entry)
        return torch.cat(
            [_read_image(entry, name) for name in ("photo", self._target, "reflection")], dim=2
        )


def _entries(folder: Path) -> list[StoredSample]:
    expected = "expected a folder that brewster render wrote"
    cure = (
        "choose another folder in data.rendered.datasets, or set BREWSTER_DATA to the folder "
        "of the data"
    )
    with read_errors(folder, RecipeError, expected, cure, (ValueError, tarfile.TarError)):
        return list(read_dataset(folder))


def _blended_sample(entry: StoredSample) -> Tensor:
    with _file_errors(entry, SCENE_FILE):
        scene = read_scene_of(entry)
    names = "background", "mirror"
    background, mirror = (_read_image(entry, name).permute(2, 0, 1) / 255 for name in names)
    photo, *layers = blended_layers(background, mirror, scene)
    compressed = Photo.open(encode_jpeg(photo, scene.camera_response.jpeg_quality)).pixels.copy()
    return torch.cat(
        [torch.from_numpy(image) for image in (compressed, *map(to_uint8, layers))], dim=2
    )


def _read_image(entry: StoredSample, layer: str) -> Tensor:
    """Reads a layer of a sample, (H, W, 3) sRGB uint8."""
    name = f"{layer}.jpg"
    with _file_errors(entry, name), error_prefix(f"{name} of sample {entry.name} in {entry.path}"):
        return torch.from_numpy(Photo.open(entry.read(name)).pixels.copy())


def _file_errors(entry: StoredSample, name: str) -> AbstractContextManager[None]:
    file = f"{name} of sample {entry.name} in {entry.path}"
    expected = "expected a sample with five images and a scene"
    cure = "delete the sample and render the dataset again"
    return read_errors(file, RecipeError, expected, cure, (KeyError,))


def blend(
    transmission_encoded: Tensor, reflection_encoded: Tensor, alpha: float, beta: float
) -> Tensor:
    """Returns I = alpha T + beta R - T o R (RDNet) of encoded images of one shape, rounded to 8
    bits, in 0..1.
    """
    t, r = (_eight_bits(layer) for layer in (transmission_encoded, reflection_encoded))
    return _eight_bits(alpha * t + beta * r - t * r)


def blended_layers(
    background: Tensor, mirror: Tensor, scene: Scene
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns I, T and R of an 8-bit mixture, each (3, H, W) in 0..1, from encoded background and
    mirror image.

    T is the background. R is the mirror image times beta. alpha is uniform in 0.8..1, beta is
    uniform in 0.4..1. Both depend on the seed and the index of the scene only.
    """
    rng = Random(f"blend/{scene.seed}/{scene.index}")  # noqa: S311  (not for secrets)
    alpha = rng.uniform(*ALPHA)
    beta = rng.uniform(*BETA)
    background = _eight_bits(background)
    mirror = _eight_bits(mirror)
    return blend(background, mirror, alpha, beta), background, _eight_bits(beta * mirror)


def _eight_bits(encoded: Tensor) -> Tensor:
    return (encoded.clamp(0, 1) * 255).round() / 255
