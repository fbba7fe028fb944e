"""`brewster train`: train a model from a recipe; the run can be resumed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from brewster.cli.extras import require_extra
from brewster.cli.terminal import interrupts, print_out, print_status, progress
from brewster.errors import RecipeError, TargetError

if TYPE_CHECKING:
    from brewster.training.recipe import CompactRecipe, LoraRecipe


@click.command
@click.argument("recipe", required=False, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    "out",
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    help="The folder for checkpoint, log, samples and, at the end, model.onnx or the folder lora. By default out/NAME for NAME.toml.",
)
@click.option(
    "--plan",
    is_flag=True,
    help="Estimate memory and time for the recipe of a large backbone, check whether they fit, and do not train.",
)
@click.option(
    "--gpu",
    "gpu_name",
    metavar="NAME",
    help='Estimate for this graphics card, such as "RTX 4090", instead of the one in this machine; implies --plan.',
)
@click.option(
    "--show-recipe",
    metavar="NAME|FILE",
    help="Print a recipe as TOML with all defaults and a comment for each key, and do not train: compact, lora, or a file.",
)
@click.option("--quiet", is_flag=True, help="Print only errors.")
def train(
    *,
    recipe: Path | None,
    out: Path | None,
    plan: bool,
    gpu_name: str | None,
    show_recipe: str | None,
    quiet: bool,
) -> None:
    """Train a model with the settings of RECIPE, a TOML file.

    The environment variable BREWSTER_DATA names the data folder. The same command resumes an interrupted run from its
    last checkpoint, and ends with the same weights. Under torchrun, several GPUs train a large backbone together.
    """
    require_extra("train", "training")
    if show_recipe:
        _show_recipe(show_recipe)
        return
    if recipe is None:
        raise click.UsageError("Name a recipe: brewster train RECIPE.")
    from brewster.training.recipe import LoraRecipe, read_recipe  # noqa: PLC0415  (imports torch, two seconds)

    parsed, out = read_recipe(recipe), out or Path("out") / recipe.stem
    if isinstance(parsed, LoraRecipe):
        require_extra("large", "a large backbone")
    if plan or gpu_name:
        _print_plan(parsed, gpu_name)
        return
    _make_folder(out)
    from brewster.training.distributed import is_main_process  # noqa: PLC0415
    from brewster.training.loop import run  # noqa: PLC0415
    from brewster.training.trainers import open_trainer  # noqa: PLC0415

    trainer = open_trainer(parsed)
    quiet = quiet or not is_main_process()
    with progress(parsed.steps, shown=not quiet) as advance:

        def report(step: int, steps: int, metrics: Mapping[str, float], logged: bool) -> None:
            interrupts.raise_pending()
            advance(step, f"loss {metrics['loss']:.4f}")
            if logged and not quiet:
                line = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())
                print_status(f"step {step} of {steps}: {line}")

        run(trainer, out, report)
    if is_main_process():
        model = trainer.export(out)
        if not quiet:
            print_status(f"the model is {model}")


def _show_recipe(name: str) -> None:
    from brewster.scene.recipe_file import commented_toml  # noqa: PLC0415
    from brewster.training.recipe import read_template  # noqa: PLC0415

    print_out(commented_toml(read_template(name)).rstrip())


def _print_plan(recipe: CompactRecipe | LoraRecipe, gpu_name: str | None) -> None:
    from brewster.training.lora.resource_estimate import estimate_resources, find_gpu, is_local_gpu  # noqa: PLC0415
    from brewster.training.recipe import LoraRecipe  # noqa: PLC0415

    if not isinstance(recipe, LoraRecipe):
        raise RecipeError(
            "the recipe trains the compact network",
            "--plan needs the recipe of a large backbone",
            "train it without --plan",
        )
    gpu = find_gpu(gpu_name)
    if gpu_name is None and not is_local_gpu(gpu):
        print_status(
            f"no graphics card found: the plan is for {gpu.name}, the paper's card; choose another with --gpu"
        )
    estimate = estimate_resources(recipe, gpu)
    print_out(estimate.table())
    estimate.check_fits()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TargetError(
            f"{folder} cannot be created ({error.strerror})",
            "the run needs a folder that can be written",
            "choose another with -o",
        ) from error
