"""The glass: one or more panes, their material, and the position of the glazing.

The first pane is the one nearest to the camera. The heading and the pitch of a glazing are those of
a camera whose optical axis is perpendicular to the glass.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from brewster.base.settings import FrozenModel, NonNegativeFloat, PositiveFloat

Point = tuple[float, float, float]
"""World coordinates in mm: x to the right, y up, -z forward."""

DEFAULT_REFRACTIVE_INDEX = 1.5


class Pane(FrozenModel):
    """One sheet of glass. Its far surface is rotated by `wedge_deg` about the vertical axis."""

    thickness_mm: Annotated[float, Field(gt=0, le=200)] = 4.0
    refractive_index: Annotated[float, Field(ge=1, le=3)] = DEFAULT_REFRACTIVE_INDEX
    absorption_per_m: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0, 0.0)
    """Beer-Lambert absorption coefficients for red, green and blue."""
    roughness: Annotated[float, Field(ge=0, le=1)] = 0.0
    """GGX roughness (alpha) of both surfaces: 0 is polished, 0.05 satin, 0.2 frosted."""
    wedge_deg: Annotated[float, Field(ge=-5, le=5)] = 0.0


class Glazing(FrozenModel):
    """Panes with equal air gaps between them, and their position.

    `opening_mm` is the width and height of an opening in a black wall that holds the glass; None
    means that the glass fills the view. `radii_mm` are the radii of curvature of the near and the
    far surface of a lens, positive where a surface is convex towards the camera. Only the Mitsuba
    renderer supports framed and curved glass.
    """

    panes: Annotated[tuple[Pane, ...], Field(min_length=1, max_length=3)] = (Pane(),)
    gap_mm: NonNegativeFloat = 0.0
    position_mm: Point = (0.0, 0.0, 0.0)
    heading_deg: float = 0.0
    pitch_deg: Annotated[float, Field(ge=-80, le=80)] = 0.0
    opening_mm: tuple[PositiveFloat, PositiveFloat] | None = None
    radii_mm: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _check_geometry(self) -> Glazing:
        if len(self.panes) > 1 and self.gap_mm == 0:
            raise ValueError("expected a gap_mm above 0 between several panes, but it is 0")
        if self.radii_mm and (
            len(self.panes) > 1 or not all(self.radii_mm) or self.opening_mm is None
        ):
            raise ValueError(
                "expected one pane, two radii other than 0 and opening_mm, because the glass is "
                "curved"
            )
        return self

    @property
    def depth_mm(self) -> float:
        """The distance from the first surface to the last."""
        return sum(pane.thickness_mm for pane in self.panes) + self.gap_mm * (len(self.panes) - 1)

    @property
    def is_flat(self) -> bool:
        """Whether the glass is flat and fills the view, as the analytic renderer requires."""
        return self.radii_mm is None and self.opening_mm is None

    @property
    def is_rough(self) -> bool:
        """Whether any surface is rough."""
        return any(pane.roughness > 0 for pane in self.panes)

    @property
    def is_wedged(self) -> bool:
        """Whether the surfaces of any pane are not parallel."""
        return any(pane.wedge_deg != 0 for pane in self.panes)
