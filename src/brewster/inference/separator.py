"""A photograph in, two layers out, at the photo's own size.

    separator = Separator.load("compact")
    separation = separator("window.jpg")
    separation.transmission.save("clear.jpg")

The model looks at small linear copies of the photo (look.py; generate.py for large image models; tiles.py cuts what
is too large for it), and detail.py brings its answer to full size.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, Unpack, final

import numpy as np

from brewster.errors import BrewsterError, MissingExtra, ModelError
from brewster.inference.guided_upsampling import Floats, GuidedUpsampler, enlarge_rows
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
from brewster.options import DiffusionOptions, Quality
from brewster.photo import DEFAULT_MAX_PIXELS, Encoding, Photo, Source

RECONSTRUCTION_ERROR_LIMIT: Final = 0.06
"""Beyond this reconstruction_error a separation is doubtful: three times what the VAEs of large models lose by themselves."""
_WORKERS: Final = 2
_WHITE_PERCENTILE: Final = 99.0
"""Of a photo brighter than white, such as an EXR, this percentile is shown to the network as white."""
_NETWORK_SHARE: Final = 0.6
"""The share of the work that is told as done when the network has answered: an estimate for those who wait."""


@final
@dataclass(frozen=True)
class Separation:
    """The answer: all pictures have the photo's size; how it was made stands beside them."""

    photo: Photo
    transmission: Photo
    reflection: Photo
    confidence_map: Floats = field(repr=False, compare=False)
    """How sure the looks were, (h, w, 1) in 0..1, as small as the network saw the photo."""
    residual: float
    """Mean of |photo - transmission - reflection| in linear light: what neither layer explains."""
    reconstruction_error: float | None
    """How far the model redraws the photo itself: mean difference, sRGB-encoded; None where it draws no photo."""
    model: str
    sha256: str | None
    device: str
    seconds: dict[str, float] = field(compare=False)
    """Wall time of decode, network and detail transfer."""

    @property
    def doubtful(self) -> bool:
        """Whether the model redrew the photo so freely that its layers may be of another scene: look at them."""
        return (
            self.reconstruction_error is not None and self.reconstruction_error > RECONSTRUCTION_ERROR_LIMIT
        )

    @cached_property
    def confidence(self) -> Photo:
        """Grey, 8 bit: 255 where the separation is sure of the transmission. Enlarged when it is first asked for."""
        return _upsampled_confidence(self.confidence_map, self.photo)


@final
class Separator:
    """A reusable, thread-safe callable around one `Backend`, or any other way to `Predictor`."""

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
    def load(
        cls, model: str = "compact", *, device: str = "auto", **diffusion_options: Unpack[DiffusionOptions]
    ) -> Separator:
        """A separator by the name of a model in the zoo, the path of an .onnx file, or a large image model.

        Args:
            model: "compact", an .onnx file, a LoRA's folder or hub id, or a backbone's ("kontext", "klein", "qwen").
            device: where it runs; "auto" takes the fastest device that is there.
            large: of large models only: `base`, where a LoRA's base lies, if not where it was trained; `quantise`,
                "int8", "float8" or "nf4", by default as for the LoRA's training; `steps` for each look, by default
                the paper's 20, and 4 for quality "draft"; `average`, how many answers are averaged; `plain`, the
                transmission as the model draws it, without the photo's own detail.

        Raises:
            ModelError: no such model, a damaged one, or options of large models for a small one.
            DeviceError: the asked device is not available, or a large model does not fit into its memory.
            DownloadError: a large model cannot be downloaded; says how to ask for access.
            MissingExtra: a large model needs the extra `large`.
        """
        if is_large(model):
            return cls._load_diffusion(model, device, diffusion_options)
        if diffusion_options:
            raise ModelError(
                f"{', '.join(diffusion_options)} was asked of {model}",
                "a large image model or a LoRA",
                "leave it out, or name such a model",
            )
        model_file = find_model(model)
        digest = model_file.verify()
        backend = OnnxBackend(model_file.path, device)
        return cls(backend, name=model_file.name, sha256=digest, device=backend.device)

    @classmethod
    def _load_diffusion(cls, model: str, device: str, diffusion_options: DiffusionOptions) -> Separator:
        try:
            from brewster.inference.diffusion_predictor import DiffusionPredictor  # noqa: PLC0415
            from brewster.models.diffusion.pipeline import open_decomposer  # noqa: PLC0415  (wakes torch)
        except ImportError as error:
            raise MissingExtra(
                f"{error.name} is not installed", f"{model} needs it", "pip install 'brewster[large]'"
            ) from error
        pipeline = open_decomposer(
            model,
            device=device,
            base=diffusion_options.get("base"),
            quantise=diffusion_options.get("quantise"),
        )
        predictor = DiffusionPredictor(
            pipeline,
            steps=diffusion_options.get("steps"),
            average=diffusion_options.get("average", 1),
            plain=diffusion_options.get("plain", False),
        )
        where = str(pipeline.backbone.device)
        return cls(predictor, name=pipeline.name, sha256=pipeline.sha256, device=where)

    def __call__(
        self,
        source: Source,
        *,
        strength: float = 1.0,
        quality: Quality = "standard",
        additive: bool = False,
        encoding: Encoding | None = None,
        max_pixels: int = DEFAULT_MAX_PIXELS,
        on_progress: ProgressCallback = lambda _share: None,
    ) -> Separation:
        """Separates a photograph; safe to call from many threads at once.

        Args:
            source: a path, the bytes of a file, a PIL image, a `Photo`, or an array (see `Photo.from_array`).
            strength: 0 returns the photo itself, 1 the whole separation; between, a share of it.
            quality: how many copies of the photo the network sees, and how large.
            additive: layers of 32-bit floats that sum to the photo exactly in linear light, for compositing.
            encoding: what an array's numbers mean, "srgb" or "linear".
            max_pixels: larger pictures are refused before they are decoded.
            on_progress: called with the share that is done, 0 to 1; an exception that it raises stops the work.

        Raises:
            PhotoError: the source cannot be read, or is too large.
            BrewsterError: strength or quality out of range.
        """
        _check_options(strength, quality)
        seconds: dict[str, float] = {}
        with _timed(seconds, "decode"):
            photo = Photo.open(source, encoding=encoding, max_pixels=max_pixels)
            inputs = [photo.resized(*size) for size in self._predictor.input_sizes(photo.size, quality)]
            white = np.float32(max(1.0, float(np.percentile(inputs[-1], _WHITE_PERCENTILE))))
            inputs = [np.clip(largest_input / white, 0, 1) for largest_input in inputs]
        on_progress(0.0)
        with _timed(seconds, "network"):
            prediction = self._predictor(inputs, quality, lambda done: on_progress(_NETWORK_SHARE * done))
        with _timed(seconds, "detail"):
            upsampler = _fit_upsampler(inputs[-1], prediction, strength, white)
            transmission, reflection, residual = _upsample(
                photo, upsampler, additive=additive, on_progress=on_progress
            )
        model_info = self.name, self.sha256, self.device
        return Separation(
            photo,
            transmission,
            reflection,
            prediction.confidence_map,
            residual,
            prediction.reconstruction_error,
            *model_info,
            seconds,
        )


