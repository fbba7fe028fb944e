"""The glass: one pane or several, how thick, what kind, how it stands.

The first pane is the one nearest to the camera. A glazing looks at the camera: its heading and pitch are those
of a camera that looks straight through it.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from brewster.scene.values import FrozenModel, NonNegativeFloat, PositiveFloat

Point = tuple[float, float, float]
"""Millimetres in the world: x to the right, y up, -z ahead."""

DEFAULT_INDEX = 1.5


class Pane(FrozenModel):
    """One sheet of glass. A wedge turns its far surface about the vertical axis."""

    thickness_mm: Annotated[float, Field(gt=0, le=200)] = 4.0
    index: Annotated[float, Field(ge=1, le=3)] = DEFAULT_INDEX
    absorption_per_m: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0, 0.0)
    """Beer-Lambert coefficients for red, green and blue light."""
    roughness: Annotated[float, Field(ge=0, le=1)] = 0.0
    """The GGX width (alpha) of both surfaces: 0 is polished, 0.05 satin, 0.2 frosted."""
    wedge_deg: Annotated[float, Field(ge=-5, le=5)] = 0.0


class Glazing(FrozenModel):
    """Panes with equal gaps of air between them, and where they stand.

    `frame_mm` is the width and height of the opening in a black wall (None: the glass fills the view);
    `radii_mm` are the radii of curvature of a lens's near and far surface, positive where it bulges towards
    the camera. Only the tracer renders framed and curved glass.
    """

    panes: Annotated[tuple[Pane, ...], Field(min_length=1, max_length=3)] = (Pane(),)
    gap_mm: NonNegativeFloat = 0.0
    position_mm: Point = (0.0, 0.0, 0.0)
    heading_deg: float = 0.0
    pitch_deg: Annotated[float, Field(ge=-80, le=80)] = 0.0
    frame_mm: tuple[PositiveFloat, PositiveFloat] | None = None
    radii_mm: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _check_geometry(self) -> Glazing:
        if len(self.panes) > 1 and self.gap_mm == 0:
            raise ValueError("panes stand apart: gap_mm is above 0 when there is more than one")
        if self.radii_mm and (len(self.panes) > 1 or not all(self.radii_mm) or self.frame_mm is None):
            raise ValueError("curved glass is one pane with two radii other than 0, in a frame")
        return self

    @property
    def depth_mm(self) -> float:
        """From the first surface to the last."""
        return sum(pane.thickness_mm for pane in self.panes) + self.gap_mm * (len(self.panes) - 1)

    @property
    def is_flat(self) -> bool:
        """Whether the analytic renderer can render it: flat, and filling the view."""
        return self.radii_mm is None and self.frame_mm is None

    @property
    def is_rough(self) -> bool:
        """Whether any surface scatters."""
        return any(pane.roughness > 0 for pane in self.panes)

    @property
    def is_wedged(self) -> bool:
        """Whether any pane's surfaces are not parallel."""
        return any(pane.wedge_deg != 0 for pane in self.panes)
