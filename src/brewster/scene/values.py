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


def _rising(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"a range goes up, and this one goes from {bounds[0]} to {bounds[1]}")
    return bounds


Share = Annotated[float, Field(ge=0, le=1)]
Above0 = Annotated[float, Field(gt=0)]
From0 = Annotated[float, Field(ge=0)]
Positive = Annotated[int, Field(gt=0)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Range = Annotated[tuple[float, float], AfterValidator(_rising)]
LogRange = Annotated[tuple[Above0, Above0], AfterValidator(_rising)]

Read = TypeVar("Read", bound=FrozenModel)


def read_toml(kind: type[Read], path: Path, *, compare: str) -> Read:
    """Reads and checks values; `compare` names what a user can compare a wrong file with.

    Raises:
        RecipeError: missing, not TOML, or with values that are missing, unknown or impossible.
    """
    try:
        return kind.model_validate(tomllib.loads(path.read_text("utf-8")))
    except OSError as error:
        raise RecipeError(f"{path} cannot be read", "a TOML file", f"see {compare}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path} is not TOML ({error})", "a TOML file", "mend that place") from error
    except ValidationError as error:
        raise wrong_value(str(path), error, compare) from error


def wrong_value(owner: str, error: ValidationError, compare: str) -> RecipeError:
    """The first thing that pydantic found wrong, in our three beats."""
    first = error.errors()[0]
    name = ".".join(map(str, first["loc"]))
    return RecipeError(
        f"{owner} has a wrong value for {name}" if name else f"{owner} contradicts itself",
        first["msg"].removeprefix("Value error, "),
        f"compare with {compare}",
    )
