"""Linear-light mixtures of photographs: training data without a renderer, live and without end.

    stream = Mixtures(read_photos([Path("photos")]), read_maps([Path("hdri")]), MixRecipe(), seed=7)
    batch = stream(step=0, count=8, size=192)

Each sample is a function of (seed, step, slot) alone. In linear light I = t B + R + veil: the target is the
background B as benchmarks photograph it, with the glass taken away, so a good answer is often brighter than
the photo minus its reflection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import torch
from torch import Generator, Tensor
from torch.nn import functional

from brewster.light import to_encoded, to_linear
from brewster.scene.values import LogRange, Range, Share, Values

if TYPE_CHECKING:
    from jaxtyping import Float

    Picture = Float[Tensor, "3 h w"]

_REFERENCE_SIZE: Final = 256
"""Lengths in a recipe are pixels of a picture of this size, and scale with the size asked for."""


@dataclass(frozen=True)
class Batch:
    """Encoded pictures, each (N, 3, S, S) in 0..1, and how far each reflection truth is to be trusted, (N,)."""

    photo_encoded: Tensor
    transmission_encoded: Tensor
    reflection_encoded: Tensor
    reflection_weight: Tensor

    @classmethod
    def of(cls, layers: Tensor) -> Batch:
        """Samples whose truths are certain, from (N, 9, S, S): photo, transmission and reflection as channels."""
        photo, transmission, reflection = layers.chunk(3, dim=1)
        return cls(photo, transmission, reflection, torch.ones(len(layers), device=layers.device))

    def to(self, device: torch.device) -> Batch:
        """The same batch on another device."""
        return Batch(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


class Stream(Protocol):
    """Where training data comes from: a function of the step, so that a resumed run sees the same data."""

    def __call__(self, step: int, count: int, size: int) -> Batch:
        """The batch of this step: `count` samples of `size` px a side."""
        ...


class MixRecipe(Values):
    """The distributions of a mixture; ranges are uniform, `_log` ranges uniform in the logarithm.

    The defaults are those that the shipped model learns from; a recipe names what it changes.
    """

    map_probability: Share = 0.45
    """Of the reflection's content coming from an HDR map; the background uses a third of it."""
    crop: Range = (0.45, 1.0)
    background_level_log: LogRange = (0.03, 0.4)
    """Mean linear luminance of the background before the camera's exposure."""
    reflection_ratio_log: LogRange = (0.03, 2.0)
    """Mean of the reflection, its lamps left out, over the mean of the background, lamps included."""
    absent_probability: Share = 0.1
    """Samples without any glass, from which a network learns to leave plain photographs alone."""
    highlight_boost: Range = (0.0, 6.0)
    temperature: Range = (-0.35, 0.35)
    transmittance: Range = (0.72, 1.0)
    veil_probability: Share = 0.3
    veil: Range = (0.0, 0.25)
    sharp_probability: Share = 0.3
    blur_px: Range = (0.5, 5.0)
    ghost_probability: Share = 0.4
    ghost_weight: Range = (0.4, 0.95)
    ghost_px: float = 6.0
    falloff_probability: Share = 0.5
    edge_probability: Share = 0.3
    exposure: Range = (0.2, 0.55)
    """The largest mean that the camera lets the whole photo have."""
    gamma_log: LogRange = (0.8, 1.25)
    contrast: Range = (-0.3, 0.5)
    noise: Range = (0.0, 0.012)


class Dice:
    """Random numbers that depend on (seed, step, slot) and nothing else."""

    def __init__(self, seed: int, step: int, slot: int) -> None:
        self.generator = Generator().manual_seed((seed * 1_000_003 + step) * 1_009 + slot)

    def uniform(self, bounds: Range) -> float:
        """A number between the bounds."""
        low, high = bounds
        return low + (high - low) * torch.rand((), generator=self.generator).item()

    def log_uniform(self, bounds: Range) -> float:
        """A number between the bounds whose logarithm is uniform."""
        return math.exp(self.uniform((math.log(bounds[0]), math.log(bounds[1]))))

    def chance(self, probability: float) -> bool:
        """True as often as `probability` says."""
        return self.uniform((0, 1)) < probability

    def choose(self, count: int) -> int:
        """A number from 0 up to, not including, `count`."""
        return int(torch.randint(count, (), generator=self.generator).item())

    def normal(self, *shape: int) -> Tensor:
        """A tensor of standard normal numbers."""
        return torch.randn(shape, generator=self.generator)


