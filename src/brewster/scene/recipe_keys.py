"""Describes the keys of a recipe from the JSON schema of its pydantic model: type, unit, allowed values, default and meaning.

docs/recipes.md, `--show-recipe` and the error messages of recipes contain these descriptions.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from brewster.scene.values import FrozenModel

REQUIRED: Final = object()
"""The default of a key that must be set."""

Schema = Mapping[str, Any]
"""A JSON schema. Those of tables have "properties". `KeyNote` adds the entry "note"."""

_UNITS: Final = {"mm": "mm", "deg": "degrees", "px": "px", "per_m": "1/m", "px_per_texel": "px per texel"}
_SUFFIX: Final = re.compile(rf"(?:^|_)({'|'.join(sorted(_UNITS, key=len, reverse=True))})$")
_LIMITS: Final = {
    "minimum": "at least",
    "exclusiveMinimum": "above",
    "maximum": "at most",
    "exclusiveMaximum": "below",
    "multipleOf": "a multiple of",
}


class RecipeKey(NamedTuple):
    """One key of a recipe in words. `path` has the names of its tables, separated by dots: "data.rendered.blend_space".

    `allowed` is "" if every value of the type `kind` is allowed. `default` is a JSON value, or REQUIRED.
    """

    path: str
    kind: str
    allowed: str
    unit: str
    default: Any
    meaning: str


class RecipeTable(NamedTuple):
    """One table of a recipe, with its keys in the order of the model `name`. The recipe itself is the table with the path ""."""

    path: str
    name: str
    keys: tuple[RecipeKey, ...]
    meaning: str


def recipe_tables(model: type[FrozenModel]) -> Iterator[RecipeTable]:
    """Yields the recipe itself and all its tables, including optional ones."""
    return _tables(_schema(model), "", "")


def describe(model: type[FrozenModel], path: Sequence[str | int]) -> str:
    """Describes the values that are allowed at a path of a recipe: "an integer, above 0"."""
    kind, allowed = _in_words(_schema_at(model, path))
    return f"{'an' if kind[:1] in 'aeiou' else 'a'} {kind}{', ' if allowed else ''}{allowed}"


def choices(model: type[FrozenModel], path: Sequence[str | int]) -> list[Any]:
    """Returns the allowed keys of a table, or the allowed values of a key. The list is empty if they are not listed."""
    schema = _schema_at(model, path)
    return list(schema.get("properties", ())) or _choices(schema.get("propertyNames", schema))


def _tables(schema: Schema, path: str, meaning: str) -> Iterator[RecipeTable]:
    keys, tables, prefix = list[RecipeKey](), list[tuple[Schema, str, str]](), f"{path}." if path else ""
    for name, field in schema["properties"].items():
        if "properties" in field:
            tables.append((field, prefix + name, field.get("meaning", "")))
            continue
        suffix = _SUFFIX.search(name)
        unit = field.get("note", {}).get("unit") or (_UNITS[suffix[1]] if suffix else "")
        default = REQUIRED if name in schema.get("required", ()) else field.get("default")
        text = " ".join(field.get("description", "").split())
        keys.append(RecipeKey(prefix + name, *_in_words(field), unit, default, text))
    text = " ".join((meaning or schema.get("description", "")).split())
    yield RecipeTable(path, schema["title"], tuple(keys), text)
    for table in tables:
        yield from _tables(*table)


# --- schemas in words


def _in_words(schema: Schema) -> tuple[str, str]:
    """Returns the type and the allowed values in words."""
    note, (kind, parts) = schema.get("note", {}), _kind(schema)
    parts = [] if note.get("replaces_constraints") else parts
    return note.get("kind") or kind, ", ".join(filter(None, [*parts, note.get("allowed")]))


def _kind(schema: Schema) -> tuple[str, list[str]]:
    """Returns the type in words, and the parts of the description of the allowed values."""
    kind, allowed = str(schema.get("type", "table")).replace("object", "table"), ""
    if values := _choices(schema):
        kind = "string" if isinstance(values[0], str) else "integer"
        allowed = f"one of {', '.join(map(json.dumps, values))}"
    elif "anyOf" in schema:
        kind = " or ".join(_in_words(member)[0] for member in schema["anyOf"])
    elif isinstance(value := schema.get("additionalProperties"), Mapping):
        kind, allowed = _join(" -> ", schema.get("propertyNames", {"type": "string"}), value)
        kind = f"table of {kind}"
    elif "prefixItems" in schema:
        kind, allowed = _join(", ", *schema["prefixItems"])
        return f"list [{kind}]", [allowed]
    elif "items" in schema:
        item, allowed = _join("", schema["items"])
        plural = item.replace("list", "lists", 1) if item.startswith("list") else f"{item}s"
        kind = f"list of {plural}"
    elif schema.get("format") == "path":
        kind = "path"
    return kind, [allowed, *_limits(schema)]


def _choices(schema: Schema) -> list[Any]:
    return list(schema.get("enum", [schema["const"]] if "const" in schema else []))


def _limits(schema: Schema) -> Iterator[str]:
    """Yields the limits of a number, or of the length of a list, in words."""
    if {"minimum", "maximum"} <= schema.keys():
        yield f"from {schema['minimum']} to {schema['maximum']}"
    else:
        yield from (f"{_LIMITS[name]} {schema[name]}" for name in _LIMITS if name in schema)
    if count := schema.get("minItems", schema.get("minProperties", schema.get("minLength"))):
        yield f"at least {count} {'entry' if count == 1 else 'entries'}"


def _join(separator: str, *parts: Schema) -> tuple[str, str]:
    """Returns the types of the parts of a list or table, and their allowed values, only once if all parts have the same."""
    kinds, allowed = zip(*map(_in_words, parts), strict=True)
    limits = "; ".join(allowed)
    if len(set(allowed)) == 1:
        limits = f"each {allowed[0].removeprefix('each ')}" if allowed[0] else ""
    return separator.join(kinds), limits


# --- schemas


@functools.cache
def _schema(model: type[FrozenModel]) -> Schema:
    """Returns the schema of a recipe. References to other models are resolved, and optional keys have the schema of their value."""
    root = model.model_json_schema()

    def resolved(schema: Any) -> Any:  # noqa: ANN401  (JSON)
        if isinstance(schema, list):
            return [resolved(part) for part in schema]
        if not isinstance(schema, dict):
            return schema
        members = [member for member in schema.get("anyOf", ()) if member != {"type": "null"}]
        if len(members) == 1:
            schema = members[0] | {name: schema[name] for name in schema.keys() - {"anyOf", "title"}}
        if "$ref" in schema:
            table = root["$defs"][schema["$ref"].rpartition("/")[2]]
            schema = table | {"meaning": schema.get("description", "")}
        return {name: resolved(part) for name, part in schema.items() if name != "$defs"}

    schema: Schema = resolved(root)
    return schema


def _schema_at(model: type[FrozenModel], path: Sequence[str | int]) -> Schema:
    """Returns the schema at a path, or of the innermost value whose parts have no schema."""
    schema = _schema(model)
    for part in path:
        items = dict(enumerate(schema.get("prefixItems", ()))) | schema.get("properties", {})
        inner = items.get(part) or schema.get("items") or schema.get("additionalProperties")
        if not isinstance(inner, Mapping):
            break
        schema = inner
    return schema
