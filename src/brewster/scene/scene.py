"""A scene: glass, camera, the two sides, and how the picture is developed. It prints and reads as TOML.

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
from brewster.scene.values import FrozenModel, NonNegativeFloat, PositiveInt, Seed, Share, read_toml
from brewster.scene.world import Side

MAX_INCIDENCE_DEG = 85.0
"""Beyond this angle of incidence the view grazes the glass, and is refused."""

WhiteBalance = Literal["none", "grey-world", "white-patch", "grey-edge"]


class Development(FrozenModel):
    """From light to a photograph: decided on I, applied to all layers alike."""

    exposure: Annotated[float, Field(gt=0, le=1)] = 0.4
    """The mean luminance of I after exposure, where what is clipped counts as white."""
    white_balance: WhiteBalance = "none"
    white_balance_strength: Share = 1.0
    contrast: Annotated[float, Field(ge=-0.5, le=0.9)] = 0.0
    """How far encoded values move from a straight line towards an S: 0 is the plain sRGB curve."""
    shot_noise: NonNegativeFloat = 0.0
    """Standard deviation at white, of noise that grows with the root of the light, in I only."""
    read_noise: NonNegativeFloat = 0.0
    """Standard deviation of noise that is everywhere the same, in I only."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 95
    """Of I; the truths are written at 95."""


class Scene(FrozenModel):
    """Everything a sample is made from; (scene, version) gives the same bytes again.

    orders "all": T and R are the full sums, so that I = T + R. "paper": T is the path without any reflection,
    R is what never enters the last pane (for one pane, the first surface alone).
    """

    recipe: str = ""
    seed: Seed = 0
    index: Annotated[int, Field(ge=0)] = 0
    version: str = ""
    """Of brewster, when the scene was drawn."""
    orders: Literal["all", "paper"] = "all"
    samples: PositiveInt = 16
    """Rays a pixel: as many where chance is needed (lens, rough glass), at most as many elsewhere."""
    glass: Glazing = Glazing()
    camera: Camera = Camera()
    behind: Side = Side()
    front: Side = Side()
    development: Development = Development()

    @model_validator(mode="after")
    def _check_geometry(self) -> Scene:
        _, _, normal = axes(self.glass.heading_deg, self.glass.pitch_deg)
        offset = self.camera_above_glass_mm
        if offset <= 0:
            raise ValueError(f"the camera stands {-offset:g} mm behind the glass; it belongs in front")
        if self.glass.is_flat:
            self._check_incidence(normal)
        self._check_focus(normal, offset)
        self._check_distances()
        return self

    @property
    def camera_above_glass_mm(self) -> float:
        """The camera's distance from the plane of the first surface."""
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
                f"the focus lies {depth:g} mm inside the glass; move focus_mm before or behind it"
            )

    def _check_distances(self) -> None:
        """A dome holds the glass and the camera; a plane, turned or not, stands clear of the glass."""
        reach = math.dist(self.camera.position_mm, self.glass.position_mm)
        for side, surface_mm in ((self.behind, self.glass.depth_mm), (self.front, 0.0)):
            if side.map and side.map.radius_mm <= max(reach, self.glass.depth_mm):
                raise ValueError(f"the camera stands outside the dome of {side.map.radius_mm:g} mm")
            if side.plane and side.plane.nearest_mm <= surface_mm:
                raise ValueError(f"a plane at {side.plane.distance_mm:g} mm stands in the glass")

    def to_toml(self, **extra_tables: dict[str, Any]) -> str:
        """The scene as TOML, with more tables after it; reading it gives an equal scene."""
        import tomli_w  # noqa: PLC0415  (reading a scene does without it)

        return tomli_w.dumps({**self.model_dump(mode="json", exclude_none=True), **extra_tables})


def read_scene(path: Path) -> Scene:
    """Reads a scene file, a sample's `scene.toml` too: what it says of the outcome is passed over.

    Raises:
        RecipeError: missing, not TOML, or not a possible scene.
    """
    return read_toml(_SceneFile, path, compare="brewster render --help").scene()


class _SceneFile(Scene):
    """A scene and what was made of it."""

    outcome: dict[str, Any] = Field(default_factory=dict)

    def scene(self) -> Scene:
        return Scene.model_validate(self.model_dump(exclude={"outcome"}))