class Mixtures:
    """A `Stream` of mixtures of photos (uint8, (H, W, 3), sRGB) and HDR maps (half, (3, H, 2 H), linear)."""

    def __init__(
        self, photos: Sequence[Tensor], maps: Sequence[Tensor], recipe: MixRecipe, *, seed: int
    ) -> None:
        self._photos, self._maps, self._recipe, self._seed = photos, maps, recipe, seed

    def __call__(self, step: int, count: int, size: int) -> Batch:
        """The batch of this step: `count` samples of `size` px a side."""
        samples = [self._sample(Dice(self._seed, step, slot), size) for slot in range(count)]
        photo, transmission, reflection = (torch.stack(layer) for layer in zip(*samples, strict=True))
        return Batch(photo, transmission, reflection, torch.ones(count))

    def _sample(self, dice: Dice, size: int) -> tuple[Tensor, Tensor, Tensor]:
        recipe = self._recipe
        background = self._background(dice, size)
        reflection = self._reflection(dice, size) * background.mean()
        if dice.chance(recipe.absent_probability):
            return _photograph(dice, recipe, background, background, torch.zeros_like(background))
        glass = dice.uniform(recipe.transmittance) * (1 + 0.02 * dice.normal(3, 1, 1))
        photo = background * glass + reflection
        if dice.chance(recipe.veil_probability):
            photo = photo + dice.uniform(recipe.veil) * photo.mean(dim=(1, 2), keepdim=True)
        return _photograph(dice, recipe, photo, background, reflection)

    def _background(self, dice: Dice, size: int) -> Picture:
        view = self._view(dice, size, self._recipe.map_probability / 3)
        level = dice.log_uniform(self._recipe.background_level_log)
        return view * _temperature(dice, self._recipe.temperature) * (level / _mean_without_lamps(view))

    def _reflection(self, dice: Dice, size: int) -> Picture:
        """A reflection for a background of mean 1: blurred, doubled, fading and cut off, in linear light."""
        recipe, scale = self._recipe, size / _REFERENCE_SIZE
        view = self._view(dice, size, recipe.map_probability)
        view = view / _mean_without_lamps(view) * _temperature(dice, recipe.temperature)
        if not dice.chance(recipe.sharp_probability):
            view = _blur(view, dice.uniform(recipe.blur_px) * scale, disc=dice.chance(0.5))
        if dice.chance(recipe.ghost_probability):
            view = _ghost(dice, view, dice.uniform(recipe.ghost_weight), recipe.ghost_px * scale)
        if dice.chance(recipe.falloff_probability):
            view = view * _falloff(dice, size)
        if dice.chance(recipe.edge_probability):
            view = view * _edge(dice, size)
        return view * dice.log_uniform(recipe.reflection_ratio_log)

    def _view(self, dice: Dice, size: int, map_probability: float) -> Picture:
        if self._maps and dice.chance(map_probability):
            return _look_into(dice, self._maps[dice.choose(len(self._maps))], size)
        crop = random_crop(dice, self._photos[dice.choose(len(self._photos))], self._recipe.crop, size)
        bright = ((crop.amax(dim=0, keepdim=True) - 0.8) / 0.2).clamp(0, 1)
        return crop * (1 + dice.uniform(self._recipe.highlight_boost) * bright**2)


