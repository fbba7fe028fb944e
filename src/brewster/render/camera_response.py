"""From light to photographs: the five pictures of a sample, as one camera with one setting would have made them.

    developed = develop(sample)
    jpeg(developed.photo_encoded, 90)

Exposure, white balance and tone curve are decided on I and applied to I, T, B and R alike, so that what was a sum
of light stays one. MR, often far brighter, has an exposure of its own. Only I has noise.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from brewster.photo import FileInfo, Photo
from brewster.render.sample import LAYERS, LightSample
from brewster.scene.scene import Development, Scene
from brewster.srgb import REC709_LUMINANCE, to_encoded

_EV_RANGE: Final = (-64.0, 32.0)
"""Stops that an exposure may be: any lamp can be tamed, but what is nearly black is left so."""

_NEARLY: Final = 0.995
"""Of the mean that exposure can reach at all: the last of it would cost any gain."""

_STRONGEST: Final = 3.0
"""White balance multiplies or divides a channel by this at most."""

_EDGE_NORM: Final = 6
"""The Minkowski norm over edges that van de Weijer et al. found best."""


@dataclass(frozen=True, eq=False)
class DevelopedSample:
    """The five pictures of a sample, each (3, H, W) float32 in 0..1, sRGB-encoded, and what was decided.

    `white_balance` are the gains of red, green and blue; light was multiplied by them and by
    2 ** `exposure_ev` (MR by 2 ** `mirror_exposure_ev`), then clipped and encoded.
    """

    scene: Scene
    photo_encoded: Tensor
    transmission_encoded: Tensor
    background_encoded: Tensor
    reflection_encoded: Tensor
    mirror_encoded: Tensor
    exposure_ev: float
    mirror_exposure_ev: float
    white_balance: tuple[float, float, float]
    overexposed: float
    """The share of I's pixels that are white in any channel."""

    def layers(self) -> dict[str, Tensor]:
        """The five encoded pictures by name."""
        return {name: getattr(self, f"{name}_encoded") for name in LAYERS}

    def decisions(self) -> dict[str, Any]:
        """What was decided, as values for TOML."""
        return {
            "exposure_ev": self.exposure_ev,
            "mirror_exposure_ev": self.mirror_exposure_ev,
            "white_balance": list(self.white_balance),
            "overexposed": self.overexposed,
        }


def develop(sample: LightSample) -> DevelopedSample:
    """Exposes, balances and encodes the pictures of a sample as its scene's development says.

    The decisions are rounded, to a thousandth of a stop, before they are used: what is recorded is what was done,
    and devices that sum in another order decide alike.
    """
    wish = sample.scene.development
    white_balance = _white_balance(sample.photo, wish)
    gains = sample.photo.new_tensor(white_balance).view(3, 1, 1)
    ev = _exposure_ev(sample.photo * gains, wish.exposure)
    mirror_ev = _exposure_ev(sample.mirror * gains, wish.exposure)
    exposed = sample.each(lambda light: light * (gains * math.exp2(ev))).layers()
    exposed["photo"] = _with_noise(exposed["photo"], sample.scene)
    exposed["mirror"] = sample.mirror * (gains * math.exp2(mirror_ev))
    return DevelopedSample(
        scene=sample.scene,
        **{f"{name}_encoded": _toned(light, wish.contrast) for name, light in exposed.items()},
        exposure_ev=ev,
        mirror_exposure_ev=mirror_ev,
        white_balance=white_balance,
        overexposed=round((exposed["photo"] >= 1).any(0).float().mean().item(), 6),
    )


def to_bytes(encoded: Tensor) -> NDArray[np.uint8]:
    """An encoded picture (3, H, W) in 0..1 as the 8-bit numbers (H, W, 3) of a file."""
    levels = (encoded.clamp(0, 1) * 255).round().to(torch.uint8)
    return levels.permute(1, 2, 0).contiguous().cpu().numpy()


def jpeg(encoded: Tensor, quality: int) -> bytes:
    """A JPEG of an encoded picture (3, H, W) at a quality of 1..100, with chroma at full resolution.

    Raises:
        UnsupportedPhoto: more than 65535 pixels a side.
    """
    return Photo(to_bytes(encoded), file_info=FileInfo(container="jpeg", jpeg_quality=quality)).encode()


def with_jpeg(developed: DevelopedSample) -> DevelopedSample:
    """The same with I as it comes back from a JPEG of the scene's `jpeg_quality`."""
    photo = developed.photo_encoded
    decoded = Photo.open(jpeg(photo, developed.scene.development.jpeg_quality)).pixels
    levels = torch.from_numpy(decoded.copy()).to(photo.device).permute(2, 0, 1)
    return replace(developed, photo_encoded=levels.to(photo.dtype).contiguous() / 255)


