"""Settings in TOML files: the base class of recipes and scenes, and how they are read, described
and written.

The docstring below an attribute is the description of its key in docs/recipes.md and in
`--show-recipe`. pydantic's JSON schema gives type and limits; `WithJsonSchema({"type": ...})`
replaces them by words.
"""

from __future__ import annotations

import json
import re
import textwrap
import tomllib
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, WithJsonSchema
from pydantic_core import ErrorDetails, PydanticUndefined, to_jsonable_python

from brewster.errors import RecipeError, expected_value, read_errors

_WIDTH: Final = 100
_MAX_VALUE_LENGTH: Final = 60
_UNITS: Final = {
    "mm": "mm",
    "deg": "degrees",
    "px": "px",
    "per_m": "1/m",
    "px_per_texel": "px per texel",
}
_UNIT_SUFFIX: Final = re.compile(r"(?:^|_)(px_per_texel|per_m|mm|deg|px)$")
_LIMITS: Final = {
    "minimum": "at least {}",
    "exclusiveMinimum": "above {}",
    "maximum": "at most {}",
    "exclusiveMaximum": "below {}",
    "multipleOf": "a multiple of {}",
    "minItems": "with {} or more entries",
}


class FrozenModel(BaseModel):
    """An immutable pydantic model that refuses unknown keys, NaN and infinity."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


Model = TypeVar("Model", bound=FrozenModel)


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(
            f"expected low <= high, but low is {bounds[0]:g} and high is {bounds[1]:g}"
        )
    return bounds


Share = Annotated[float, Field(ge=0, le=1)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(gt=0)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Pixels = Annotated[int, Field(ge=16, json_schema_extra={"unit": "px"})]
Range = Annotated[
    tuple[float, float],
    AfterValidator(_ascending),
    WithJsonSchema({"type": "range [low, high], sampled uniformly"}),
]
LogRange = Annotated[
    tuple[PositiveFloat, PositiveFloat],
    AfterValidator(_ascending),
    WithJsonSchema({"type": "range [low, high] above 0, sampled log-uniformly"}),
]
JpegQuality = Annotated[int, Field(ge=1, le=100)]
JpegQualityRange = Annotated[
    tuple[JpegQuality, JpegQuality],
    AfterValidator(_ascending),
    WithJsonSchema({"type": "range [low, high] of integers from 1 to 100, sampled uniformly"}),
]


def packaged_file(name: str, folder: Path) -> Path:
    """Returns the path of a packaged recipe, a TOML file in `folder`, by its name, or of any .toml
    file. Raises RecipeError if there is no packaged recipe of this name.
    """
    packaged = {path.stem: path for path in sorted(folder.glob("*.toml"))}
    if name not in packaged and not name.endswith(".toml"):
        raise RecipeError(
            f"there is no recipe {name!r}",
            f"expected one of the packaged recipes {', '.join(packaged)}",
            "choose one of these names, or a .toml file",
        )
    return packaged.get(name, Path(name))


def read_toml(
    model: type[Model], path: Path, *, reference: str, ignored: Collection[str] = ()
) -> Model:
    """Reads and validates a TOML file, without the keys `ignored`. Error messages refer the user to
    `reference`. Raises RecipeError if the file is missing or not TOML, or keys are missing, unknown
    or have impossible values.
    """
    with read_errors(path, RecipeError, "expected a TOML file", f"see {reference}"):
        data = path.read_bytes()
    return parse_toml(model, data, source=str(path), reference=reference, ignored=ignored)


def parse_toml(
    model: type[Model], data: bytes, *, source: str, reference: str, ignored: Collection[str] = ()
) -> Model:
    """As `read_toml`, for the bytes of a file. Messages name `source`, the origin of the bytes."""
    try:
        values = tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(
            f"{source} is not TOML ({error})",
            "expected a TOML file",
            "correct the file at this place",
        ) from error
    known = {name: value for name, value in values.items() if name not in ignored}
    return validated(model, known, source=source, reference=reference)


def validated(
    model: type[Model], values: Mapping[str, Any], *, source: str, reference: str
) -> Model:
    """Returns the values as an instance of `model`. Raises RecipeError if keys are missing, unknown
    or have impossible values: one message for each problem, which names `source`, the origin of the
    values.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        known: dict[str, Key | Table] = {table.path: table for table in tables(model)}
        known |= {key.path: key for table in tables(model) for key in table.keys}
        problems = [
            _problem(known, each, source, f"compare with {reference}") for each in error.errors()
        ]
        first, *others = {str(problem): problem for problem in problems}.values()
        raise RecipeError(first.happened, first.expected, first.cure, tuple(others)) from error


