"""Generates the reference of the command line and that of all recipe keys; `make docs` writes the
two pages.

.venv/bin/python runs/write_reference.py > docs/reference.md
.venv/bin/python runs/write_reference.py recipes > docs/recipes.md
"""

import inspect
import re
import sys
from collections.abc import Iterator
from typing import Final

import click

from brewster.base.settings import FrozenModel, Key, tables
from brewster.cli import cli
from brewster.diffusion.lora.recipe import LoraRecipe
from brewster.render.scene.recipe import SceneRecipe
from brewster.training.recipe import CompactRecipe

_COMMANDS: Final = """# The command line

`make docs` generates this page from the commands; a test checks that it is up to date.

Exit codes: 0 success, 1 error (each error is one line `error: ...` on standard error), 2 invalid
arguments, 130 interrupted by Ctrl-C."""
_RECIPES: Final = """# Recipe keys

`make docs` generates this page from the recipe models; a test checks that it is up to date.

Recipes are TOML files. `brewster render --show-recipe window` and `brewster train --show-recipe
compact` (or `lora`) print a complete recipe with all defaults and a comment for each key. Save and
edit this text to write your own recipe. Both options also accept the path of a recipe file. The
error message for an invalid recipe has one line a problem."""

RECIPE_KINDS: Final[dict[str, tuple[type[FrozenModel], str]]] = {
    "Scene recipes": (
        SceneRecipe,
        "For `brewster render --recipe`: the distributions of random scenes.",
    ),
    "Training recipes of a compact network": (
        CompactRecipe,
        "For `brewster train`, without the key `backbone`.",
    ),
    "Training recipes of a LoRA": (
        LoraRecipe,
        "For `brewster train`, with the key `backbone`.",
    ),
}
"""Title of a section -> the pydantic model of its recipes, and their purpose."""


def reference() -> str:
    """Returns the page of the commands in Markdown, with a section for each command and its
    options.
    """
    context = click.Context(cli, info_name="brewster", show_default=True)
    return "\n\n".join([_COMMANDS, *_command_sections(cli, context)]) + "\n"


def recipe_reference() -> str:
    """Returns the page of the recipes in Markdown, with a table of keys for each TOML table of each
    kind of recipe.
    """
    return "\n\n".join([_RECIPES, *_recipe_sections()]) + "\n"


def _command_sections(command: click.Command, context: click.Context) -> Iterator[str]:
    yield f"## {context.command_path}"
    yield f"    {context.command_path} {' '.join(command.collect_usage_pieces(context))}"
    yield inspect.cleandoc(command.help or "")
    rows = [
        _option_row(param, context) for param in command.params if isinstance(param, click.Option)
    ]
    if rows:
        yield "\n".join(["| option | meaning |", "|---|---|", *rows])
    if isinstance(command, click.Group):
        for name, child in sorted(command.commands.items()):
            yield from _command_sections(
                child, click.Context(child, info_name=name, parent=context)
            )


def _option_row(option: click.Option, context: click.Context) -> str:
    value = "" if option.is_flag else f" {option.make_metavar(context)}"
    default = option.get_help_extra(context).get("default")
    usage = f"{', '.join(option.opts)}{value}".replace("|", "\\|")
    return f"| `{usage}` | {option.help}{f' Default: `{default}`.' if default else ''} |"


def _recipe_sections() -> Iterator[str]:
    seen: dict[str, str] = {}
    for title, (model, purpose) in RECIPE_KINDS.items():
        yield f"## {title}\n\n{purpose}"
        for table in tables(model):
            yield f"### [{table.path}]\n\n{table.meaning}" if table.path else table.meaning
            if table.name in seen:
                yield f"The keys are those of {seen[table.name]}."
            else:
                head = "| key | values | unit | default | meaning |\n|---|---|---|---|---|"
                yield "\n".join([head, *map(_key_row, table.keys)])
            seen.setdefault(table.name, f'`[{table.path}]` in "{title}"')


def _key_row(key: Key) -> str:
    default = re.sub("^default (.*)", r"`\1`", key.default)
    cells = (f"`{key.path}`", key.values, key.unit, default, key.meaning)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


if __name__ == "__main__":
    click.echo(recipe_reference() if sys.argv[1:] == ["recipes"] else reference(), nl=False)
