"""What a large backbone is asked to do with a photo: which panels to make, how large, and by which way."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, Literal, final

from brewster.errors import PhotoError, RecipeError
from brewster.models.diffusion.panels import PanelFit, PanelLayout, fit_panel
from brewster.models.diffusion.sampling import GUIDANCE

Objective = Literal["flow", "one_step"]

PAPER_PX: Final = 1536 * 512


@final
@dataclass(frozen=True)
class DecompositionTask:
    """Panels of at most `budget_px` pixels together, made from noise in many steps ("flow"), or in "one_step".

    `guidance` is that of separating, which need not be that of learning.
    """

    layout: PanelLayout = field(default_factory=PanelLayout)
    budget_px: int = PAPER_PX
    objective: Objective = "flow"
    guidance: float = GUIDANCE

    def __post_init__(self) -> None:
        """Refuses a task without T, which every user wants."""
        if "T" not in self.layout.panels:
            raise RecipeError(
                f"the panels are {list(self.layout.panels)}", "T among them", "add T to the panels"
            )

    def fit(self, size: tuple[int, int], multiple: int) -> PanelFit:
        """The largest panel for a photo of this (width, height); a small photo gets a smaller panel.

        Raises:
            PhotoError: the photo has fewer than `multiple` pixels a side, or is too long and thin.
        """
        max_cells = self.budget_px // (len(self.layout.panels) * multiple**2)
        cells = min(max_cells, math.prod(-(-side // multiple) for side in size))
        for cell_count in range(cells, 0, -1):
            budget = cell_count * len(self.layout.panels) * multiple**2
            with suppress(PhotoError):
                return fit_panel(size, self.layout, budget_px=budget, multiple=multiple)
        raise PhotoError(
            f"the photo has {size[0]} x {size[1]} pixels",
            f"at least {multiple} a side, and not so long and thin",
            "crop it, or use the compact model",
        )
