"""Describes the keys of a recipe from its pydantic model: type, unit, allowed values, default and meaning.

    for key in recipe_keys(SceneRecipe):
        print(key.path, key.kind, key.allowed)

docs/recipes.md, `--show-recipe` and the error messages of recipes contain these descriptions.
"""

from __future__ import annotations

import re
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, final, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MinLen, MultipleOf
from pydantic.fields import FieldInfo

from brewster.scene.values import FrozenModel, KeyNote

REQUIRED: Final = object()
"""The default of a key that must be set."""

_UNITS: Final = {"mm": "mm", "deg": "degrees", "px": "px", "per_m": "1/m", "px_per_texel": "px per texel"}
_SUFFIX: Final = re.compile(rf"(?:^|_)({'|'.join(sorted(_UNITS, key=len, reverse=True))})$")
_KINDS: Final = {bool: "boolean", int: "integer", float: "number", str: "string", Path: "path"}


@final
@dataclass(frozen=True)
class RecipeKey:
    """One key of a recipe."""

    path: str
    """The names of the key's tables and of the key, separated by dots: "data.rendered.blend_space"."""
    kind: str
    """The type in words: "number", "list of paths"."""
    allowed: str
    """The allowed values in words, or "" if every value of the type is allowed."""
    unit: str
    """The unit, or "" for a value without a unit."""
    default: Any
    """The default value in the model, or REQUIRED."""
    meaning: str
    """What the key does."""


@final
@dataclass(frozen=True)
class RecipeTable:
    """One table of a recipe. The recipe itself is the table with the path ""."""

    path: str
    model: type[FrozenModel]
    meaning: str
    """What the keys of the table describe."""

    @property
    def keys(self) -> list[RecipeKey]:
        """The keys of the table in the order of the model, without the tables inside this table."""
        return [
            _key(_joined(self.path, name), name, field)
            for name, field in self.model.model_fields.items()
            if _table_model(field.annotation) is None
        ]


def recipe_tables(model: type[FrozenModel], path: str = "", meaning: str = "") -> Iterator[RecipeTable]:
    """Yields the recipe itself and all its tables, including optional ones."""
    yield RecipeTable(path, model, _one_paragraph(meaning or model.__doc__))
    for name, field in model.model_fields.items():
        if table := _table_model(field.annotation):
            yield from recipe_tables(table, _joined(path, name), field.description or "")


def recipe_keys(model: type[FrozenModel]) -> Iterator[RecipeKey]:
    """Yields all keys of a recipe, table by table, without the tables themselves."""
    for table in recipe_tables(model):
        yield from table.keys


def describe(model: type[FrozenModel], path: Sequence[str | int]) -> str:
    """Describes the values that are allowed at a path of a recipe: "an integer, above 0".

    Args:
        model: the model of the recipe.
        path: names of keys and indices of list items.
    """
    annotation, metadata = _annotation_at(model, path)
    kind, allowed = _type_and_limits(annotation, metadata)
    return f"{'an' if kind[:1] in 'aeiou' else 'a'} {kind}{', ' if allowed else ''}{allowed}"


def literal_values(model: type[FrozenModel], path: Sequence[str | int]) -> tuple[Any, ...]:
    """Returns the allowed values at a path if the type is a Literal, else an empty tuple."""
    annotation, _ = _annotation_at(model, path)
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def allowed_keys(model: type[FrozenModel], path: Sequence[str | int]) -> list[str]:
    """Returns the allowed keys of the table at a path; an empty list if any key is allowed."""
    annotation, _ = _annotation_at(model, path)
    if table := _table_model(annotation):
        return list(table.model_fields)
    keys = get_args(annotation)[0] if get_origin(annotation) is dict else None
    return [str(name) for name in get_args(keys)]


def _key(path: str, name: str, field: FieldInfo) -> RecipeKey:
    kind, allowed = _type_and_limits(field.annotation, field.metadata)
    default = REQUIRED if field.is_required() else field.get_default(call_default_factory=True)
    suffix = _SUFFIX.search(name)
    unit = next((note.unit for note in field.metadata if isinstance(note, KeyNote) and note.unit), "")
    unit = unit or (_UNITS[suffix[1]] if suffix else "")
    return RecipeKey(path, kind, allowed, unit, default, _one_paragraph(field.description))


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _one_paragraph(text: str | None) -> str:
    return " ".join((text or "").split())


# --- annotations in words


