"""Scores the predictions for one case with all metrics. Regions and features of the ground truth are computed once."""

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
from brewster.metrics import CachedImage, Comparison, Image, Metric, Region
from brewster.photo import Photo

_DIGITS: Final = 6
"""Decimal places of the scores in scores.jsonl and results.json."""


@final
@dataclass(frozen=True, eq=False)
class CaseFiles:
    """The encoded bytes of a case by role: "photo", "transmission" and, if there is one, "reflection"."""

    case: Case
    data: Mapping[str, bytes]

    @classmethod
    def read(cls, case: Case) -> CaseFiles:
        """Reads the files of a case.

        Raises:
            PhotoError: a file cannot be read.
        """
        files = {"photo": case.photo, "transmission": case.ground_truth, "reflection": case.reflection}
        return cls(case, {role: file.read() for role, file in files.items() if file})

    def digests(self) -> list[str]:
        """Returns the SHA-256 of photo, transmission and reflection; "" if there is no reflection."""
        roles = ("photo", "transmission", "reflection")
        return [hashlib.sha256(self.data[role]).hexdigest() if role in self.data else "" for role in roles]


@final
@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A decoded case: the photo for the methods, and role -> image, 8-bit sRGB, uint8 (H, W, 3).

    The roles are "photo", "transmission" and, if there is one, "reflection".
    """

    case: Case
    photo: Photo
    images: Mapping[str, Image]

    @classmethod
    def open(cls, case: Case, config: EvaluationConfig) -> GroundTruth:
        """Reads and decodes a case.

        Raises:
            PhotoError: an image cannot be read, or the images differ in size.
        """
        return cls.decode(CaseFiles.read(case), config)

    @classmethod
    def decode(cls, files: CaseFiles, config: EvaluationConfig) -> GroundTruth:
        """Decodes the images of a case and downscales them to `config.size`.

        Raises:
            PhotoError: an image cannot be decoded, or the images differ in size.
        """
        case = files.case
        photos = {role: downscale(Photo.open(data), config.size) for role, data in files.data.items()}
        for role, photo in photos.items():
            _check_size(
                f"the {role} of {case.benchmark}/{case.name}",
                photo,
                photos["photo"].size,
                "replace the file in the benchmark",
            )
        return cls(case, photos["photo"], {role: photo.srgb_8bit() for role, photo in photos.items()})

    def region(self, threshold: float) -> Region:
        """Returns the reflection region, bool (H, W). `threshold` is a difference, as a fraction of full scale."""
        return metrics.reflection_region(
            self.images["photo"], self.images["transmission"], threshold=threshold
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
                    "run the method on photos of that size (with --size, they are in the folder inputs)",
                )


@final
class Scorer:
    """Scores the predictions for one case. It caches the regions and the features of the ground truth."""

    def __init__(self, truth: GroundTruth, config: EvaluationConfig) -> None:
        self._truth, self._config = truth, config
        self._cached_images = {role: CachedImage(image) for role, image in truth.images.items()}
        self._regions: dict[float, Region] = {}

    @cached_property
    def region_share(self) -> float:
        """The fraction of pixels in the reflection region of the first threshold, 0 to 1."""
        return round(float(self._region(self._config.thresholds[0]).mean()), _DIGITS)

    def score(self, prediction: MethodOutput) -> dict[str, float | None]:
        """Returns column -> score.

        A score is None if it is undefined, because the region is empty or the image is too small for the metric. There is
        no column if the metric compares a layer that the prediction or the ground truth does not have.
        """
        layers = {"transmission": CachedImage(prediction.transmission.srgb_8bit())}
        if prediction.reflection:
            layers["reflection"] = CachedImage(prediction.reflection.srgb_8bit())
        return {
            column: _round_or_none(lambda column=column, metric=metric: self._compute(column, metric, layers))  # type: ignore[misc]
            for column, metric in self._config.columns().items()
            if self._applies(metric, layers)
        }

    def _applies(self, metric: Metric, layers: Mapping[str, CachedImage]) -> bool:
        if metric.of == "rendered":
            return self._truth.case.rendered
        return metric.of in layers and metric.of in self._cached_images

    def _compute(self, column: str, metric: Metric, layers: Mapping[str, CachedImage]) -> float:
        layer = "transmission" if metric.of == "rendered" else metric.of
        images = self._truth.images
        region = self._region(self._config.threshold(column)) if metric.where == "region" else None
        return metric.score(
            Comparison(
                layers[layer], self._cached_images[layer], images["photo"], images.get("reflection"), region
            )
        )

    def _region(self, threshold: float) -> Region:
        if threshold not in self._regions:
            self._regions[threshold] = self._truth.region(threshold)
        return self._regions[threshold]


def _round_or_none(score: Callable[[], float]) -> float | None:
    """Returns the rounded score. Metrics raise ValueError if a score is undefined; the result is then None."""
    try:
        return round(score(), _DIGITS)
    except ValueError:
        return None


def downscale(photo: Photo, shorter: int | None) -> Photo:
    """Downscales a photo by area means in linear light, so that its shorter side has `shorter` px.

    Returns:
        The downscaled photo, 8-bit sRGB. The photo itself if it is not larger, or if `shorter` is None.
    """
    if shorter is None or min(photo.size) <= shorter:
        return photo
    width, height = (round(side * shorter / min(photo.size)) for side in photo.size)
    small = Photo.from_array(photo.resized(width, height), encoding="linear")
    return Photo.from_array(small.srgb_8bit(), encoding="srgb")


def _check_size(name: str, photo: Photo, size: tuple[int, int], suggestion: str) -> None:
    if photo.size != size:
        (width, height), (expected_width, expected_height) = photo.size, size
        raise PhotoError(
            f"{name} is {width}x{height}",
            f"expected {expected_width}x{expected_height}, the size of the photo",
            suggestion,
        )
