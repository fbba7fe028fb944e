"""A scene recipe: how scenes of one kind are distributed. TOML in, frozen values out.

Ranges are uniform, `_log` ranges uniform in the logarithm; `_probability` is the share of scenes that have it.
The packaged recipes lie in `recipes/` beside this file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from brewster.errors import RecipeError
from brewster.scene.scene import WhiteBalance
from brewster.scene.values import (
    FrozenModel,
    LogRange,
    NonNegativeFloat,
    PositiveInt,
    Range,
    Share,
    read_toml,
)

_FOLDER: Final = Path(__file__).parent / "recipes"
RECIPES: Final = tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))
"""The names of the packaged recipes."""


class GlassRecipe(FrozenModel):
    """The glass of one kind of scene."""

    double_probability: Share = 0.0
    gap_mm: Range = (6.0, 20.0)
    thickness_mm: LogRange = (3.0, 6.0)
    structural_probability: Share = 0.0
    structural_mm: LogRange = (10.0, 40.0)
    index: Range = (1.45, 1.65)
    tints: tuple[tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat], ...] = ((4.0, 1.5, 2.5),)
    """Absorption per metre for red, green and blue; clear float glass is a little green."""
    tint_strength_log: LogRange = (0.3, 2.0)
    rough_probability: Share = 0.0
    roughness_log: LogRange = (0.01, 0.1)
    wedge_probability: Share = 0.0
    wedge_deg_log: LogRange = (0.01, 0.3)
    pitch_deg: Range = (0.0, 0.0)

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        if self.index[0] < 1:
            raise ValueError(f"glass has an index of 1 or more, and this begins at {self.index[0]:g}")
        if self.gap_mm[0] <= 0 and self.double_probability:
            raise ValueError(f"panes stand apart: gap_mm begins at {self.gap_mm[0]:g}")
        if not self.tints:
            raise ValueError("tints has at least one colour")
        return self


class CameraRecipe(FrozenModel):
    """Cameras that look at the glass."""

    width: Annotated[int, Field(ge=16)] = 512
    height: Annotated[int, Field(ge=16)] = 384
    distance_mm_log: LogRange = (300.0, 3000.0)
    incidence_deg: Range = (-35.0, 35.0)
    pitch_deg: Range = (-12.0, 12.0)
    fov_deg: Range = (30.0, 90.0)
    pinhole_probability: Share = 0.7
    aperture_mm_log: LogRange = (1.0, 15.0)
    focus_on_front_probability: Share = 0.15
    """Of a lens that is set on what is mirrored, instead of on what is behind the glass."""


class SideRecipe(FrozenModel):
    """What one side may hold. A map is taken only where a pixel spans at least 1 / most_px_per_texel texels."""

    map_probability: Share = 1.0
    maps: tuple[str, ...] = ()
    """Wanted categories; none means any."""
    most_px_per_texel: Annotated[float, Field(gt=0)] = 2.5
    dome_probability: Share = 0.0
    radius_mm_log: LogRange = (3000.0, 10_000.0)
    picture_probability: Share = 0.0
    distance_mm_log: LogRange = (1000.0, 8000.0)
    fill: Range = (1.05, 1.5)
    """The picture's width over the width that would just cover the view."""
    turn_deg: Range = (0.0, 0.0)
    highlights: Range = (0.0, 0.0)
    luminance_log: LogRange = (1.0, 1.0)


class DevelopmentRecipe(FrozenModel):
    """How the photographs are developed; see `Development`."""

    exposure: LogRange = (0.2, 0.5)
    white_balance: Annotated[tuple[WhiteBalance, ...], Field(min_length=1)] = (
        "none",
        "grey-world",
        "white-patch",
        "grey-edge",
    )
    white_balance_strength: Range = (0.3, 1.0)
    contrast: Range = (-0.1, 0.5)
    shot_noise: Range = (0.0, 0.02)
    read_noise: Range = (0.0, 0.004)
    jpeg_quality: tuple[Annotated[int, Field(ge=1, le=100)], Annotated[int, Field(ge=1, le=100)]] = (60, 97)

    @model_validator(mode="after")
    def _check_quality(self) -> Self:
        if self.jpeg_quality[0] > self.jpeg_quality[1]:
            raise ValueError(f"jpeg_quality goes up, and this goes from {self.jpeg_quality[0]}")
        return self


class SceneRecipe(FrozenModel):
    """One kind of scene."""

    name: str
    about: str
    orders: Literal["all", "paper"] = "all"
    samples: PositiveInt = 8
    rough_samples: PositiveInt = 16
    glass: GlassRecipe = GlassRecipe()
    camera: CameraRecipe = CameraRecipe()
    behind: SideRecipe = SideRecipe()
    front: SideRecipe = SideRecipe()
    development: DevelopmentRecipe = DevelopmentRecipe()


def read_scene_recipe(name: str) -> SceneRecipe:
    """A packaged recipe by its name, or one of your own by its path.

    Raises:
        RecipeError: unknown, missing, not TOML, or with values that are missing, unknown or impossible.
    """
    if name in RECIPES:
        return read_toml(SceneRecipe, _FOLDER / f"{name}.toml", compare="the packaged recipes")
    if not name.endswith(".toml"):
        raise RecipeError(
            f"there is no recipe {name!r}",
            f"known are {', '.join(RECIPES)}",
            "name one, or give a .toml file",
        )
    return read_toml(SceneRecipe, Path(name), compare="the packaged recipes")
