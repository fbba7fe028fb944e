"""How a model looks at a photo: at which small copies, how often, and what it makes of them together.

A network that answers at once (`MultiScalePredictor`) sees copies of several sizes, each as it is and in a mirror: the mean is the
answer, the disagreement tells how sure it is. A model that generates pictures looks in a way of its own (generate.py).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.inference.guided_upsampling import Floats, GeneratedOverride, enlarge_rows
from brewster.inference.tiles import Backend, run_tiled
from brewster.options import Quality
from brewster.srgb import to_encoded

if TYPE_CHECKING:
    from jaxtyping import Float32

ProgressCallback = Callable[[float], None]
"""Called with the share that is done, 0 to 1, between pieces of work; what it raises stops the work."""

QUALITIES: Final[dict[Quality, tuple[int, ...]]] = {
    "draft": (100_000,),
    "standard": (100_000, 200_000),
    "best": (30_000, 100_000, 200_000, 350_000),
}
"""Pixels of the small copies that `MultiScalePredictor` shows the network, the largest last."""

_MIN_SHORT_SIDE_PX: Final = 160
_MAX_ELONGATED_SCALE: Final = 3.0
"""How much larger than the dial says the small copy of a long thin photo may be, a side."""
_TILE_PX: Final = 1024
_OVERLAP_PX: Final = 192
_SPREAD_AT_1_E: Final = 0.05
"""Disagreement, in sRGB-encoded units, at which confidence has fallen to 1/e."""


@final
@dataclass(frozen=True, eq=False)
class Prediction:
    """What a look has found, in maps of the size of the largest copy, linear light."""

    change: Float32[NDArray[np.float32], "h w 3"]
    """Transmission - photo."""
    reflection: Float32[NDArray[np.float32], "h w 3"]
    confidence_map: Float32[NDArray[np.float32], "h w 1"]
    """1 where it is sure, towards 0 where it is not."""
    override: GeneratedOverride | None = None
    """Where the transmission is to be taken as the model drew it."""
    reconstruction_error: float | None = None
    """Mean of |the photo as the model redraws it - the photo|, sRGB-encoded; None where it redraws nothing."""


class Predictor(ABC):
    """A way of looking. It is called from many threads at once."""

    @abstractmethod
    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:
        """Width and height of the copies that it wants of a photo of this size, smallest first, each once."""

    @abstractmethod
    def __call__(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """Looks at these copies, (h, w, 3) each, linear light in 0..1."""


@final
class MultiScalePredictor(Predictor):
    """Looks through a `Backend` at copies of several sizes, each as it is and in a mirror."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:
        """As `QUALITIES` says; more pixels for long thin photos."""
        width, height = size
        sizes = []
        for pixels in QUALITIES[quality]:
            scale = math.sqrt(pixels / (width * height))
            scale = min(1.0, max(scale, min(_MAX_ELONGATED_SCALE * scale, _MIN_SHORT_SIDE_PX / min(size))))
            sizes.append((max(1, round(width * scale)), max(1, round(height * scale))))
        return list(dict.fromkeys(sizes))

    def __call__(
        self,
        inputs: Sequence[Floats],
        quality: Quality,  # noqa: ARG002
        on_progress: ProgressCallback,
    ) -> Prediction:
        """The mean of all views; it is sure where they agree."""
        size = inputs[-1].shape[:2]
        changes, reflections = [], []
        for scaled_input in inputs:
            for transmission, reflection in self._predict_with_flip(scaled_input):
                changes.append(enlarge_rows(transmission - scaled_input, 0, size[0], size))
                reflections.append(enlarge_rows(reflection, 0, size[0], size))
                on_progress(len(changes) / (2 * len(inputs)))
        transmissions_encoded = to_encoded(np.maximum(inputs[-1] + np.stack(changes), 0))
        return Prediction(
            np.mean(changes, axis=0),
            np.mean(reflections, axis=0),
            confidence_from_spread(np.ptp(transmissions_encoded, axis=0)),
        )

    def _predict_with_flip(self, scaled_input: Floats) -> Iterator[tuple[Floats, Floats]]:
        """Both layers of a copy as it is, and as seen in a mirror."""
        yield self._predict(scaled_input)
        transmission, reflection = self._predict(np.ascontiguousarray(scaled_input[:, ::-1]))
        yield transmission[:, ::-1], reflection[:, ::-1]

    def _predict(self, scaled_input: Floats) -> tuple[Floats, Floats]:
        transmission, reflection = run_tiled(
            self._backend, scaled_input, tile_px=_TILE_PX, overlap_px=_OVERLAP_PX
        )
        return transmission, reflection


def confidence_from_spread(spread: Float32[Floats, "h w 3"]) -> Float32[Floats, "h w 1"]:
    """How sure one can be where answers differ by so much, sRGB-encoded: 1 where they do not."""
    confidence: Floats = np.exp(-spread.max(axis=2, keepdims=True) / np.float32(_SPREAD_AT_1_E))
    return confidence
