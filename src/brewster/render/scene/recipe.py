"""Scene recipes: distributions of the parameters of random scenes, read from TOML into frozen
models.

A `Range` is sampled uniformly, a `LogRange` log-uniformly (uniformly in the logarithm). A key that
ends in `_probability` is the probability that a scene has the feature. The packaged recipes are the
TOML files in the folder `recipes` next to this file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal, Self, get_args

from pydantic import Field, WithJsonSchema, model_validator

from brewster.base.settings import (
    FrozenModel,
    JpegQualityRange,
    LogRange,
    NonNegativeFloat,
    Pixels,
    PositiveFloat,
    PositiveInt,
    Range,
    Share,
    packaged_file,
    read_toml,
)
from brewster.render.scene.scene import WhiteBalance

Setup = Literal["map|map", "map|plane", "plane|map"]
"""The kinds of content behind and in front of the glass (paper, figure on scene setups: HDR|HDR,
HDR|LDR, LDR|HDR).
"""

_FOLDER: Final = Path(__file__).parent / "recipes"
RECIPES: Final = tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))
"""The names of the packaged recipes."""


class GlassRecipe(FrozenModel):
    """The glass: panes, thickness, refractive index, tint, roughness."""

    double_probability: Share = 0.0
    """Probability of double glazing: two panes with air between them."""
    gap_mm: Range = (6.0, 20.0)
    """Width of the air gap of double glazing."""
    thickness_mm: LogRange = (3.0, 6.0)
    """Thickness of a pane."""
    structural_probability: Share = 0.0
    """Probability of thick structural glass."""
    structural_thickness_mm: LogRange = (10.0, 40.0)
    """Thickness of a pane of structural glass."""
    refractive_index: Range = (1.45, 1.65)
    """Refractive index, the same for all panes of a scene; at least 1."""
    absorption_per_m: tuple[tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat], ...] = (
        (4.0, 1.5, 2.5),
    )
    """List of triples of absorption coefficients (red, green, blue). One triple is drawn for each
    scene. The default coefficients are larger for red and blue than for green, because clear float
    glass is slightly green.
    """
    tint_strength: LogRange = (0.3, 2.0)
    """Factor on the absorption coefficients."""
    rough_probability: Share = 0.0
    """Probability of rough glass."""
    roughness: LogRange = (0.01, 0.1)
    """GGX roughness (alpha) of the surfaces of rough glass: 0.05 is satin, 0.2 frosted."""
    wedge_probability: Share = 0.0
    """Probability of wedged panes, whose two surfaces are not parallel."""
    wedge_deg: LogRange = (0.01, 0.3)
    """Angle between the two surfaces of a wedged pane."""
    pitch_deg: Range = (0.0, 0.0)
    """Elevation of the normal of the glass above the horizon; 0 for upright glass."""

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        if self.refractive_index[0] < 1:
            raise ValueError(
                "expected a refractive_index of at least 1, but it starts at "
                f"{self.refractive_index[0]:g}"
            )
        if self.gap_mm[0] <= 0 and self.double_probability:
            raise ValueError(
                f"expected a gap_mm above 0 for double glazing, but it starts at {self.gap_mm[0]:g}"
            )
        if not self.absorption_per_m:
            raise ValueError("expected at least one colour, but absorption_per_m is empty")
        return self


class CameraRecipe(FrozenModel):
    """The camera: the size of its image, its position in front of the glass, its lens."""

    width: Pixels = 512
    """Width of the image."""
    height: Pixels = 384
    """Height of the image."""
    distance_mm: LogRange = (300.0, 3000.0)
    """Distance of the camera from the glass."""
    incidence_deg: Range = (-35.0, 35.0)
    """Horizontal angle between the optical axis and the normal of the glass."""
    pitch_deg: Range = (-12.0, 12.0)
    """Angle of the optical axis above the horizon."""
    fov_deg: Range = (30.0, 90.0)
    """Horizontal field of view. `max_px_per_texel` raises the lower limit for small maps."""
    pinhole_probability: Share = 0.7
    """Probability of a pinhole camera, which has no defocus."""
    aperture_mm: LogRange = (1.0, 15.0)
    """Aperture diameter of a camera with a lens."""
    focus_on_front_probability: Share = 0.15
    """Probability that the camera is focused on the mirrored content instead of the content behind
    the glass.
    """


class SideRecipe(FrozenModel):
    """The content on one side of the glass: an environment map, a picture on a plane, or both."""

    map_probability: Share = 1.0
    """Probability of an environment map. A side without a map has a picture."""
    map_categories: tuple[str, ...] = ()
    """Categories of the maps, such as indoor, outdoor or night. An empty list selects all maps."""
    max_px_per_texel: PositiveFloat = 2.5
    """Maximum width of a texel of the map in the image. It limits the choice of maps and the field
    of view.
    """
    dome_probability: Share = 0.0
    """Probability that the map is on a sphere (dome) of finite radius around the glass instead of
    at infinity.
    """
    radius_mm: LogRange = (3000.0, 10_000.0)
    """Radius of the dome."""
    plane_probability: Share = 0.0
    """Probability of a picture on a plane, in front of the map if there is one."""
    distance_mm: LogRange = (1000.0, 8000.0)
    """Distance of the picture behind the last pane; in [front], its distance behind the camera."""
    relative_width: Range = (1.05, 1.5)
    """Width of the picture, divided by the width that exactly covers the view."""
    heading_deg: Range = (0.0, 0.0)
    """Rotation of the picture about the vertical axis. The rotation about the horizontal axis has
    half this range.
    """
    highlight_boost: Range = (0.0, 0.0)
    """Extra brightness of clipped whites in a picture: the light of white is multiplied by 1 +
    highlight_boost.
    """
    partial_probability: Share = 0.0
    """Probability that a side with a map has a picture that covers only a part of the view and is
    much brighter or darker than the map: a lit window in a dark room, or a person against the sky.
    """
    partial_width: Range = (0.2, 0.7)
    """Width of such a picture, divided by the width of the view at its distance."""
    partial_contrast: LogRange = (4.0, 40.0)
    """Ratio of the mean luminances of such a picture and of the map; the brighter one has
    `luminance`.
    """
    luminance: LogRange = (1.0, 1.0)
    """Mean luminance of the content. Only the ratio of the two sides matters: the exposure is
    automatic.
    """


class CameraResponseRecipe(FrozenModel):
    """The camera response: the conversion of linear light into an 8-bit photograph."""

    target_luminance: LogRange = (0.2, 0.5)
    """Mean luminance of the photo I after exposure and clipping to 0..1."""
    white_balance: Annotated[tuple[WhiteBalance, ...], Field(min_length=1)] = get_args(WhiteBalance)
    """Methods of automatic white balance, one of which is drawn."""
    white_balance_strength: Range = (0.3, 1.0)
    """Exponent on the white balance gains: 0 gives no correction, 1 the full correction."""
    contrast: Range = (-0.1, 0.5)
    """Weight of an S-shaped tone curve: 0 is the sRGB curve, negative values give less contrast."""
    shot_noise: Range = (0.0, 0.02)
    """Shot noise of the photo I: its standard deviation at white, proportional to the square root
    of the light.
    """
    read_noise: Range = (0.0, 0.004)
    """Read noise of the photo I: its standard deviation, which does not depend on the light."""
    jpeg_quality: JpegQualityRange = (60, 97)
    """JPEG quality of the photo I. The other images have a quality of 95."""


class BurstRecipe(FrozenModel):
    """Several photos of each scene, by a camera that moves, or in light that changes."""

    light: Literal["constant", "polariser", "cloth"] = "constant"
    """What changes the reflection from photo to photo: a polariser that is turned by half a turn
    in all, or a dark cloth that is moved in front of the mirrored scene.
    """
    polariser_jitter_deg: NonNegativeFloat = 6.0
    """Standard deviation of the angles of the polariser from equal steps."""
    cloth_width: Range = (0.4, 1.0)
    """Width of the cloth in half widths of the photo."""
    cloth_path: Range = (1.0, 2.0)
    """Length of the path of the cloth in half widths of the photo; at most 2 is in the photo."""
    cloth_transmittance: Range = (0.01, 0.08)
    """The share of the mirrored light that the cloth sends, too."""
    cloth_softness: LogRange = (0.005, 0.1)
    """Width of the edges of the cloth in half widths of the photo."""

    frames: Annotated[int, Field(ge=2, le=99)] = 5
    """Number of photos in a burst."""
    baseline_mm: Range = (0.0, 120.0)
    """Distance between the first and the last position of the camera; at least 0."""
    direction_deg: Range = (-20.0, 20.0)
    """Angle between the move of the camera and the horizontal axis of the photo."""
    tremble_mm: NonNegativeFloat = 2.0
    """Standard deviation of the position of the camera from the line, for each of its three
    coordinates.
    """
    tremble_deg: NonNegativeFloat = 0.3
    """Standard deviation of the rotation of the camera about each of its three axes."""
    exposure_jitter_ev: Annotated[NonNegativeFloat, Field(json_schema_extra={"unit": "stops"})] = (
        0.1
    )
    """Standard deviation of the exposure."""
    static_probability: Share = 0.0
    """Probability of a burst from a tripod: the camera does not move, so neither layer moves."""

    @model_validator(mode="after")
    def _check_baseline(self) -> Self:
        if self.baseline_mm[0] < 0:
            raise ValueError(
                f"expected a baseline_mm of at least 0, but it starts at {self.baseline_mm[0]:g}"
            )
        return self


class SceneRecipe(FrozenModel):
    """Distributions of the parameters of random scenes."""

    name: str
    """The name of the recipe. Recipes with different names give different scenes for the same seed.
    """
    about: str
    """A description of the scenes."""
    orders: Literal["all", "truncated"] = "all"
    """Light paths in T and R. With "all", they contain all orders of reflection, so that I = T + R.
    With "truncated", T contains only the path without a reflection, and R only the paths that do
    not enter the last pane.
    """
    samples_per_pixel: PositiveInt = 8
    """Rays per pixel of scenes that need Monte Carlo sampling (a wedged pane, or a lens and near
    content), and the maximum for other scenes without rough glass.
    """
    rough_samples_per_pixel: PositiveInt = 16
    """Rays per pixel for scenes with rough glass."""
    setups: Annotated[
        dict[Setup, Share],
        WithJsonSchema(
            {"type": 'table of "map|map", "map|plane" and "plane|map" = weight from 0 to 1'}
        ),
    ] = Field(default={})
    """Relative frequencies of the kinds of content behind|in front of the glass: an environment
    map, or a picture on a plane without a map. They replace map_probability and plane_probability
    of both sides. With an empty table, each side is drawn independently.
    """
    glass: GlassRecipe = GlassRecipe()
    camera: CameraRecipe = CameraRecipe()
    behind: SideRecipe = SideRecipe()
    """The content behind the glass, which is visible in the transmission."""
    front: SideRecipe = SideRecipe()
    """The content in front of the glass, which is visible in the reflection. It has the same keys
    as [behind].
    """
    camera_response: CameraResponseRecipe = CameraResponseRecipe()
    burst: BurstRecipe | None = None
    """Bursts: several photos of each scene. The camera moves sideways along a line and trembles;
    exposure and noise of the photos differ. The middle photo, the reference frame, is the photo
    that the recipe gives without this table.
    """

    @property
    def frames(self) -> int:
        """The number of photos of each scene: 1 without the table [burst]."""
        return self.burst.frames if self.burst else 1

    @model_validator(mode="after")
    def _check_setups(self) -> Self:
        if self.setups and not any(self.setups.values()):
            raise ValueError("expected a weight above 0 for at least one of the setups")
        return self

    def with_setup(self, setup: Setup) -> SceneRecipe:
        """Returns the recipe whose two sides have exactly this kind of content."""
        behind, front = (
            side.model_copy(
                update={
                    "map_probability": float(kind == "map"),
                    "plane_probability": float(kind != "map"),
                }
            )
            for side, kind in zip((self.behind, self.front), setup.split("|"), strict=True)
        )
        return self.model_copy(update={"behind": behind, "front": front})


def read_scene_recipe(name: str) -> SceneRecipe:
    """Reads a packaged recipe by its name, or any recipe from a .toml file. Raises RecipeError if
    the name is unknown, the file is missing or not TOML, or keys are missing, unknown or have
    impossible values.
    """
    return read_toml(SceneRecipe, packaged_file(name, _FOLDER), reference="docs/recipes.md")
