"""Types of parameters, and options that several commands have."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import cache, partial, reduce, wraps
from pathlib import Path
from types import NoneType
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    TypeVar,
    final,
    get_args,
    get_origin,
    get_type_hints,
)

import click

from brewster.options import Device, field_schemas

_Command = TypeVar("_Command", bound=Callable[..., Any])
_Schemas = Callable[[], Mapping[str, Mapping[str, Any]]]

FILE: Final = click.Path(path_type=Path)
FOLDER: Final = click.Path(path_type=Path, file_okay=False)
EXISTING_FOLDER: Final = click.Path(path_type=Path, file_okay=False, exists=True)
FOLDER.name = EXISTING_FOLDER.name = "folder"
flag: Final = partial(click.option, is_flag=True)
JSON: Final = flag("--json", "as_json", help="Print JSON.")
QUIET: Final = flag("-q", "--quiet", help="Print only errors.")
OVERWRITE: Final = flag("--overwrite", help="Replace existing layers.")
DEVICE: Final = click.option(
    "--device",
    type=click.Choice(get_args(Device)),
    default="auto",
    help="The device that runs the models.",
)


@final
class Number(click.IntRange):
    """An integer in a range."""

    name = "number"


@final
class Fraction(click.FloatRange):
    """A number in a range."""

    name = "fraction"


@final
class Share(click.FloatRange):
    """A number in 0..1, which may also be given in percent: 0.7 or 70%."""

    name = "number"

    def __init__(self) -> None:
        super().__init__(0, 1)

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Returns the number. A number above 1 without a percent sign is an error."""
        text = str(value).strip()
        if text.endswith("%"):
            return super().convert(self._number(text[:-1], param, ctx) / 100, param, ctx)
        number = self._number(text, param, ctx)
        if number > 1:
            self.fail(f"{text} is not in the range 0<=x<=1. Did you mean {text}%?", param, ctx)
        return super().convert(number, param, ctx)

    def _number(self, text: str, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            return float(text)
        except ValueError:
            self.fail(f"{text!r} is neither a number in 0..1 nor a percentage.", param, ctx)


def json_lines(item: str) -> Callable[[_Command], _Command]:
    """The option --json of a command that prints a line for each item."""
    return flag(
        "--json", "as_json", help=f"Print one line of JSON for each {item} on standard output."
    )


def output_folder(description: str, **settings: Any) -> Callable[[_Command], _Command]:  # noqa: ANN401
    """The option -o of a command that writes a folder; `settings` are those of click."""
    return click.option("-o", "--output", "out", type=FOLDER, help=description, **settings)


def options(*decorators: Callable[[_Command], _Command]) -> Callable[[_Command], _Command]:
    """Returns a decorator that adds several options to a command, in this order."""
    return lambda command: reduce(
        lambda inner, decorator: decorator(inner), reversed(decorators), command
    )


def named_value(example: str, *, needs_name: bool = True) -> Callable[[str], tuple[str, str]]:
    """Returns the type NAME=VALUE, two strings. With `needs_name=False`, VALUE alone is allowed,
    and the name is empty.
    """

    def split(text: str) -> tuple[str, str]:
        name, equals, value = text.partition("=")
        if not equals and not needs_name:
            return "", name
        if not (name and value):
            raise click.BadParameter(f"{text!r} is not NAME=VALUE. An example is {example}.")
        return name, value

    return split


# --- commands whose options are the fields of a dataclass


def settings_options(settings: type[Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Adds an option for each field of a dataclass to a command, which gets the values as an
    instance of it.

    The docstring below a field is the help, so that the dataclass has `PYDANTIC_CONFIG`. A type may
    be annotated with a type of click, and with a dict of other keywords of `click.option`; "names"
    replaces the name of the field.
    """
    names = [field.name for field in dataclasses.fields(settings)]
    add_options = field_options(settings, names, {})

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def run(*args: Any, **values: Any) -> Any:  # noqa: ANN401  (of any command)
            own = {name: values.pop(name) for name in names}
            return command(*args, settings(**own), **values)

        return add_options(run)

    return decorate


def field_options(
    settings: type[Any], names: Collection[str], details: Mapping[str, Mapping[str, Any]]
) -> Callable[[_Command], _Command]:
    """Adds an option for each of these fields of a dataclass to a command. `details` are other
    keywords of `click.option` by the name of the field. Numbers may have the limits "ge" and "le"
    in their metadata.
    """
    hints = get_type_hints(settings, include_extras=True)
    schemas = cache(lambda: field_schemas(settings))
    return options(
        *(
            _field_option(schemas, field, hints[field.name], details.get(field.name, {}))
            for field in dataclasses.fields(settings)
            if field.name in names
        )
    )


@final
class _FieldOption(click.Option):
    """An option whose help is the docstring below a field, which pydantic reads. It is read when
    it is shown, because importing pydantic is slow.
    """

    def __init__(self, *args: Any, schemas: _Schemas, **keywords: Any) -> None:  # noqa: ANN401
        super().__init__(*args, **keywords)
        self._schemas = schemas

    @property
    def help(self) -> str:
        """The description of the field, in one line."""
        description: str = self._schemas()[self.name]["description"]
        return description

    @help.setter  # noqa: A003  (the name of the attribute of click)
    def help(self, value: str | None) -> None:
        """Ignores the value of click's constructor, which is None."""


def _field_option(
    schemas: _Schemas,
    field: dataclasses.Field[Any],
    hint: Any,  # noqa: ANN401
    details: Mapping[str, Any],
) -> Callable[[_Command], _Command]:
    hint, *more = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    if NoneType in get_args(hint):
        hint = get_args(hint)[0]
    keywords: dict[str, Any] = {"cls": _FieldOption, "schemas": schemas}
    if field.default is dataclasses.MISSING:
        keywords["required"] = True
    else:
        keywords["default"] = field.default
    if hint is bool:
        keywords["is_flag"] = True
    elif get_args(hint)[1:] == (...,):
        keywords["multiple"] = True
    elif get_origin(hint) is Literal:
        keywords["type"] = click.Choice(get_args(hint))
    elif "ge" in field.metadata:
        kind = click.FloatRange if hint is float else click.IntRange
        keywords |= {
            "type": kind(field.metadata["ge"], field.metadata.get("le")),
            "metavar": "NUMBER",
        }
    else:
        keywords["type"] = FILE if hint is Path else hint
    for item in more:
        keywords |= item if isinstance(item, dict) else {"type": item}
    keywords |= details
    short = ("-q",) if field.name == "quiet" else ()
    names = keywords.pop("names", (*short, f"--{field.name.replace('_', '-')}"))
    return click.option(*names, field.name, **keywords)
