"""`brewster train`: train a model from a recipe. An interrupted run can be resumed."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, final

import click

from brewster.base.files import check_output_folder
from brewster.cli.extras import require_extra
from brewster.cli.parameters import FILE, named_value, settings_options
from brewster.cli.terminal import print_out, print_status, progress
from brewster.options import PYDANTIC_CONFIG


@final
@dataclass(frozen=True)
class _Settings:
    __pydantic_config__ = PYDANTIC_CONFIG

    out: Annotated[Path | None, {"names": ["-o", "--output"], "metavar": "FOLDER"}] = None
    """The folder for the checkpoint, the log, sample images and the trained model (model.onnx or
    the folder lora); by default out/NAME for NAME.toml.
    """
    changes: Annotated[
        tuple[tuple[str, str], ...],
        {
            "names": ["--set"],
            "metavar": "KEY=VALUE",
            "type": named_value("data.rendered.count=300"),
        },
    ] = ()
    """Replace a value of the recipe, such as data.rendered.count=300, for an ablation; repeatable.
    """
    show_recipe: Annotated[str | None, {"metavar": "NAME|FILE"}] = None
    """Do not train; print a recipe as TOML with all defaults and a comment for each key. NAME is
    compact or lora; FILE is a recipe file.
    """
    device: Literal["auto", "cpu"] = "auto"
    """The device to train on. auto is the GPU, or the CPU if there is no GPU. A diffusion backbone
    is trained on a CPU only with --device cpu, because this takes weeks.
    """
    as_json: Annotated[bool, {"names": ["--json"]}] = False
    """Print one line of JSON for each event on standard output: start, report (the metrics of a
    line of the log), end.
    """
    quiet: bool = False
    """Print only errors."""


@click.command
@click.argument("recipe", required=False, type=FILE)
@settings_options(_Settings)
def train(settings: _Settings, recipe: Path | None) -> None:
    """Train a model with the settings of RECIPE, a TOML file.

    The environment variable BREWSTER_DATA is the path of the data folder. To resume an interrupted
    run from its last checkpoint, run the same command again; on a CPU, the final weights are the
    same as without the interruption. To make a run longer, raise `steps` in the recipe and run the
    command again.
    """
    if settings.show_recipe:
        from brewster.base.settings import commented_toml  # noqa: PLC0415
        from brewster.training.recipe import read_template  # noqa: PLC0415

        print_out(commented_toml(read_template(settings.show_recipe)).rstrip())
        return
    require_extra("train", "training")
    if recipe is None:
        raise click.UsageError("The recipe is missing. Usage: brewster train RECIPE.")
    from brewster.diffusion.lora.recipe import LoraRecipe  # noqa: PLC0415
    from brewster.training.recipe import read_recipe, with_value  # noqa: PLC0415

    parsed = read_recipe(recipe)
    out = settings.out or Path("out") / recipe.stem
    for key, value in settings.changes:
        parsed = with_value(parsed, key, _toml_value(value))
    if isinstance(parsed, LoraRecipe):
        require_extra("diffusion", "training a diffusion backbone")
    check_output_folder(out)
    from brewster.training.loop import open_trainer, run  # noqa: PLC0415

    trainer = open_trainer(parsed, settings.device)
    printer = _TrainingPrinter(settings.as_json, settings.quiet, out)
    with progress(
        parsed.steps, shown=not printer.quiet, as_json=settings.as_json
    ) as update_progress:

        def on_progress(
            step: int, steps: int, metrics: Mapping[str, float], is_logged: bool
        ) -> None:
            update_progress(step, f"loss {metrics['loss']:.4f}")
            if is_logged:
                printer.report(step, steps, metrics)

        run(trainer, out, on_progress, printer.start)
    printer.end(trainer.export(out))


def _toml_value(text: str) -> object:
    """Returns the value that a recipe would have. Text needs no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


@final
@dataclass(frozen=True)
class _TrainingPrinter:
    """Prints the events of a run: as JSON on standard output, and as text on standard error."""

    as_json: bool
    quiet: bool
    folder: Path

    def start(self, step: int, steps: int, seconds: float) -> None:
        """If the run is resumed, prints the number of completed steps and the time that they
        took.
        """
        text = f"step {step} of {steps}, after {seconds / 60:.1f} minutes of training"
        if step == steps:
            text = (
                f"the run in {self.folder} is complete at {text}: to make it longer, raise "
                "steps in the recipe"
            )
        elif step:
            text = f"resuming the run in {self.folder} from {text}"
        event = {"step": step, "steps": steps, "seconds": seconds, "folder": str(self.folder)}
        self._print(text if step else "", event="start", **event)

    def report(self, step: int, steps: int, metrics: Mapping[str, float]) -> None:
        line = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        self._print(
            f"step {step} of {steps}: {line}",
            event="report",
            step=step,
            steps=steps,
            metrics=dict(metrics),
        )

    def end(self, model: Path) -> None:
        self._print(f"the model is in {model}", event="end", model=str(model))

    def _print(self, text: str, **event: object) -> None:
        if self.as_json:
            print_out(json.dumps(event))
        if text and not self.quiet:
            print_status(text)