def _type_and_limits(annotation: Any, metadata: Sequence[Any]) -> tuple[str, str]:  # noqa: ANN401  (a type)
    """Returns the type and the allowed values in words."""
    annotation, metadata = _unwrapped(annotation, metadata)
    notes = [note for note in metadata if isinstance(note, KeyNote)]
    kind, allowed = _kind(annotation)
    kind = next((note.kind for note in notes if note.kind), kind)
    if any(note.replaces_constraints for note in notes):
        return kind, ", ".join(note.allowed for note in notes if note.allowed)
    parts = [allowed, *_limits(metadata), *(note.allowed for note in notes)]
    return kind, ", ".join(part for part in parts if part)


def _kind(annotation: Any) -> tuple[str, str]:  # noqa: ANN401
    """Returns the type in words, and the allowed values of its parts. The constraints of the type itself are not included."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return _KINDS[type(args[0])], f"one of {', '.join(_quoted(value) for value in args)}"
    if origin is dict:
        (key, allowed_key), (value, allowed_value) = (_type_and_limits(part, ()) for part in args)
        return f"table of {key} -> {value}", _limits_of_parts(allowed_key, allowed_value)
    if origin is list or (origin is tuple and args[-1] is ...):
        kind, allowed = _type_and_limits(args[0], ())
        return f"list of {_plural(kind)}", _limits_of_parts(allowed)
    if origin is tuple:
        kinds, allowed_parts = zip(*(_type_and_limits(part, ()) for part in args), strict=True)
        return f"list [{', '.join(kinds)}]", _limits_of_parts(*allowed_parts)
    if origin in (Union, types.UnionType):
        return " or ".join(_type_and_limits(part, ())[0] for part in args), ""
    return _KINDS.get(annotation, "table"), ""


def _limits(metadata: Sequence[Any]) -> Iterator[str]:
    """Yields the limits of a number, or of the length of a list, in words."""
    low = next((limit for limit in metadata if isinstance(limit, Ge | Gt)), None)
    high = next((limit for limit in metadata if isinstance(limit, Le | Lt)), None)
    if isinstance(low, Ge) and isinstance(high, Le):
        yield f"from {low.ge} to {high.le}"
    else:
        if low:
            yield f"at least {low.ge}" if isinstance(low, Ge) else f"above {low.gt}"
        if high:
            yield f"at most {high.le}" if isinstance(high, Le) else f"below {high.lt}"
    for limit in metadata:
        if isinstance(limit, MultipleOf):
            yield f"a multiple of {limit.multiple_of}"
        if isinstance(limit, MinLen):
            yield f"at least {limit.min_length} {'entry' if limit.min_length == 1 else 'entries'}"


def _limits_of_parts(*allowed: str) -> str:
    """Returns the allowed values of the parts of a list or a table in words, only once if all parts have the same."""
    if len(set(allowed)) == 1:
        return f"each {allowed[0].removeprefix('each ')}" if allowed[0] else ""
    return "; ".join(allowed)


def _plural(kind: str) -> str:
    return kind.replace("list", "lists", 1) if kind.startswith("list") else f"{kind}s"


def _quoted(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


# --- walking through annotations


def _annotation_at(model: type[FrozenModel], path: Sequence[str | int]) -> tuple[Any, Sequence[Any]]:
    annotation: Any = model
    metadata: Sequence[Any] = ()
    for part in path:
        table = _table_model(annotation)
        if table and part in table.model_fields:
            field = table.model_fields[str(part)]
            annotation, metadata = _unwrapped(field.annotation, field.metadata)
            continue
        args = [arg for arg in get_args(_without_none(annotation)) if arg is not ...]
        if not args:
            break
        index = part if isinstance(part, int) and len(args) > part else -1
        annotation, metadata = _unwrapped(args[index], ())
    return annotation, metadata


def _unwrapped(annotation: Any, metadata: Sequence[Any]) -> tuple[Any, Sequence[Any]]:  # noqa: ANN401
    """Returns a type without Annotated and None, and all its metadata in one list."""
    annotation = _without_none(annotation)
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        metadata = [*metadata, *more]
        annotation = _without_none(annotation)
    flat: list[Any] = []
    for note in metadata:
        flat += note.metadata if isinstance(note, FieldInfo) else [note]
    return annotation, flat


def _without_none(annotation: Any) -> Any:  # noqa: ANN401
    if get_origin(annotation) in (Union, types.UnionType):
        args = [arg for arg in get_args(annotation) if arg is not type(None)]
        return args[0] if len(args) == 1 else annotation
    return annotation


def _table_model(annotation: Any) -> type[FrozenModel] | None:  # noqa: ANN401
    annotation, _ = _unwrapped(annotation, ())
    is_model = isinstance(annotation, type) and issubclass(annotation, FrozenModel)
    return annotation if is_model else None
