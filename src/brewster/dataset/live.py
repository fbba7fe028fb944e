"""Rendered samples as a stream without end or disk, on any device: a function of (seed, index) alone.

stream = Rendered(read_scene_recipe("window"), catalog, Assets(folders), seed=7, device="cuda")
batch = stream(step=0, count=16, size=256)
for developed in stream: ...
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count as numbers
from typing import Literal

import torch

from brewster.dataset.blend import blended
from brewster.dataset.mix import Batch
from brewster.render.develop import Developed, develop, with_jpeg
from brewster.render.pane import render
from brewster.scene.recipe import SceneRecipe
from brewster.scene.sampler import Catalog, draw
from brewster.worlds.assets import Assets


class Rendered:
    """A `Stream` of the pane renderer's samples, also an iterable of them.

    `target` says what a network is to find behind the glass: the background B, as benchmarks photograph it with
    the glass taken away, or T, which adds up with R. `mixing` "8-bit" blends the same content as RDNet does.
    """

    def __init__(
        self,
        recipe: SceneRecipe,
        catalog: Catalog,
        assets: Assets,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        target: Literal["background", "transmission"] = "background",
        mixing: Literal["light", "8-bit"] = "light",
    ) -> None:
        self._recipe, self._catalog, self._assets = recipe, catalog, assets
        self._seed, self._device, self._target, self._mixing = seed, device, target, mixing

    def __iter__(self) -> Iterator[Developed]:
        return (self.sample(index) for index in numbers())

    def sample(self, index: int) -> Developed:
        """The sample of this number, at the recipe's size; I has been through JPEG.

        Raises:
            RecipeError: the recipe gives no possible scene, or a file is missing.
            PhotoError: a file cannot be read.
        """
        return self._developed(self._recipe, index)

    def __call__(self, step: int, count: int, size: int) -> Batch:
        """The batch of this step: `count` samples of `size` px a side."""
        camera = self._recipe.camera.model_copy(update={"width": size, "height": size})
        square = self._recipe.model_copy(update={"camera": camera})
        made = [self._developed(square, step * count + slot) for slot in range(count)]
        behind = "background_encoded" if self._target == "background" else "transmission_encoded"
        photo, transmission, reflection = (
            torch.stack([getattr(developed, name) for developed in made])
            for name in ("photo_encoded", behind, "reflection_encoded")
        )
        return Batch(photo, transmission, reflection, torch.ones(count, device=self._device))

    def _developed(self, recipe: SceneRecipe, index: int) -> Developed:
        scene = draw(recipe, self._catalog, self._seed, index)
        developed = develop(render(scene, self._assets, self._device))
        return with_jpeg(developed if self._mixing == "light" else blended(developed))
