"""The keys of a recipe: type, unit, allowed values, default and meaning, read from its pydantic model.

    for key in recipe_keys(SceneRecipe):
        print(key.path, key.kind, key.allowed)

docs/recipes.md, `--show-recipe` and the error messages of recipes are made from these descriptions.
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
"""The default of a key that has none."""

_UNITS: Final = {"mm": "mm", "deg": "degrees", "px": "px", "per_m": "1/m", "px_per_texel": "px per texel"}
_SUFFIX: Final = re.compile(rf"(?:^|_)({'|'.join(sorted(_UNITS, key=len, reverse=True))})(?:_log)?$")
_KINDS: Final = {bool: "boolean", int: "integer", float: "number", str: "string", Path: "path"}


@final
@dataclass(frozen=True)
class RecipeKey:
    """One key of a recipe."""

    path: str
    """The names of its tables and its own, with dots between: "data.rendered.mixing"."""
    kind: str
    """The type in words: "number", "list of paths"."""
    allowed: str
    """The allowed values in words, or "" where any value of the type is."""
    unit: str
    """The unit, or "" for a number without one."""
    default: Any
    """The default as the model holds it, or REQUIRED."""
    meaning: str
    """What the key does."""


@final
@dataclass(frozen=True)
class RecipeTable:
    """One table of a recipe; the recipe itself is the table of path ""."""

    path: str
    model: type[FrozenModel]
    meaning: str
    """What the table is about."""

    @property
    def keys(self) -> list[RecipeKey]:
        """The keys of the table that are not tables themselves, in the order of the model."""
        return [
            _key(_joined(self.path, name), name, field)
            for name, field in self.model.model_fields.items()
            if _model_in(field.annotation) is None
        ]


def recipe_tables(model: type[FrozenModel], path: str = "", meaning: str = "") -> Iterator[RecipeTable]:
    """The recipe itself and all tables in it, optional ones too."""
    yield RecipeTable(path, model, _one_paragraph(meaning or model.__doc__))
    for name, field in model.model_fields.items():
        if table := _model_in(field.annotation):
            yield from recipe_tables(table, _joined(path, name), field.description or "")


def recipe_keys(model: type[FrozenModel]) -> Iterator[RecipeKey]:
    """Every key of a recipe that is not a table, table by table."""
    for table in recipe_tables(model):
        yield from table.keys


def describe(model: type[FrozenModel], path: Sequence[str | int]) -> str:
    """What may stand at a place in a recipe: "an integer, above 0".

    Args:
        model: the model of the recipe.
        path: names of keys, and indices into lists.
    """
    annotation, metadata = _annotation_at(model, path)
    kind, allowed = _words(annotation, metadata)
    return f"{'an' if kind[:1] in 'aeiou' else 'a'} {kind}{', ' if allowed else ''}{allowed}"


def choices(model: type[FrozenModel], path: Sequence[str | int]) -> tuple[Any, ...]:
    """The values of a place that allows a fixed list of them; else nothing."""
    annotation, _ = _annotation_at(model, path)
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def names_in(model: type[FrozenModel], path: Sequence[str | int]) -> list[str]:
    """The keys that the table at a place may hold, where they are a fixed list."""
    annotation, _ = _annotation_at(model, path)
    if table := _model_in(annotation):
        return list(table.model_fields)
    keys = get_args(annotation)[0] if get_origin(annotation) is dict else None
    return [str(name) for name in get_args(keys)]


def _key(path: str, name: str, field: FieldInfo) -> RecipeKey:
    kind, allowed = _words(field.annotation, field.metadata)
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


def _words(annotation: Any, metadata: Sequence[Any]) -> tuple[str, str]:  # noqa: ANN401  (a type)
    """The type and the allowed values in words."""
    annotation, metadata = _flat(annotation, metadata)
    notes = [note for note in metadata if isinstance(note, KeyNote)]
    kind, allowed = _kind(annotation)
    kind = next((note.kind for note in notes if note.kind), kind)
    if any(note.instead for note in notes):
        return kind, ", ".join(note.allowed for note in notes if note.allowed)
    parts = [allowed, *_limits(metadata), *(note.allowed for note in notes)]
    return kind, ", ".join(part for part in parts if part)


def _kind(annotation: Any) -> tuple[str, str]:  # noqa: ANN401
    """The type in words without its constraints, and what its parts allow."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return _KINDS[type(args[0])], f"one of {', '.join(_quoted(value) for value in args)}"
    if origin is dict:
        (key, allowed_key), (value, allowed_value) = (_words(part, ()) for part in args)
        return f"table of {key} -> {value}", _each(allowed_key, allowed_value)
    if origin is list or (origin is tuple and args[-1] is ...):
        kind, allowed = _words(args[0], ())
        return f"list of {_plural(kind)}", _each(allowed)
    if origin is tuple:
        kinds, allowed_parts = zip(*(_words(part, ()) for part in args), strict=True)
        return f"list [{', '.join(kinds)}]", _each(*allowed_parts)
    if origin in (Union, types.UnionType):
        return " or ".join(_words(part, ())[0] for part in args), ""
    return _KINDS.get(annotation, "table"), ""


def _limits(metadata: Sequence[Any]) -> Iterator[str]:
    """Numeric limits and lengths in words."""
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


def _each(*allowed: str) -> str:
    """What the parts of a list or a table allow: once if it is the same for all."""
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
        table = _model_in(annotation)
        if table and part in table.model_fields:
            field = table.model_fields[str(part)]
            annotation, metadata = _flat(field.annotation, field.metadata)
            continue
        args = [arg for arg in get_args(_without_none(annotation)) if arg is not ...]
        if not args:
            break
        index = part if isinstance(part, int) and len(args) > part else -1
        annotation, metadata = _flat(args[index], ())
    return annotation, metadata


def _flat(annotation: Any, metadata: Sequence[Any]) -> tuple[Any, Sequence[Any]]:  # noqa: ANN401
    """A type without Annotated and None, and all metadata of it, as pydantic reads it."""
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


def _model_in(annotation: Any) -> type[FrozenModel] | None:  # noqa: ANN401
    annotation, _ = _flat(annotation, ())
    is_model = isinstance(annotation, type) and issubclass(annotation, FrozenModel)
    return annotation if is_model else None
