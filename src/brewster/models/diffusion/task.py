"""The task of a diffusion backbone: which panels it generates, their size, and the sampling method."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Final, Literal, final

from pydantic import Field, TypeAdapter

from brewster.errors import ModelError, RecipeError
from brewster.files import write_atomically
from brewster.models.diffusion.panels import PanelFit, PanelLayout, fit_panel

Objective = Literal["flow", "one_step"]
"""The objectives that brewster trains."""

STEPS: Final = 20
GUIDANCE: Final = 4.0
PAPER_COMPOSITE_PIXELS: Final = 1536 * 512
"""The size of the paper's composite: three panels of 512 x 512 pixels."""
TASK_FILE: Final = "task.json"
"""The file with the task of a finetuned base, next to model_index.json."""


@final
@dataclass(frozen=True)
class DecompositionTask:
    """Which panels to generate, and how. All panels together have at most `max_composite_pixels` pixels.

    `objective` is "flow" (from noise, in many steps), "one_step" (from the photo, in one step) or "direct" (one
    prediction at time `time`, without noise and without a conditioning image: transmission = photo - prediction, both
    encoded; Zakarin et al. 2025). A direct task decodes each panel separately; its panel I is the encoded photo.
    `guidance` is used for separation; training may use another value. `steps`, `timestep_shift` and `last_sigma` define
    the sampling schedule, see `Backbone.schedule`.
    `short_side_px` is the short side of the input, for models that were trained with one size; a smaller photo is
    enlarged. With `square_tiles` the input is divided into squares of this side.
    """

    layout: PanelLayout = field(default_factory=PanelLayout)
    max_composite_pixels: int = PAPER_COMPOSITE_PIXELS
    objective: Objective | Literal["direct"] = "flow"
    guidance: float = GUIDANCE
    steps: Annotated[int, Field(ge=1)] = STEPS
    timestep_shift: Annotated[float, Field(gt=0)] | None = None
    last_sigma: Annotated[float, Field(gt=0, lt=1)] | None = None
    time: Annotated[float, Field(gt=0, le=1)] = 1.0
    short_side_px: Annotated[int, Field(ge=16)] | None = None
    square_tiles: bool = False

    def __post_init__(self) -> None:
        """Raises RecipeError for a task without T, which every separation needs, or for a direct task with R."""
        if "T" not in self.layout.panels:
            raise RecipeError(
                f"the panels are {list(self.layout.panels)}", "expected a list with T", "add T to the panels"
            )
        if self.objective == "direct" and "R" in self.layout.panels:
            raise RecipeError(
                f"the panels of a direct task are {list(self.layout.panels)}",
                "expected T, or I and T, because it generates no reflection",
                "remove R from the panels",
            )

    def input_size(self, size: tuple[int, int], size_divisor: int) -> tuple[int, int]:
        """The (width, height) of the copy of a photo that is the input, never larger than the photo. Raises PhotoError, see
        `fit`. With `short_side_px` every photo has an input size."""
        if self.short_side_px is None:
            return self.fit(size, size_divisor).content
        scale = min(1.0, self.short_side_px / min(size))
        return round(scale * size[0]), round(scale * size[1])

    def fit(self, size: tuple[int, int], size_divisor: int) -> PanelFit:
        """The largest panel within the budget for a photo of this (width, height). A photo is never enlarged. Raises PhotoError
        if the photo has fewer than `size_divisor` pixels on a side, or its aspect ratio is too extreme."""
        budget = self.max_composite_pixels
        return fit_panel(size, self.layout, max_composite_pixels=budget, size_divisor=size_divisor)


def windowseat_task(side_px: int = 768) -> DecompositionTask:
    """The task of a WindowSeat with this processing resolution, as in its published inference code: time 0.499, latents
    minus prediction, square tiles, no guidance."""
    # Panel I is the encoded photo, decoded again. It separates the errors of the VAE from the change by the model.
    return DecompositionTask(
        PanelLayout(("I", "T")),
        max_composite_pixels=2 * side_px**2,
        objective="direct",
        guidance=1.0,
        time=0.499,
        short_side_px=side_px,
        square_tiles=True,
    )


def named_task(model: str) -> DecompositionTask:
    """The task of a registered model: a published one, or a backbone, which generates panel T."""
    return windowseat_task() if model == "windowseat" else DecompositionTask(PanelLayout(("T",)))


def save_task(task: DecompositionTask, path: Path) -> None:
    """Writes a JSON file, and replaces an existing one."""
    write_atomically(path, f"{json.dumps(asdict(task), indent=2)}\n".encode(), overwrite=True)


def load_task(path: Path) -> DecompositionTask:
    """Reads a file that `save_task` wrote."""
    try:
        return TypeAdapter(DecompositionTask).validate_json(path.read_bytes(), strict=True, extra="forbid")
    except (OSError, ValueError, RecipeError) as error:
        raise ModelError(
            f"{path} cannot be read: {error}",
            "expected the task of a model",
            "copy or convert the model again",
        ) from error
