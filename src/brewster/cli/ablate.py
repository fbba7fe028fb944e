"""`brewster ablate`: train a model for each value of one setting, and compare the models in tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from brewster.cli.evaluate import print_failures, print_remarks, print_tables
from brewster.cli.extras import require_extra
from brewster.cli.terminal import interrupts, print_status


@click.command
@click.argument("path", metavar="ABLATION", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    "out",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="The folder for models, tables and the report. By default out/ablations/NAME for NAME.toml, or NAME-BASE with --base.",
)
@click.option(
    "--base",
    metavar="RECIPE",
    type=click.Path(path_type=Path),
    help="A training recipe to use instead of the one in ABLATION, such as a tiny one for a test run.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Number of processes that compute scores.",
)
@click.option("--quiet", is_flag=True, help="Print only errors, and no tables.")
@click.pass_context
def ablate(
    context: click.Context, /, *, path: Path, out: Path | None, base: Path | None, workers: int, quiet: bool
) -> None:
    """Train and evaluate a model for each choice of the one setting that ABLATION, a TOML file, varies.

    The environment variable BREWSTER_DATA names the data folder. The same command resumes an interrupted run. The
    tables go to standard output; the tables and report.html are also written to the output folder.
    """
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

    def on_progress(choice: str, step: int, steps: int, metrics: Mapping[str, float], logged: bool) -> None:
        interrupts.raise_pending()
        if logged and not quiet:
            print_status(f"{choice}, step {step} of {steps}: loss {metrics['loss']:.4f}")

    results = run(study, benchmarks, out, workers=workers, on_progress=on_progress)
    if not quiet:
        print_tables(results)
        print_status(f"results are in {out}")
    context.exit(0 if print_failures(results, quiet=quiet) and is_complete else 1)
