"""`brewster models`: which there are, what their cards say, and whether their files are whole."""

from __future__ import annotations

import json
from typing import Any

import click

from brewster.cli.terminal import complain
from brewster.errors import BrewsterError
from brewster.models import zoo

_JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
_NAME = click.argument("name", default="compact")


@click.group
def models() -> None:
    """Show the models, their cards and their files."""


@models.command("list")
@_JSON
def list_models(*, as_json: bool) -> None:
    """List the models that come with brewster."""
    rows = [describe(model) for model in zoo.MODELS.values()]
    if as_json:
        click.echo(json.dumps(rows))
        return
    for row in rows:
        size = f"{row['bytes'] / 1e6:.1f} MB" if row["error"] is None else "damaged"
        click.echo(f"{row['name']:20} {size:>10}  {row['licence']}")


@models.command
@_NAME
def card(*, name: str) -> None:
    """Print the card of a model: licence, training data, scores, where it fails."""
    click.echo(zoo.find_model(name).card())


@models.command
@_NAME
def path(*, name: str) -> None:
    """Print where the file of a model lies."""
    model = zoo.find_model(name)
    model.verify()
    click.echo(model.path)


@models.command
@click.argument("names", nargs=-1, metavar="[NAME]...")
@_JSON
@click.pass_context
def verify(context: click.Context, *, names: tuple[str, ...], as_json: bool) -> None:
    """Check that the files of models, of all unless some are named, are those that were shipped."""
    rows = [describe(zoo.find_model(name)) for name in names or zoo.MODELS]
    if as_json:
        click.echo(json.dumps(rows))
    for row in rows:
        if row["error"]:
            complain(row["error"])
        elif not as_json:
            click.echo(f"{row['name']}: {row['sha256']}")
    context.exit(1 if any(row["error"] for row in rows) else 0)


def describe(model: zoo.Model) -> dict[str, Any]:
    """A model in plain values; `error` says what is wrong with its file, or is None."""
    row = {"name": model.name, "path": str(model.path), "licence": model.licence, "sha256": model.sha256}
    try:
        return row | {"sha256": model.verify(), "bytes": model.path.stat().st_size, "error": None}
    except BrewsterError as error:
        return row | {"bytes": None, "error": str(error)}
