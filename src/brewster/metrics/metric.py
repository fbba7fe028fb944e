"""What a metric is, and what its function is given: one answer and the ground truth of one case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, cast, final

from brewster.metrics.windows import Picture, Region

_Features = TypeVar("_Features")


@final
@dataclass(frozen=True, eq=False)
class CachedPicture:
    """A picture, uint8 sRGB (H, W, 3), with the features that metrics have computed from it."""

    pixels: Picture
    _features: dict[Callable[[Picture], Any], Any] = field(default_factory=dict, repr=False)

    def features(self, compute: Callable[[Picture], _Features]) -> _Features:
        """The result of `compute` for this picture; computed once, however many metrics ask for it."""
        if compute not in self._features:
            self._features[compute] = compute(self.pixels)
        return cast("_Features", self._features[compute])


@final
@dataclass(frozen=True, eq=False)
class Comparison:
    """The layer that is scored, its ground truth, and the rest of the case.

    A metric "of" a rendered sample gets the transmissions, and always has a `reflection`.
    """

    prediction: CachedPicture
    truth: CachedPicture
    photo: Picture
    reflection: Picture | None = None
    """The ground truth of the reflection, if the case has one."""
    region: Region | None = None
    """The pixels to score, for a metric that is limited to the reflection region."""


@final
@dataclass(frozen=True)
class Metric:
    """A score: how to compute it, how to print it, and how to read it."""

    name: str
    title: str
    unit: str
    """"dB", or nothing for a pure number."""
    higher_is_better: bool
    digits: int
    """After the point, in tables."""
    about: str
    """The definition with its parameters, in one sentence."""
    of: Literal["transmission", "reflection", "rendered"]
    """Which truth it needs: the transmission, the reflection, or all layers of a rendered sample."""
    score: Callable[[Comparison], float]
    """Computes it; a ValueError says that it has no meaning here (no region, a picture too small)."""
    where: Literal["picture", "region"] = "picture"
    """Over the whole picture, or in the reflection region only."""
    prepare: Callable[[], object] | None = None
    """Loads what it needs (weights that may be missing), once, before anything is scored."""

    def to_dict(self) -> dict[str, Any]:
        """Its plain values but the name, for results.json."""
        keys = ("title", "unit", "higher_is_better", "digits", "about", "of", "where")
        return {key: getattr(self, key) for key in keys}