class Pairs:
    """A `Stream` of aligned real pairs (uint8, (H, W, 3), sRGB): photo and the same view without glass."""

    reflection_weight = 0.3  # its truth is only what photo - transmission leaves

    def __init__(self, pairs: Sequence[tuple[Tensor, Tensor]], crop: Range, *, seed: int) -> None:
        self._pairs, self._crop, self._seed = pairs, crop, seed

    def __call__(self, step: int, count: int, size: int) -> Batch:
        """The batch of this step: `count` samples of `size` px a side."""
        samples = [self._sample(Dice(self._seed, step, slot), size) for slot in range(count)]
        photo, transmission = (torch.stack(layer) for layer in zip(*samples, strict=True))
        reflection = (photo - transmission).clamp(min=0)
        weight = torch.full((count,), self.reflection_weight)
        return Batch(to_encoded(photo), to_encoded(transmission), to_encoded(reflection), weight)

    def _sample(self, dice: Dice, size: int) -> tuple[Tensor, Tensor]:
        both = torch.cat(self._pairs[dice.choose(len(self._pairs))], dim=2)
        crop = random_crop(dice, both, self._crop, size)
        return crop[:3], crop[3:]


class Blend:
    """A `Stream` that takes a share of each batch from one stream and the rest from another; blends may nest.

    A batch comes on the accelerator if any part does, as what was rendered there should not travel twice.
    """

    def __init__(self, first: Stream, second: Stream, first_share: float) -> None:
        self._first, self._second, self._share = first, second, first_share

    def __call__(self, step: int, count: int, size: int) -> Batch:
        """The batch of this step: `count` samples of `size` px a side."""
        first_count = round(count * self._share)
        counts = (self._first, first_count), (self._second, count - first_count)
        parts = [stream(step, some, size) for stream, some in counts if some]
        device = max((part.photo_encoded.device for part in parts), key=lambda device: device.type != "cpu")
        names = Batch.__dataclass_fields__
        return Batch(*(torch.cat([getattr(part.to(device), name) for part in parts]) for name in names))


def _photograph(dice: Dice, recipe: MixRecipe, *layers: Picture) -> tuple[Picture, Picture, Picture]:
    """One exposure and one tone curve for photo, background and reflection; noise and 8 bits for the photo."""
    exposure = min(1.0, dice.uniform(recipe.exposure) / layers[0].clamp(max=1).mean().item())
    gamma, contrast = dice.log_uniform(recipe.gamma_log), dice.uniform(recipe.contrast)

    def develop(linear: Picture) -> Picture:
        encoded = to_encoded((linear * exposure).clamp(0, 1)) ** gamma
        return encoded + contrast * (encoded * encoded * (3 - 2 * encoded) - encoded)

    photo, background, reflection = (develop(layer) for layer in layers)
    noise = dice.uniform(recipe.noise) * dice.normal(*photo.shape)
    return ((photo + noise).clamp(0, 1) * 255).round() / 255, background, reflection


def random_crop(dice: Dice, picture: Tensor, fraction: Range, size: int) -> Tensor:
    """A random window, maybe mirrored, in linear light: (H, W, C) sRGB uint8 to (C, size, size).

    `fraction` is the range of the window's side over the picture's shorter one.
    """
    height, width, _ = picture.shape
    side = min(height, width) * dice.uniform(fraction)
    stretch = math.sqrt(dice.log_uniform((0.85, 1.18)))
    rows, columns = (max(8, min(limit, round(length))) for limit, length in (
        (height, side * stretch), (width, side / stretch)))  # fmt: skip
    top, left = dice.choose(height - rows + 1), dice.choose(width - columns + 1)
    window = _light_of(picture[top : top + rows, left : left + columns]).permute(2, 0, 1)
    if dice.chance(0.5):
        window = window.flip(2)
    return functional.interpolate(window[None], (size, size), mode="bilinear", antialias=True)[0].clamp(min=0)


_LINEAR_OF_BYTE: Final = to_linear(torch.arange(256) / 255)


def _light_of(encoded: Tensor) -> Tensor:
    """Linear light of sRGB bytes, by a table; in one row, as torch looks up a row much faster than a picture."""
    return _LINEAR_OF_BYTE.index_select(0, encoded.reshape(-1).int()).view(encoded.shape)


