"""The predictions of a diffusion model for one photo: the size of the input, its tiles, and the sampling steps.

`DiffusionPredictor` runs this work, and `separation_plan` estimates it. The module needs no torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

from brewster.errors import ModelError
from brewster.inference.tiles import tile_slices
from brewster.models.diffusion.task import DecompositionTask
from brewster.options import Quality

_DRAFT_STEPS: Final = 4
_SQUARE_TILE_OVERLAP_DIVISOR: Final = 12
"""Square tiles overlap by at least their side divided by this: 64 of 768 pixels, as in WindowSeat."""


@final
@dataclass(frozen=True)
class DiffusionWork:
    """The work of a task. All sizes are (width, height) in pixels.

    `steps` is the number of sampling steps, by default that of the task (20 as in the paper), and at most 4 for "draft".
    `ensemble_size` is the number of samples with different seeds. The sides of a panel are multiples of `size_divisor`.
    """

    task: DecompositionTask
    size_divisor: int = 16
    steps: int | None = None
    ensemble_size: int = 1

    def __post_init__(self) -> None:
        """Raises ModelError if a number is below 1, or set for a one-step model."""
        given = f"steps = {self.steps}, ensemble_size = {self.ensemble_size}"
        if (self.steps is not None and self.steps < 1) or self.ensemble_size < 1:
            raise ModelError(given, "expected both to be at least 1", "set them to 1 or more")
        if self.task.objective != "flow" and (self.steps not in (None, 1) or self.ensemble_size > 1):
            raise ModelError(
                f"{given} were set for a one-step model",
                "expected neither, because it takes one step and is deterministic",
                "leave them out",
            )

    def sampling_steps(self, quality: Quality) -> int:
        """The number of sampling steps of each prediction."""
        if self.task.objective != "flow":
            return 1
        return self.steps or (min(_DRAFT_STEPS, self.task.steps) if quality == "draft" else self.task.steps)

    def tiling(self, size: tuple[int, int]) -> dict[str, int]:
        """The side and the overlap of the tiles for an input of this size: one tile, or squares of its short side."""
        side = min(size) if self.task.square_tiles else max(size)
        return {"tile_px": side, "overlap_px": side // _SQUARE_TILE_OVERLAP_DIVISOR}

    def enlarged(self, tile: tuple[int, int]) -> tuple[int, int]:
        """The size of a tile that the model gets: at least the short side of the task."""
        scale = max(1.0, (self.task.short_side_px or 0) / min(tile))
        return round(scale * tile[0]), round(scale * tile[1])

    def panel_size(self, tile: tuple[int, int]) -> tuple[int, int]:
        """The size of the panels for an enlarged tile: both sides are rounded up to a multiple of `size_divisor`."""
        width, height = (-(-side // self.size_divisor) * self.size_divisor for side in tile)
        return width, height

    def panel_sizes(self, size: tuple[int, int]) -> list[tuple[int, int]]:
        """The size of the panels for a photo of this size, one for each tile."""
        width, height = self.task.input_size(size, self.size_divisor)
        return [
            self.panel_size(self.enlarged((columns.stop - columns.start, rows.stop - rows.start)))
            for rows, columns in tile_slices((height, width), **self.tiling((height, width)))
        ]
