"""Rendered samples as a stream without end or disk, on any device: a function of (seed, index) alone.

stream = Rendered(read_scene_recipe("window"), catalog, Assets(folders), seed=7, device="cuda")
batch = stream(step=0, count=16, size=256)
for developed in stream: ...
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count as numbers
from threading import Lock
from typing import Literal

import torch
from torch import Tensor

from brewster.environments.assets import Assets
from brewster.render.analytic import render
from brewster.render.camera_response import DevelopedSample, develop, with_jpeg
from brewster.scene.recipe import SceneRecipe
from brewster.scene.sampler import Catalog, draw
from brewster.training.data.alpha_blend import blended
from brewster.training.data.mixtures import Target, TrainingBatch

Mixing = Literal["light", "8-bit"]
"""How a photo came about: light that met at the glass, or a blend of the same content in 8 bits, as RDNet's."""


class OnlineRendered:
    """A `Stream` of the analytic renderer's samples, also an iterable of them; threads may share it.

    They render one at a time, as `Assets` serves one at a time; the rest of their work runs side by side.
    """

    def __init__(
        self,
        recipe: SceneRecipe,
        catalog: Catalog,
        assets: Assets,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        target: Target = "background",
        mixing: Mixing = "light",
    ) -> None:
        self._recipe, self._catalog, self._assets = recipe, catalog, assets
        self._seed, self._device, self._target, self._mixing = seed, device, target, mixing
        self._render_lock = Lock()

    def __iter__(self) -> Iterator[DevelopedSample]:
        return (self.sample(index) for index in numbers())

    def sample(self, index: int) -> DevelopedSample:
        """The sample of this number, at the recipe's size; I has been through JPEG.

        Raises:
            RecipeError: the recipe gives no possible scene, or a file is missing.
            PhotoError: a file cannot be read.
        """
        return self._developed(self._recipe, index)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """The batch of this step: `count` samples of `size` px a side, none of them ever seen before."""
        return TrainingBatch.from_layers(
            torch.stack([self.layers(step * count + slot, size) for slot in range(count)])
        )

    def layers(self, index: int, size: int) -> Tensor:
        """Photo, target and reflection of this number, square and as channels: (9, size, size), encoded, in 0..1.

        Raises:
            RecipeError: the recipe gives no possible scene, or a file is missing.
            PhotoError: a file cannot be read.
        """
        camera = self._recipe.camera.model_copy(update={"width": size, "height": size})
        developed = self._developed(self._recipe.model_copy(update={"camera": camera}), index).layers()
        return torch.cat([developed[name] for name in ("photo", self._target, "reflection")])

    def _developed(self, recipe: SceneRecipe, index: int) -> DevelopedSample:
        scene = draw(recipe, self._catalog, self._seed, index)
        with self._render_lock:
            sample = render(scene, self._assets, self._device)
        developed = develop(sample)
        return with_jpeg(developed if self._mixing == "light" else blended(developed))
