"""Mixtures of photos in linear light: an endless stream of training data without a renderer.

Each sample depends on (seed, step, slot) only. In linear light, photo = T + R + veil with T = t B:
the transmission T is the background B behind a pane of transmittance t.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from brewster.base.settings import Range
from brewster.photo.srgb import to_encoded, to_linear
from brewster.training.data import effects
from brewster.training.data.data_recipe import PAIR_REFLECTION_WEIGHT, MixRecipe
from brewster.training.data.sample_rng import SampleRng

if TYPE_CHECKING:
    from jaxtyping import Float

    Image = Float[Tensor, "3 h w"]

_REFERENCE_SIDE_PX: Final = 256
"""Side of the image to which lengths in a recipe refer. They are scaled to the side of the images
of the batch.
"""


@dataclass(frozen=True)
class TrainingBatch:
    """Encoded images, (N, 3, S, S) in 0..1, weights of the reflections in the loss, (N,), and hints
    (N, 2, S, S).
    """

    photo_encoded: Tensor
    transmission_encoded: Tensor
    reflection_encoded: Tensor
    reflection_weight: Tensor
    hints: Tensor | None = None

    @classmethod
    def from_layers(cls, layers: Tensor) -> TrainingBatch:
        """Creates a batch with reflection weights of 1 from (N, 9, S, S): photo, T and R as
        channels.
        """
        photo, transmission, reflection = layers.chunk(3, dim=1)
        return cls(photo, transmission, reflection, torch.ones(len(layers), device=layers.device))

    def to(self, device: torch.device) -> TrainingBatch:
        """Returns the batch on another device."""
        return TrainingBatch(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def split(self, max_size: int) -> list[TrainingBatch]:
        """Splits the batch into batches of at most `max_size` samples."""
        names = self.tensors()
        splits = zip(*(torch.split(tensor, max_size) for tensor in names.values()), strict=True)
        return [TrainingBatch(**dict(zip(names, parts, strict=True))) for parts in splits]

    def tensors(self) -> dict[str, Tensor]:
        """Returns the tensors by name, with hints only if the batch has some."""
        return {name: tensor for name, tensor in vars(self).items() if tensor is not None}


class Stream(Protocol):
    """A source of training data. A batch depends on step, count and size only: a resumed run uses
    the same data.
    """

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """Returns the batch of this step: `count` samples with sides of `size` px."""


class Mixtures:
    """A `Stream` of mixtures of photos, uint8 (H, W, 3) sRGB, and HDR maps, float16 (3, H, 2 H)
    linear.

    `weights` are the relative sampling frequencies of the photos. By default, all are equal.
    """

    def __init__(
        self,
        photos: Sequence[Tensor],
        maps: Sequence[Tensor],
        recipe: MixRecipe,
        *,
        seed: int,
        weights: Sequence[float] | None = None,
    ) -> None:
        self._photos = photos
        self._maps = maps
        self._recipe = recipe
        self._seed = seed
        self._cumulative = torch.tensor(weights or [1.0] * len(photos), dtype=torch.float64).cumsum(
            0
        )

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """See `Stream`."""
        samples = [self._sample(SampleRng(self._seed, step, slot), size) for slot in range(count)]
        photo, transmission, reflection = map(torch.stack, zip(*samples, strict=True))
        return TrainingBatch(photo, transmission, reflection, torch.ones(count))

    def _sample(self, rng: SampleRng, size: int) -> tuple[Tensor, Tensor, Tensor]:
        recipe = self._recipe
        background = self._background(rng, size)
        reflection = self._reflection(rng, size) * background.mean()
        if rng.bernoulli(recipe.no_glass_probability):
            return self._take_photo(rng, background, background, torch.zeros_like(background))
        glass = (
            effects.window(rng, size)
            if rng.bernoulli(recipe.partial_probability)
            else torch.ones(1)
        )
        transmittance = rng.uniform(recipe.transmittance) * (1 + 0.02 * rng.normal(3, 1, 1))
        transmission = background * (1 + glass * (transmittance - 1))
        reflection = reflection * glass
        photo = transmission + reflection
        if rng.bernoulli(recipe.veil_probability):
            photo = photo + glass * rng.uniform(recipe.veil) * photo.mean(dim=(1, 2), keepdim=True)
        target = transmission if recipe.target == "transmission" else background
        return self._take_photo(rng, photo, target, reflection)

    def _take_photo(self, rng: SampleRng, *layers: Image) -> tuple[Image, Image, Image]:
        """Applies the softness, one exposure and one tone curve to photo, target and reflection, in
        this order.

        The photo is also given noise, rounded to 8 bits, and compressed as JPEG with the
        probability in the recipe.
        """
        recipe = self._recipe
        if rng.bernoulli(recipe.camera_blur_probability):
            sigma_px = rng.log_uniform(recipe.camera_blur_sigma_px)
            layers = tuple(effects.blur(layer, sigma_px, disc=False) for layer in layers)
        exposure = min(
            1.0, rng.uniform(recipe.target_luminance) / layers[0].clamp(max=1).mean().item()
        )
        if rng.bernoulli(recipe.overexposed_probability):
            white = _quantile(layers[1].amax(dim=0), 1 - rng.uniform(recipe.overexposed_share))
            exposure = max(exposure, 1 / (white + 1e-3))
        gamma = rng.log_uniform(recipe.gamma)
        contrast = rng.uniform(recipe.contrast)

        def develop(linear: Image) -> Image:
            encoded = to_encoded((linear * exposure).clamp(0, 1)) ** gamma
            return encoded + contrast * (encoded * encoded * (3 - 2 * encoded) - encoded)

        photo, target, reflection = map(develop, layers)
        noise = rng.uniform(recipe.noise) * rng.normal(*photo.shape)
        photo = ((photo + noise).clamp(0, 1) * 255).round() / 255
        if rng.bernoulli(recipe.jpeg_probability):
            low, high = recipe.jpeg_quality
            photo = effects.jpeg(photo, low + rng.randint(high - low + 1))
        return photo, target, reflection

    def _background(self, rng: SampleRng, size: int) -> Image:
        recipe = self._recipe
        scale = size / _REFERENCE_SIDE_PX
        view = self._view(rng, size, recipe.background_map_probability)
        if rng.bernoulli(recipe.background_blur_probability):
            sigma_px = rng.log_uniform(recipe.background_blur_sigma_px) * scale
            view = effects.blur(view, sigma_px, disc=rng.bernoulli(0.5))
        if rng.bernoulli(recipe.shadow_probability):
            view = view * effects.shadow(rng, size)
        if recipe.haze_probability and rng.bernoulli(recipe.haze_probability):  # 0 draws no number
            view = effects.haze(rng, view)
        view = view / _mean_without_highlights(view)
        # Lamps and signs are as frequent behind the glass as in it: a network must not learn that
        # they are reflections.
        if rng.bernoulli(recipe.sign_probability):
            view = effects.sign(rng, view)
        if rng.bernoulli(recipe.lamp_probability):
            view = view + effects.lamps(rng, size)
        return (
            view * _temperature(rng, recipe.temperature) * rng.log_uniform(recipe.background_level)
        )

    def _reflection(self, rng: SampleRng, size: int) -> Image:
        """Returns a reflection in linear light, as a multiple of the mean of the background."""
        recipe = self._recipe
        scale = size / _REFERENCE_SIDE_PX
        view = self._view(rng, size, recipe.reflection_map_probability)
        view = view / _mean_without_highlights(view)
        view = view * (view.mean(dim=0) + 1e-4) ** (rng.log_uniform(recipe.reflection_contrast) - 1)
        view = view / _mean_without_highlights(view) * _temperature(rng, recipe.temperature)
        if rng.bernoulli(recipe.sign_probability):
            view = effects.sign(rng, view)
        if not rng.bernoulli(recipe.reflection_sharp_probability):
            view = effects.blur(
                view,
                rng.log_uniform(recipe.reflection_blur_sigma_px) * scale,
                disc=rng.bernoulli(0.5),
            )
        if rng.bernoulli(recipe.lamp_probability):
            view = view + effects.lamps(rng, size)
        if rng.bernoulli(recipe.ghost_probability):
            view = effects.ghost(
                rng, view, rng.uniform(recipe.ghost_weight), recipe.ghost_px * scale
            )
        if rng.bernoulli(recipe.falloff_probability):
            view = view * effects.smooth_attenuation_mask(rng, size)
        if rng.bernoulli(recipe.edge_probability):
            view = view * effects.edge(rng, size)
        return view * rng.log_uniform(recipe.reflection_ratio)

    def _view(self, rng: SampleRng, size: int, map_probability: float) -> Image:
        if self._maps and rng.bernoulli(map_probability):
            return _perspective_view(rng, self._maps[rng.randint(len(self._maps))], size)
        crop = self._augmented_crop(rng, self._photos[self._choose_photo(rng)], size)
        bright = ((crop.amax(dim=0, keepdim=True) - 0.8) / 0.2).clamp(0, 1)
        return crop * (1 + rng.uniform(self._recipe.highlight_boost) * bright**2)

    def _augmented_crop(self, rng: SampleRng, photo: Tensor, size: int) -> Image:
        probability = self._recipe.augmentation_probability
        if (
            not probability
        ):  # draws no numbers, so that recipes without augmentation keep their samples
            return random_crop(rng, photo, self._recipe.crop, size)
        take = rotated_crop if rng.bernoulli(probability) else random_crop
        return effects.recolour(rng, take(rng, photo, self._recipe.crop, size), probability)

    def _choose_photo(self, rng: SampleRng) -> int:
        point = rng.uniform((0, float(self._cumulative[-1])))
        return min(
            int(torch.searchsorted(self._cumulative, point, right=True)), len(self._photos) - 1
        )


class Pairs:
    """A `Stream` of aligned real pairs, uint8 (H, W, 3) sRGB: the photo, and the same view without
    glass.
    """

    reflection_weight = PAIR_REFLECTION_WEIGHT

    def __init__(self, pairs: Sequence[tuple[Tensor, Tensor]], crop: Range, *, seed: int) -> None:
        self._pairs = pairs
        self._crop = crop
        self._seed = seed

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """See `Stream`."""
        crops = []
        for slot in range(count):
            rng = SampleRng(self._seed, step, slot)
            both = torch.cat(self._pairs[rng.randint(len(self._pairs))], dim=2)
            crops.append(random_crop(rng, both, self._crop, size))
        photo, transmission = torch.stack(crops).chunk(2, dim=1)
        reflection = (photo - transmission).clamp(min=0)
        weight = torch.full((count,), self.reflection_weight)
        return TrainingBatch(
            to_encoded(photo), to_encoded(transmission), to_encoded(reflection), weight
        )


class InterleavedStream:
    """A `Stream` that takes a share of each batch from one stream and the rest from another.
    Instances can be nested.
    """

    def __init__(self, first: Stream, second: Stream, first_share: float) -> None:
        self._first = first
        self._second = second
        self._share = first_share

    def __call__(self, step: int, count: int, size: int) -> TrainingBatch:
        """See `Stream`."""
        first_count = round(count * self._share)
        counts = (self._first, first_count), (self._second, count - first_count)
        tensors = [
            stream(step, part_count, size).tensors() for stream, part_count in counts if part_count
        ]
        return TrainingBatch(
            **{name: torch.cat([part[name] for part in tensors]) for name in tensors[0]}
        )


def random_crop(rng: SampleRng, image: Tensor, fraction: Range, size: int) -> Tensor:
    """Returns a random crop, mirrored with probability 0.5, in linear light: (H, W, C) sRGB uint8
    to (C, size, size).

    `fraction` is the range of the side of the crop divided by the shorter side of the image. A crop
    is enlarged by at most 1.25 where possible: enlarged crops are soft, and a network would learn
    that backgrounds are.
    """
    height, width, _ = image.shape
    side = min(height, width) * rng.uniform(fraction)
    side = max(side, min(height, width, size / _MAX_ENLARGEMENT))
    stretch = math.sqrt(rng.log_uniform((0.85, 1.18)))
    rows = max(8, min(height, round(side * stretch)))
    columns = max(8, min(width, round(side / stretch)))
    top, left = rng.randint(height - rows + 1), rng.randint(width - columns + 1)
    encoded = image[top : top + rows, left : left + columns]
    # a lookup table; torch indexes flat tensors faster
    linear = _LINEAR_OF_BYTE.index_select(0, encoded.reshape(-1).int()).view(encoded.shape)
    window = linear.permute(2, 0, 1)
    if rng.bernoulli(0.5):
        window = window.flip(2)
    return functional.interpolate(window[None], (size, size), mode="bilinear", antialias=True)[
        0
    ].clamp(min=0)


def rotated_crop(rng: SampleRng, image: Tensor, fraction: Range, size: int) -> Tensor:
    """Returns a random crop like `random_crop`, rotated by up to 25 degrees. The crop lies within
    the image.
    """
    angle = math.radians(rng.uniform((-_MAX_ROTATION_DEG, _MAX_ROTATION_DEG)))
    cosine = math.cos(angle)
    sine = math.sin(angle)
    bounding_side = cosine + abs(sine)  # of a rotated square with sides of 1
    upright = random_crop(rng, image, fraction, math.ceil(size * bounding_side))
    turn = torch.tensor([[[cosine, -sine, 0.0], [sine, cosine, 0.0]]]) / bounding_side
    grid = functional.affine_grid(turn, [1, 3, size, size], align_corners=False)
    return functional.grid_sample(upright[None], grid, padding_mode="border", align_corners=False)[
        0
    ]


_MAX_ROTATION_DEG: Final = 25.0
_MAX_ENLARGEMENT: Final = 1.25
_LINEAR_OF_BYTE: Final = to_linear(torch.arange(256) / 255)


def _perspective_view(rng: SampleRng, lat_long: Tensor, size: int) -> Image:
    """Returns a random perspective view of a lat-long map (3, H, 2 H): 50 to 100 degrees wide,
    pitched by up to 20.
    """
    half = math.tan(math.radians(rng.uniform((50, 100))) / 2)
    heading = rng.uniform((-math.pi, math.pi))
    pitch = math.radians(rng.uniform((-20, 20)))
    down, right = torch.meshgrid(*[torch.linspace(-half, half, size)] * 2, indexing="ij")
    y = -down * math.cos(pitch) + math.sin(pitch)
    z = down * math.sin(pitch) + math.cos(pitch)
    longitude = (
        torch.remainder(torch.atan2(right, z) + heading + math.pi, 2 * math.pi) / math.pi - 1
    )
    latitude = torch.atan2(-y, torch.hypot(right, z)) / (math.pi / 2)
    grid = torch.stack([longitude, latitude], dim=-1)[None]
    view = functional.grid_sample(
        lat_long[None].float(), grid, align_corners=False, padding_mode="border"
    )
    return view[0].clamp(min=0)


def _mean_without_highlights(image: Image) -> Tensor:
    """Returns the mean after clipping at the 95th percentile, so that a lamp does not determine the
    exposure.
    """
    return image.clamp(max=_quantile(image, 0.95)).mean() + 1e-4


def _quantile(image: Tensor, fraction: float) -> float:
    """Returns a quantile of every 29th value. The quantile of all values takes as long as the rest
    of the sample.
    """
    values = image.flatten()[::29]
    return values.kthvalue(max(1, round(fraction * len(values)))).values.item()


def _temperature(rng: SampleRng, bounds: Range) -> Tensor:
    """Returns random gains of the colour channels for warmer or colder light, (3, 1, 1)."""
    warmth = rng.uniform(bounds)
    gains = torch.tensor([warmth, 0, -warmth]) + 0.05 * rng.normal(3)
    return gains.exp()[:, None, None]
