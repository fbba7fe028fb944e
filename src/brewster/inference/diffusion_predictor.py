"""Predicts layers with a diffusion model, which generates them as panels of one image.

Generated panels differ from the photo in colour and detail. If the model also generates the input (panel I), that
panel and panel T have about the same errors. So the change is the difference of the generated panels, T - I, and
guided_upsampling.py applies it to the real photo. The reconstruction error is the difference between the generated and
the real input.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from threading import Lock
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from brewster.errors import ModelError
from brewster.inference.diffusion_work import DiffusionWork
from brewster.inference.guided_upsampling import Floats, GeneratedOverride
from brewster.inference.predictor import Prediction, Predictor, ProgressCallback, confidence_from_spread
from brewster.inference.tiles import run_tiled, tile_slices
from brewster.models.diffusion.panels import PanelFit
from brewster.models.diffusion.pipeline import DecompositionPipeline
from brewster.options import Quality
from brewster.srgb import to_encoded, to_linear


@final
class DiffusionPredictor(Predictor):
    """Runs a `DecompositionPipeline` on one copy of the photo: as a whole, or in square tiles if the task has
    them.

    The prediction is the mean of `ensemble_size` samples with different seeds, which has less invented
    detail. With `no_guided_upsampling`, the transmission is the generated panel, without the detail of the
    photo. For `steps`, see `DiffusionWork`.
    """

    def __init__(
        self,
        pipeline: DecompositionPipeline,
        *,
        steps: int | None = None,
        ensemble_size: int = 1,
        no_guided_upsampling: bool = False,
    ) -> None:
        self._work = DiffusionWork(pipeline.task, pipeline.backbone.size_divisor, steps, ensemble_size)
        self._pipeline, self._no_guided_upsampling = pipeline, no_guided_upsampling
        self._seeds = range(ensemble_size)
        self._lock = Lock()

    def input_sizes(
        self,
        size: tuple[int, int],
        quality: Quality,  # noqa: ARG002
    ) -> list[tuple[int, int]]:
        """Returns the (width, height) of the only input, see `DiffusionWork`."""
        return [self._work.task.input_size(size, self._work.size_divisor)]

    def __call__(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """Returns the prediction for the only input."""
        (scaled_input,) = inputs
        height, width, _ = scaled_input.shape
        tiling, steps = self._work.tiling((height, width)), self._work.sampling_steps(quality)
        tiles, started = len(tile_slices((height, width), **tiling)), itertools.count()

        def predict_tile(tile: Floats) -> tuple[Floats, ...]:
            index = next(started)
            return self._predict_tile(
                tile, steps, lambda step, total: on_progress((index + step / total) / tiles)
            )

        with self._lock:  # two predictions at the same time would need twice the GPU memory
            change, reflection, generated_transmission, spread, reconstruction_error = run_tiled(
                predict_tile, scaled_input, **tiling
            )
        override, mean_error = None, None
        if self._reconstructs_input:
            override = GeneratedOverride.weighted_by_detail(generated_transmission, reflection)
            mean_error = float(reconstruction_error.mean())
        if self._no_guided_upsampling:
            everywhere = np.ones_like(generated_transmission[..., :1])
            override = GeneratedOverride(generated_transmission, everywhere)
        if self._reconstructs_input or (len(self._seeds) > 1 and self._pipeline.task.objective == "flow"):
            confidence = confidence_from_spread(spread + reconstruction_error)
        else:  # there is neither a reconstruction error nor a spread of several samples
            confidence = np.zeros_like(spread[..., :1])
        return Prediction(
            change,
            reflection,
            confidence,
            override,
            mean_error,
            reflection_is_derived="R" not in self._pipeline.task.layout.panels,
        )

    @property
    def _reconstructs_input(self) -> bool:
        return bool({"I", "R"} & set(self._pipeline.task.layout.panels))

    def _predict_tile(
        self, tile: Floats, steps: int, on_step: Callable[[int, int], None]
    ) -> tuple[Floats, ...]:
        """Means of change, reflection and T over the samples, spread of T, error: (h, w, 3) each."""
        height, width, _ = tile.shape
        enlarged_size = self._work.enlarged((width, height))
        if enlarged_size != (width, height):
            enlarged = np.clip(_resize(tile, enlarged_size[::-1], "bicubic"), 0, 1)
            maps = self._predict_tile(enlarged, steps, on_step)
            return tuple(_resize(map_, (height, width), "bilinear") for map_ in maps)
        panel_fit = PanelFit((width, height), self._work.panel_size((width, height)))
        panel_input = torch.from_numpy(2 * to_encoded(tile) - 1).permute(2, 0, 1)[None]
        panels = self._pipeline(
            panel_fit.pad(panel_input), steps=steps, seeds=self._seeds, on_progress=on_step
        )
        linear_panels: dict[str, NDArray[np.float32]] = {}
        for name, panel in panels.items():
            if not panel.isfinite().all():
                raise ModelError(
                    f"panel {name} of the model contains NaN or infinity",
                    "expected finite values",
                    "choose another value of quantization, or train the LoRA again: its weights may be damaged",
                )
            encoded = ((panel_fit.crop(panel) + 1) / 2).clamp(0, 1)
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
    """Resizes an image (h, w, 3) to this (height, width), with a low-pass filter if it is reduced."""
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None]
    resized = functional.interpolate(tensor, size, mode=mode, antialias=True, align_corners=False)
    result: Floats = resized[0].permute(1, 2, 0).numpy()
    return result
