"""A photograph in, two layers out, at the photo's own size.

    separator = Separator.load("compact")
    separation = separator("window.jpg")
    separation.transmission.save("clear.jpg")

The network sees a small linear copy of the photo (tiles.py cuts it where it is large), twice: as it is and
mirrored. The mean is the answer, the disagreement tells how sure it is. detail.py brings it to full size.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final, Literal, final

import numpy as np

from brewster.errors import BrewsterError
from brewster.light import to_encoded
from brewster.models.zoo import find_model
from brewster.photo import Photo, Source
from brewster.separate.detail import Floats, Transfer, enlarge_rows
from brewster.separate.runtime import OnnxBackend
from brewster.separate.tiles import Backend, in_tiles

Quality = Literal["draft", "standard", "best"]

QUALITIES: Final[dict[str, int]] = {"draft": 100_000, "standard": 250_000, "best": 600_000}
"""Pixels of the small copy that the network sees."""

_SHORTEST_SIDE_PX: Final = 192
_TILE_PX: Final = 1024
_OVERLAP_PX: Final = 192
_STRIP_PX: Final = 1_000_000
_WORKERS: Final = 2
_UNSURE: Final = 0.05
"""Disagreement of the two views, in sRGB-encoded units, at which confidence has fallen to 1/e."""


@final
@dataclass(frozen=True)
class Separation:
    """The answer: all pictures have the photo's size; how it was made stands beside them."""

    photo: Photo
    transmission: Photo
    reflection: Photo
    confidence: Photo
    """Grey, 8 bit: 255 where the separation is sure of the transmission."""
    remainder: float
    """Mean of |photo - transmission - reflection| in linear light: what neither layer explains."""
    model: str
    sha256: str | None
    device: str
    seconds: dict[str, float] = field(compare=False)
    """Wall time of decode, network and detail transfer."""


@final
class Separator:
    """A reusable, thread-safe callable around one `Backend`."""

    def __init__(
        self, backend: Backend, *, name: str = "custom", sha256: str | None = None, device: str = "cpu"
    ) -> None:
        self._backend = backend
        self.name, self.sha256, self.device = name, sha256, device

    @classmethod
    def load(cls, model: str = "compact", *, device: str = "auto") -> Separator:
        """A separator by the name of a model in the zoo or the path of an .onnx file.

        Raises:
            ModelError: no such model, or a damaged one.
            DeviceError: the asked device is not available.
        """
        found = find_model(model)
        digest = found.verify()
        backend = OnnxBackend(found.path, device)
        return cls(backend, name=found.name, sha256=digest, device=backend.device)

    def __call__(
        self,
        source: Source | Photo,
        *,
        strength: float = 1.0,
        quality: Quality = "standard",
        additive: bool = False,
    ) -> Separation:
        """Separates a path, bytes, PIL image, array (see `Photo.from_array`) or `Photo`.

        Args:
            source: the photograph.
            strength: 0 returns the photo itself, 1 the whole separation; between, a share of it.
            quality: how large a copy the network sees.
            additive: layers of 32-bit floats that sum to the photo exactly in linear light, for compositing.

        Raises:
            PhotoError: the source cannot be read.
            BrewsterError: strength or quality out of range.
        """
        _check(strength, quality)
        seconds: dict[str, float] = {}
        with _clock(seconds, "decode"):
            photo = source if isinstance(source, Photo) else Photo.of(source)
            small = np.clip(photo.small(*_work_size(photo.size, QUALITIES[quality])), 0, 1)
        with _clock(seconds, "network"):
            transmission, reflection, sure = self._two_views(small)
        with _clock(seconds, "detail"):
            transfer = Transfer.learn(small, small + strength * (transmission - small), strength * reflection)
            layers, remainder = _at_full_size(photo, transfer, additive=additive)
            confidence = _enlarged(sure, photo.size)
        return Separation(photo, *layers, confidence, remainder, self.name, self.sha256, self.device, seconds)

    def _two_views(self, small: Floats) -> tuple[Floats, Floats, Floats]:
        """Transmission, reflection and confidence (h, w, 1) of the small copy."""
        plain = self._separate(small)
        mirrored = [layer[:, ::-1] for layer in self._separate(np.ascontiguousarray(small[:, ::-1]))]
        transmission, reflection = ((one + other) / 2 for one, other in zip(plain, mirrored, strict=True))
        apart = np.abs(to_encoded(plain[0]) - to_encoded(mirrored[0])).max(axis=2, keepdims=True)
        return transmission, reflection, np.exp(-apart / _UNSURE)

    def _separate(self, small: Floats) -> tuple[Floats, Floats]:
        return in_tiles(self._backend, small, tile_px=_TILE_PX, overlap_px=_OVERLAP_PX)


