"""Samples as a large backbone sees them: whole, in their own aspect ratio, composed of panels, and encoded once.

    samples = open_samples(recipe)
    encoded = Latents(samples, backbone, recipe)(SampleRng(seed, step, slot))

Latents are a function of sample, mirroring and crop, by which they are kept, and of bucket (the size of the panels) and
VAE, which need not stand beside them: a run has one VAE, frozen, and one budget, so that a sample's shape decides its
bucket, the same for all crops of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from brewster.benchmarks.pairing import PictureGroup, read_folders
from brewster.errors import RecipeError
from brewster.models.diffusion.families.family import Backbone
from brewster.models.diffusion.panels import PanelFit, compose, condition, fit_panel
from brewster.models.diffusion.pipeline import start
from brewster.photo import Photo
from brewster.srgb import to_encoded, to_linear
from brewster.training.data.image_loading import read_pairs
from brewster.training.data.mixtures import Pairs
from brewster.training.data.rendered import RenderedSets
from brewster.training.data.sample_rng import SampleRng
from brewster.training.recipe import LoraRecipe
from brewster.training.streams import found

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

KEPT: Final = 2048
"""How many latents stay in memory: 3 GiB at the paper's size (a thousand sets, also mirrored, without crops). Beyond,
those that were not used for longest are encoded again when their turn comes: slower, but the same."""
_LEAST_SIDE: Final = 0.5
"""Of a crop, over the whole sample's."""


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """Photo, transmission and reflection, sRGB uint8 (H, W, 9), and how far the reflection is to be trusted."""

    layers: UInt8[Tensor, "h w 9"]
    trust: float = 1.0


@dataclass(frozen=True, eq=False)
class EncodedSample:
    """Latent grids (1, C, h, w), float32, on the CPU: the composite, what the model is shown, and where it starts.

    `start` is the photo in every panel, where there is one step only; else noise takes its place.
    """

    composite: Float[Tensor, "1 c h w"]
    condition: Float[Tensor, "1 c p q"]
    start: Float[Tensor, "1 c h w"] | None
    trust: float


class SampleSequence:
    """Rendered sets and real pairs as one sequence: first the sets, then the pairs."""

    def __init__(
        self, rendered: RenderedSets | None, pairs: Sequence[TrainingSample], pairs_share: float
    ) -> None:
        self._rendered, self._pairs, self._share = rendered, pairs, pairs_share
        self._first_pair = len(rendered) if rendered else 0

    def __len__(self) -> int:
        return self._first_pair + len(self._pairs)

    def __getitem__(self, number: int) -> TrainingSample:
        if self._rendered and number < self._first_pair:
            return TrainingSample(self._rendered.sample(number))
        return self._pairs[number - self._first_pair]

    def at_hand(self) -> Iterator[UInt8[Tensor, "h w 9"]]:
        """Layers that need no reading: the first rendered ones, and every pair's."""
        if self._rendered:
            yield self._rendered.sample(0)
        yield from (pair.layers for pair in self._pairs)

    def choose(self, rng: SampleRng) -> int:
        """The number of a sample: a pair as often as their share says."""
        if rng.bernoulli(self._share):
            return self._first_pair + rng.randint(len(self._pairs))
        return rng.randint(self._first_pair)


class LatentEncoder:
    """Encodes what the rng choose.

    Raises:
        PhotoError: a pair, or the first of the rendered samples, is smaller than a panel.
    """

    def __init__(self, samples: SampleSequence, backbone: Backbone, recipe: LoraRecipe) -> None:
        self._samples, self._backbone, self._recipe = samples, backbone, recipe
        for layers in samples.at_hand():  # better now than after an hour
            panel_for(layers, backbone, recipe)
        self._encoded = lru_cache(KEPT)(self._encode)

    def __call__(self, rng: SampleRng) -> EncodedSample:
        """A sample, maybe mirrored, whole or a crop of it.

        Raises:
            RecipeError, PhotoError: its files are missing or damaged, or it is smaller than a panel.
        """
        number = self._samples.choose(rng)
        mirrored = self._recipe.flip and rng.bernoulli(0.5)
        crops = self._recipe.crops
        return self._encoded(number, mirrored, rng.randint(crops + 1) if crops else 0)

    def _encode(self, number: int, mirrored: bool, crop: int) -> EncodedSample:
        sample, layout, see = self._samples[number], self._recipe.layout, self._backbone.encode
        fit = panel_for(sample.layers, self._backbone, self._recipe)
        seen = sample.layers
        if crop:
            seen = cropped(
                SampleRng(self._recipe.seed, -1 - number, crop), seen, fit
            )  # rng that no step throws
        panels = panels_in(seen.flip(1) if mirrored else seen, fit)
        many = self._recipe.objective == "flow"
        return EncodedSample(
            see(compose(panels, layout)).cpu(),
            see(condition(panels["I"], layout)).cpu(),
            None if many else start(panels["I"], self._backbone, layout).cpu(),
            sample.trust,
        )


