"""Scores the predictions for one case with all metrics. Regions and features of the ground truth
are computed once.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, TypeVar, cast, final

import numpy as np
from numpy.typing import NDArray

from brewster import metrics
from brewster.errors import PhotoError
from brewster.evaluation.benchmarks.image_files import Case
from brewster.evaluation.config import EvaluationConfig
from brewster.evaluation.methods import MethodOutput
from brewster.evaluation.registration import find_misregistration
from brewster.metrics import CachedImage, Comparison, Image, Region
from brewster.photo import Photo

_Array = TypeVar("_Array", bound=NDArray[Any])
_DIGITS: Final = 6
"""Decimal places of the scores in scores.jsonl and results.json."""


def resize(photo: Photo, config: EvaluationConfig) -> Photo:
    """Downscales a photo to `config.short_side_px` by area means in linear light, then to multiples
    of `size_divisor`.

    The second step interpolates the 8-bit values by cubic convolution (a = -0.5, antialiased),
    first along the rows, as Pillow's `Image.resize` does by default: the test code of DSRNet, RDNet
    and XReflection uses it. The result is 8-bit sRGB, or the photo itself if both settings leave it
    as it is. A side is never enlarged.
    """
    shorter = config.short_side_px
    divisor = config.size_divisor
    if shorter is not None and shorter < min(photo.size):
        width, height = (round(side * shorter / min(photo.size)) for side in photo.size)
        small = Photo.from_array(photo.resized(width, height), encoding="linear")
        photo = Photo.from_array(small.srgb_8bit(), encoding="srgb")
    width, height = (max(side // divisor * divisor, min(side, divisor)) for side in photo.size)
    if (width, height) == photo.size:
        return photo
    import torch  # noqa: PLC0415 - an extra
    from torch.nn.functional import interpolate  # noqa: PLC0415

    pixels = torch.from_numpy(photo.srgb_8bit().copy()).permute(2, 0, 1)[None].double()
    for size in ((photo.size[1], width), (height, width)):
        pixels = (
            interpolate(pixels, size, mode="bicubic", antialias=True).add(0.5).floor().clamp(0, 255)
        )
    return Photo.from_array(pixels[0].byte().permute(1, 2, 0).numpy(), encoding="srgb")


@final
@dataclass(frozen=True, eq=False)
class CaseFiles:
    """The encoded bytes of a case by role: "photo", "transmission" and, if there is one,
    "reflection".
    """

    case: Case
    data: Mapping[str, bytes]

    @classmethod
    def read(cls, case: Case) -> CaseFiles:
        """Reads the files of a case. Raises PhotoError if a file cannot be read."""
        files = {
            "photo": case.photo,
            "transmission": case.ground_truth,
            "reflection": case.reflection,
        }
        return cls(case, {role: file.read() for role, file in files.items() if file})

    def digests(self) -> list[str]:
        """Returns the SHA-256 of photo, transmission and reflection; "" if there is no
        reflection.
        """
        data = (self.data.get(role) for role in ("photo", "transmission", "reflection"))
        return [hashlib.sha256(content).hexdigest() if content else "" for content in data]


@final
@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A decoded case: the photo for the methods, and role of `CaseFiles` -> image, 8-bit sRGB,
    uint8 (H, W, 3).
    """

    case: Case
    photo: Photo
    images: Mapping[str, Image]

    @classmethod
    def open(cls, case: Case, config: EvaluationConfig) -> GroundTruth:
        """Reads and decodes a case. Raises PhotoError if an image cannot be read, or the images
        differ in size.
        """
        return cls.decode(CaseFiles.read(case), config)

    @classmethod
    def decode(cls, files: CaseFiles, config: EvaluationConfig) -> GroundTruth:
        """Decodes the images of a case and resizes them as `config` says. Raises PhotoError if one
        is damaged, or sizes differ."""
        case = files.case
        photos = {role: resize(Photo.open(data), config) for role, data in files.data.items()}
        for role, photo in photos.items():
            name = f"the {role} of {case.benchmark}/{case.name}"
            _check_size(name, photo, photos["photo"].size, "replace the file in the benchmark")
        return cls(
            case, photos["photo"], {role: photo.srgb_8bit() for role, photo in photos.items()}
        )

    def region(self, threshold: float) -> Region:
        """Returns the reflection region, bool (H, W). `threshold` is a difference, as a fraction of
        full scale.
        """
        photo = self.images["photo"]
        transmission = self.images["transmission"]
        return metrics.reflection_region(photo, transmission, threshold=threshold)

    def check(self, prediction: MethodOutput, name: str) -> None:
        """Checks the size of a prediction. Raises PhotoError if a layer differs from the photo in
        size.
        """
        for layer in ("transmission", "reflection"):
            if photo := getattr(prediction, layer):
                what = f"{name}'s {layer} of {self.case.benchmark}/{self.case.name}"
                cure = (
                    "run the method on photos of that size (if photos are resized, they are "
                    "in the folder inputs)"
                )
                _check_size(what, photo, self.photo.size, cure)