def _problem(
    known: Mapping[str, Key | Table], details: ErrorDetails, source: str, cure: str
) -> RecipeError:
    """Translates an error of pydantic. `known` has all keys and tables by path."""
    kind = details["type"]
    value = details["input"]
    parts = [*map(str, details["loc"])]
    path = ".".join(part for part in parts if part != "[key]")
    prefixes = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    key = known[next((prefix for prefix in prefixes if prefix in known), "")]
    expected = f"expected {key.values}"
    if kind == "missing":
        return RecipeError(f"{source}: {path} is missing", expected, "add this key")
    happened = f"{source}: {path} is {shortened(value)}"
    if kind == "extra_forbidden":
        same_name = [other for other in known if other.rpartition(".")[2] == parts[-1]]
        close = [*get_close_matches(path, known, n=1), *same_name]
        happened = f"{source}: there is no key {path} (its value is {shortened(value)})"
        return RecipeError(
            happened, "expected a known key", f"did you mean {close[0]}?" if close else cure
        )
    if isinstance(value, Mapping) and kind == "value_error":
        happened = f"{source}: the values{f' of [{path}]' if path else ''} are inconsistent"
    is_ours = kind in {"value_error", "finite_number"}
    return RecipeError(happened, expected_value(details) if is_ours else expected, cure)


def shortened(value: object) -> str:
    """Returns the beginning of a value as TOML."""
    text = to_toml(value)
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[:_MAX_VALUE_LENGTH]}..."


def flatten(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yields the dotted path and the value of every value in nested tables."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


class Key(NamedTuple):
    """A key in words. `path` has the names of its tables, separated by dots:
    "data.rendered.blend_space". `values` are its type and limits, `default` is "required", "not set
    by default" or "default" and TOML.
    """

    path: str
    values: str
    unit: str
    default: str
    meaning: str


class Table(NamedTuple):
    """A table, with its keys in the order of the model `name`. The file itself is the table with
    the path "".
    """

    path: str
    name: str
    keys: tuple[Key, ...]
    meaning: str
    values: str = "a table"


def tables(model: type[FrozenModel], path: str = "", meaning: str | None = None) -> Iterator[Table]:
    """Yields the file itself and all its tables, including optional ones."""
    schemas = model.model_json_schema()["properties"]
    keys = list[Key]()
    inner = list[Any]()
    for name, field in model.model_fields.items():
        where = f"{path}.{name}" if path else name
        types = [
            part
            for part in (field.annotation, *get_args(field.annotation))
            if isinstance(part, type)
        ]
        if models := [part for part in types if issubclass(part, FrozenModel)]:
            inner.append((models[0], where, field.description))
            continue
        suffix = _UNIT_SUFFIX.search(name)
        schema = schemas[name]
        unit = schema.get("unit") or (_UNITS[suffix[1]] if suffix else "")
        keys.append(
            Key(where, _in_words(schema), unit, _default(field.default), _line(field.description))
        )
    yield Table(path, model.__name__, tuple(keys), _line(meaning or model.__doc__))
    for arguments in inner:
        yield from tables(*arguments)


def _in_words(schema: Mapping[str, Any]) -> str:
    """Returns type and limits: "integer, above 0"."""
    if choices := schema.get("enum", [schema["const"]] if "const" in schema else []):
        return f"one of {', '.join(map(json.dumps, choices))}"
    if "anyOf" in schema:
        return " or ".join(_in_words(part) for part in schema["anyOf"] if part != {"type": "null"})
    if items := schema.get("prefixItems"):
        kinds = [_in_words(part) for part in items]
        return f"[{len(kinds)} x {kinds[0]}]" if len({*kinds}) == 1 else f"[{', '.join(kinds)}]"
    kind = f"list of {_in_words(schema['items'])}" if "items" in schema else schema["type"]
    limits = [text.format(schema[name]) for name, text in _LIMITS.items() if name in schema]
    return ", ".join(["path" if schema.get("format") == "path" else kind, *limits])


def _default(value: object) -> str:
    if value is PydanticUndefined:
        return "required"
    return (
        "not set by default" if value is None else f"default {to_toml(to_jsonable_python(value))}"
    )


def _line(text: str | None) -> str:
    return " ".join((text or "").split())


def commented_toml(settings: FrozenModel) -> str:
    """Returns the settings as TOML with all keys, each with a comment; keys that are not set are
    commented out. `read_toml` returns equal settings if it reads this text.
    """
    dumped = settings.model_dump(mode="json")
    lines = list[str]()
    for table in tables(type(settings)):
        found: Any = dumped
        for name in filter(None, table.path.split(".")):
            found = found and found[name]
        if table.path:
            lines += ["", *_comment(table.meaning), f"{'' if found else '# '}[{table.path}]"]
        for key in table.keys:
            lines += _comment(f"{key.meaning} ({', '.join(filter(None, key[1:4]))})")
            name = key.path.rpartition(".")[2]
            value = found[name] if found else None
            text = key.default.partition("default ")[2] if value is None else to_toml(value)
            lines.append(f"{'# ' if value is None else ''}{name} = {text}".rstrip())
    return "\n".join(lines) + "\n"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False
    )


def to_toml(value: object) -> str:
    """Returns a value as TOML on one line: JSON with "=" in inline tables."""
    text = json.dumps(value, ensure_ascii=False, separators=(", ", " = "), default=str)
    return text.replace("\x7f", "\\u007f")  # JSON allows it, TOML does not
