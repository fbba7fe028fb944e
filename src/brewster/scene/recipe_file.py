"""Reads recipes from TOML files and reports all problems at once; writes recipes with all defaults."""

from __future__ import annotations

import re
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from brewster.errors import RecipeError, expected_value
from brewster.scene.recipe_keys import REQUIRED, RecipeKey, choices, describe, recipe_tables
from brewster.scene.values import FrozenModel

Model = TypeVar("Model", bound=FrozenModel)

_WIDTH: Final = 100
_ESCAPES: Final = {code: f"\\u{code:04x}" for code in (*range(32), 127, ord('"'), ord("\\"))}
_MAX_VALUE_LENGTH: Final = 60


# --- reading


def read_toml(model: type[Model], path: Path, *, reference: str) -> Model:
    """Reads and validates a TOML file. Error messages refer the user to `reference`. Raises RecipeError if
    the file is missing or not TOML, or keys are missing, unknown or have impossible values."""
    try:
        values = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise RecipeError(f"{path} cannot be read", "expected a TOML file", f"see {reference}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(
            f"{path} is not TOML ({error})", "expected a TOML file", "correct the file at this place"
        ) from error
    return validated(model, values, source=str(path), reference=reference)


def validated(model: type[Model], values: Mapping[str, Any], *, source: str, reference: str) -> Model:
    """Returns the values as an instance of `model`. Raises RecipeError if keys are missing, unknown or have
    impossible values: one message for each problem, which names `source`, the origin of the values."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = [_problem(model, values, details, source, reference) for details in error.errors()]
        first, *others = {str(problem): problem for problem in problems}.values()
        raise RecipeError(first.happened, first.expected, first.cure, tuple(others)) from error


def _problem(
    model: type[FrozenModel], values: Mapping[str, Any], details: ErrorDetails, source: str, reference: str
) -> RecipeError:
    """Translates an error of pydantic into a RecipeError."""
    location, kind = details["loc"], details["type"]
    path, value = _look_up(values, location)
    cure = f"compare with {reference}"
    if kind == "missing":
        missing = [*path, str(location[-1])]
        return RecipeError(
            f"{source}: {_dotted(missing)} is missing", f"expected {describe(model, missing)}", "add this key"
        )
    if kind == "extra_forbidden" or location[-1:] == ("[key]",):
        return _unknown_key(model, path, value, source)
    if isinstance(value, Mapping):
        table = f" of [{_dotted(path)}]" if path else ""
        return RecipeError(f"{source}: the values{table} are inconsistent", expected_value(details), cure)
    happened = f"{source}: {_dotted(path)} is {_shortened(value)}"
    if kind in {"value_error", "finite_number"}:
        return RecipeError(happened, expected_value(details), cure)
    known = [name for name in choices(model, path) if isinstance(name, str)]
    if close := get_close_matches(str(value), known, n=1):
        cure = f'did you mean "{close[0]}"?'
    return RecipeError(happened, f"expected {describe(model, path)}", cure)


def _look_up(
    values: Any,  # noqa: ANN401  (any value of TOML)
    location: Sequence[str | int],
) -> tuple[list[str | int], Any]:
    """Returns the part of pydantic's location that exists in the values, and the value there. The rest may be "[key]"."""
    path: list[str | int] = []
    for part in location:
        is_key = isinstance(values, Mapping) and part in values
        is_index = isinstance(values, Sequence) and isinstance(part, int) and part < len(values)
        if not (is_key or is_index):
            break
        values = values[part]
        path.append(part)
    return path, values


def _unknown_key(
    model: type[FrozenModel], path: Sequence[str | int], value: object, source: str
) -> RecipeError:
    table = path[:-1]
    owner = f"[{_dotted(table)}]" if table else "the recipe"
    close = _similar_key(model, path)
    known = "" if close else f", one of {', '.join(choices(model, table))}"
    return RecipeError(
        f"{source}: there is no key {_dotted(path)} (its value is {_shortened(value)})",
        f"expected a key of {owner}{known}",
        f"did you mean {close}?" if close else "remove this key",
    )


def _similar_key(model: type[FrozenModel], path: Sequence[str | int]) -> str | None:
    """Returns the most similar known key: one of the same table with a similar name, or of another table with
    the same name."""
    *table, name = path
    if close := get_close_matches(str(name), choices(model, table), n=1):
        return _dotted([*table, close[0]])
    tables = list(recipe_tables(model))
    paths = [key.path for table in tables for key in table.keys] + [table.path for table in tables]
    return next((known for known in paths if known.rpartition(".")[2] == name), None)


def flatten(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yields the dotted path and the value of every value in nested tables."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _dotted(path: Sequence[str | int]) -> str:
    return ".".join(map(str, path))


def _shortened(value: object) -> str:
    text = _toml(value)
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[:_MAX_VALUE_LENGTH]}..."


# --- writing


def commented_toml(recipe: FrozenModel) -> str:
    """Returns the recipe as TOML with all keys, each with a comment; keys that are not set are commented out.
    `read_toml` returns an equal recipe if it reads this text."""
    values = recipe.model_dump(mode="json")
    lines: list[str] = []
    for table in recipe_tables(type(recipe)):
        is_set = _value_at(values, table.path) is not None
        if table.path:
            lines += ["", *_comment(table.meaning), _line(f"[{table.path}]", is_set=is_set)]
        for key in table.keys:
            default = None if key.default is REQUIRED else key.default
            value = _value_at(values, key.path) if is_set else default
            facts = (key.kind, key.allowed, key.unit and f"in {key.unit}", describe_default(key))
            lines += _comment(f"{key.meaning} ({', '.join(filter(None, facts))})")
            name, text = key.path.rpartition(".")[2], "" if value is None else _toml(value)
            lines.append(_line(f"{name} = {text}".rstrip(), is_set=is_set and value is not None))
    return "\n".join(lines) + "\n"


def describe_default(key: RecipeKey) -> str:
    """Returns the default of a key in words."""
    if key.default is REQUIRED:
        return "required"
    return "not set by default" if key.default is None else f"default {_toml(key.default)}"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)


def _line(text: str, *, is_set: bool) -> str:
    return text if is_set else f"# {text}"


def _value_at(values: Any, path: str) -> Any:  # noqa: ANN401
    for name in path.split(".") if path else ():
        values = values.get(name) if values else None
    return values


def _toml(value: object) -> str:
    """Returns a value as TOML on one line."""
    match value:
        case bool():
            return str(value).lower()
        case Mapping():
            is_bare = re.compile(r"[A-Za-z0-9_-]+").fullmatch
            pairs = [
                f"{name if is_bare(name) else _toml(name)} = {_toml(inner)}" for name, inner in value.items()
            ]
            return f"{{ {', '.join(pairs)} }}" if pairs else "{}"
        case list() | tuple():
            return f"[{', '.join(map(_toml, value))}]"
        case str():
            return f'"{value.translate(_ESCAPES)}"'
        case _:
            return str(value)
