"""What a large backbone is asked to do with a photo: which panels to make, how large, and by which way."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Self, final

from brewster.errors import PhotoError
from brewster.models.large.panels import Fit, Layout, fit_panel
from brewster.models.large.sampling import GUIDANCE

Objective = Literal["flow", "one_step"]

Quantisation = Literal["int8", "float8", "nf4"]
"""How a base is stored that would not fit as it is: 8 bits by torchao, 4 by bitsandbytes."""

PAPER_PX: Final = 1536 * 512


@final
@dataclass(frozen=True)
class Task:
    """Panels of at most `budget_px` pixels together, made from noise in many steps ("flow"), or in "one_step".

    `guidance` is that of separating, which need not be that of learning.
    """

    layout: Layout = field(default_factory=Layout)
    budget_px: int = PAPER_PX
    objective: Objective = "flow"
    guidance: float = GUIDANCE

    def fit(self, size: tuple[int, int], multiple: int) -> Fit:
        """The largest panel for a photo of this (width, height); a small photo gets a smaller panel.

        Raises:
            PhotoError: the photo has fewer than `multiple` pixels a side, or is long and thin beyond the budget.
        """
        try:
            return fit_panel(size, self.layout, budget_px=self.budget_px, multiple=multiple)
        except PhotoError:
            if min(size) < multiple:
                raise PhotoError(
                    f"the photo has {size[0]} x {size[1]} pixels",
                    f"at least {multiple} a side",
                    "large models see nothing smaller: use another photo, or the compact model",
                ) from None
            cells = math.prod(max(1, side // multiple) for side in size)
            small = min(self.budget_px, cells * len(self.layout.panels) * multiple**2)
            return fit_panel(size, self.layout, budget_px=small, multiple=multiple)

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> Self:
        """Reads what `dataclasses.asdict` gives.

        Raises:
            TypeError, KeyError: values are missing or unknown.
            RecipeError: there is no such layout.
        """
        layout = Layout(tuple(values["layout"]["panels"]), values["layout"]["direction"])
        return cls(**(values | {"layout": layout}))