def cropped(rng: SampleRng, layers: UInt8[Tensor, "h w 9"], fit: PanelFit) -> UInt8[Tensor, "p q 9"]:
    """A window of the sample's aspect ratio, anywhere, with 0.5 to 1 of its sides, yet no smaller than what `fit` shows."""
    height, width, _ = layers.shape
    least = max(_LEAST_SIDE, fit.content[0] / width, fit.content[1] / height)
    side = rng.uniform((least, 1.0))
    columns, rows = (
        max(shown, round(side * whole)) for shown, whole in zip(fit.content, (width, height), strict=True)
    )
    top, left = rng.randint(height - rows + 1), rng.randint(width - columns + 1)
    return layers[top : top + rows, left : left + columns]


def panels_in(layers: UInt8[Tensor, "h w 9"], fit: PanelFit) -> dict[str, Float[Tensor, "1 3 p q"]]:
    """I, T and R, shrunk in linear light until they fit, in [-1, 1]."""
    light = to_linear(layers.permute(2, 0, 1)[None] / 255)
    small = functional.interpolate(light, fit.content[::-1], mode="bilinear", antialias=True)
    padded = fit.pad(2 * to_encoded(small.clamp(0, 1)) - 1)
    return dict(zip("ITR", padded.chunk(3, dim=1), strict=True))


def panel_for(layers: Tensor, backbone: Backbone, recipe: LoraRecipe) -> PanelFit:
    """How a sample stands in a panel.

    Raises:
        PhotoError: it is smaller than that.
    """
    height, width, _ = layers.shape
    return fit_panel((width, height), recipe.layout, budget_px=recipe.budget_px, multiple=backbone.multiple)


def open_samples(recipe: LoraRecipe) -> SampleSequence:
    """The recipe's rendered sets and pairs; what has a share of 0 is not read.

    Raises:
        RecipeError: a folder is missing, empty or without reflections, or too few samples are rendered.
        PhotoError: a picture cannot be read.
    """
    data, wanted = recipe.data, recipe.data.rendered
    rendered = None
    if wanted and data.pairs_share < 1 and data.rendered_share:
        rendered = RenderedSets(
            found(wanted.sets),
            seed=recipe.seed,
            count=wanted.count,
            target=wanted.target,
            mixing=wanted.mixing,
        )
    folders = found(data.pairs) if data.pairs_share else []
    pairs = [sample for folder in folders for sample in _pairs(folder, recipe)]
    return SampleSequence(rendered, pairs, data.pairs_share)


def _pairs(folder: Path, recipe: LoraRecipe) -> list[TrainingSample]:
    pictures = read_pairs([folder])
    trios = sorted(read_folders(folder).trios, key=lambda trio: trio.photo)
    if "R" in recipe.panels and recipe.reflections == "given":
        _refuse_without_reflections(folder, trios)
    return [_whole(trio, *pair) for trio, pair in zip(trios, pictures, strict=True)]


def _refuse_without_reflections(folder: Path, trios: Sequence[PictureGroup]) -> None:
    lacking = [trio.name for trio in trios if trio.reflection is None]
    if lacking:
        raise RecipeError(
            f"{folder} has no reflection for {lacking[0]} ({len(lacking)} such)",
            "one for each photo, as R is a panel",
            'add a folder reflection_layer, set reflections = "difference", or leave R out of panels',
        )


def _whole(trio: PictureGroup, photo: Tensor, transmission: Tensor) -> TrainingSample:
    if trio.reflection is None:
        return TrainingSample(with_difference(photo, transmission), Pairs.reflection_weight)
    reflection = _read(trio.reflection)
    if reflection.shape != photo.shape:
        raise RecipeError(
            f"{trio.photo} and {trio.reflection} differ in size",
            "layers are aligned",
            "crop one to the other",
        )
    return TrainingSample(torch.cat([photo, transmission, reflection], dim=2))


def with_difference(photo: Tensor, transmission: Tensor) -> Tensor:
    """A pair as (H, W, 9), with the light that the transmission lacks for its reflection."""
    light = to_linear(photo / 255) - to_linear(transmission / 255)
    reflection = (to_encoded(light.clamp(0, 1)) * 255).round().to(torch.uint8)
    return torch.cat([photo, transmission, reflection], dim=2)


def _read(path: Path) -> Tensor:
    photo = Photo.open(path)
    encoded = to_encoded(np.clip(photo.resized(*photo.size), 0, 1))
    return torch.from_numpy(np.rint(encoded * 255).astype(np.uint8))
