"""Scores the predictions for one case in every metric. What depends on the ground truth alone is computed once."""

from __future__ import annotations

import hashlib
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
class CaseFiles:
    """The encoded bytes of a case by role: "photo", "transmission" and, if there is one, "reflection"."""

    case: Case
    data: Mapping[str, bytes]

    @classmethod
    def read(cls, case: Case) -> CaseFiles:
        """Opens and reads each file once.

        Raises:
            PhotoError: a file cannot be read.
        """
        files = {"photo": case.photo, "transmission": case.ground_truth, "reflection": case.reflection}
        return cls(case, {role: file.read() for role, file in files.items() if file})

    def digests(self) -> list[str]:
        """SHA-256 of photo, transmission and reflection; "" if there is no reflection."""
        roles = ("photo", "transmission", "reflection")
        return [hashlib.sha256(self.data[role]).hexdigest() if role in self.data else "" for role in roles]


@final
@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A decoded case: the photo that methods receive, and 8-bit sRGB pictures by role, uint8 (H, W, 3)."""

    case: Case
    photo: Photo
    pictures: Mapping[str, Picture]

    @classmethod
    def open(cls, case: Case, config: EvaluationConfig) -> GroundTruth:
        """Reads and decodes a case.

        Raises:
            PhotoError: a picture cannot be read, or the pictures differ in size.
        """
        return cls.decode(CaseFiles.read(case), config)

    @classmethod
    def decode(cls, files: CaseFiles, config: EvaluationConfig) -> GroundTruth:
        """Decodes the pictures of a case and downscales them to `config.size`.

        Raises:
            PhotoError: a picture cannot be decoded, or the pictures differ in size.
        """
        case = files.case
        photos = {role: downscale(Photo.open(data), config.size) for role, data in files.data.items()}
        for role, photo in photos.items():
            _check_size(
                f"the {role} of {case.benchmark}/{case.name}",
                photo,
                photos["photo"].size,
                "correct the benchmark's files",
            )
        return cls(case, photos["photo"], {role: photo.srgb_8bit() for role, photo in photos.items()})

    def region(self, threshold: float) -> Region:
        """The reflection region, bool (H, W)."""
        return metrics.reflection_region(
            self.pictures["photo"], self.pictures["transmission"], threshold=threshold
        )

    def check(self, prediction: MethodOutput, name: str) -> None:
        """Checks the size of a prediction.

        Raises:
            PhotoError: a layer differs from the photo in size.
        """
        for layer, photo in (
            ("transmission", prediction.transmission),
            ("reflection", prediction.reflection),
        ):
            if photo:
                _check_size(
                    f"{name}'s {layer} of {self.case.benchmark}/{self.case.name}",
                    photo,
                    self.photo.size,
                    "predict at that size; with --size, use the photos in the folder inputs/ as input",
                )


@final
class Scorer:
    """Scores predictions for one case. Regions and features of the ground truth are computed once."""

    def __init__(self, truth: GroundTruth, config: EvaluationConfig) -> None:
        self._truth, self._protocol = truth, config
        self._pictures = {role: CachedPicture(picture) for role, picture in truth.pictures.items()}
        self._regions: dict[float, Region] = {}

    @cached_property
    def region_share(self) -> float:
        """The share of pixels in the reflection region of the first threshold, 0 to 1."""
        return round(float(self._region(self._protocol.thresholds[0]).mean()), _DIGITS)

    def score(self, prediction: MethodOutput) -> dict[str, float | None]:
        """column -> score; None if it is undefined: the region is empty, or the picture is too small for the metric.

        Columns are left out if the prediction or the ground truth has no such layer.
        """
        layers = {"transmission": CachedPicture(prediction.transmission.srgb_8bit())}
        if prediction.reflection:
            layers["reflection"] = CachedPicture(prediction.reflection.srgb_8bit())
        return {
            column: _or_none(lambda column=column, metric=metric: self._measure(column, metric, layers))  # type: ignore[misc]
            for column, metric in self._protocol.columns().items()
            if self._applies(metric, layers)
        }

    def _applies(self, metric: Metric, layers: Mapping[str, CachedPicture]) -> bool:
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


def downscale(photo: Photo, shorter: int | None) -> Photo:
    """The photo with its shorter side reduced to `shorter` px by area means in linear light, as 8-bit sRGB.

    A smaller photo, or any photo if `shorter` is None, is returned unchanged.
    """
    if shorter is None or min(photo.size) <= shorter:
        return photo
    width, height = (round(side * shorter / min(photo.size)) for side in photo.size)
    small = Photo.from_array(photo.resized(width, height), encoding="linear")
    return Photo.from_array(small.srgb_8bit(), encoding="srgb")


def _check_size(name: str, photo: Photo, size: tuple[int, int], cure: str) -> None:
    if photo.size != size:
        (width, height), (wanted, tall) = photo.size, size
        raise PhotoError(
            f"{name} is {width}x{height}", f"expected {wanted}x{tall}, the size of the photo", cure
        )
