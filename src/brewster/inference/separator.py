"""Separates a photo into transmission and reflection at the size of the photo.

    separator = Separator.load("compact")
    separation = separator("window.jpg")
    separation.transmission.save("clear.jpg")

The model predicts both layers for small linear copies of the photo (predictor.py, or diffusion_predictor.py for
diffusion models; tiles.py splits inputs that are too large). guided_upsampling.py applies the prediction to the
photo at full size.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, final

import numpy as np

from brewster.errors import BrewsterError, MissingExtra, ModelError
from brewster.inference.assessment import Assessment, assess
from brewster.inference.guided_upsampling import Floats, GuidedUpsampler, upsample_rows
from brewster.inference.onnx_backend import OnnxBackend
from brewster.inference.predictor import (
    QUALITIES,
    MultiScalePredictor,
    Prediction,
    Predictor,
    ProgressCallback,
)
from brewster.inference.tiles import Backend
from brewster.models.zoo import find_model, is_large
from brewster.options import Options, Quality, Quantisation, document_options
from brewster.photo import Encoding, Mask, Photo, Source

if TYPE_CHECKING:
    from brewster.models.diffusion.pipeline import DecompositionPipeline

_WORKERS: Final = 2
_WHITE_PERCENTILE: Final = 99.0
"""If this percentile of the photo is above 1, as in an EXR, the input of the network is divided by it."""
_NETWORK_SHARE: Final = 0.6
"""Estimated fraction of the total time that the network takes, for the progress."""


@final
@dataclass(frozen=True)
class Separation:
    """The layers of a photo, each of the size of the photo, with the model, the device and the quality measures."""

    photo: Photo
    transmission: Photo
    reflection: Photo
    confidence_map: Floats = field(repr=False, compare=False)
    """Confidence in 0..1, (h, w, 1), at the size of the largest input of the network."""
    residual: float
    """Mean of |photo - transmission - reflection| in linear light."""
    reconstruction_error: float | None
    """Mean of |generated input - input|, sRGB-encoded, or None if the model does not generate the input."""
    assessment: Assessment
    """What the model found in the photo, at strength 1, and how reliable the result is."""
    model: str
    sha256: str | None
    device: str
    seconds: dict[str, float] = field(compare=False)
    """Wall time of the steps `decode`, `network` and `detail`."""
    reflection_is_derived: bool = False
    """Whether the reflection is photo - transmission in linear light, because the model predicts no reflection."""

    @cached_property
    def confidence(self) -> Photo:
        """The confidence as a grey 8-bit image of the size of the photo: 255 is certain. Computed on first use."""
        return _upsampled_confidence(self.confidence_map, self.photo)


@final
class Separator:
    """Separates photos with one model. Reusable and thread-safe.

    Args:
        model: a `Predictor`, or a `Backend`, which a `MultiScalePredictor` runs at several input scales.
        name: the name of the model, for `Separation.model`.
        sha256: the digest of the model file, for `Separation.sha256`.
        device: the device that runs the model, for `Separation.device`.
    """

    def __init__(
        self,
        model: Backend | Predictor,
        *,
        name: str = "custom",
        sha256: str | None = None,
        device: str = "cpu",
    ) -> None:
        self._predictor = model if isinstance(model, Predictor) else MultiScalePredictor(model)
        self.name, self.sha256, self.device = name, sha256, device

    @classmethod
    @document_options
    def load(
        cls,
        model: str = Options.model,
        *,
        device: str = Options.device,
        base: str | None = Options.base,
        quantise: Quantisation | None = Options.quantise,
        steps: int | None = Options.steps,
        average: int = Options.average,
        plain: bool = Options.plain,
    ) -> Separator:
        """Loads a model and returns its separator.

        Args:

        Raises:
            ModelError: the model is unknown or damaged, or an option of diffusion models is set for another model.
            DeviceError: the device is not available, or the model does not fit into its memory.
            DownloadError: a diffusion model cannot be downloaded, for example because access was not granted.
            MissingExtra: a diffusion model needs the extra `large`.
        """
        if is_large(model):
            pipeline = _open_pipeline(model, device, base, quantise)
            return cls._from_pipeline(pipeline, steps=steps, average=average, plain=plain)
        chosen = {"base": base, "quantise": quantise, "steps": steps, "average": average, "plain": plain}
        if changed := [name for name, value in chosen.items() if value != getattr(Options, name)]:
            raise ModelError(
                f"{', '.join(changed)} was set for the model {model}",
                "expected a diffusion model or a LoRA for this option",
                "leave the option out, or choose such a model",
            )
        model_file = find_model(model)
        digest = model_file.verify()
        backend = OnnxBackend(model_file.path, device)
        return cls(backend, name=model_file.name, sha256=digest, device=backend.device)

    @classmethod
    def _from_pipeline(
        cls, pipeline: DecompositionPipeline, *, steps: int | None, average: int, plain: bool
    ) -> Separator:
        from brewster.inference.diffusion_predictor import DiffusionPredictor  # noqa: PLC0415  (imports torch)

        predictor = DiffusionPredictor(pipeline, steps=steps, average=average, plain=plain)
        device = str(pipeline.backbone.device)
        return cls(predictor, name=pipeline.name, sha256=pipeline.sha256, device=device)

    @document_options
    def __call__(
        self,
        source: Source,
        *,
        strength: float = Options.strength,
        quality: Quality = Options.quality,
        mask: Source | None = Options.mask,
        additive: bool = Options.additive,
        encoding: Encoding | None = None,
        max_pixels: int = Options.max_pixels,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> Separation:
        """Separates a photo. Thread-safe.

        Args:
            source: a path, the bytes of a file, a PIL image, a `Photo`, or an array (see `Photo.from_array`).
            encoding: the encoding of an array, "srgb" or "linear"; for arrays only.
            on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops the work.

        Raises:
            PhotoError: the source cannot be read, or is too large.
            MaskError: the mask cannot be read, is not grey, or has another size than the photo.
            BrewsterError: strength or quality is out of range.
        """
        _check_options(strength, quality)
        seconds: dict[str, float] = {}
        with _timed(seconds, "decode"):
            photo = Photo.open(source, encoding=encoding, max_pixels=max_pixels)
            weights = None if mask is None else Mask.open(mask, photo.size)
            inputs, white = self._inputs(photo, quality)
        on_progress(0.0)
        with _timed(seconds, "network"):
            prediction = self._predictor(inputs, quality, lambda done: on_progress(_NETWORK_SHARE * done))
        with _timed(seconds, "detail"):
            upsampler = _fit_upsampler(inputs[-1], prediction, strength, white)
            transmission, reflection, residual = _upsample(
                photo, upsampler, weights, additive=additive, on_progress=on_progress
            )
        return Separation(
            photo,
            transmission,
            reflection,
            prediction.confidence_map,
            residual,
            prediction.reconstruction_error,
            _assess(inputs[-1], prediction),
            self.name,
            self.sha256,
            self.device,
            seconds,
            prediction.reflection_is_derived,
        )

    def fit(
        self,
        photo: Photo,
        *,
        quality: Quality = Options.quality,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> tuple[GuidedUpsampler, Prediction, Assessment]:
        """Predicts the layers of a photo, without computing them at full size.

        Args:
            photo: the photo.
            quality: as in a call.
            on_progress: as in a call.

        Returns:
            The upsampler at strength 1, which computes the layers of any rows of the photo; the prediction; and its
            assessment.

        Raises:
            BrewsterError: quality is out of range.
        """
        _check_options(Options.strength, quality)
        inputs, white = self._inputs(photo, quality)
        prediction = self._predictor(inputs, quality, on_progress)
        upsampler = _fit_upsampler(inputs[-1], prediction, Options.strength, white)
        return upsampler, prediction, _assess(inputs[-1], prediction)

    def _inputs(self, photo: Photo, quality: Quality) -> tuple[list[Floats], np.float32]:
        """Returns the inputs of the model in 0..1, smallest first, and the white level by which they are divided."""
        inputs = [photo.resized(*size) for size in self._predictor.input_sizes(photo.size, quality)]
        white = np.float32(max(1.0, float(np.percentile(inputs[-1], _WHITE_PERCENTILE))))
        return [np.clip(scaled_input / white, 0, 1) for scaled_input in inputs], white


@document_options
def separate(
    source: Source,
    *,
    model: str = Options.model,
    device: str = Options.device,
    strength: float = Options.strength,
    quality: Quality = Options.quality,
    mask: Source | None = Options.mask,
    additive: bool = Options.additive,
    encoding: Encoding | None = None,
    max_pixels: int = Options.max_pixels,
    base: str | None = Options.base,
    quantise: Quantisation | None = Options.quantise,
    steps: int | None = Options.steps,
    average: int = Options.average,
    plain: bool = Options.plain,
) -> Separation:
    """Separates one photo. For several photos, use `Separator.load` once and call the separator for each.

    Args:
        source: a path, the bytes of a file, a PIL image, a `Photo`, or an array (see `Photo.from_array`).
        encoding: the encoding of an array, "srgb" or "linear"; for arrays only.

    Raises:
        BrewsterError: an error of `Separator.load` or of a call of the `Separator`.
    """
    separator = Separator.load(
        model, device=device, base=base, quantise=quantise, steps=steps, average=average, plain=plain
    )
    return separator(
        source,
        strength=strength,
        quality=quality,
        mask=mask,
        additive=additive,
        encoding=encoding,
        max_pixels=max_pixels,
    )


def _open_pipeline(
    model: str, device: str, base: str | None, quantise: Quantisation | None
) -> DecompositionPipeline:
    try:
        from brewster.models.diffusion.pipeline import load_pipeline  # noqa: PLC0415  (imports torch)
    except ImportError as error:
        raise MissingExtra(
            f"{error.name} is not installed",
            f"expected it to be installed, because {model} needs it",
            "run: pip install 'brewster[large]'",
        ) from error
    return load_pipeline(model, device=device, base=base, quantise=quantise)


def _check_options(strength: float, quality: str) -> None:
    if not 0 <= strength <= 1:
        raise BrewsterError(
            f"strength is {strength}", "expected a number from 0 to 1", "choose a number in this range"
        )
    if quality not in QUALITIES:
        raise BrewsterError(
            f"quality is {quality!r}", f"expected one of {', '.join(QUALITIES)}", "choose one of them"
        )


def _assess(largest_input: Floats, prediction: Prediction) -> Assessment:
    transmission = np.clip(largest_input + prediction.change, 0, 1)
    return assess(largest_input, transmission, prediction.confidence_map, prediction.reconstruction_error)


def _fit_upsampler(
    largest_input: Floats, prediction: Prediction, strength: float, white: np.float32
) -> GuidedUpsampler:
    """Fits the upsampler to a prediction, scaled by the strength and by the white level `white` of the photo."""
    scale, override = np.float32(strength) * white, prediction.override
    if override:
        override = replace(override, transmission=white * override.transmission, strength=strength)
    reflection = None if prediction.reflection_is_derived else scale * prediction.reflection
    return GuidedUpsampler.fit(white * largest_input, scale * prediction.change, reflection, override)


def _upsample(
    photo: Photo,
    upsampler: GuidedUpsampler,
    mask: Mask | None,
    *,
    additive: bool,
    on_progress: ProgressCallback,
) -> tuple[Photo, Photo, float]:
    """Returns transmission, reflection and the mean residual. The layers are encoded like the photo, or as exact floats."""
    template = _float_template(photo) if additive else photo
    canvases = [np.empty(template.pixels.shape, template.pixels.dtype) for _ in range(2)]

    def fill(rows: slice) -> float:
        linear = photo.linear_rows(rows.start, rows.stop)
        weights = None if mask is None else mask.rows(rows.start, rows.stop)
        layers = upsampler.apply(linear, rows.start, photo.size[1], weights)
        stored = [template.stored_rows(layer, rows.start) for layer in layers]
        if additive:
            stored = _exact_sum_layers(template.stored_rows(linear, rows.start), stored[0])
        for canvas, layer in zip(canvases, stored, strict=True):
            canvas[rows] = layer
        return 0.0 if additive else float(np.abs(linear - layers[0] - layers[1]).sum(dtype=np.float64))

    strips, residual_sum = list(photo.strips()), 0.0
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done, strip_residual in enumerate(pool.map(fill, strips), 1):
            residual_sum += strip_residual
            on_progress(_NETWORK_SHARE + (1 - _NETWORK_SHARE) * done / len(strips))
    transmission, reflection = (template.with_pixels(canvas) for canvas in canvases)
    return transmission, reflection, residual_sum / (math.prod(photo.size) * 3)


def _float_template(photo: Photo) -> Photo:
    """Returns a black photo of the same size, 32-bit floats in linear light, with the alpha and EXIF of the photo."""
    file_info = replace(
        photo.file_info, container="tiff", bits=32, compression=None, icc=None, primaries=None, header=None
    )
    alpha = photo.alpha
    if alpha is not None and alpha.dtype.kind == "u":
        alpha = alpha / np.float32(np.iinfo(alpha.dtype).max)
    black = np.broadcast_to(np.float32(0), photo.pixels.shape)
    return Photo(black, alpha, file_info)


def _exact_sum_layers(photo: Floats, transmission: Floats) -> list[Floats]:
    """Returns transmission and reflection whose float sum is bit-equal to the photo.

    They are not negative where the photo is not negative.

    At least one of the two differences is exact (Sterbenz 1974), which makes the sum exact.
    """
    reflection = photo - np.minimum(transmission, photo)
    return [photo - reflection, reflection]


def _upsampled_confidence(map_: Floats, photo: Photo) -> Photo:
    """Upsamples a map (h, w, 1) in 0..1 to a grey 8-bit image of the size of the photo."""
    width, height = photo.size
    canvas = np.empty((height, width, 1), np.uint8)
    for rows in photo.strips():
        canvas[rows] = np.rint(255 * upsample_rows(map_, rows.start, rows.stop - rows.start, (height, width)))
    return Photo(canvas)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - started
