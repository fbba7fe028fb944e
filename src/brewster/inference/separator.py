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
_LOOKING: Final = 0.6
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
        return _enlarged(self.confidence_map, self.photo)


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
        self._look = model if isinstance(model, Predictor) else MultiScalePredictor(model)
        self.name, self.sha256, self.device = name, sha256, device

    @classmethod
    def load(
        cls, model: str = "compact", *, device: str = "auto", **large: Unpack[DiffusionOptions]
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
            return cls._load_large(model, device, large)
        if large:
            raise ModelError(
                f"{', '.join(large)} was asked of {model}",
                "a large image model or a LoRA",
                "leave it out, or name such a model",
            )
        found = find_model(model)
        digest = found.verify()
        backend = OnnxBackend(found.path, device)
        return cls(backend, name=found.name, sha256=digest, device=backend.device)

    @classmethod
    def _load_large(cls, model: str, device: str, asked: DiffusionOptions) -> Separator:
        try:
            from brewster.inference.diffusion_predictor import DiffusionPredictor  # noqa: PLC0415
            from brewster.models.diffusion.pipeline import load_pipeline  # noqa: PLC0415  (wakes torch)
        except ImportError as error:
            raise MissingExtra(
                f"{error.name} is not installed", f"{model} needs it", "pip install 'brewster[large]'"
            ) from error
        decomposer = load_pipeline(
            model, device=device, base=asked.get("base"), quantise=asked.get("quantise")
        )
        look = DiffusionPredictor(
            decomposer,
            steps=asked.get("steps"),
            average=asked.get("average", 1),
            plain=asked.get("plain", False),
        )
        where = str(decomposer.backbone.device)
        return cls(look, name=decomposer.name, sha256=decomposer.sha256, device=where)

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
        _check(strength, quality)
        seconds: dict[str, float] = {}
        with _clock(seconds, "decode"):
            photo = Photo.open(source, encoding=encoding, max_pixels=max_pixels)
            copies = [photo.small(*size) for size in self._look.sizes(photo.size, quality)]
            white = np.float32(max(1.0, float(np.percentile(copies[-1], _WHITE_PERCENTILE))))
            copies = [np.clip(copy / white, 0, 1) for copy in copies]
        on_progress(0.0)
        with _clock(seconds, "network"):
            seen = self._look(copies, quality, lambda done: on_progress(_LOOKING * done))
        with _clock(seconds, "detail"):
            transfer = _transfer(copies[-1], seen, strength, white)
            whole, mirrored, residual = _at_full_size(
                photo, transfer, additive=additive, on_progress=on_progress
            )
        made_by = self.name, self.sha256, self.device
        return Separation(
            photo,
            whole,
            mirrored,
            seen.confidence_map,
            residual,
            seen.reconstruction_error,
            *made_by,
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
    **large: Unpack[DiffusionOptions],
) -> Separation:
    """Separates one photograph; for many, `Separator.load` once and call it. Options and errors are theirs."""
    separator = Separator.load(model, device=device, **large)
    return separator(
        source,
        strength=strength,
        quality=quality,
        additive=additive,
        encoding=encoding,
        max_pixels=max_pixels,
    )


def _check(strength: float, quality: str) -> None:
    if not 0 <= strength <= 1:
        raise BrewsterError(f"strength is {strength}", "a number from 0 to 1", "choose one in that range")
    if quality not in QUALITIES:
        raise BrewsterError(f"quality is {quality!r}", f"one of {', '.join(QUALITIES)}", "choose one of them")


def _transfer(copy: Floats, seen: Prediction, strength: float, white: np.float32) -> GuidedUpsampler:
    """What was seen, as strong and as bright as it is asked for."""
    share, redrawn = np.float32(strength) * white, seen.redrawn
    if redrawn:
        redrawn = replace(redrawn, transmission=white * redrawn.transmission, strength=strength)
    return GuidedUpsampler.learn(white * copy, share * seen.change, share * seen.reflection, redrawn)


def _at_full_size(
    photo: Photo, transfer: GuidedUpsampler, *, additive: bool, on_progress: ProgressCallback
) -> tuple[Photo, Photo, float]:
    """Both layers, stored as the photo is or as exact floats, and the mean unexplained residual."""
    store = _as_floats(photo) if additive else photo
    canvases = [np.empty(store.pixels.shape, store.pixels.dtype) for _ in range(2)]

    def fill(rows: slice) -> float:
        linear = photo.linear_rows(rows.start, rows.stop)
        layers = transfer.apply(linear, rows.start, photo.size[1])
        stored = [store.stored_rows(layer, rows.start) for layer in layers]
        if additive:
            stored = _summing_exactly(store.stored_rows(linear, rows.start), stored[0])
        for canvas, layer in zip(canvases, stored, strict=True):
            canvas[rows] = layer
        return 0.0 if additive else float(np.abs(linear - layers[0] - layers[1]).sum(dtype=np.float64))

    strips, unexplained = list(photo.strips()), 0.0
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done, part in enumerate(pool.map(fill, strips), 1):
            unexplained += part
            on_progress(_LOOKING + (1 - _LOOKING) * done / len(strips))
    transmission, reflection = (store.with_pixels(canvas) for canvas in canvases)
    return transmission, reflection, unexplained / (math.prod(photo.size) * 3)


def _as_floats(photo: Photo) -> Photo:
    """The photo's like, black, in 32-bit floats of linear light, to be filled; alpha and EXIF are kept."""
    file_info = replace(
        photo.file_info, container="tiff", bits=32, compression=None, icc=None, primaries=None, header=None
    )
    alpha = photo.alpha
    if alpha is not None and alpha.dtype.kind == "u":
        alpha = alpha / np.float32(np.iinfo(alpha.dtype).max)
    black = np.broadcast_to(np.float32(0), photo.pixels.shape)
    return Photo(black, alpha, file_info)


def _summing_exactly(photo: Floats, transmission: Floats) -> list[Floats]:
    """Two layers, none negative where the photo is not, whose float sum is the photo to the last bit.

    Of the two differences at least one is exact (Sterbenz 1974), which makes the sum exact.
    """
    reflection = photo - np.minimum(transmission, photo)
    return [photo - reflection, reflection]


def _enlarged(map_: Floats, photo: Photo) -> Photo:
    """A map (h, w, 1) in 0..1 as a grey 8-bit picture of the photo's size."""
    width, height = photo.size
    canvas = np.empty((height, width, 1), np.uint8)
    for rows in photo.strips():
        canvas[rows] = np.rint(255 * enlarge_rows(map_, rows.start, rows.stop - rows.start, (height, width)))
    return Photo(canvas)


@contextmanager
def _clock(seconds: dict[str, float], name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - started
