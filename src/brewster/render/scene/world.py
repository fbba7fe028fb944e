"""The content on each side of the glass: an environment map, a picture on a plane, or a picture in
front of a map.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, PlainSerializer, model_validator

from brewster.base.settings import FrozenModel, NonNegativeFloat, PositiveFloat

Radius = Annotated[float, Field(gt=0, allow_inf_nan=True), PlainSerializer(float)]


class AssetSource(FrozenModel):
    """The name of a file in an assets folder or of a built-in map or photo, and the sha256 of its
    bytes.
    """

    file: str
    sha256: str = ""


class EnvironmentMap(FrozenModel):
    """A lat-long environment map (u = atan2(x, -z) / (2 pi), v = acos(y) / pi), at infinity or on a
    dome.
    """

    source: AssetSource
    heading_deg: float = 0.0
    """Heading of the left edge of the map."""
    luminance: NonNegativeFloat = 1.0
    """Mean luminance over the sphere, in the arbitrary unit of the scene. Lamps have little weight
    in this mean (see `Assets.map_radiance`).
    """
    radius_mm: Radius = math.inf


class Plane(FrozenModel):
    """A picture on a plane.

    A plane in front of the glass is visible in the reflection only. If it is between the glass and
    the camera, choose a position outside the direct view, because the analytic renderer does not
    show the plane in that view.
    """

    source: AssetSource
    distance_mm: PositiveFloat
    """Distance of the plane's centre from the position of the glazing, along the normal of the
    glass.
    """
    offset_mm: tuple[float, float] = (0.0, 0.0)
    """Offset of the centre to the right and up, as seen by a camera that looks through the glass.
    """
    width_mm: PositiveFloat
    height_mm: PositiveFloat | None = None
    """None: the height that keeps the aspect ratio of the picture. Frames of a burst have a height.
    """
    heading_deg: Annotated[float, Field(gt=-80, lt=80)] = 0.0
    pitch_deg: Annotated[float, Field(gt=-80, lt=80)] = 0.0
    luminance: NonNegativeFloat = 1.0
    """Mean luminance of the picture before `highlight_boost` is applied."""
    highlight_boost: NonNegativeFloat = 0.0
    """Extra brightness of clipped whites: the light of white is multiplied by 1 + highlight_boost.
    """

    @property
    def nearest_mm(self) -> float:
        """Lower bound of the distance between the glass and the rotated plane, for a square
        picture.
        """
        sines = sum(
            abs(math.sin(math.radians(angle))) for angle in (self.heading_deg, self.pitch_deg)
        )
        return self.distance_mm - sines * self.width_mm / 2


class Cloth(FrozenModel):
    """A dark cloth that covers a band of the mirrored scene, as the camera sees it in the glass.

    Positions are in half widths of the photo, from its centre.
    """

    centre: float = 0.0
    """The position of the middle of the band."""
    width: PositiveFloat
    direction_deg: float = 0.0
    """The direction in which the band ends: 0 is to the right, so that the band is upright."""
    softness: NonNegativeFloat = 0.0
    """The width of its edges, which are out of focus."""
    transmittance: Annotated[float, Field(ge=0, le=1)] = 0.0
    """The share of the mirrored light that the cloth sends, too."""


class Side(FrozenModel):
    """The content on one side of the glass. The side is black if it has neither a map nor a
    plane.
    """

    map: EnvironmentMap | None = None
    plane: Plane | None = None

    @model_validator(mode="after")
    def _check_distance(self) -> Side:
        if self.map and self.plane and self.plane.distance_mm >= self.map.radius_mm:
            raise ValueError(
                "expected the plane inside the dome of the map: distance_mm must be below radius_mm"
            )
        return self

    @property
    def distance_mm(self) -> float:
        """The distance from the glass to the nearest content; infinite for a map at infinity."""
        distances = [self.plane.distance_mm] if self.plane else []
        distances += [self.map.radius_mm] if self.map else []
        return min(distances, default=math.inf)
