"""The two sides of the glass: an HDR map all around, a picture on a plane, or a picture before a map."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, PlainSerializer, model_validator

from brewster.scene.values import FrozenModel, NonNegativeFloat, PositiveFloat

BUILTIN = "builtin:"
"""A source that is computed, not read: `builtin:street:7` is the seventh street."""

Radius = Annotated[float, Field(gt=0, allow_inf_nan=True), PlainSerializer(float)]


class AssetSource(FrozenModel):
    """A file's name below its assets folder with the sha256 of its bytes, or a builtin world, which has none."""

    file: str
    sha256: str = ""


class EnvironmentMap(FrozenModel):
    """A lat-long map (u = atan2(x, -z) / 2 pi, v = acos(y) / pi) at infinity, or on a dome around the glass."""

    source: AssetSource
    heading_deg: float = 0.0
    """The map's left edge lies in this direction."""
    luminance: NonNegativeFloat = 1.0
    """Its mean luminance over the sphere, lamps left out, in the scene's own unit."""
    radius_mm: Radius = math.inf


class Plane(FrozenModel):
    """A picture on an upright plane, seen from the glass; its height follows from the picture's own shape.

    In front of the glass it is seen in the mirror alone: between glass and camera it belongs beside the view, since
    the analytic renderer does not show it directly.
    """

    source: AssetSource
    distance_mm: PositiveFloat
    """From the glazing's position, straight out to its side."""
    offset_mm: tuple[float, float] = (0.0, 0.0)
    """Of its centre, to the right and up, as a camera sees it that looks through the glass."""
    width_mm: PositiveFloat
    heading_deg: Annotated[float, Field(gt=-80, lt=80)] = 0.0
    pitch_deg: Annotated[float, Field(gt=-80, lt=80)] = 0.0
    luminance: NonNegativeFloat = 1.0
    """Its mean luminance, before highlights are raised."""
    highlights: NonNegativeFloat = 0.0
    """How much light the file's clipped whites get back: white shines (1 + highlights) times as bright."""

    @property
    def nearest_mm(self) -> float:
        """How near to the glass a turned plane comes, if it is square."""
        turned = sum(abs(math.sin(math.radians(angle))) for angle in (self.heading_deg, self.pitch_deg))
        return self.distance_mm - turned * self.width_mm / 2


class Side(FrozenModel):
    """What lies on one side of the glass; with neither map nor plane, darkness."""

    map: EnvironmentMap | None = None
    plane: Plane | None = None

    @model_validator(mode="after")
    def _check_distance(self) -> Side:
        if self.map and self.plane and self.plane.distance_mm >= self.map.radius_mm:
            raise ValueError("the plane stands inside the map's dome: distance_mm is below radius_mm")
        return self

    @property
    def distance_mm(self) -> float:
        """From the glass to the nearest content, infinite where all is far."""
        distances = [self.plane.distance_mm] if self.plane else []
        distances += [self.map.radius_mm] if self.map else []
        return min(distances, default=math.inf)
