"""An endless stream of samples that are rendered during training on a CPU or a GPU. A sample depends on (seed, index) only.

stream = OnlineRendered(read_scene_recipe("window"), catalog, Assets(folders), seed=7, device="cuda")
batch = stream(step=0, count=16, size=256)
for developed in stream: ...
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count as integers_from
from threading import Lock

import torch
from torch import Tensor

from brewster.environments.assets import Assets
from brewster.render.analytic import render
from brewster.render.camera_response import DevelopedSample, develop, with_jpeg
from brewster.scene.recipe import SceneRecipe
from brewster.scene.sampler import Catalog, draw
from brewster.training.data.alpha_blend import blended
from brewster.training.data.data_recipe import BlendSpace, Target
from brewster.training.data.mixtures import TrainingBatch


class OnlineRendered:
    """A `Stream` of samples of the analytic renderer, and an iterable of single samples. It is thread-safe.

    Only one thread renders at a time, because `Assets` is not thread-safe. Several threads can compute camera response and JPEG
    at the same time.
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
        blend_space: BlendSpace = "linear",
    ) -> None:
        self._recipe, self._catalog, self._assets = recipe, catalog, assets
        self._seed, self._device, self._target, self._blend_space = seed, device, target, blend_space
        self._render_lock = Lock()

    def __iter__(self) -> Iterator[DevelopedSample]:
        return (self.sample(index) for index in integers_from(0))

    def sample(self, index: int) -> DevelopedSample:
        """Renders the sample of this index at the size in the recipe. The photo has JPEG artefacts.

        Raises:
            RecipeError: no valid scene can be drawn from the recipe, or a file is missing.
            PhotoError: a file cannot be decoded.
        """
        return self._developed(self._recipe, index)

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """Returns the batch of this step: `count` new samples with sides of `size` px."""
        return TrainingBatch.from_layers(
            torch.stack([self.layers(step * count + slot, size) for slot in range(count)])
        )

    def layers(self, index: int, size: int) -> Tensor:
        """Renders the sample of this index as a square. Returns photo, `target` and reflection as channels, (9, size, size),
        encoded, in 0..1.

        Raises:
            RecipeError: no valid scene can be drawn from the recipe, or a file is missing.
            PhotoError: a file cannot be decoded.
        """
        camera = self._recipe.camera.model_copy(update={"width": size, "height": size})
        developed = self._developed(self._recipe.model_copy(update={"camera": camera}), index).images()
        return torch.cat([developed[name] for name in ("photo", self._target, "reflection")])

    def _developed(self, recipe: SceneRecipe, index: int) -> DevelopedSample:
        scene = draw(recipe, self._catalog, self._seed, index)
        with self._render_lock:
            sample = render(scene, self._assets, self._device)
        developed = develop(sample)
        return with_jpeg(developed if self._blend_space == "linear" else blended(developed))
