"""`brewster train`: a recipe in; a run that can be resumed and a model file out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from brewster.cli.doctor import require_extra
from brewster.cli.terminal import interrupts, progress, say
from brewster.errors import TargetError


@click.command
@click.argument("recipe", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    "out",
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    help="The folder of the run: its checkpoint, log, samples and, at the end, model.onnx. By default out/NAME for NAME.toml.",
)
@click.option("--quiet", is_flag=True, help="Say nothing but errors.")
def train(*, recipe: Path, out: Path | None, quiet: bool) -> None:
    """Train a model as RECIPE, a TOML file, says.

    The folder BREWSTER_DATA holds the data. A run that was stopped goes on from its last checkpoint when the same
    command is given again, and ends with the same weights.
    """
    require_extra("train", "training")
    from brewster.train.recipe import read_recipe  # noqa: PLC0415  (wakes torch, in two seconds)

    read, out = read_recipe(recipe), out or Path("out") / recipe.stem
    _make(out)
    from brewster.train.export import export_onnx  # noqa: PLC0415
    from brewster.train.loop import train as run  # noqa: PLC0415

    with progress(read.steps, shown=not quiet) as advance:

        def report(step: int, steps: int, numbers: Mapping[str, float], logged: bool) -> None:
            interrupts.heed()
            advance(step, f"loss {numbers['loss']:.4f}")
            if logged and not quiet:
                told = ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())
                say(f"step {step} of {steps}: {told}")

        network = run(read, out, report)
    model = out / "model.onnx"
    export_onnx(network, model)
    if not quiet:
        say(f"the model is {model}")


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TargetError(
            f"{folder} cannot be made ({error.strerror})", "a folder for the run", "choose another with -o"
        ) from error
