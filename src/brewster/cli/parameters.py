"""Types of parameters, and options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any, Final, TypeVar, final, get_args

import click

from brewster.options import Device

FILE: Final = click.Path(path_type=Path)
FOLDER: Final = click.Path(path_type=Path, file_okay=False)
EXISTING_FOLDER: Final = click.Path(path_type=Path, file_okay=False, exists=True)
FOLDER.name = EXISTING_FOLDER.name = "folder"
JSON: Final = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
QUIET: Final = click.option("--quiet", is_flag=True, help="Print only errors.")
OVERWRITE: Final = click.option("--overwrite", is_flag=True, help="Replace existing layers.")
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


_Command = TypeVar("_Command", bound=Callable[..., Any])


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
