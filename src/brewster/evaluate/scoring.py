"""Scores: one case, all answers to it, every metric. The truth's features and regions are computed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

from brewster import metrics
from brewster.benchmarks.registry import Case
from brewster.errors import PhotoError
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.methods import MethodOutput
from brewster.metrics import CachedPicture, Comparison, Metric, Picture, Region
from brewster.photo import Photo

_DIGITS: Final = 6


@final
@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A case as it is measured: the photo that methods see, and uint8 sRGB pictures (H, W, 3) to compare with."""

    case: Case
    photo: Photo
    pictures: Mapping[str, Picture]

    @classmethod
    def open(cls, case: Case, protocol: EvaluationConfig) -> GroundTruth:
        """Reads the pictures of a case, reduced as the protocol says.

        Raises:
            PhotoError: one cannot be read, or they differ in size.
        """
        files = {"photo": case.photo, "transmission": case.transmission, "reflection": case.reflection}
        photos = {
            role: reduced(Photo.open(file.read()), protocol.size) for role, file in files.items() if file
        }
        for role, photo in photos.items():
            _refuse_size(
                f"the {role} of {case.benchmark}/{case.name}",
                photo,
                photos["photo"].size,
                "mend the benchmark",
            )
        return cls(case, photos["photo"], {role: photo.srgb_8bit() for role, photo in photos.items()})

    def region(self, threshold: float) -> Region:
        """Where the reflection is, bool (H, W)."""
        return metrics.reflection_region(
            self.pictures["photo"], self.pictures["transmission"], threshold=threshold
        )

    def check(self, answer: MethodOutput, name: str) -> None:
        """Refuses an answer of another size.

        Raises:
            PhotoError: so it is.
        """
        for layer, photo in (("transmission", answer.transmission), ("reflection", answer.reflection)):
            if photo:
                _refuse_size(
                    f"{name}'s {layer} of {self.case.benchmark}/{self.case.name}",
                    photo,
                    self.photo.size,
                    "make it again at that size; with --size, from the photos in inputs/ beside the results",
                )


@final
class Scorer:
    """Scores answers to one case; what depends on the truth exclusive is computed once."""

    def __init__(self, truth: GroundTruth, protocol: EvaluationConfig) -> None:
        self._truth, self._protocol = truth, protocol
        self._pictures = {role: CachedPicture(picture) for role, picture in truth.pictures.items()}
        self._regions: dict[float, Region] = {}

    @cached_property
    def region_share(self) -> float:
        """The share of the picture that the reflection region takes, by the first threshold."""
        return round(float(self._region(self._protocol.thresholds[0]).mean()), _DIGITS)

    def score(self, answer: MethodOutput) -> dict[str, float | None]:
        """column -> score; None where it has no meaning: no region, no such layer, a picture too small."""
        layers = {"transmission": CachedPicture(answer.transmission.srgb_8bit())}
        if answer.reflection:
            layers["reflection"] = CachedPicture(answer.reflection.srgb_8bit())
        return {
            column: _or_none(lambda column=column, metric=metric: self._measure(column, metric, layers))  # type: ignore[misc]
            for column, metric in self._protocol.columns().items()
            if self._has_meaning(metric, layers)
        }

    def _has_meaning(self, metric: Metric, layers: Mapping[str, CachedPicture]) -> bool:
        if metric.of == "rendered":
            return self._truth.case.rendered
        return metric.of in layers and metric.of in self._pictures

    def _measure(self, column: str, metric: Metric, layers: Mapping[str, CachedPicture]) -> float:
        layer = "transmission" if metric.of == "rendered" else metric.of
        truths = self._truth.pictures
        region = self._region(self._protocol.threshold(column)) if metric.where == "region" else None
        return metric.score(
            Comparison(
                layers[layer], self._pictures[layer], truths["photo"], truths.get("reflection"), region
            )
        )

    def _region(self, threshold: float) -> Region:
        if threshold not in self._regions:
            self._regions[threshold] = self._truth.region(threshold)
        return self._regions[threshold]


def _or_none(measure: Callable[[], float]) -> float | None:
    try:
        return round(measure(), _DIGITS)
    except ValueError:
        return None


def reduced(photo: Photo, shorter: int | None) -> Photo:
    """The photo, its shorter side at most so many px, as 8-bit sRGB."""
    if shorter is None or min(photo.size) <= shorter:
        return photo
    width, height = (round(side * shorter / min(photo.size)) for side in photo.size)
    small = Photo.from_array(photo.resized(width, height), encoding="linear")
    return Photo.from_array(small.srgb_8bit(), encoding="srgb")


def _refuse_size(name: str, photo: Photo, size: tuple[int, int], cure: str) -> None:
    if photo.size != size:
        (width, height), (wanted, tall) = photo.size, size
        raise PhotoError(f"{name} is {width}x{height}", f"{wanted}x{tall}, as the photo", cure)
