"""Predicts the layers of a photo from downscaled copies of it.

`MultiScalePredictor` averages a network at several input scales with flips; the confidence is
computed from the spread. Diffusion models have their own predictor (diffusion/predictor.py).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.errors import ModelError
from brewster.options import Quality
from brewster.photo.srgb import to_encoded
from brewster.separation.guided_upsampling import Floats, GeneratedOverride, upsample_rows
from brewster.separation.tiles import Backend, HintedBackend, run_tiled

if TYPE_CHECKING:
    from jaxtyping import Float32

ProgressCallback = Callable[[float], None]
"""Called with the completed fraction, 0 to 1. An exception raised in it stops the work."""

QUALITIES: Final[dict[Quality, tuple[int, ...]]] = {
    "draft": (100_000,),
    "standard": (100_000, 200_000),
}
"""The input scales of `MultiScalePredictor`: width times height of each input in pixels, the
largest last.
"""

_MIN_SHORT_SIDE_PX: Final = 160
"""Inputs whose short side would be below this length are enlarged."""
_MAX_ENLARGEMENT: Final = 3.0
"""Maximum factor of this enlargement."""
_TILE_PX: Final = 1024
_OVERLAP_PX: Final = 192
SPREAD_AT_1_E: Final = 0.05
"""The spread of outputs (maximum - minimum), in sRGB-encoded units, at which the confidence is 1/e.
"""


@final
@dataclass(frozen=True, eq=False)
class Prediction:
    """The output of a predictor: maps with the size (h, w) of the largest input, in linear
    light.
    """

    change: Float32[NDArray[np.float32], "h w 3"]
    """Transmission minus photo."""
    reflection: Float32[NDArray[np.float32], "h w 3"]
    confidence_map: Float32[NDArray[np.float32], "h w 1"]
    """Confidence in the transmission: 1 is certain, 0 is unknown."""
    override: GeneratedOverride | None = None
    """A generated transmission, and where it replaces the result of guided upsampling."""
    reconstruction_error: float | None = None
    """Mean of |generated input - input|, sRGB-encoded, or None if the model does not generate the
    input.
    """
    reflection_is_derived: bool = False
    """Whether the reflection is photo - transmission in linear light, because the model predicts no
    reflection.
    """


_MAX_OUTPUT: Final = 16.0
"""Outputs with larger absolute values are errors: they are not linear light with 1 as white."""


class Predictor(ABC):
    """Predicts the layers of a photo from copies of it. Thread-safe."""

    takes_hints = False
    """Whether the inputs may have two more channels: the hints of a person, see
    `brewster.photo.Hints`.
    """
    is_measured = False
    """Whether the layers were measured in several photos. Then those of clipped light are used,
    too: without them, simulated bursts lost 1.0 to 2.9 dB in T and 2.4 to 10.2 dB in R.
    """

    @abstractmethod
    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:
        """Returns the (width, height) of each input for a photo of this (width, height): smallest
        first.
        """

    @abstractmethod
    def __call__(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """Returns the prediction for copies of the photo with the sizes of `input_sizes`.

        An input is (h, w, 3), linear light in 0..1, or (h, w, 5) with hints."""


@final
class MultiScalePredictor(Predictor):
    """Runs a `Backend` at several input scales, with and without a horizontal flip, and averages
    the outputs.
    """

    def __init__(
        self,
        backend: Backend,
        scales: tuple[int, ...] | None = None,
        *,
        flips: bool = True,
        tile_px: int = _TILE_PX,
    ) -> None:
        """By default, the input scales are `QUALITIES`, each with a flip. With given `scales` in
        pixels, as for a large network, standard runs all of them, and draft only the smallest, once
        and without a flip.
        """
        self._backend = backend
        self._scales: dict[Quality, tuple[int, ...]] = (
            {"draft": scales[:1], "standard": scales} if scales else QUALITIES
        )
        self._flipped_qualities = [
            name for name in QUALITIES if flips and (name == "standard" or not scales)
        ]
        self._tile_px = tile_px
        self._hinted = (
            backend if isinstance(backend, HintedBackend) and backend.takes_hints else None
        )
        self.takes_hints = self._hinted is not None

    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:
        """Returns sizes with the pixels of the scales, not above the photo, but with short sides of
        160 px if possible.
        """
        width, height = size
        sizes = []
        for pixels in self._scales[quality]:
            scale = math.sqrt(pixels / (width * height))
            scale = min(
                1.0, max(scale, min(_MAX_ENLARGEMENT * scale, _MIN_SHORT_SIDE_PX / min(size)))
            )
            sizes.append((max(1, round(width * scale)), max(1, round(height * scale))))
        return list(dict.fromkeys(sizes))

    def __call__(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """Returns the mean over input scales and flips. The confidence is 0 for one output."""
        size = inputs[-1].shape[:2]
        changes = []
        reflections = []
        # -1 flips the input, and flips the outputs back
        passes = list(product(inputs, (1, -1) if quality in self._flipped_qualities else (1,)))
        for scaled_input, direction in passes:
            layers = run_tiled(
                self._run_backend,
                np.ascontiguousarray(scaled_input[:, ::direction]),
                tile_px=self._tile_px,
                overlap_px=_OVERLAP_PX,
            )
            transmission, reflection = (layer[:, ::direction] for layer in layers)
            changes.append(upsample_rows(transmission - scaled_input[..., :3], 0, size[0], size))
            reflections.append(upsample_rows(reflection, 0, size[0], size))
            on_progress(len(changes) / len(passes))
        transmissions_encoded = to_encoded(np.maximum(inputs[-1][..., :3] + np.stack(changes), 0))
        confidence = confidence_from_spread(np.ptp(transmissions_encoded, axis=0))
        return Prediction(
            np.mean(changes, axis=0),
            np.mean(reflections, axis=0),
            confidence if len(passes) > 1 else np.zeros_like(confidence),
        )

    def _run_backend(self, tile: Floats) -> tuple[Floats, Floats]:
        photo = tile[..., :3]
        hints = tile[..., 3:]
        outputs = (
            self._hinted(photo, hints) if self._hinted and hints.size else self._backend(photo)
        )
        return checked_layers(outputs, photo)


def checked_layers(outputs: object, tile: Floats) -> tuple[Floats, Floats]:
    """Returns the two outputs of a backend for a tile (H, W, 3) as float32. Raises ModelError if
    they are not two float arrays with the shape of the tile, or contain NaN or values outside
    -16..16.
    """
    if not isinstance(outputs, tuple | list) or len(outputs) != 2:
        raise ModelError(
            f"the model returned a {type(outputs).__name__}",
            "expected a pair (transmission, reflection)",
            "return both layers of the tile",
        )
    layers = [np.asarray(output) for output in outputs]
    for name, layer in zip(("transmission", "reflection"), layers, strict=True):
        if layer.shape != tile.shape or layer.dtype.kind != "f":
            raise ModelError(
                f"the model returned a {name} of shape {layer.shape} and dtype {layer.dtype}",
                f"expected floats of shape {tile.shape}, as the tile",
                "return (height, width, channels), and convert integers to floats in 0..1",
            )
        low = float(layer.min())
        high = float(layer.max())  # NaN if one value is NaN
        if not (low >= -_MAX_OUTPUT and high <= _MAX_OUTPUT):
            raise ModelError(
                f"the model returned a {name} with values in {low:g}..{high:g}",
                "expected linear light of about 0..1, without NaN and infinity",
                "divide values of 8 bits by 255, and decode sRGB to linear light",
            )
    transmission, reflection = (layer.astype(np.float32, copy=False) for layer in layers)
    return transmission, reflection


def confidence_from_spread(spread: Float32[Floats, "h w 3"]) -> Float32[Floats, "h w 1"]:
    """Returns exp(-s / 0.05), where s is the largest spread of the three channels. `spread` is
    sRGB-encoded.
    """
    confidence: Floats = np.exp(-spread.max(axis=2, keepdims=True) / np.float32(SPREAD_AT_1_E))
    return confidence