def separate(
    source: Source | Photo,
    *,
    model: str = "compact",
    device: str = "auto",
    strength: float = 1.0,
    quality: Quality = "standard",
    additive: bool = False,
) -> Separation:
    """Separates one photograph; for many, `Separator.load` once and call it. Raises what they raise."""
    separator = Separator.load(model, device=device)
    return separator(source, strength=strength, quality=quality, additive=additive)


def _check(strength: float, quality: str) -> None:
    if not 0 <= strength <= 1:
        raise BrewsterError(f"strength is {strength}", "a number from 0 to 1", "choose one in that range")
    if quality not in QUALITIES:
        raise BrewsterError(f"quality is {quality!r}", f"one of {', '.join(QUALITIES)}", "choose one of them")


def _work_size(size: tuple[int, int], pixels: int) -> tuple[int, int]:
    """Width and height of the small copy: about `pixels` in all, no side too short, never enlarged."""
    width, height = size
    scale = max(math.sqrt(pixels / (width * height)), _SHORTEST_SIDE_PX / min(size))
    scale = min(1.0, scale)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _at_full_size(photo: Photo, transfer: Transfer, *, additive: bool) -> tuple[list[Photo], float]:
    """Both layers as photos, made strip by strip, and the mean unexplained remainder."""
    width, height = photo.size
    kind = (np.float32, 3) if additive else (photo.pixels.dtype, photo.pixels.shape[2])
    canvases = [np.empty((height, width, kind[1]), kind[0]) for _ in range(2)]

    def fill(rows: slice) -> float:
        linear = photo.linear_rows(rows.start, rows.stop)
        layers = transfer.apply(linear, rows.start, height)
        if additive:
            layers = _summing_exactly(linear, layers[0])
        for canvas, layer in zip(canvases, layers, strict=True):
            canvas[rows] = layer if additive else photo.stored_rows(layer, rows.start)
        return float(np.abs(linear - layers[0] - layers[1]).sum(dtype=np.float64))

    step = max(1, _STRIP_PX // width)
    strips = [slice(top, min(top + step, height)) for top in range(0, height, step)]
    with ThreadPoolExecutor(_WORKERS) as pool:
        unexplained = sum(pool.map(fill, strips))
    layers = [photo.with_pixels(canvas) for canvas in canvases]
    return layers, unexplained / (width * height * 3)


def _summing_exactly(photo: Floats, transmission: Floats) -> tuple[Floats, Floats]:
    """Two layers whose float sum is the photo, to the last bit: one difference is exact (Sterbenz 1974)."""
    reflection = photo - np.minimum(transmission, photo)
    return photo - reflection, reflection


def _enlarged(map_: Floats, size: tuple[int, int]) -> Photo:
    width, height = size
    step = max(1, _STRIP_PX // width)
    rows = [
        np.rint(255 * enlarge_rows(map_, top, min(step, height - top), (height, width))).astype(np.uint8)
        for top in range(0, height, step)
    ]
    return Photo.from_array(np.concatenate(rows), encoding="srgb")


@contextmanager
def _clock(seconds: dict[str, float], name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - started
