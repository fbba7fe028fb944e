"""How a large image model looks at a photo: it draws the panels anew, and only what it changes is believed.

A generated picture drifts from the photo in its colours and in its detail. Where the model draws the photo, too (the
panel I), it drifts there alike, so that the change is taken between its own panels, T - I, and detail.py lays it over
the real photo. How far its photo is from the real one is the reconstruction_error, of which nobody should be unaware.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Final, final

import numpy as np
import torch
from numpy.typing import NDArray

from brewster.errors import ModelError
from brewster.inference.guided_upsampling import Floats, GeneratedOverride, enlarge_rows
from brewster.inference.predictor import Prediction, Predictor, ProgressCallback, confidence_from_spread
from brewster.inference.tiles import run_tiled, tile_slices
from brewster.models.diffusion.panels import PanelFit
from brewster.models.diffusion.pipeline import DecompositionPipeline
from brewster.models.diffusion.sampling import STEPS
from brewster.options import Quality
from brewster.srgb import to_encoded, to_linear

_DRAFT_STEPS: Final = 4
_FINE_SCALE: Final = 2
"""How much larger a side of the second copy of a close look is; it is seen in tiles of a panel each."""
_MIN_FINE_SCALE: Final = 1.25
"""A copy that is less than so much larger shows nothing new."""


@final
class DiffusionPredictor(Predictor):
    """Looks through a `DecompositionPipeline`: at the whole photo in one panel, and for "best" also closer, panel by panel.

    Args:
        decomposer: the model.
        steps: how many steps each look takes; by default the paper's 20, and 4 for "draft".
        average: how many answers, from as many seeds, are averaged: what the model merely made up averages out.
        plain: gives the transmission as the model draws it, enlarged, without the photo's own detail.

    Raises:
        ModelError: no step, or nothing to average.
    """

    def __init__(
        self,
        pipeline: DecompositionPipeline,
        *,
        steps: int | None = None,
        average: int = 1,
        plain: bool = False,
    ) -> None:
        if (steps is not None and steps < 1) or average < 1:
            raise ModelError(f"steps = {steps}, average = {average}", "at least 1 of each", "raise them")
        if pipeline.task.objective == "one_step" and (steps not in (None, 1) or average > 1):
            raise ModelError(
                f"steps = {steps}, average = {average} were asked of a model that answers in one step",
                "there is one step and one answer",
                "leave them out",
            )
        self._pipeline, self._plain = pipeline, plain
        self._steps, self._seeds = steps, range(average)
        self._lock = Lock()

    def input_sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:
        """As large as a panel, and for "best" twice that, as far as the photo is.

        Raises:
            PhotoError: the photo has fewer than 16 pixels a side, or is too long and thin.
        """
        task, multiple = self._pipeline.task, self._pipeline.backbone.multiple
        coarse = task.fit(size, multiple).content
        scale = min(_FINE_SCALE, size[0] / coarse[0])
        if quality != "best" or scale < _MIN_FINE_SCALE:
            return [coarse]
        return [coarse, (round(scale * coarse[0]), round(scale * coarse[1]))]

    def __call__(
        self, inputs: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """The mean of the looks; the reconstruction_error is that of the look at the whole."""
        size = inputs[-1].shape[:2]
        sides = [max(inputs[0].shape), *(self._tile_px for _ in inputs[1:])]
        tiles = [
            len(tile_slices(scaled_input.shape[:2], **_tiling(side)))
            for scaled_input, side in zip(inputs, sides, strict=True)
        ]
        steps = self._steps or (_DRAFT_STEPS if quality == "draft" else STEPS)
        progress = _ProgressCounter(on_progress, sum(tiles))
        predictions = []
        with self._lock:  # two at once would need twice the memory of the card
            for scaled_input, side in zip(inputs, sides, strict=True):
                predictions.append(
                    run_tiled(
                        lambda tile: self._predict_tile(tile, steps, progress), scaled_input, **_tiling(side)
                    )
                )
        change, reflection, generated, spread, reconstruction_error = (
            np.mean([enlarge_rows(map_, 0, size[0], size) for map_ in maps], axis=0)
            for maps in zip(*predictions, strict=True)
        )
        override, mean_error = None, None
        if self._plain:
            override = GeneratedOverride(generated, np.ones_like(generated[..., :1]))
        elif self._reconstructs_input:
            override = GeneratedOverride.weighted_by_detail(generated, reflection)
        if self._reconstructs_input:
            mean_error = float(predictions[0][-1].mean())
        confidence = confidence_from_spread(spread + reconstruction_error)
        return Prediction(
            change,
            reflection,
            confidence if self._has_confidence else np.zeros_like(confidence),
            override,
            mean_error,
        )

    @property
    def _reconstructs_input(self) -> bool:
        return bool({"I", "R"} & set(self._pipeline.task.layout.panels))

    @property
    def _has_confidence(self) -> bool:
        """Whether anything shows how sure the model is: a photo that it draws, or other answers."""
        return self._reconstructs_input or (len(self._seeds) > 1 and self._pipeline.task.objective == "flow")

    @property
    def _tile_px(self) -> int:
        """The side of a square panel."""
        task, multiple = self._pipeline.task, self._pipeline.backbone.multiple
        return max(1, math.isqrt(task.budget_px // len(task.layout.panels)) // multiple) * multiple

    def _predict_tile(self, tile: Floats, steps: int, progress: _ProgressCounter) -> tuple[Floats, ...]:
        """Change, reflection and transmission, linear; how far the answers are apart and their photo strays, encoded."""
        height, width, _ = tile.shape
        fit = PanelFit((width, height), _round_up((width, height), self._pipeline.backbone.multiple))
        panel_input = torch.from_numpy(2 * to_encoded(tile) - 1).permute(2, 0, 1)[None]
        panels = self._pipeline(
            fit.pad(panel_input), steps=steps, seeds=self._seeds, on_progress=progress.within_tile
        )
        progress.tile_done()
        _check_finite(panels)
        light = {name: _to_light(fit.cut(panel)) for name, panel in panels.items()}
        photo = light.get("I", tile)
        change = light["T"] - photo
        reflection = light.get("R", np.maximum(-change, 0))
        generated = to_encoded(_reconstruction(light, tile))
        return (
            change.mean(axis=0),
            reflection.mean(axis=0),
            light["T"].mean(axis=0),
            np.ptp(to_encoded(light["T"]), axis=0),
            np.abs(generated - to_encoded(tile)).mean(axis=0),
        )


@dataclass
class _ProgressCounter:
    """Tells how far a look is, tile by tile and step by step."""

    on_progress: ProgressCallback
    tiles: int
    done: int = 0

    def within_tile(self, step: int, steps: int) -> None:
        self.on_progress((self.done + step / steps) / self.tiles)

    def tile_done(self) -> None:
        self.done += 1


def _reconstruction(light: Mapping[str, Floats], tile: Floats) -> Floats:
    """The photo as the model draws it: its own panel, or T and R together, or not at all."""
    if "I" in light:
        return light["I"]
    return np.minimum(light["T"] + light["R"], 1) if "R" in light else tile[None]


def _check_finite(panels: Mapping[str, torch.Tensor]) -> None:
    for name, panel in panels.items():
        if not panel.isfinite().all():
            raise ModelError(
                f"the model drew a panel {name} with numbers that are none",
                "finite ones",
                "store the base otherwise (quantise), or train the LoRA again: its weights may be broken",
            )


def _to_light(panels: torch.Tensor) -> NDArray[np.float32]:
    """Panels (n, 3, h, w) in [-1, 1] as linear light (n, h, w, 3)."""
    light: NDArray[np.float32] = to_linear(((panels + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1).numpy())
    return light


def _tiling(side: int) -> dict[str, int]:
    return {"tile_px": side, "overlap_px": side // 4}


def _round_up(size: tuple[int, int], multiple: int) -> tuple[int, int]:
    width, height = (-(-side // multiple) * multiple for side in size)
    return width, height
