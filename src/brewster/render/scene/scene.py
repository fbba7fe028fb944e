"""A scene: glass, camera, content on both sides, and camera response. Scenes are read from and
written to TOML.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from brewster.base.settings import (
    FrozenModel,
    NonNegativeFloat,
    PositiveInt,
    Seed,
    Share,
    read_toml,
)
from brewster.render.scene.camera import Camera, axes, dot
from brewster.render.scene.glass import Glazing
from brewster.render.scene.world import Cloth, Side

MAX_INCIDENCE_DEG = 85.0
"""The largest allowed angle of incidence at the four corners of the view on flat glass."""

WhiteBalance = Literal["none", "grey-world", "white-patch", "grey-edge"]


class CameraResponse(FrozenModel):
    """The camera response: the conversion of linear light into a photograph.

    Exposure and white balance gains are computed on I and applied to I, T, B and R. MR has its own
    exposure.
    """

    target_luminance: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Mean luminance of I after exposure and clipping to 0..1."""
    white_balance: WhiteBalance = "none"
    white_balance_strength: Share = 1.0
    contrast: Annotated[float, Field(ge=-0.5, le=0.9)] = 0.0
    """Weight of an S-shaped tone curve on encoded values: 0 is the sRGB curve."""
    shot_noise: NonNegativeFloat = 0.0
    """Standard deviation at white of the noise of I only. It is proportional to the square root of
    the light.
    """
    read_noise: NonNegativeFloat = 0.0
    """Standard deviation of the noise that is added to I only and does not depend on the light."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 95
    """JPEG quality of I. The ground truth is written with quality 95."""


class BurstFrame(FrozenModel):
    """The position of a photo in its burst. Its scenes differ only in camera, exposure and
    noise.
    """

    frame: Annotated[int, Field(ge=0)]
    frames: Annotated[int, Field(ge=2)]

    @model_validator(mode="after")
    def _check_frame(self) -> BurstFrame:
        if self.frame >= self.frames:
            raise ValueError(
                f"expected a frame below {self.frames}, the number of frames, but it is "
                f"{self.frame}"
            )
        return self

    @property
    def is_reference(self) -> bool:
        """Whether this is the reference frame: the middle one."""
        return self.frame == self.frames // 2


class Scene(FrozenModel):
    """All data that determine a sample: the same scene and the same version of brewster give the
    same bytes.

    With `orders` "all", T and R contain all light paths, so that I = T + R. With "truncated", T has
    only the path without a reflection, and R only the paths that do not enter the last pane (of one
    pane: its first surface reflects).
    """

    recipe: str = ""
    seed: Seed = 0
    index: Annotated[int, Field(ge=0)] = 0
    version: str = ""
    """The version of brewster that drew the scene."""
    orders: Literal["all", "truncated"] = "all"
    samples_per_pixel: PositiveInt = 16
    """Rays per pixel of scenes with rough or wedged glass, or a lens and near content; the maximum
    for others.
    """
    glass: Glazing = Glazing()
    camera: Camera = Camera()
    behind: Side = Side()
    front: Side = Side()
    cloth: Annotated[Cloth | None, Field(exclude_if=lambda cloth: cloth is None)] = None
    """A cloth in front of the mirrored scene."""
    camera_response: CameraResponse = CameraResponse()
    burst: BurstFrame | None = None
    """The position in a burst; None for a single photo. All frames of a burst have the same `seed`
    and `index`.
    """

    @model_validator(mode="after")
    def _check_geometry(self) -> Scene:
        _, _, normal = axes(self.glass.heading_deg, self.glass.pitch_deg)
        above_glass_mm = self.camera_above_glass_mm
        if above_glass_mm <= 0:
            raise ValueError(
                f"expected the camera in front of the glass, but it is {-above_glass_mm:g} mm "
                "behind it"
            )
        for corner in self.camera.corners() if self.glass.is_flat else ():
            cosine = -dot(corner, normal) / math.sqrt(dot(corner, corner))
            if cosine <= math.cos(math.radians(MAX_INCIDENCE_DEG)):
                raise ValueError(
                    f"expected angles of incidence up to {MAX_INCIDENCE_DEG:g} degrees, but a "
                    "corner of the view"
                    " exceeds this limit: turn the camera to the glass, or reduce fov_deg"
                )
        _, _, back = self.camera.axes
        depth_mm = self.camera.focus_mm * dot(back, normal) - above_glass_mm
        if self.camera.aperture_mm > 0 and 0 <= depth_mm <= self.glass.depth_mm:
            raise ValueError(
                f"expected a focus_mm outside the glass, but the focus is {depth_mm:g} mm inside "
                "the glass"
            )
        return self

    @model_validator(mode="after")
    def _check_polariser(self) -> Scene:
        if self.camera.polariser_deg is not None and (self.glass.is_rough or self.glass.is_wedged):
            raise ValueError("expected smooth parallel panes, because the camera has a polariser")
        return self

    @model_validator(mode="after")
    def _check_distances(self) -> Scene:
        """Checks that glass and camera are inside every dome, and that no plane touches the
        glass.
        """
        camera_distance_mm = math.dist(self.camera.position_mm, self.glass.position_mm)
        for side, surface_mm in ((self.behind, self.glass.depth_mm), (self.front, 0.0)):
            if side.map and side.map.radius_mm <= max(camera_distance_mm, self.glass.depth_mm):
                raise ValueError(
                    "expected the camera and the glass inside the dome, but its radius_mm is"
                    f" {side.map.radius_mm:g}: increase it"
                )
            if side.plane and side.plane.nearest_mm <= surface_mm:
                raise ValueError(
                    "expected a plane that does not touch the glass, but its distance_mm is"
                    f" {side.plane.distance_mm:g}: increase it"
                )
        return self

    @property
    def camera_above_glass_mm(self) -> float:
        """The distance of the camera from the plane of the first surface."""
        _, _, normal = axes(self.glass.heading_deg, self.glass.pitch_deg)
        x, y, z = (
            a - b for a, b in zip(self.camera.position_mm, self.glass.position_mm, strict=True)
        )
        return dot((x, y, z), normal)

    @property
    def noise_seeds(self) -> tuple[int, ...]:
        """The seeds of the noise in I. The reference frame of a burst has the noise of the single
        photo.
        """
        seeds = self.seed, self.index
        return (
            seeds
            if self.burst is None or self.burst.is_reference
            else (*seeds, self.burst.frame + 1)
        )

    def to_toml(self, **extra_tables: dict[str, Any]) -> str:
        """Returns the scene as TOML, followed by extra tables. `read_scene` reads an equal scene
        from it.
        """
        import tomli_w  # noqa: PLC0415  (not needed to read a scene)

        return tomli_w.dumps({**self.model_dump(mode="json", exclude_none=True), **extra_tables})


def read_scene(path: Path) -> Scene:
    """Reads a scene file or the `scene.toml` of a sample, without its table `outcome`. Raises
    RecipeError if the file is missing or not TOML, or its values are unknown or not possible.
    """
    return read_toml(Scene, path, reference="brewster render --help", ignored={"outcome"})
