"""The task of a large backbone: which panels it generates, their size, and the sampling method."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, Literal, final

from brewster.errors import PhotoError, RecipeError
from brewster.models.diffusion.panels import PanelFit, PanelLayout, fit_panel
from brewster.models.diffusion.sampling import GUIDANCE, STEPS

Objective = Literal["flow", "one_step"]

PAPER_PX: Final = 1536 * 512
"""The size of the paper's composite: three panels of 512 x 512 pixels."""


@final
@dataclass(frozen=True)
class DecompositionTask:
    """Which panels to generate, and how. All panels together have at most `budget_px` pixels.

    `objective` is "flow" (from noise, in many steps) or "one_step" (from the photo, in one step). `guidance` is used
    for separation; training may use another value. `steps`, `timestep_shift` and `last_sigma` define the sampling
    schedule, see `Backbone.schedule`.
    """

    layout: PanelLayout = field(default_factory=PanelLayout)
    budget_px: int = PAPER_PX
    objective: Objective = "flow"
    guidance: float = GUIDANCE
    steps: int = STEPS
    timestep_shift: float | None = None
    last_sigma: float | None = None

    def __post_init__(self) -> None:
        """Raises RecipeError for a task without T, because every separation needs a transmission, or for invalid numbers."""
        if "T" not in self.layout.panels:
            raise RecipeError(
                f"the panels are {list(self.layout.panels)}", "expected a list with T", "add T to the panels"
            )
        shift_is_valid = self.timestep_shift is None or self.timestep_shift > 0
        if self.steps < 1 or not shift_is_valid or not 0 < (self.last_sigma or 1) <= 1:
            raise RecipeError(
                f"the task has steps = {self.steps}, timestep_shift = {self.timestep_shift}, last_sigma = {self.last_sigma}",
                "expected at least 1 step, a shift above 0, and a last_sigma above 0 and at most 1",
                "correct these values",
            )

    def fit(self, size: tuple[int, int], multiple: int) -> PanelFit:
        """The largest panel within the budget for a photo of this (width, height). A photo is never enlarged.

        Raises:
            PhotoError: the photo has fewer than `multiple` pixels on a side, or its aspect ratio is too extreme.
        """
        max_cells = self.budget_px // (len(self.layout.panels) * multiple**2)
        cells = min(max_cells, math.prod(-(-side // multiple) for side in size))
        for cell_count in range(cells, 0, -1):
            budget = cell_count * len(self.layout.panels) * multiple**2
            with suppress(PhotoError):
                return fit_panel(size, self.layout, budget_px=budget, multiple=multiple)
        raise PhotoError(
            f"the photo has {size[0]} x {size[1]} pixels",
            f"expected at least {multiple} pixels a side, and a less extreme aspect ratio",
            "crop it, or use the compact model",
        )
