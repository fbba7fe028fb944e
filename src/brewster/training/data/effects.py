"""Optical effects of mixtures: defocus, ghost images, lamps, signs, shadows, haze, windows, and
JPEG.

Images are (3, H, W) in linear light, unless their names end in `encoded`. Masks are (1, size, size)
in 0..1. All random numbers come from the `SampleRng` argument.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torch.nn import functional

from brewster.training.data.sample_rng import SampleRng

if TYPE_CHECKING:
    from jaxtyping import Float

    Image = Float[Tensor, "3 h w"]
    Mask = Float[Tensor, "1 s s"]


def blur(image: Image, sigma_px: float, *, disc: bool) -> Image:
    """Blurs by defocus: with a Gaussian of this standard deviation, or a disc of radius 2
    `sigma_px`, as of an aperture.

    A large blur is computed on a smaller copy of the image, because its cost grows with `sigma_px`.
    """
    reduction = int(sigma_px / 3)
    if reduction > 1:
        small = functional.interpolate(image[None], scale_factor=1 / reduction, mode="area")[0]
        blurred = blur(small, sigma_px / reduction, disc=disc)
        return functional.interpolate(blurred[None], image.shape[1:], mode="bilinear")[0]
    if disc:
        radius_px = 2 * sigma_px
        reach = max(1, math.ceil(radius_px))
        y, x = torch.meshgrid(*[torch.arange(-reach, reach + 1.0)] * 2, indexing="ij")
        kernel = (radius_px + 0.5 - torch.hypot(x, y)).clamp(0, 1)
        return _filter(image, kernel / kernel.sum())
    reach = max(1, round(3 * sigma_px))
    line = torch.exp(-((torch.arange(-reach, reach + 1) / max(sigma_px, 0.1)) ** 2) / 2)
    line = line / line.sum()
    return _filter(_filter(image, line[:, None]), line[None])


def ghost(rng: SampleRng, image: Image, weight: float, reach_px: float) -> Image:
    """Adds a ghost image of the second surface of the pane, displaced by whole pixels. The mean
    luminance stays.
    """
    reach = max(1, round(reach_px))
    down, right = rng.randint(2 * reach + 1), rng.randint(2 * reach + 1)
    padded = functional.pad(image[None], (reach,) * 4, mode="replicate")[0]
    copy = padded[:, down : down + image.shape[1], right : right + image.shape[2]]
    return (image + weight * copy) / (1 + weight)


def recolour(rng: SampleRng, image: Image, probability: float) -> Image:
    """Exchanges colour channels, changes the saturation, and applies a gamma curve, each with this
    probability.
    """
    if rng.bernoulli(probability):
        image = image[_CHANNEL_ORDERS[rng.randint(len(_CHANNEL_ORDERS))]]
    if rng.bernoulli(probability):
        grey = image.mean(dim=0, keepdim=True)
        image = (grey + rng.log_uniform((0.5, 1.6)) * (image - grey)).clamp(0, 1)
    if rng.bernoulli(probability):
        image = image ** rng.log_uniform((0.75, 1.33))
    return image


_CHANNEL_ORDERS: Final = ([0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0])


def lamps(rng: SampleRng, size: int) -> Image:
    """Returns one to six small lamps on black, (3, size, size). A lamp is a disc with a glow."""
    count = 1 + rng.randint(6)
    x, y = rng.uniform_tensor(2, count, 1, 1) * size
    rows, columns = _pixels(size)
    distance = torch.hypot(columns - x, rows - y)
    radius = torch.exp(math.log(0.004) + math.log(8) * rng.uniform_tensor(count, 1, 1)) * size
    core = (radius + 0.5 - distance).clamp(0, 1)
    glow = 0.04 * torch.exp(-distance / (3 * radius))
    colour = (
        torch.tensor([0.3, 0, -0.4]) * rng.uniform((-0.5, 1)) + 0.1 * rng.normal(count, 3)
    ).exp()
    light = rng.log_uniform((3, 60)) * (0.3 + rng.uniform_tensor(count, 1, 1)) * (core + glow)
    return torch.einsum("nc,nhw->chw", colour, light)


def sign(rng: SampleRng, image: Image) -> Image:
    """Adds a sign with rows of random glyphs: luminous letters, or dark letters on a luminous
    panel.
    """
    size = image.shape[-1]
    rows, columns = 1 + rng.randint(3), 3 + rng.randint(9)
    glyphs = (rng.uniform_tensor(rows, 5, columns, 3) < 0.55).float()
    lines = functional.pad(functional.pad(glyphs, (0, 1)).flatten(2), (1, 0, 1, 1)).flatten(0, 1)
    angle = rng.uniform((-0.4, 0.4))
    scale = rng.log_uniform((1.2, 5.0))
    wide = lines.shape[1] / lines.shape[0]
    turn = scale * torch.tensor(
        [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
    )
    turn[1] *= wide * rng.uniform((0.6, 1.2))
    shift = rng.uniform_tensor(2, 1) * 2 - 1
    grid = functional.affine_grid(
        torch.cat([turn, shift], 1)[None], [1, 1, size, size], align_corners=False
    )
    texture = torch.stack([lines, torch.ones_like(lines)])[None]
    letters, panel = functional.grid_sample(texture, grid, align_corners=False)[0]
    letters, panel = (torch.sigmoid(20 * (mask - 0.5)) for mask in (letters, panel))
    lit = letters if rng.bernoulli(0.6) else panel * (1 - letters)
    colour = (0.8 * rng.normal(3, 1, 1)).exp()
    return image * (1 - 0.7 * panel) + rng.log_uniform((0.8, 6.0)) * colour * lit


def smooth_attenuation_mask(rng: SampleRng, size: int) -> Mask:
    """Returns a smooth mask that dims parts of the reflection, as if parts of the mirrored scene
    were dark.
    """
    return torch.sigmoid(
        rng.uniform((1, 6)) * (_noise(rng, size, 2 + rng.randint(4)) + rng.uniform((-0.5, 0.5)))
    )


def edge(rng: SampleRng, size: int) -> Mask:
    """Returns a mask that is a half-plane, for a reflection that ends at a straight line such as a
    window frame.
    """
    return torch.sigmoid(rng.log_uniform((4, 100)) * _line(rng, size))


def window(rng: SampleRng, size: int) -> Mask:
    """Returns a mask of the glass: the intersection of one to four half-planes, with edges of about
    one pixel.
    """
    inside = torch.stack([_line(rng, size) + 0.3 for _ in range(1 + rng.randint(4))]).amin(dim=0)
    return torch.sigmoid(size * inside)


def shadow(rng: SampleRng, size: int) -> Mask:
    """Returns a mask for the light of a scene: hard shadows with straight edges, or shadows of
    leaves.
    """
    if rng.bernoulli(0.5):
        lit = torch.stack([_line(rng, size) for _ in range(1 + rng.randint(3))]).amin(dim=0)
    else:
        lit = _noise(rng, size, 4 + rng.randint(12)) + 0.7 * _noise(rng, size, 2 + rng.randint(4))
    lit = torch.sigmoid(rng.log_uniform((10, 2 * size)) * lit)
    darkest = rng.uniform((0.08, 0.5))
    return darkest + (1 - darkest) * lit


def haze(rng: SampleRng, image: Image) -> Image:
    """Adds the light that the air scatters, (3, size, size), which grows with the distance
    (Koschmieder 1924).
    """
    size = image.shape[-1]
    rows, _ = _pixels(size)
    below = (rows / size - rng.uniform((0.1, 0.7))).clamp(min=0)
    distance = 1 / (below / 0.15 + rng.uniform((0.05, 0.3)))
    distance = (distance / distance.max() + 0.25 * _noise(rng, size, 2 + rng.randint(4))).clamp(
        0, 1
    )
    passed = torch.exp(-rng.log_uniform((0.2, 2.5)) * distance)
    colour = torch.tensor([0.92, 1.0, 1.1])[:, None, None] ** rng.uniform((-0.5, 2))
    return image * passed + rng.log_uniform((0.5, 1.8)) * image.mean() * colour * (1 - passed)


def jpeg(encoded: Image, quality: int) -> Image:
    """Simulates JPEG compression of an encoded image, whose sides are multiples of 8, at a quality
    of 1..100.

    A cosine transform of blocks of 8 x 8 px, quantization (tables K.1 and K.2 of ITU-T T.81;
    Wallace, "The JPEG still picture compression standard", CACM 34, 1991) and rounding to 8 bits,
    with chroma at full resolution. It takes a tenth of the time of a codec.
    """
    scale = 50 / quality if quality < 50 else 2 - quality / 50
    luma, chroma = (_JPEG_TABLES * scale + 0.5).floor().clamp(1, 255)
    planes = torch.einsum("yc,chw->yhw", _TO_YCBCR, encoded * 255 - 128).round()
    rows, columns = planes.shape[1] // 8, planes.shape[2] // 8
    blocks = planes.view(3, rows, 8, columns, 8).transpose(2, 3)
    steps = torch.stack([luma, chroma, chroma])[:, None, None]
    levels = (_COSINES @ blocks @ _COSINES.T / steps).round() * steps
    planes = (_COSINES.T @ levels @ _COSINES).transpose(2, 3).reshape(planes.shape)
    decoded = torch.einsum("cy,yhw->chw", _TO_YCBCR.inverse(), planes.round()) + 128
    return decoded.round().clamp(0, 255) / 255


_TO_YCBCR: Final = torch.tensor(
    [
        [0.299, 0.587, 0.114],
        [-0.168736, -0.331264, 0.5],
        [0.5, -0.418688, -0.081312],
    ]
)
_JPEG_TABLES: Final = torch.tensor(
    [
        [  # K.1, luma
            [16, 11, 10, 16, 24, 40, 51, 61],
            [12, 12, 14, 19, 26, 58, 60, 55],
            [14, 13, 16, 24, 40, 57, 69, 56],
            [14, 17, 22, 29, 51, 87, 80, 62],
            [18, 22, 37, 56, 68, 109, 103, 77],
            [24, 35, 55, 64, 81, 104, 113, 92],
            [49, 64, 78, 87, 103, 121, 120, 101],
            [72, 92, 95, 98, 112, 100, 103, 99],
        ],
        [  # K.2, chroma
            [17, 18, 24, 47, 99, 99, 99, 99],
            [18, 21, 26, 66, 99, 99, 99, 99],
            [24, 26, 56, 99, 99, 99, 99, 99],
            [47, 66, 99, 99, 99, 99, 99, 99],
            [99, 99, 99, 99, 99, 99, 99, 99],
            [99, 99, 99, 99, 99, 99, 99, 99],
            [99, 99, 99, 99, 99, 99, 99, 99],
            [99, 99, 99, 99, 99, 99, 99, 99],
        ],
    ]
)
_FREQUENCIES: Final = torch.arange(1, 8)[:, None]
_POSITIONS: Final = 2 * torch.arange(8)[None] + 1
_COSINES: Final = torch.cat(
    [
        torch.full((1, 8), math.sqrt(1 / 8)),
        0.5 * torch.cos(_FREQUENCIES * _POSITIONS * math.pi / 16),
    ]
)
"""Matrix of the orthonormal discrete cosine transform of eight values."""


def _pixels(size: int) -> tuple[Tensor, Tensor]:
    """Returns row and column coordinates of pixel centres, (size, 1) and (1, size)."""
    centres = torch.arange(size) + 0.5
    return centres[:, None], centres[None]


def _line(rng: SampleRng, size: int) -> Mask:
    """Returns the signed distance to a random line, in units of half the side of the image."""
    angle = rng.uniform((0, 2 * math.pi))
    offset = rng.uniform((-0.5, 0.5))
    rows, columns = (2 * centres / size - 1 for centres in _pixels(size))
    return (columns * math.cos(angle) + rows * math.sin(angle) + offset)[None]


def _noise(rng: SampleRng, size: int, cells: int) -> Mask:
    """Returns normal noise on a grid of `cells` x `cells` nodes, bicubically interpolated."""
    return functional.interpolate(rng.normal(1, 1, cells, cells), (size, size), mode="bicubic")[0]


def _filter(image: Image, kernel: Tensor) -> Image:
    rows, columns = (side // 2 for side in kernel.shape)
    padded = functional.pad(image[None], (columns, columns, rows, rows), mode="replicate")
    return functional.conv2d(padded.transpose(0, 1), kernel[None, None]).transpose(0, 1)[0]
