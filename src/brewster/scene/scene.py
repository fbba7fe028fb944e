"""A scene: glass, camera, content on both sides, and camera response. It is read from and written as TOML.

scene = read_scene(Path("scene.toml"))
print(scene.to_toml())
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from brewster.scene.camera import Camera, axes, dot
from brewster.scene.glass import Glazing
from brewster.scene.recipe_file import read_toml
from brewster.scene.values import FrozenModel, NonNegativeFloat, PositiveInt, Seed, Share
from brewster.scene.world import Side

MAX_INCIDENCE_DEG = 85.0
"""The largest angle of incidence in a view; steeper ones are refused."""

WhiteBalance = Literal["none", "grey-world", "white-patch", "grey-edge"]


class CameraResponse(FrozenModel):
    """The camera response, from linear light to a photograph. It is computed for I and applied to all layers."""

    exposure: Annotated[float, Field(gt=0, le=1)] = 0.4
    """The mean luminance of I after exposure, where clipped values count as 1."""
    white_balance: WhiteBalance = "none"
    white_balance_strength: Share = 1.0
    contrast: Annotated[float, Field(ge=-0.5, le=0.9)] = 0.0
    """Strength of an S-shaped tone curve on encoded values: 0 is the sRGB curve."""
    shot_noise: NonNegativeFloat = 0.0
    """Standard deviation at white of noise that grows with the square root of the light, in I only."""
    read_noise: NonNegativeFloat = 0.0
    """Standard deviation of noise that does not depend on the light, in I only."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 95
    """JPEG quality of I. The ground truth is written with quality 95."""


class Scene(FrozenModel):
    """Everything that a sample depends on: the same scene and version give the same bytes.

    orders "all": T and R are the full sums, so that I = T + R. "paper": T is the path without any reflection,
    R is what never enters the last pane (for one pane, the first surface alone).
    """

    recipe: str = ""
    seed: Seed = 0
    index: Annotated[int, Field(ge=0)] = 0
    version: str = ""
    """The version of brewster that drew the scene."""
    orders: Literal["all", "paper"] = "all"
    samples: PositiveInt = 16
    """Rays per pixel where random sampling is needed (lens, rough glass), and at most that many elsewhere."""
    glass: Glazing = Glazing()
    camera: Camera = Camera()
    behind: Side = Side()
    front: Side = Side()
    camera_response: CameraResponse = CameraResponse()

    @model_validator(mode="after")
    def _check_geometry(self) -> Scene:
        _, _, normal = axes(self.glass.heading_deg, self.glass.pitch_deg)
        offset = self.camera_above_glass_mm
        if offset <= 0:
            raise ValueError(f"the camera is {-offset:g} mm behind the glass; move it in front of the glass")
        if self.glass.is_flat:
            self._check_incidence(normal)
        self._check_focus(normal, offset)
        self._check_distances()
        return self

    @property
    def camera_above_glass_mm(self) -> float:
        """The distance of the camera from the plane of the first surface."""
        _, _, normal = axes(self.glass.heading_deg, self.glass.pitch_deg)
        x, y, z = (a - b for a, b in zip(self.camera.position_mm, self.glass.position_mm, strict=True))
        return dot((x, y, z), normal)

    def _check_incidence(self, normal: tuple[float, float, float]) -> None:
        for corner in self.camera.corners():
            cosine = -dot(corner, normal) / math.sqrt(dot(corner, corner))
            if cosine <= math.cos(math.radians(MAX_INCIDENCE_DEG)):
                raise ValueError(
                    f"a corner of the view meets the glass at more than {MAX_INCIDENCE_DEG:g} degrees;"
                    " turn the camera to the glass or narrow fov_deg"
                )

    def _check_focus(self, normal: tuple[float, float, float], offset: float) -> None:
        _, _, back = axes(self.camera.heading_deg, self.camera.pitch_deg)
        depth = self.camera.focus_mm * dot(back, normal) - offset
        if self.camera.aperture_mm > 0 and 0 <= depth <= self.glass.depth_mm:
            raise ValueError(
                f"the focus is {depth:g} mm inside the glass; choose focus_mm in front of or behind it"
            )

    def _check_distances(self) -> None:
        """Glass and camera must be inside a dome, and a plane, rotated or not, must not touch the glass."""
        reach = math.dist(self.camera.position_mm, self.glass.position_mm)
        for side, surface_mm in ((self.behind, self.glass.depth_mm), (self.front, 0.0)):
            if side.map and side.map.radius_mm <= max(reach, self.glass.depth_mm):
                raise ValueError(
                    f"the camera is outside the dome of {side.map.radius_mm:g} mm; raise radius_mm"
                )
            if side.plane and side.plane.nearest_mm <= surface_mm:
                raise ValueError(
                    f"a plane at {side.plane.distance_mm:g} mm touches the glass; raise distance_mm"
                )

    def to_toml(self, **extra_tables: dict[str, Any]) -> str:
        """The scene as TOML, followed by extra tables. Reading it gives an equal scene."""
        import tomli_w  # noqa: PLC0415  (not needed to read a scene)

        return tomli_w.dumps({**self.model_dump(mode="json", exclude_none=True), **extra_tables})


def read_scene(path: Path) -> Scene:
    """Reads a scene file or the `scene.toml` of a sample, whose table `outcome` is ignored.

    Raises:
        RecipeError: the file is missing or not TOML, or the scene is not possible.
    """
    return read_toml(_SceneFile, path, compare="brewster render --help").scene()


class _SceneFile(Scene):
    """A scene and the outcome of its rendering."""

    outcome: dict[str, Any] = Field(default_factory=dict)

    def scene(self) -> Scene:
        return Scene.model_validate(self.model_dump(exclude={"outcome"}))
