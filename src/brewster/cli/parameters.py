"""Types of parameters, and options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from pathlib import Path
from typing import Any, Final, TypeVar, final, get_args

import click

from brewster.options import Device

_Command = TypeVar("_Command", bound=Callable[..., Any])

FILE: Final = click.Path(path_type=Path)
FOLDER: Final = click.Path(path_type=Path, file_okay=False)
EXISTING_FOLDER: Final = click.Path(path_type=Path, file_okay=False, exists=True)
FOLDER.name = EXISTING_FOLDER.name = "folder"
flag: Final = partial(click.option, is_flag=True)
JSON: Final = flag("--json", "as_json", help="Print JSON.")
QUIET: Final = flag("--quiet", help="Print only errors.")
QUIET_TABLES: Final = flag("--quiet", help="Print only errors, and no tables.")
OVERWRITE: Final = flag("--overwrite", help="Replace existing layers.")
DEVICE: Final = click.option(
    "--device", type=click.Choice(get_args(Device)), default="auto", help="The device that runs the models."
)


@final
class Number(click.IntRange):
    """An integer in a range."""

    name = "number"


@final
class Fraction(click.FloatRange):
    """A number in a range."""

    name = "fraction"


def json_lines(item: str) -> Callable[[_Command], _Command]:
    """The option --json of a command that prints a line for each item."""
    return flag("--json", "as_json", help=f"Print one line of JSON for each {item} on standard output.")


def output_folder(description: str, **settings: Any) -> Callable[[_Command], _Command]:  # noqa: ANN401
    """The option -o of a command that writes a folder; `settings` are those of click."""
    return click.option("-o", "--output", "out", type=FOLDER, help=description, **settings)


def options(*decorators: Callable[[_Command], _Command]) -> Callable[[_Command], _Command]:
    """Returns a decorator that adds several options to a command, in this order."""
    return lambda command: reduce(lambda inner, decorator: decorator(inner), reversed(decorators), command)


def named_value(example: str, *, needs_name: bool = True) -> Callable[[str], tuple[str, str]]:
    """Returns the type NAME=VALUE, two strings. With `needs_name=False`, VALUE alone is allowed, and the name is empty."""

    def split(text: str) -> tuple[str, str]:
        name, equals, value = text.partition("=")
        if not equals and not needs_name:
            return "", name
        if not (name and value):
            raise click.BadParameter(f"{text!r} is not NAME=VALUE. An example is {example}.")
        return name, value

    return split