def _look_into(dice: Dice, lat_long: Tensor, size: int) -> Picture:
    """A perspective view into a lat-long map (3, H, 2 H): any heading, level within 20 degrees."""
    half = math.tan(math.radians(dice.uniform((50, 100))) / 2)
    heading, pitch = dice.uniform((-math.pi, math.pi)), math.radians(dice.uniform((-20, 20)))
    down, right = torch.meshgrid(*[torch.linspace(-half, half, size)] * 2, indexing="ij")
    y = -down * math.cos(pitch) + math.sin(pitch)
    z = down * math.sin(pitch) + math.cos(pitch)
    longitude = torch.remainder(torch.atan2(right, z) + heading + math.pi, 2 * math.pi) / math.pi - 1
    latitude = torch.atan2(-y, torch.hypot(right, z)) / (math.pi / 2)
    grid = torch.stack([longitude, latitude], dim=-1)[None]
    view = functional.grid_sample(lat_long[None].float(), grid, align_corners=False, padding_mode="border")
    return view[0].clamp(min=0)


def _mean_without_lamps(picture: Picture) -> Tensor:
    """The mean of what is not brighter than the 95th percentile, so that a lamp does not set the exposure."""
    return picture.clamp(max=picture.flatten()[::7].quantile(0.95).item()).mean() + 1e-4


def _temperature(dice: Dice, bounds: Range) -> Tensor:
    """Gains of a warmer or colder light, (3, 1, 1)."""
    warmth = dice.uniform(bounds)
    gains = torch.tensor([warmth, 0, -warmth]) + 0.05 * dice.normal(3)
    return gains.exp()[:, None, None]


def _blur(picture: Picture, radius_px: float, *, disc: bool) -> Picture:
    """Defocus: a gaussian of this standard deviation, or a lens's disc of the same spread."""
    if disc:
        return _filter(picture, _disc(min(2 * radius_px, 6.0)))
    reach = max(1, round(3 * radius_px))
    line = torch.exp(-((torch.arange(-reach, reach + 1) / max(radius_px, 0.1)) ** 2) / 2)
    line = line / line.sum()
    return _filter(_filter(picture, line[:, None]), line[None])


def _disc(radius_px: float) -> Tensor:
    reach = max(1, math.ceil(radius_px))
    y, x = torch.meshgrid(*[torch.arange(-reach, reach + 1.0)] * 2, indexing="ij")
    disc = (radius_px + 0.5 - torch.hypot(x, y)).clamp(0, 1)
    return disc / disc.sum()


def _filter(picture: Picture, kernel: Tensor) -> Picture:
    rows, columns = (side // 2 for side in kernel.shape)
    padded = functional.pad(picture[None], (columns, columns, rows, rows), mode="replicate")
    return functional.conv2d(padded.transpose(0, 1), kernel[None, None]).transpose(0, 1)[0]


def _ghost(dice: Dice, picture: Picture, weight: float, reach_px: float) -> Picture:
    """The second surface's copy, displaced by whole pixels."""
    reach = max(1, round(reach_px))
    down, right = dice.choose(2 * reach + 1), dice.choose(2 * reach + 1)
    padded = functional.pad(picture[None], (reach,) * 4, mode="replicate")[0]
    copy = padded[:, down : down + picture.shape[1], right : right + picture.shape[2]]
    return (picture + weight * copy) / (1 + weight)


def _falloff(dice: Dice, size: int) -> Tensor:
    """A smooth field in 0..1, (1, size, size): where the mirrored side is lit, and where it is dark."""
    cells = 2 + dice.choose(4)
    field = functional.interpolate(dice.normal(1, 1, cells, cells), (size, size), mode="bicubic")[0]
    return torch.sigmoid(dice.uniform((1, 6)) * (field + dice.uniform((-0.5, 0.5))))


def _edge(dice: Dice, size: int) -> Tensor:
    """The reflection ends at a line, such as a frame or a dark body in front of the glass: (1, size, size)."""
    angle, offset = dice.uniform((0, 2 * math.pi)), dice.uniform((-0.5, 0.5))
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, size)] * 2, indexing="ij")
    return torch.sigmoid(dice.log_uniform((4, 100)) * (x * math.cos(angle) + y * math.sin(angle) + offset))[
        None
    ]
