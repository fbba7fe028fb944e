"""`Metric`, the row type of METRICS, and `Comparison`, the argument of its `score` function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, cast, final

from brewster.metrics.windows import Image, Region

_Features = TypeVar("_Features")
_Shared = TypeVar("_Shared")


@final
@dataclass(frozen=True, eq=False)
class CachedImage:
    """An image, uint8 sRGB (H, W, 3), with the features that metrics have computed from this
    image.
    """

    pixels: Image
    _features: dict[Callable[[Image], Any], Any] = field(default_factory=dict, repr=False)

    def features(self, compute: Callable[[Image], _Features]) -> _Features:
        """Returns the result of `compute` for this image. It is computed once and reused by all
        metrics.
        """
        if compute not in self._features:
            self._features[compute] = compute(self.pixels)
        return cast("_Features", self._features[compute])


@final
@dataclass(frozen=True, eq=False)
class Comparison:
    """The predicted layer to score, its ground truth, and the photo.

    If `ground_truth` is "rendered", `prediction` is the transmission, `truth` the background;
    `reflection` is not None.
    """

    prediction: CachedImage
    """The predicted layer."""
    truth: CachedImage
    """The ground truth of this layer."""
    photo: Image
    """The unprocessed photo, uint8 sRGB (H, W, 3)."""
    reflection: Image | None = None
    """The ground truth of the reflection; None if the case has none."""
    region: Region | None = None
    """The pixels to score for a metric whose `area` is "region"; otherwise None."""
    _shared: dict[Callable[[Comparison], Any], Any] = field(default_factory=dict, repr=False)

    def shared(self, compute: Callable[[Comparison], _Shared]) -> _Shared:
        """Returns the result of `compute` for this pair of images, which is computed once and
        reused by all metrics of the pair, with or without a region.

        Args:
            compute: a function of the comparison, whose result does not depend on the region.
        """
        if compute not in self._shared:
            self._shared[compute] = compute(self)
        return cast("_Shared", self._shared[compute])


@final
@dataclass(frozen=True)
class Metric:
    """A metric: its definition, its function, and the format of its values."""

    name: str
    """The key in METRICS and in results."""
    title: str
    """The heading in tables."""
    unit: str
    """"dB", or "" for a number without a unit."""
    higher_is_better: bool
    """Whether a higher value is a better one."""
    digits: int
    """The number of decimal places in tables."""
    definition: str
    """The definition with all parameters, in one or two sentences."""
    ground_truth: Literal["transmission", "reflection", "rendered"]
    """The ground truth that the metric needs: the transmission, the reflection, or all layers of a
    rendered sample.
    """
    score: Callable[[Comparison], float]
    """Computes the value. Raises ValueError for an empty region or a too small image."""
    area: Literal["image", "region"] = "image"
    """The pixels over which to average: the whole image ("image"), or the reflection region
    ("region").
    """
    prepare: Callable[[], object] | None = None
    """A function that loads the weights of the metric, so that missing weights are reported before
    the first score.
    """

    def to_dict(self) -> dict[str, Any]:
        """Returns all fields except the name and the functions, for results.json."""
        keys = ("title", "unit", "higher_is_better", "digits", "definition", "ground_truth", "area")
        return {key: getattr(self, key) for key in keys}
