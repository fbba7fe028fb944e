"""Generates the reference of all recipe keys from their pydantic models: `make docs` writes docs/recipes.md.

.venv/bin/python -m brewster.cli.recipe_reference > docs/recipes.md"""

import re
from collections.abc import Iterator
from typing import Final

import click

from brewster.scene.recipe import SceneRecipe
from brewster.settings import FrozenModel, Key, tables
from brewster.training.recipe import CompactRecipe, LoraRecipe

_BEGINNING: Final = """# Recipe keys

`make docs` generates this page from the recipe models; a test checks that it is up to date.

Recipes are TOML files. `brewster render --show-recipe window` and `brewster train --show-recipe compact` (or `lora`)
print a complete recipe with all defaults and a comment for each key. Save and edit this text to write your own recipe. Both
options also accept the path of a recipe file. The error message for an invalid recipe has one line for each problem."""

RECIPE_KINDS: Final[dict[str, tuple[type[FrozenModel], str]]] = {
    "Scene recipes": (
        SceneRecipe,
        "For `brewster render --recipe`: the distributions from which random scenes are drawn.",
    ),
    "Training recipes of a compact network": (
        CompactRecipe,
        "For `brewster train`, without the key `backbone`.",
    ),
    "Training recipes of a LoRA": (LoraRecipe, "For `brewster train`, with the key `backbone`."),
}
"""Title of a section -> the pydantic model of its recipes, and their purpose."""


def recipe_reference() -> str:
    """Returns the page in Markdown, with a table of keys for each TOML table of each kind of recipe."""
    return "\n\n".join([_BEGINNING, *_sections()]) + "\n"


def _sections() -> Iterator[str]:
    seen: dict[str, str] = {}
    for title, (model, purpose) in RECIPE_KINDS.items():
        yield f"## {title}\n\n{purpose}"
        for table in tables(model):
            yield f"### [{table.path}]\n\n{table.meaning}" if table.path else table.meaning
            if table.name in seen:
                yield f"The keys are those of {seen[table.name]}."
            else:
                head = "| key | values | unit | default | meaning |\n|---|---|---|---|---|"
                yield "\n".join([head, *map(_row, table.keys)])
            seen.setdefault(table.name, f'`[{table.path}]` in "{title}"')


def _row(key: Key) -> str:
    default = re.sub("^default (.*)", r"`\1`", key.default)
    cells = (f"`{key.path}`", key.values, key.unit, default, key.meaning)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


if __name__ == "__main__":
    click.echo(recipe_reference(), nl=False)
