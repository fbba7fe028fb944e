"""The camera (a thin lens and a sensor), and the axes of an object with a given heading and
pitch.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from brewster.base.settings import FrozenModel, NonNegativeFloat, PositiveFloat
from brewster.render.scene.glass import Point

Axes = tuple[Point, Point, Point]
"""Unit vectors (right, up, back)."""


class Camera(FrozenModel):
    """Position, orientation and thin lens of a camera with square pixels.

    `roll_deg` turns the camera about its optical axis, clockwise for the photographer. `fov_deg` is
    the horizontal field of view. `aperture_mm` is the diameter of the lens; with 0, the camera is a
    pinhole. `focus_mm` is the distance from the lens to the plane in focus, along the optical axis.
    `width` and `height` are in px.
    """

    position_mm: Point = (0.0, 0.0, 1000.0)
    heading_deg: float = 0.0
    pitch_deg: Annotated[float, Field(ge=-80, le=80)] = 0.0
    roll_deg: Annotated[float, Field(ge=-180, le=180, exclude_if=lambda roll: roll == 0)] = 0.0
    fov_deg: Annotated[float, Field(gt=0.5, lt=150)] = 50.0
    focus_mm: PositiveFloat = 3000.0
    aperture_mm: NonNegativeFloat = 0.0
    width: Annotated[int, Field(ge=16, le=16384)] = 512
    height: Annotated[int, Field(ge=16, le=16384)] = 384
    polariser_deg: Annotated[
        float | None, Field(ge=-180, le=180, exclude_if=lambda angle: angle is None)
    ] = None
    """The direction of the light that a linear polariser in front of the lens passes: 0 is the
    horizontal axis of the photo. None: no polariser. Light is relative to that of an unpolarised
    scene behind the polariser.
    """

    @property
    def axes(self) -> Axes:
        """Unit vectors (right, up, back) in world coordinates. `back` is opposite to the viewing
        direction.
        """
        right, up, back = axes(self.heading_deg, self.pitch_deg)
        cosine = math.cos(math.radians(self.roll_deg))
        sine = math.sin(math.radians(self.roll_deg))
        rolled = (
            _add(_scale(right, cosine), _scale(up, -sine)),
            _add(_scale(up, cosine), _scale(right, sine)),
        )
        return (*rolled, back)

    def moved(self, offset_mm: Point, turn_deg: Point) -> Camera:
        """Returns the camera after a move to the right, up and back, and a turn of heading, pitch
        and roll. Raises ValidationError if the pitch is then above 80 degrees.
        """
        moves = map(_scale, self.axes, offset_mm)
        values = {"position_mm": _add(self.position_mm, *moves)}
        angles = zip(("heading_deg", "pitch_deg", "roll_deg"), turn_deg, strict=True)
        turned = {name: getattr(self, name) + turn for name, turn in angles}
        return Camera.model_validate(dict(self) | values | turned)

    @property
    def half_width(self) -> float:
        """Half the width of the image in the plane at distance 1: the tangent of half the field of
        view.
        """
        return math.tan(math.radians(self.fov_deg) / 2)

    @property
    def pixel_rad(self) -> float:
        """Angle of view of one pixel at the centre of the image, in radians."""
        return 2 * self.half_width / self.width

    def corners(self) -> list[Point]:
        """Returns the directions through the four corners of the image. They are not normalised."""
        right, up, back = self.axes
        across, down = self.half_width, self.half_width * self.height / self.width
        return [
            _add(_scale(right, x), _scale(up, y), _scale(back, -1))
            for x in (-across, across)
            for y in (-down, down)
        ]


def axes(heading_deg: float, pitch_deg: float) -> Axes:
    """Returns the `Axes` of an object with a heading (0 is -z, 90 is +x) and a pitch above the
    horizon.
    """
    heading = math.radians(heading_deg)
    pitch = math.radians(pitch_deg)
    forward = (
        math.sin(heading) * math.cos(pitch),
        math.sin(pitch),
        -math.cos(heading) * math.cos(pitch),
    )
    right = (math.cos(heading), 0.0, math.sin(heading))
    up = (
        right[1] * forward[2] - right[2] * forward[1],
        right[2] * forward[0] - right[0] * forward[2],
        right[0] * forward[1] - right[1] * forward[0],
    )
    return right, up, _scale(forward, -1)


def dot(one: Point, other: Point) -> float:
    """Returns the inner product of two vectors."""
    return sum(a * b for a, b in zip(one, other, strict=True))


def _scale(point: Point, factor: float) -> Point:
    return point[0] * factor, point[1] * factor, point[2] * factor


def _add(*points: Point) -> Point:
    x, y, z = (sum(values) for values in zip(*points, strict=True))
    return x, y, z
