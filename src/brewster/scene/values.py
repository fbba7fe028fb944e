"""The base class of all recipes and scenes, and the types of their values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic_core import CoreSchema


class FrozenModel(BaseModel):
    """An immutable pydantic model that refuses unknown keys, NaN and infinity.

    The docstring below an attribute is the description of its key in docs/recipes.md and in `--show-recipe`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


@dataclass(frozen=True)
class KeyNote:
    """Additions to the description of a key, which its type and constraints do not contain."""

    kind: str = ""
    """The type in words. It replaces the description of the annotation."""
    allowed: str = ""
    """The allowed values in words. They follow the description of the constraints."""
    unit: str = ""
    """The unit, for keys whose name has no suffix such as `_mm`."""
    replaces_constraints: bool = False
    """Whether `allowed` replaces the description of the constraints."""

    def __get_pydantic_json_schema__(
        self, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Adds this note to the JSON schema of the key, where `recipe_keys` reads it."""
        return handler(core_schema) | {"note": asdict(self)}


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"expected low <= high, but low is {bounds[0]:g} and high is {bounds[1]:g}")
    return bounds


Share = Annotated[float, Field(ge=0, le=1)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(gt=0)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Pixels = Annotated[int, Field(ge=16), KeyNote(unit="px")]
Range = Annotated[
    tuple[float, float], AfterValidator(_ascending), KeyNote("range [low, high]", "sampled uniformly")
]
LogRange = Annotated[
    tuple[PositiveFloat, PositiveFloat],
    AfterValidator(_ascending),
    KeyNote("range [low, high]", "sampled log-uniformly"),
]
JpegQuality = Annotated[int, Field(ge=1, le=100)]
JpegQualityRange = Annotated[
    tuple[JpegQuality, JpegQuality],
    AfterValidator(_ascending),
    KeyNote("range [low, high] of integers", "sampled uniformly"),
]
