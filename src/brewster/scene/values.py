"""The base class of every recipe and scene, and the value types that they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


class FrozenModel(BaseModel):
    """An immutable model. Unknown keys, NaN and infinity are refused.

    The docstring below an attribute becomes the description of its key: in docs/recipes.md, in `--show-recipe`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


@dataclass(frozen=True)
class KeyNote:
    """Metadata of a key for its description, where the type and the constraints do not say it."""

    kind: str = ""
    """The type in words, instead of the one derived from the annotation."""
    allowed: str = ""
    """The allowed values in words, after those derived from the constraints."""
    unit: str = ""
    """The unit, where the name of the key has no suffix such as `_mm`."""
    instead: bool = False
    """Whether `allowed` replaces the words derived from the constraints."""


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"expected low <= high, and low is {bounds[0]:g}, high is {bounds[1]:g}")
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
    KeyNote("range [low, high]", "sampled uniformly in the logarithm"),
]
JpegQuality = Annotated[int, Field(ge=1, le=100)]
JpegQualityRange = Annotated[
    tuple[JpegQuality, JpegQuality],
    AfterValidator(_ascending),
    KeyNote("range [low, high] of integers", "sampled uniformly"),
]
