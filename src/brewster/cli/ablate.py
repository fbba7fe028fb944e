"""`brewster ablate`: train one model for each value of a recipe key, and compare the models in tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from brewster.cli.evaluate import print_failures, print_remarks, print_tables
from brewster.cli.extras import require_extra
from brewster.cli.parameters import FILE, QUIET_TABLES, Number, output_folder
from brewster.cli.terminal import interrupts, print_status


@click.command
@click.argument("path", metavar="ABLATION", type=FILE)
@output_folder(
    "The folder for models, tables and the report; by default out/ablations/NAME for NAME.toml, and with --base BASE.toml, out/ablations/NAME-BASE."
)
@click.option(
    "--base",
    metavar="RECIPE",
    type=FILE,
    help="A training recipe that replaces the base recipe of ABLATION, such as a tiny one for a test run.",
)
@click.option("--workers", type=Number(1), default=1, help="The number of processes that compute scores.")
@QUIET_TABLES
@click.pass_context
def ablate(
    context: click.Context, /, *, path: Path, out: Path | None, base: Path | None, workers: int, quiet: bool
) -> None:
    """Train and evaluate one model for each value of one recipe key.

    ABLATION is a TOML file with the base recipe, the key, its values and the benchmarks.

    The environment variable BREWSTER_DATA is the path of the data folder. To resume an interrupted run, run the same
    command again. The tables are printed on standard output; the output folder gets the tables and report.html."""
    require_extra("train", "training")
    require_extra("evaluate", "evaluating")
    from brewster.evaluate.ablation import ablate as run  # noqa: PLC0415  (imports torch, two seconds)
    from brewster.evaluate.ablation import read_study  # noqa: PLC0415

    study, name = read_study(path), path.stem
    if base:
        study, name = study.model_copy(update={"base": base}), f"{name}-{base.stem}"
    out = out or Path("out") / "ablations" / name
    benchmarks = study.open_benchmarks()
    is_complete = print_remarks(benchmarks, quiet=quiet)

    def on_progress(
        choice: str, step: int, steps: int, metrics: Mapping[str, float], is_logged: bool
    ) -> None:
        interrupts.raise_pending()
        if is_logged and not quiet:
            print_status(f"{choice}, step {step} of {steps}: loss {metrics['loss']:.4f}")

    results = run(study, benchmarks, out, workers=workers, on_progress=on_progress)
    if not quiet:
        print_tables(results)
        print_status(f"the results are in {out}")
    context.exit(0 if print_failures(results, quiet=quiet) and is_complete else 1)
