"""`brewster models`: which there are, what their cards say, whether their files are whole; and sending a LoRA to the hub."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from brewster.cli.extras import require_extra
from brewster.cli.terminal import print_error, print_out, print_status
from brewster.errors import BrewsterError, ModelError
from brewster.files import write_atomically
from brewster.models import zoo

_JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
_NAME = click.argument("name", default="compact")
_CARD = "README.md"


@click.group
def models() -> None:
    """Show the models, their cards and their files."""


@models.command("list")
@_JSON
def list_models(*, as_json: bool) -> None:
    """List the models that come with brewster."""
    rows = [describe(model) for model in zoo.MODELS.values()]
    if as_json:
        print_out(json.dumps(rows))
        return
    for row in rows:
        size = f"{row['bytes'] / 1e6:.1f} MB" if row["error"] is None else "damaged"
        print_out(f"{row['name']:20} {size:>10}  {row['licence']}")


@models.command
@_NAME
@click.option(
    "--scores",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Put the tables of this results.json, which brewster evaluate wrote, into the card of a LoRA's folder first.",
)
def card(*, name: str, scores: Path | None) -> None:
    """Print the card of a model, or of a LoRA's folder: licence, training data, scores, where it fails."""
    if scores:
        _update_scores(Path(name), scores)
    is_folder = name not in zoo.MODELS and Path(name).is_dir()
    print_out(_read_card(Path(name)) if is_folder else zoo.find_model(name).card())


@models.command
@_NAME
def path(*, name: str) -> None:
    """Print where the file of a model lies."""
    model = zoo.find_model(name)
    model.verify()
    print_out(model.path)


@models.command
@click.argument("names", nargs=-1, metavar="[NAME]...")
@_JSON
@click.pass_context
def verify(context: click.Context, *, names: tuple[str, ...], as_json: bool) -> None:
    """Check that the files of models, of all unless some are named, are those that were shipped."""
    rows = [describe(zoo.find_model(name)) for name in names or zoo.MODELS]
    if as_json:
        print_out(json.dumps(rows))
    for row in rows:
        if row["error"]:
            print_error(row["error"])
        elif not as_json:
            print_out(f"{row['name']}: {row['sha256']}")
    context.exit(1 if any(row["error"] for row in rows) else 0)


@models.command
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("repo_id", metavar="OWNER/NAME")
@click.option("--public", is_flag=True, help="For everybody to see; without it, only you and your team.")
@click.option("--message", metavar="TEXT", default="", help="Of the commit, if not the base and rank.")
@click.option("--dry-run", is_flag=True, help="Check the folder, print what would be sent, and send nothing.")
@_JSON
def push(*, folder: Path, repo_id: str, public: bool, message: str, dry_run: bool, as_json: bool) -> None:
    """Send the LoRA in FOLDER to the Hugging Face hub as OWNER/NAME, in one commit.

    Sent are its weights, its prompt, its recipe and its card, nothing else; places of this machine are not named. The
    token is HF_TOKEN, or the one of `hf auth login`.
    """
    require_extra("large", "pushing")
    from brewster.models.diffusion.adapter import hub  # noqa: PLC0415  (wakes torch)

    plan = hub.plan_push(folder, repo_id, message=message, public=public)
    for remark in plan.remarks:
        print_status(remark)
    address = None if dry_run else hub.push(plan)
    if as_json:
        print_out(json.dumps(plan.about() | {"address": address}))
    else:
        print_out(plan.table())
        print_out(f"sent: {address}" if address else "nothing was sent")


def describe(model: zoo.ModelFile) -> dict[str, Any]:
    """A model in plain values; `error` says what is wrong with its file, or is None."""
    row = {"name": model.name, "path": str(model.path), "licence": model.licence, "sha256": model.sha256}
    try:
        return row | {"sha256": model.verify(), "bytes": model.path.stat().st_size, "error": None}
    except BrewsterError as error:
        return row | {"bytes": None, "error": str(error)}


def _read_card(folder: Path) -> str:
    path = folder / _CARD
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(
            f"{path} cannot be read ({error})",
            "the card of a LoRA, as brewster train writes it",
            "name its folder lora",
        ) from error


def _update_scores(folder: Path, scores: Path) -> None:
    """Replaces what the card in this folder says was measured."""
    require_extra("train", "writing a card")
    from brewster.evaluate.report.tables import overview  # noqa: PLC0415  (wakes torch)
    from brewster.training.lora.model_card import with_measured  # noqa: PLC0415

    try:
        results = json.loads(scores.read_text("utf-8"))
        lines = [overview(results), *(f"- {choice}" for choice in results["protocol"]["choices"])]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ModelError(
            f"{scores} cannot be read ({error!r})",
            "the results.json that brewster evaluate wrote",
            "name that file",
        ) from error
    text = with_measured(_read_card(folder), "\n".join(lines))
    write_atomically(folder / _CARD, text.encode(), overwrite=True)
