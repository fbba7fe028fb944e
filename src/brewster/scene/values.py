"""Frozen values from TOML: the base class of every recipe and scene, their common types, and the reader."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from brewster.errors import RecipeError


class FrozenModel(BaseModel):
    """Frozen values; unknown names and numbers that are not numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"a range goes up, and this one goes from {bounds[0]} to {bounds[1]}")
    return bounds


Share = Annotated[float, Field(ge=0, le=1)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(gt=0)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Range = Annotated[tuple[float, float], AfterValidator(_ascending)]
LogRange = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_ascending)]

Model = TypeVar("Model", bound=FrozenModel)


def read_toml(model: type[Model], path: Path, *, compare: str) -> Model:
    """Reads and checks values; `compare` names what a user can compare a wrong file with.

    Raises:
        RecipeError: missing, not TOML, or with values that are missing, unknown or impossible.
    """
    try:
        return model.model_validate(tomllib.loads(path.read_text("utf-8")))
    except OSError as error:
        raise RecipeError(f"{path} cannot be read", "a TOML file", f"see {compare}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path} is not TOML ({error})", "a TOML file", "mend that place") from error
    except ValidationError as error:
        raise validation_error(str(path), error, compare) from error


def validation_error(owner: str, error: ValidationError, compare: str) -> RecipeError:
    """The first thing that pydantic found wrong, in our three beats."""
    first = error.errors()[0]
    name = ".".join(map(str, first["loc"]))
    return RecipeError(
        f"{owner} has a wrong value for {name}" if name else f"{owner} contradicts itself",
        first["msg"].removeprefix("Value error, "),
        f"compare with {compare}",
    )