def separate(
    source: Source,
    *,
    model: str = "compact",
    device: str = "auto",
    strength: float = 1.0,
    quality: Quality = "standard",
    additive: bool = False,
    encoding: Encoding | None = None,
    max_pixels: int = DEFAULT_MAX_PIXELS,
    **diffusion_options: Unpack[DiffusionOptions],
) -> Separation:
    """Separates one photograph; for many, `Separator.load` once and call it. Options and errors are theirs."""
    separator = Separator.load(model, device=device, **diffusion_options)
    return separator(
        source,
        strength=strength,
        quality=quality,
        additive=additive,
        encoding=encoding,
        max_pixels=max_pixels,
    )


def _check_options(strength: float, quality: str) -> None:
    if not 0 <= strength <= 1:
        raise BrewsterError(f"strength is {strength}", "a number from 0 to 1", "choose one in that range")
    if quality not in QUALITIES:
        raise BrewsterError(f"quality is {quality!r}", f"one of {', '.join(QUALITIES)}", "choose one of them")


def _fit_upsampler(
    largest_input: Floats, prediction: Prediction, strength: float, white: np.float32
) -> GuidedUpsampler:
    """What was seen, as strong and as bright as it is asked for."""
    scale, override = np.float32(strength) * white, prediction.override
    if override:
        override = replace(override, transmission=white * override.transmission, strength=strength)
    return GuidedUpsampler.fit(
        white * largest_input, scale * prediction.change, scale * prediction.reflection, override
    )


def _upsample(
    photo: Photo, upsampler: GuidedUpsampler, *, additive: bool, on_progress: ProgressCallback
) -> tuple[Photo, Photo, float]:
    """Both layers, stored as the photo is or as exact floats, and the mean unexplained residual."""
    template = _float_template(photo) if additive else photo
    canvases = [np.empty(template.pixels.shape, template.pixels.dtype) for _ in range(2)]

    def fill(rows: slice) -> float:
        linear = photo.linear_rows(rows.start, rows.stop)
        layers = upsampler.apply(linear, rows.start, photo.size[1])
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
    """The photo's like, black, in 32-bit floats of linear light, to be filled; alpha and EXIF are kept."""
    file_info = replace(
        photo.file_info, container="tiff", bits=32, compression=None, icc=None, primaries=None, header=None
    )
    alpha = photo.alpha
    if alpha is not None and alpha.dtype.kind == "u":
        alpha = alpha / np.float32(np.iinfo(alpha.dtype).max)
    black = np.broadcast_to(np.float32(0), photo.pixels.shape)
    return Photo(black, alpha, file_info)


def _exact_sum_layers(photo: Floats, transmission: Floats) -> list[Floats]:
    """Two layers, none negative where the photo is not, whose float sum is the photo to the last bit.

    Of the two differences at least one is exact (Sterbenz 1974), which makes the sum exact.
    """
    reflection = photo - np.minimum(transmission, photo)
    return [photo - reflection, reflection]


def _upsampled_confidence(map_: Floats, photo: Photo) -> Photo:
    """A map (h, w, 1) in 0..1 as a grey 8-bit picture of the photo's size."""
    width, height = photo.size
    canvas = np.empty((height, width, 1), np.uint8)
    for rows in photo.strips():
        canvas[rows] = np.rint(255 * enlarge_rows(map_, rows.start, rows.stop - rows.start, (height, width)))
    return Photo(canvas)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - started
