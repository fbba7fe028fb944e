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
from brewster.inference.tiles import in_tiles, tiles_of
from brewster.models.diffusion.panels import PanelFit
from brewster.models.diffusion.pipeline import DecompositionPipeline
from brewster.models.diffusion.sampling import STEPS
from brewster.options import Quality
from brewster.srgb import to_encoded, to_linear

_DRAFT_STEPS: Final = 4
_CLOSER: Final = 2
"""How much larger a side of the second copy of a close look is; it is seen in tiles of a panel each."""
_WORTH_IT: Final = 1.25
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
        decomposer: DecompositionPipeline,
        *,
        steps: int | None = None,
        average: int = 1,
        plain: bool = False,
    ) -> None:
        if (steps is not None and steps < 1) or average < 1:
            raise ModelError(f"steps = {steps}, average = {average}", "at least 1 of each", "raise them")
        if decomposer.task.objective == "one_step" and (steps not in (None, 1) or average > 1):
            raise ModelError(
                f"steps = {steps}, average = {average} were asked of a model that answers in one step",
                "there is one step and one answer",
                "leave them out",
            )
        self._decomposer, self._plain = decomposer, plain
        self._steps, self._seeds = steps, range(average)
        self._one_at_a_time = Lock()

    def sizes(self, size: tuple[int, int], quality: Quality) -> list[tuple[int, int]]:
        """As large as a panel, and for "best" twice that, as far as the photo is.

        Raises:
            PhotoError: the photo has fewer than 16 pixels a side, or is too long and thin.
        """
        task, multiple = self._decomposer.task, self._decomposer.backbone.multiple
        whole = task.fit(size, multiple).content
        scale = min(_CLOSER, size[0] / whole[0])
        if quality != "best" or scale < _WORTH_IT:
            return [whole]
        return [whole, (round(scale * whole[0]), round(scale * whole[1]))]

    def __call__(
        self, copies: Sequence[Floats], quality: Quality, on_progress: ProgressCallback
    ) -> Prediction:
        """The mean of the looks; the reconstruction_error is that of the look at the whole."""
        size = copies[-1].shape[:2]
        sides = [max(copies[0].shape), *(self._tile_px for _ in copies[1:])]
        tiles = [
            len(tiles_of(copy.shape[:2], **_cut(side))) for copy, side in zip(copies, sides, strict=True)
        ]
        steps = self._steps or (_DRAFT_STEPS if quality == "draft" else STEPS)
        count = _ProgressCounter(on_progress, sum(tiles))
        looks = []
        with self._one_at_a_time:  # two at once would need twice the memory of the card
            for copy, side in zip(copies, sides, strict=True):
                looks.append(in_tiles(lambda tile: self._answer(tile, steps, count), copy, **_cut(side)))
        change, reflection, drawn, apart, reconstruction_error = (
            np.mean([enlarge_rows(map_, 0, size[0], size) for map_ in maps], axis=0)
            for maps in zip(*looks, strict=True)
        )
        redrawn, strayed = None, None
        if self._plain:
            redrawn = GeneratedOverride(drawn, np.ones_like(drawn[..., :1]))
        elif self._redraws:
            redrawn = GeneratedOverride.where_mirrored(drawn, reflection)
        if self._redraws:
            strayed = float(looks[0][-1].mean())
        sure = confidence_from_spread(apart + reconstruction_error)
        return Prediction(
            change, reflection, sure if self._can_tell else np.zeros_like(sure), redrawn, strayed
        )

    @property
    def _redraws(self) -> bool:
        return bool({"I", "R"} & set(self._decomposer.task.layout.panels))

    @property
    def _can_tell(self) -> bool:
        """Whether anything shows how sure the model is: a photo that it draws, or other answers."""
        return self._redraws or (len(self._seeds) > 1 and self._decomposer.task.objective == "flow")

    @property
    def _tile_px(self) -> int:
        """The side of a square panel."""
        task, multiple = self._decomposer.task, self._decomposer.backbone.multiple
        return max(1, math.isqrt(task.budget_px // len(task.layout.panels)) // multiple) * multiple

    def _answer(self, tile: Floats, steps: int, count: _ProgressCounter) -> tuple[Floats, ...]:
        """Change, reflection and transmission, linear; how far the answers are apart and their photo strays, encoded."""
        height, width, _ = tile.shape
        fit = PanelFit((width, height), _up((width, height), self._decomposer.backbone.multiple))
        shown = torch.from_numpy(2 * to_encoded(tile) - 1).permute(2, 0, 1)[None]
        panels = self._decomposer(
            fit.pad(shown), steps=steps, seeds=self._seeds, on_progress=count.within_tile
        )
        count.tile_done()
        _refuse_broken(panels)
        light = {name: _light(fit.crop(panel)) for name, panel in panels.items()}
        photo = light.get("I", tile)
        change = light["T"] - photo
        reflection = light.get("R", np.maximum(-change, 0))
        drawn = to_encoded(_drawn(light, tile))
        return (
            change.mean(axis=0),
            reflection.mean(axis=0),
            light["T"].mean(axis=0),
            np.ptp(to_encoded(light["T"]), axis=0),
            np.abs(drawn - to_encoded(tile)).mean(axis=0),
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


def _drawn(light: Mapping[str, Floats], tile: Floats) -> Floats:
    """The photo as the model draws it: its own panel, or T and R together, or not at all."""
    if "I" in light:
        return light["I"]
    return np.minimum(light["T"] + light["R"], 1) if "R" in light else tile[None]


def _refuse_broken(panels: Mapping[str, torch.Tensor]) -> None:
    for name, panel in panels.items():
        if not panel.isfinite().all():
            raise ModelError(
                f"the model drew a panel {name} with numbers that are none",
                "finite ones",
                "store the base otherwise (quantise), or train the LoRA again: its weights may be broken",
            )


def _light(panels: torch.Tensor) -> NDArray[np.float32]:
    """Panels (n, 3, h, w) in [-1, 1] as linear light (n, h, w, 3)."""
    light: NDArray[np.float32] = to_linear(((panels + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1).numpy())
    return light


def _cut(side: int) -> dict[str, int]:
    return {"tile_px": side, "overlap_px": side // 4}


def _up(size: tuple[int, int], multiple: int) -> tuple[int, int]:
    width, height = (-(-side // multiple) * multiple for side in size)
    return width, height
