"""Training samples of a diffusion backbone: panels with the aspect ratio of the sample, encoded by
its VAE.

    load = EncodedSampleLoader(open_samples(recipe), backbone, recipe)
    encoded = load(SampleRng(seed, step, slot))

Latents are cached by (sample, mirrored), because a run has one VAE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torch.nn import functional

from brewster.diffusion.backbones.backbone import Backbone
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.diffusion.pipeline import one_step_start
from brewster.diffusion.task import PanelFit, compose, conditioning_image
from brewster.errors import RecipeError
from brewster.evaluation.benchmarks.pairing import ImageGroup
from brewster.photo.srgb import to_encoded, to_linear
from brewster.training.data.data_recipe import PAIR_REFLECTION_WEIGHT
from brewster.training.data.image_loading import image_groups, read_aligned
from brewster.training.data.rendered import RenderedDatasets
from brewster.training.data.sample_rng import SampleRng
from brewster.training.streams import resolve_folders

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

CACHE_SIZE: Final = 2048
"""Largest number of cached samples: 3 GiB at the paper's size, enough for 1,000 samples and their
mirrored versions. The least recently used samples are dropped. They are encoded again when they are
drawn.
"""


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """Photo, transmission and reflection, sRGB uint8 (H, W, 9), and the weight of the reflection in
    the loss.
    """

    layers: UInt8[Tensor, "h w 9"]
    reflection_weight: float = 1.0


@dataclass(frozen=True, eq=False)
class EncodedSample:
    """Latents of a sample, float32, on the CPU: the composite of all panels, and the conditioning
    image. `start` contains the photo in every panel for the objective one_step. It is None for
    flow, which starts from noise.
    """

    composite: Float[Tensor, "1 c h w"]
    condition: Float[Tensor, "1 c p q"]
    start: Float[Tensor, "1 c h w"] | None
    reflection_weight: float


class SampleSequence:
    """Rendered samples and real pairs as one sequence: first the rendered samples, then the
    pairs.
    """

    def __init__(
        self, rendered: RenderedDatasets | None, pairs: Sequence[TrainingSample], pairs_share: float
    ) -> None:
        self._rendered = rendered
        self._pairs = pairs
        self._pairs_share = pairs_share
        self._first_pair = len(rendered) if rendered else 0

    def __len__(self) -> int:
        return self._first_pair + len(self._pairs)

    def __getitem__(self, number: int) -> TrainingSample:
        if self._rendered and number < self._first_pair:
            return TrainingSample(self._rendered.sample(number))
        return self._pairs[number - self._first_pair]

    def check_sizes(self, recipe: LoraRecipe, size_divisor: int) -> None:
        """Checks the size of the first rendered sample and of every pair. Training calls this
        first, so that an unusable sample stops it before any step.
        """
        first = [TrainingSample(self._rendered.sample(0))] if self._rendered else []
        for sample in (*first, *self._pairs):
            fit_sample(sample.layers, recipe, size_divisor)

    def draw_index(self, rng: SampleRng) -> int:
        """Draws the index of a sample. With the probability `pairs_share` it is a pair."""
        if rng.bernoulli(self._pairs_share):
            return self._first_pair + rng.randint(len(self._pairs))
        return rng.randint(self._first_pair)


class EncodedSampleLoader:
    """Draws samples and encodes them. The encoded samples are cached."""

    def __init__(self, samples: SampleSequence, backbone: Backbone, recipe: LoraRecipe) -> None:
        self._samples = samples
        self._backbone = backbone
        self._recipe = recipe
        self._encoded = lru_cache(CACHE_SIZE)(self._encode)

    def __call__(self, rng: SampleRng) -> EncodedSample:
        """Draws the index of a sample and whether it is mirrored. Returns the encoded sample."""
        number = self._samples.draw_index(rng)
        return self._encoded(number, self._recipe.flip and rng.bernoulli(0.5))

    def _encode(self, number: int, mirrored: bool) -> EncodedSample:
        sample = self._samples[number]
        layout = self._recipe.layout
        encode = self._backbone.encode
        layers = sample.layers
        fit = fit_sample(layers, self._recipe, self._backbone.size_divisor)
        panels = make_panels(layers.flip(1) if mirrored else layers, fit)
        return EncodedSample(
            encode(compose(panels, layout)).cpu(),
            encode(conditioning_image(panels["I"], layout)).cpu(),
            None
            if self._recipe.objective == "flow"
            else encode(one_step_start(panels["I"], layout)).cpu(),
            sample.reflection_weight,
        )


def make_panels(
    layers: UInt8[Tensor, "h w 9"], fit: PanelFit
) -> dict[str, Float[Tensor, "1 3 p q"]]:
    """Resizes the layers in linear light and pads them. Returns the panels I, T and R, sRGB-encoded
    in [-1, 1].
    """
    linear = to_linear(layers.permute(2, 0, 1)[None] / 255)
    small = functional.interpolate(linear, fit.content[::-1], mode="bilinear", antialias=True)
    padded = fit.pad(2 * to_encoded(small.clamp(0, 1)) - 1)
    return dict(zip("ITR", padded.chunk(3, dim=1), strict=True))


def fit_sample(layers: Tensor, recipe: LoraRecipe, size_divisor: int) -> PanelFit:
    """Returns the size of the panels of a sample, and its position in them, as at inference: never
    enlarged.
    """
    height, width, _ = layers.shape
    return recipe.task.fit((width, height), size_divisor)


def open_samples(recipe: LoraRecipe) -> SampleSequence:
    """Opens the rendered datasets and pairs of a recipe. Data with a share of 0 is not read. Raises
    RecipeError if a folder is missing, empty or without reflections, or there are too few rendered
    samples.
    """
    data = recipe.data
    rendered = recipe.data.rendered
    datasets = None
    if rendered and data.pairs_share < 1 and data.rendered_share:
        datasets = RenderedDatasets(
            resolve_folders(rendered.datasets),
            seed=recipe.seed,
            count=rendered.count,
            target=rendered.target,
            blend_space=rendered.blend_space,
        )
    samples = list[TrainingSample]()
    for folder in resolve_folders(data.pairs) if data.pairs_share else []:
        groups = image_groups(folder)
        missing = [group.name for group in groups if group.reflection is None]
        if missing and "R" in recipe.panels and recipe.reflections == "given":
            raise RecipeError(
                f"{folder} has no reflection for {missing[0]} (photos without one: {len(missing)})",
                "expected a reflection for each photo, because R is a panel",
                'add a folder reflection_layer, set reflections = "difference", or leave R out '
                "of panels",
            )
        samples += map(_read_sample, groups)
    return SampleSequence(datasets, samples, data.pairs_share)


def _read_sample(group: ImageGroup) -> TrainingSample:
    if group.reflection is None:
        photo, transmission = read_aligned(group.photo, group.transmission)
        return TrainingSample(layers_from_pair(photo, transmission), PAIR_REFLECTION_WEIGHT)
    layers = read_aligned(group.photo, group.transmission, group.reflection)
    return TrainingSample(torch.cat(layers, dim=2))


def layers_from_pair(photo: Tensor, transmission: Tensor) -> Tensor:
    """Returns photo, transmission and reflection as (H, W, 9) sRGB uint8. R is photo - T in linear
    light, or 0.
    """
    difference = to_linear(photo / 255) - to_linear(transmission / 255)
    reflection = (to_encoded(difference.clamp(0, 1)) * 255).round().to(torch.uint8)
    return torch.cat([photo, transmission, reflection], dim=2)