@final
class Scorer:
    """Scores the predictions for one case. It caches the regions and the features of the ground
    truth.
    """

    def __init__(self, truth: GroundTruth, config: EvaluationConfig) -> None:
        self._truth = truth
        self._config = config
        self._images = {role: self._inside(image) for role, image in truth.images.items()}
        self._cached_images = {role: CachedImage(image) for role, image in self._images.items()}

    @cached_property
    def region_share(self) -> float:
        """The fraction of pixels in the reflection region, 0 to 1."""
        return round(float(self._region.mean()), _DIGITS)

    def registration(self, prediction: MethodOutput) -> str:
        """Returns how the transmission is flipped or shifted against the photo, "" if it is not."""
        return find_misregistration(
            prediction.transmission.srgb_8bit(), self._truth.images["photo"]
        )

    def score(
        self, prediction: MethodOutput, columns: Iterable[str] | None = None
    ) -> dict[str, float | None]:
        """Returns column -> score, for all columns of the evaluation or for some of them. A score
        is None if it is undefined, because the region is empty or the image is too small for the
        metric. There is no column if the metric compares a layer that the prediction or the ground
        truth does not have.
        """
        layers = {"transmission": prediction.transmission, "reflection": prediction.reflection}
        comparisons = {
            layer: Comparison(
                CachedImage(self._inside(photo.srgb_8bit())),
                self._cached_images[layer],
                self._images["photo"],
                self._images.get("reflection"),
            )
            for layer, photo in layers.items()
            if photo and layer in self._cached_images
        }
        if self._truth.case.rendered:
            comparisons["rendered"] = comparisons["transmission"]
        all_columns = self._config.columns()
        scores: dict[str, float | None] = {}
        for column in all_columns if columns is None else columns:
            metric = all_columns[column]
            if comparison := comparisons.get(metric.ground_truth):
                if metric.area == "region":
                    comparison = replace(comparison, region=self._region)
                scores[column] = None
                with contextlib.suppress(ValueError):  # the score is undefined
                    scores[column] = round(metric.score(comparison), _DIGITS)
        return scores

    def _inside(self, image: _Array) -> _Array:
        """The part of an image or region that is scored. It has no pixels if the border covers the
        image.
        """
        border = self._config.border
        inside = np.s_[border : len(image) - border, border : image.shape[1] - border]
        return cast("_Array", image[inside]) if border else image

    @cached_property
    def _region(self) -> Region:
        return self._inside(self._truth.region(self._config.threshold))


def _check_size(name: str, photo: Photo, size: tuple[int, int], suggestion: str) -> None:
    if photo.size != size:
        found, expected = ("x".join(map(str, sides)) for sides in (photo.size, size))
        raise PhotoError(
            f"{name} is {found}", f"expected {expected}, the size of the photo", suggestion
        )
