"""Predicts layers with a diffusion model, which generates them as panels of one image.

Generated panels differ from the photo in colour and detail. If the model also generates panel I, it
has about the errors of panel T, so the change is T - I, and guided_upsampling.py applies it to the
real photo.
"""

import itertools
from collections.abc import Callable, Sequence
from threading import Lock
from typing import Final, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from brewster.diffusion.pipeline import DecompositionPipeline
from brewster.diffusion.task import PanelFit
from brewster.errors import ModelError
from brewster.options import Quality
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.guided_upsampling import Floats, GeneratedOverride
from brewster.separation.predictor import (
    Prediction,
    Predictor,
    ProgressCallback,
    confidence_from_spread,
)
from brewster.separation.tiles import run_tiled, tile_slices

_DRAFT_STEPS: Final = 4
_SQUARE_TILE_OVERLAP_DIVISOR: Final = 12
"""Square tiles overlap by at least their side divided by this: 64 of 768 pixels, as in WindowSeat.
"""


@final
class DiffusionPredictor(Predictor):
    """Runs a `DecompositionPipeline` on one copy of the photo: as a whole, or in square tiles if
    the task has them.

    The prediction is the mean of `ensemble_size` samples, which has less invented detail. With
    `no_guided_upsampling`, the transmission is the generated panel. `steps` is by default that of
    the task, and at most 4 for quality "draft". Raises ModelError if a number is below 1, or set
    for a one-step model.
    """

    def __init__(
        self,
        pipeline: DecompositionPipeline,
        *,
        steps: int | None = None,
        ensemble_size: int = 1,
        no_guided_upsampling: bool = False,
    ) -> None:
        given = f"steps = {steps}, ensemble_size = {ensemble_size}"
        if (steps is not None and steps < 1) or ensemble_size < 1:
            raise ModelError(given, "expected both to be at least 1", "set them to 1 or more")
        if pipeline.task.objective != "flow" and (steps not in (None, 1) or ensemble_size > 1):
            raise ModelError(
                f"{given} were set for a one-step model",
                "expected neither, because it takes one step and is deterministic",
                "leave them out",
            )
        self._pipeline = pipeline
        self._no_guided_upsampling = no_guided_upsampling
        self._task = pipeline.task
        self._size_divisor = pipeline.backbone.size_divisor
        self._steps = steps
        self._seeds = range(ensemble_size)
        self._lock = Lock()

    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:  # noqa: ARG002
        """Returns the (width, height) of the only input."""
        return [self._task.input_size(size, self._size_divisor)]

    def __call__(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """Returns the prediction for the only input."""
        (scaled_input,) = inputs
        height, width, _ = scaled_input.shape
        steps = self._sampling_steps(quality)
        side = min(height, width) if self._task.square_tiles else max(height, width)
        tiling = {"tile_px": side, "overlap_px": side // _SQUARE_TILE_OVERLAP_DIVISOR}
        tiles = len(tile_slices((height, width), **tiling))
        started = itertools.count()

        def predict_tile(tile: Floats) -> tuple[Floats, ...]:
            index = next(started)
            return self._predict_tile(
                tile, steps, lambda done, of: on_progress((index + done / of) / tiles)
            )

        with self._lock:  # two predictions at the same time would need twice the GPU memory
            change, reflection, generated_transmission, spread, reconstruction_error = run_tiled(
                predict_tile, scaled_input, **tiling
            )
        override = None
        mean_error = None
        if self._reconstructs_input:
            override = GeneratedOverride.weighted_by_detail(generated_transmission, reflection)
            mean_error = float(reconstruction_error.mean())
        if self._no_guided_upsampling:
            everywhere = np.ones_like(generated_transmission[..., :1])
            override = GeneratedOverride(generated_transmission, everywhere)
        if self._reconstructs_input or (len(self._seeds) > 1 and self._task.objective == "flow"):
            confidence = confidence_from_spread(spread + reconstruction_error)
        else:  # there is neither a reconstruction error nor a spread of several samples
            confidence = np.zeros_like(spread[..., :1])
        derived = "R" not in self._task.layout.panels
        return Prediction(
            change, reflection, confidence, override, mean_error, reflection_is_derived=derived
        )

    def _sampling_steps(self, quality: Quality) -> int:
        if self._task.objective != "flow":
            return 1
        return self._steps or (
            min(_DRAFT_STEPS, self._task.steps) if quality == "draft" else self._task.steps
        )

    @property
    def _reconstructs_input(self) -> bool:
        return bool({"I", "R"} & set(self._task.layout.panels))

    def _predict_tile(
        self, tile: Floats, steps: int, on_step: Callable[[int, int], None]
    ) -> tuple[Floats, ...]:
        """Means of change, reflection and T over the samples, spread of T, error: (h, w, 3)
        each.
        """
        height, width, _ = tile.shape
        scale = max(1.0, (self._task.short_side_px or 0) / min(width, height))
        if scale > 1:
            enlarged_size = round(scale * height), round(scale * width)
            enlarged = np.clip(_resize(tile, enlarged_size, "bicubic"), 0, 1)
            maps = self._predict_tile(enlarged, steps, on_step)
            return tuple(_resize(map_, (height, width), "bilinear") for map_ in maps)
        divisor = self._size_divisor
        fit = PanelFit(
            (width, height), (-(-width // divisor) * divisor, -(-height // divisor) * divisor)
        )
        panel_input = torch.from_numpy(2 * to_encoded(tile) - 1).permute(2, 0, 1)[None]
        panels = self._pipeline(
            fit.pad(panel_input), steps=steps, seeds=self._seeds, on_progress=on_step
        )
        linear_panels: dict[str, NDArray[np.float32]] = {}
        for name, panel in panels.items():
            if not panel.isfinite().all():
                raise ModelError(
                    f"panel {name} of the model contains NaN or infinity",
                    "expected finite values",
                    "choose another value of quantization, or train the LoRA again: its weights "
                    "may be damaged",
                )
            encoded = ((fit.crop(panel) + 1) / 2).clamp(0, 1)
            linear_panels[name] = to_linear(encoded.permute(0, 2, 3, 1).numpy())
        photo = linear_panels.get("I", tile)
        change = linear_panels["T"] - photo
        reflection = linear_panels.get("R", np.maximum(-change, 0))
        reconstruction = tile[None]  # if the model generates neither I nor R
        if "I" in linear_panels:
            reconstruction = linear_panels["I"]
        elif "R" in linear_panels:
            reconstruction = np.minimum(linear_panels["T"] + linear_panels["R"], 1)
        return (
            change.mean(axis=0),
            reflection.mean(axis=0),
            linear_panels["T"].mean(axis=0),
            np.ptp(to_encoded(linear_panels["T"]), axis=0),
            np.abs(to_encoded(reconstruction) - to_encoded(tile)).mean(axis=0),
        )


def _resize(image: Floats, size: tuple[int, ...], mode: str) -> Floats:
    """Resizes an image (h, w, 3) to this (height, width), with a low-pass filter if it is
    reduced.
    """
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None]
    resized = functional.interpolate(tensor, size, mode=mode, antialias=True, align_corners=False)
    result: Floats = resized[0].permute(1, 2, 0).numpy()
    return result