def _toned(linear: Tensor, contrast: float) -> Tensor:
    """Clipped light through the sRGB curve, then so far towards (or from) a smooth step as contrast says."""
    encoded = to_encoded(linear.clamp(0, 1)).clamp(0, 1)
    smooth = encoded * encoded * (3 - 2 * encoded)
    return torch.lerp(encoded, smooth, contrast).clamp(0, 1) if contrast else encoded


def luminance(colour: Tensor) -> float:
    """The Rec.709 luminance of a linear colour, (3,)."""
    return float(sum(map(operator.mul, REC709_LUMINANCE, colour.tolist())))


# --- exposure


def _exposure_ev(light: Tensor, wanted: float) -> float:
    """The stops after which the mean luminance of light (3, H, W), clipped at white, is as wanted.

    That mean rises with exposure, so bisection finds it. Where too much is black to get there, the answer
    is where nearly everything else is white; a black picture stays as it is.
    """

    def mean(ev: float) -> float:
        return luminance((light * math.exp2(ev)).clamp_(0, 1).mean((1, 2)))

    low, high = _EV_RANGE
    wanted = min(wanted, _NEARLY * mean(high))
    if wanted <= 0:
        return 0.0
    while high - low > 2e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if mean(middle) < wanted else (low, middle)
    return round((low + high) / 2, 3)


# --- white balance


def _white_balance(photo: Tensor, wish: Development) -> tuple[float, float, float]:
    """Gains that make the light's colour grey and keep its luminance, or go there by the wished strength.

    The colour is judged where a camera would have seen one: what clips in any channel is left out, unless that
    is all there is.
    """
    if wish.white_balance == "none":
        return 1.0, 1.0, 1.0
    exposed = (photo * math.exp2(_exposure_ev(photo, wish.exposure))).clamp(0, 1)
    seen = (exposed < 1).all(0)
    colour = _ESTIMATES[wish.white_balance](exposed, seen if seen.any() else ~seen)
    return _gains(colour, wish.white_balance_strength)


def _gains(colour: Tensor, strength: float) -> tuple[float, float, float]:
    """Gains for a light's colour (3,); ones where nothing is lit enough to have one."""
    before = luminance(colour)
    if before < 1e-9:
        return 1.0, 1.0, 1.0
    full = before / colour.clamp(min=before * 1e-6)
    partly = full**strength
    kept = partly * (before / luminance(colour * partly))
    red, green, blue = kept.clamp(1 / _STRONGEST, _STRONGEST).tolist()
    return round(red, 4), round(green, 4), round(blue, 4)


def _mean(picture: Tensor, seen: Tensor) -> Tensor:
    """Grey-world: on average, the world is grey (G. Buchsbaum, J. Franklin Institute 310, 1980)."""
    return picture[:, seen].mean(1)


def _brightest(picture: Tensor, seen: Tensor) -> Tensor:
    """White-patch: the brightest thing is white (E. H. Land, Scientific American 237, 1977); 99th percentile."""
    values = picture[:, seen]
    return values.kthvalue(math.ceil(0.99 * values.shape[1]), dim=1).values


def _edges(picture: Tensor, seen: Tensor) -> Tensor:
    """Grey-edge: on average, differences are grey (J. van de Weijer et al., IEEE Trans. Image Proc. 16, 2007).

    Differences run along both diagonals of each two by two pixels that were all seen, without smoothing: light
    that was rendered has little noise yet.
    """
    first, second = picture[:, 1:, 1:] - picture[:, :-1, :-1], picture[:, 1:, :-1] - picture[:, :-1, 1:]
    whole = seen[1:, 1:] & seen[:-1, :-1] & seen[1:, :-1] & seen[:-1, 1:]
    edges = torch.hypot(first, second)[:, whole]
    steepest = edges.max().clamp(min=1e-12) if edges.numel() else 1.0  # sixth powers leave float32 otherwise
    colour: Tensor = torch.linalg.vector_norm(edges / steepest, _EDGE_NORM, dim=1)
    return colour


_ESTIMATES: Final[dict[str, Callable[[Tensor, Tensor], Tensor]]] = {
    "grey-world": _mean,
    "white-patch": _brightest,
    "grey-edge": _edges,
}
"""From a picture (3, H, W) in 0..1 and which pixels count (H, W) to the colour of the light (3,), of any scale."""


# --- noise


def _with_noise(exposed: Tensor, scene: Scene) -> Tensor:
    """Light with the noise of photons and of electronics, which depends on the scene's seed and index alone.

    Both are nearly Gaussian, and so is their sum (A. Foi et al., IEEE Trans. Image Proc. 17, 2008).
    """
    wish = scene.development
    if wish.shot_noise == wish.read_noise == 0:
        return exposed
    # torch's generator on the CPU heeds 32 bits of its seed only
    seed = int(np.random.SeedSequence((scene.seed, scene.index)).generate_state(1)[0])
    normal = torch.randn(exposed.shape, generator=Generator().manual_seed(seed)).to(exposed.device)
    variance = wish.shot_noise**2 * exposed.clamp(0, 1) + wish.read_noise**2
    return exposed + variance.sqrt() * normal
