"""Separates a photo into transmission and reflection at the size of the photo.

    separation = Separator.load("compact")("window.jpg")
    separation.transmission.save("clear.jpg")

The model predicts both layers from downscaled copies of the photo in linear light (predictor.py),
in tiles if they are large (tiles.py). guided_upsampling.py applies it at full size.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from itertools import islice
from typing import Any, Final, Unpack, final

import numpy as np

from brewster.errors import BrewsterError, MaskError, ModelError
from brewster.options import LoadOptions, Options, Quality, check_keywords
from brewster.photo import Encoding, Hints, Mask, Photo, Source
from brewster.photo.history import PHOTO, separation_parameters, with_layer_history
from brewster.separation.assessment import Assessment, assess, next_step
from brewster.separation.clipping import keep_clipped_light
from brewster.separation.guided_upsampling import Floats, GuidedUpsampler, upsample_layers
from brewster.separation.predictor import (
    MultiScalePredictor,
    Prediction,
    Predictor,
    ProgressCallback,
)
from brewster.separation.registry import find, plugin_errors
from brewster.separation.separation import Separation
from brewster.separation.tiles import Backend

_PREDICTOR_OPTIONS: Final = ("steps", "ensemble_size", "no_guided_upsampling")
_NETWORK_SHARE: Final = 0.6
"""Estimated time of the network divided by the total time, for the progress."""
_RESIZERS: Final = 2
"""The inputs of the network that are computed at the same time."""


@final
class Separator:
    """Separates photos with one model. Reusable and thread-safe.

    Args:
        model: a `Predictor`, or a `Backend`, which a `MultiScalePredictor` runs at several input
            scales.
        name: the name of the model, for `Separation.model`.
        sha256: the digest of the model file, for `Separation.sha256`.
        device: the device that runs the model, for `Separation.device`.
        method: how the layers were made from several photos, such as "burst"; recorded in them, and
            part of the name.
        is_calibrated: whether the verdicts were fitted to this model (bench/verdict.py). Others,
            and other qualities than "standard", never give "removed".
    """

    def __init__(
        self,
        model: Backend | Predictor,
        *,
        name: str = "custom",
        sha256: str | None = None,
        device: str = "cpu",
        method: str | None = None,
        is_calibrated: bool = False,
    ) -> None:
        if not callable(model):
            raise TypeError(
                f"the model is of type {type(model).__name__}; expected a function tile -> "
                "(transmission, reflection); pass one, or load a model by its name with "
                "Separator.load"
            )
        self._predictor = model if isinstance(model, Predictor) else MultiScalePredictor(model)
        self.name = f"{method} with {name}" if method else name
        self.sha256 = sha256
        self.device = device
        self._recorded = {"model": name, "burst": "no", **({"method": method} if method else {})}
        self.takes_hints = self._predictor.takes_hints
        self._is_calibrated = is_calibrated

    def __repr__(self) -> str:
        return f"Separator({self.name}, {self.device})"

    def for_burst(self, photo_count: int, **recorded: str) -> Separator:
        """Returns a copy whose layers record the number of photos of a burst, and other
        parameters.

        Args:
            photo_count: the number of photos of the burst.
            recorded: further parameters by name, for the metadata of the layers.
        """
        separator = copy(self)
        separator._recorded = self._recorded | {"burst": f"{photo_count} photos"} | recorded
        return separator

    @classmethod
    def load(cls, model: str = Options.model, **options: Unpack[LoadOptions]) -> Separator:
        """Loads a model and returns its separator.

        Args:
            model: a name from `brewster models list`, an .onnx file, the folder of a training run,
                or a LoRA's folder or hub id.
            options: those of `brewster.options.LoadOptions`: device ("auto" selects the fastest
                one), and for diffusion models those that `brewster separate --help` explains.

        Raises:
            ModelError: the model is unknown or damaged, or does not have an option that is set.
            DeviceError: the device is not available, or the model does not fit into its memory.
            DownloadError: a diffusion model cannot be downloaded, for example because access was
                not granted.
            MissingExtra: a diffusion model needs the extra `diffusion`.
            BrewsterError: the value of an option of a diffusion model is invalid.
            TypeError: there is no such option.
        """
        check_keywords(options, "load")
        changed: dict[str, Any] = {
            name: value for name, value in options.items() if value != getattr(Options, name)
        }
        device = changed.pop("device", Options.device)
        found = find(model)
        if unknown := [name for name in changed if name not in found.options]:
            raise ModelError(
                f"{', '.join(unknown)} was set for the model {model}",
                "expected a diffusion model or a LoRA for this option",
                "leave the option out, or choose such a model",
            )
        with plugin_errors(found.package):
            separator = found.load(device, **changed)
            if not isinstance(separator, cls):
                raise TypeError(f"load returned a {type(separator).__name__}, no Separator")
        return separator

    def many(
        self,
        sources: Iterable[Source],
        *,
        threads: int = 2,
        **options: Any,  # noqa: ANN401  (those of __call__)
    ) -> Iterator[Separation | BrewsterError]:
        """Separates many photos with several threads, and yields the results in the order of the
        sources.

        If a photo cannot be separated, its result is the error. At most `threads` + 1 photos are in
        memory, so that the sources can be endless.

        Args:
            sources: the photos; each is a source of `Photo.open`.
            threads: the number of photos that are separated at the same time.
            options: those of a call, for all photos.

        Raises:
            BrewsterError: `threads` is less than 1.
            TypeError: the sources are a single path or the bytes of a file.
        """
        if isinstance(sources, str | bytes):  # its characters would be the sources
            raise TypeError(
                f"sources is a single {type(sources).__name__}; expected an iterable; pass [source]"
            )
        if threads < 1:
            raise BrewsterError(
                f"threads is {threads}", "expected at least 1", "choose 1, 2 or more"
            )
        return self._many(iter(sources), threads, options)

    def _many(
        self, sources: Iterator[Source], threads: int, options: dict[str, Any]
    ) -> Iterator[Separation | BrewsterError]:
        def separate_one(source: Source) -> Separation | BrewsterError:
            try:
                return self(source, **options)
            except BrewsterError as error:
                return error

        with ThreadPoolExecutor(threads) as pool:
            running = deque(
                pool.submit(separate_one, source) for source in islice(sources, threads)
            )
            try:
                while running:
                    result = running.popleft().result()
                    running.extend(
                        pool.submit(separate_one, source) for source in islice(sources, 1)
                    )
                    yield result
            finally:  # the caller may stop early
                for future in running:
                    future.cancel()

    def __call__(
        self,
        source: Source,
        *,
        strength: float = Options.strength,
        quality: Quality = Options.quality,
        mask: Source | None = Options.mask,
        hints: Source | None = Options.hints,
        additive: bool = Options.additive,
        encoding: Encoding | None = None,
        max_pixels: int = Options.max_pixels,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> Separation:
        """Separates a photo. Thread-safe.

        Args:
            source: a path, the bytes of a file, an open binary file, a PIL image, a `Photo`, or an
                array.
            strength: how much of the separation to apply, from 0 (the unchanged photo) to 1.
            quality: the number and size of the input scales: "draft" is faster than "standard".
            mask: a grey image of the size of the photo that scales the strength: black stays
                unchanged.
            hints: an image of that size with rough strokes, red on the reflection, green where
                there is only the scene.
            additive: whether the layers sum to the photo exactly, as 32-bit floats in linear light.
            encoding: the encoding of an array, "srgb" or "linear"; by default, "srgb" for integers.
                For arrays only.
            max_pixels: refuse photos with more pixels than this, before they are decoded.
            on_progress: called with the completed fraction, 0 to 1. An exception raised in it stops
                the work.

        Raises PhotoError and TypeError for the source, MaskError for the mask or the hints,
        ModelError for an invalid output of the model, and BrewsterError for another option.
        """
        strength = Options(
            strength=strength, quality=quality
        ).strength  # checks and converts the values
        seconds: dict[str, float] = {}
        with timed(seconds, "decode"):
            photo = Photo.open(source, encoding=encoding, max_pixels=max_pixels)
            weights = None if mask is None else Mask.open(mask, photo.size)
            inputs, white = self._inputs(photo, quality, hints)
        on_progress(0.0)
        with timed(seconds, "network"):
            prediction = self._predict(
                inputs, quality, lambda done: on_progress(_NETWORK_SHARE * done)
            )
            largest_input = inputs[-1][..., :3]
        with timed(seconds, "upsampling"):
            upsampler = _fit_upsampler(largest_input, prediction, strength, white)
            transmission, reflection, residual = upsample_layers(
                photo,
                upsampler,
                weights,
                additive=additive,
                on_progress=lambda done: on_progress(_NETWORK_SHARE + (1 - _NETWORK_SHARE) * done),
            )
        parameters = separation_parameters(
            strength=strength, quality=quality, additive=additive, mask=mask, hints=hints
        )
        step = parameters | self._recorded
        step |= {"sha256": self.sha256[:12]} if self.sha256 else {}
        step |= {PHOTO: photo.file_info.digest} if photo.file_info.digest else {}
        assessment = self._assess(largest_input, prediction, quality, strength, weights)
        takes_hints = self.takes_hints and hints is None
        step_to_try = next_step(assessment.verdict, takes_hints=takes_hints) if strength else None
        return Separation(
            photo,
            with_layer_history(transmission, "transmission", step),
            with_layer_history(reflection, "reflection", step),
            prediction.confidence_map,
            residual,
            prediction.reconstruction_error,
            assessment,
            self.name,
            self.sha256,
            self.device,
            seconds,
            prediction.reflection_is_derived,
            step_to_try,
        )

    def fit(
        self,
        photo: Photo,
        *,
        quality: Quality = Options.quality,
        hints: Source | None = Options.hints,
        on_progress: ProgressCallback = lambda _fraction: None,
    ) -> tuple[GuidedUpsampler, Prediction, Assessment]:
        """Predicts the layers of a photo, but does not compute them at full size.

        Args:
            photo: the photo, decoded.
            quality: the number and size of the input scales, "draft" or "standard".
            hints: an image of the size of the photo: red for reflection, green for scene.
            on_progress: called with the completed fraction, 0..1.

        Returns:
            The upsampler at strength 1, the prediction, and its assessment.
        """
        Options(quality=quality)  # checks the value
        inputs, white = self._inputs(photo, quality, hints)
        prediction = self._predict(inputs, quality, on_progress)
        largest_input = inputs[-1][..., :3]
        upsampler = _fit_upsampler(largest_input, prediction, Options.strength, white)
        return upsampler, prediction, self._assess(largest_input, prediction, quality)

    def _predict(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        prediction = self._predictor(inputs, quality, on_progress)
        return (
            prediction
            if self._predictor.is_measured
            else keep_clipped_light(inputs[-1], prediction)
        )

    def _assess(
        self,
        largest_input: Floats,
        prediction: Prediction,
        quality: Quality,
        strength: float = Options.strength,
        mask: Mask | None = None,
    ) -> Assessment:
        height, width, _ = largest_input.shape
        return assess(
            largest_input,
            np.clip(largest_input + prediction.change, 0, 1),
            prediction.confidence_map,
            prediction.reconstruction_error,
            float(strength) if mask is None else np.float32(strength) * mask.sampled(width, height),
            is_calibrated=self._is_calibrated and quality == "standard",
        )

    def _inputs(
        self, photo: Photo, quality: Quality, hints: Source | None
    ) -> tuple[list[Floats], np.float32]:
        """The inputs of the model, smallest first, and the white level."""
        sizes = self._predictor.input_sizes(photo.size, quality)
        with ThreadPoolExecutor(_RESIZERS) as pool:
            inputs = list(pool.map(lambda size: photo.resized(*size), sizes))
        white = white_level(inputs[-1])
        inputs = [np.clip(scaled_input / white, 0, 1) for scaled_input in inputs]
        if hints is None:
            return inputs, white
        if not self.takes_hints:
            raise MaskError(
                f"hints were given to the model {self.name}, which takes none",
                "expected a model with an input for hints",
                "leave the hints out, or choose another model",
            )
        painted = Hints.open(hints, photo.size, photo)
        return [
            np.concatenate([each, painted.sampled(*each.shape[1::-1])], axis=2) for each in inputs
        ], white


def _fit_upsampler(
    largest_input: Floats, prediction: Prediction, strength: float, white: np.float32
) -> GuidedUpsampler:
    """Fits the upsampler to a prediction. It is scaled by the strength and the white level of the
    photo.
    """
    scale = np.float32(strength) * white
    override = prediction.override
    if override:
        override = replace(override, transmission=white * override.transmission, strength=strength)
    reflection = None if prediction.reflection_is_derived else scale * prediction.reflection
    return GuidedUpsampler.fit(
        white * largest_input, scale * prediction.change, reflection, override
    )


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the wall time of the block to `seconds[name]`."""
    started = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - started


def white_level(light: Floats) -> np.float32:
    """Returns the level by which linear light is divided before the network: 1, or a larger 99th
    percentile (EXR).
    """
    return np.float32(max(1.0, float(np.percentile(light, 99))))
