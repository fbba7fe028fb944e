"""`brewster evaluate`: score methods on benchmarks, and write tables, a report and the scores of every image."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import click

from brewster.cli.extras import require_extra
from brewster.cli.parameters import DEVICE, QUIET_TABLES, Number, flag, named_value, output_folder
from brewster.cli.terminal import interrupts, print_error, print_out, print_status, progress, write_out
from brewster.errors import counted
from brewster.options import Device, Quality

if TYPE_CHECKING:
    from brewster.benchmarks.registry import Benchmark
    from brewster.evaluate.config import EvaluationConfig
    from brewster.evaluate.methods import Method
    from brewster.evaluate.results import Results


_ENCODE_ERRORS: Final = "backslashreplace"
"""The error handler for file names with bytes that are not valid text: these bytes are printed as escapes."""
_NATIVE: Final = "native"
_CASES_PER_WORKER: Final = 25
"""A worker process imports torch and loads the weights of LPIPS, which takes as long as it takes to score some images."""


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(number) for number in text.split(","))
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is not a list of numbers. An example is 0.05,0.1.") from error


def _size(text: str) -> int | str:
    if text != _NATIVE and not (text.isdecimal() and int(text)):
        raise click.BadParameter(f"{text!r} is neither native nor a positive number of pixels.")
    return text if text == _NATIVE else int(text)


@click.command
@click.option(
    "--benchmark",
    "benchmarks",
    metavar="NAME=FOLDER",
    type=named_value("real20=data/real20"),
    multiple=True,
    required=True,
    help="The name of a benchmark and the folder of your copy; repeatable. docs/evaluation.md lists the names, such as real20, "
    "sir2, pairs (any folder of pairs) or rendered (a set of brewster render). An unknown NAME gives an error that lists all names.",
)
@click.option(
    "--model",
    "models",
    metavar="[NAME=]MODEL",
    type=named_value("ours=model.onnx", needs_name=False),
    multiple=True,
    help="A model to run, given in the same way as for `brewster --model`; NAME is its name in the tables; repeatable.",
)
@flag("--burst", help="Runs each model a second time, on all photos of each burst (the method NAME burst).")
@click.option(
    "--predictions",
    metavar="NAME=FOLDER",
    type=named_value("RDNet=out/rdnet"),
    multiple=True,
    help="The name of another method and the folder of its predictions, named like the photos of the benchmark; repeatable.",
)
@output_folder(
    "The folder for results, tables, the report and the models' predictions.", default=Path("out/evaluate")
)
@click.option(
    "--metrics",
    metavar="NAME,...",
    help="The metrics to compute; by default those of the protocol. docs/evaluation.md lists them. A metric is skipped if the "
    "benchmark has no ground truth for it.",
)
@click.option(
    "--protocol",
    type=click.Choice(
        ["brewster", "paper", "xreflection", "windowseat", "ERRNet", "ntire2026"], case_sensitive=False
    ),
    default="brewster",
    help="The choices of a paper or contest: metrics, sizes, border and subsets. The report lists them with their sources. "
    "paper: also report one image per scene of Postcard and SolidObject, chosen at random with a fixed seed.",
)
@click.option(
    "--size",
    type=_size,
    metavar="native|420|512",
    help="First downscale larger images, both photo and ground truth, so that their shorter side has this number of pixels; by default as in the protocol.",
)
@click.option(
    "--region-threshold",
    "thresholds",
    type=_numbers,
    metavar="NUMBER,...",
    help="The smallest difference between photo and ground truth inside the reflection region, as a fraction of the full range, such as 0.08; several values are evaluated separately.",
)
@click.option(
    "--quality",
    type=click.Choice(get_args(Quality)),
    default="standard",
    help="Number and size of the input scales of the models.",
)
@DEVICE
@click.option(
    "--workers",
    type=Number(1),
    help="The number of processes that compute scores; by default one for each 25 images, but at most one for each processor.",
)
@click.option(
    "--limit",
    type=Number(1),
    help="For a first look: score at most this number of images of each benchmark, evenly spread over it.",
)
@click.option(
    "--pictures",
    type=Number(0),
    default=50,
    help="The number of images of each benchmark that the report shows: those with the worst scores of the first method.",
)
@flag("--intervals", help="Print 95 % confidence intervals in the terminal and in table.tex.")
@click.option(
    "--export",
    type=click.Choice(["ntire2026"]),
    help="After scoring, also write the zip files that a contest takes, for each method: ntire2026 for openrr=FOLDER.",
)
@flag("--json", "as_json", help="Print the results as JSON instead of the tables.")
@QUIET_TABLES
@flag("--dry-run", help="Check benchmarks and methods, print the names of the images, and score nothing.")
@click.pass_context
def evaluate(
    context: click.Context,
    /,
    *,
    benchmarks: tuple[tuple[str, str], ...],
    models: tuple[tuple[str, str], ...],
    burst: bool,
    predictions: tuple[tuple[str, str], ...],
    out: Path,
    limit: int | None,
    workers: int | None,
    pictures: int,
    intervals: bool,
    export: str | None,
    as_json: bool,
    quiet: bool,
    dry_run: bool,
    device: Device,
    **settings: Any,  # noqa: ANN401  (those of _config)
) -> None:
    """Score methods on benchmarks, with the unprocessed input as baseline.

    The tables are printed on standard output. The output folder gets results.json and scores.csv (the scores of every
    image), tables.md (also intervals and differences), table.tex, table.csv and report.html. To resume an interrupted run, run the same command again.

    Photos and ground truth are paired by file name. If a photo has no ground truth, or if a method fails on it, it is
    listed, all other photos are scored, and the exit code is 1."""
    require_extra("evaluate", "evaluating")
    from brewster.evaluate import evaluation  # noqa: PLC0415  (imports torch, two seconds)
    from brewster.evaluate.methods import IdentityBaseline, ModelMethod, PredictionFolder  # noqa: PLC0415
    from brewster.evaluate.submission import openrr_folder  # noqa: PLC0415
    from brewster.models.zoo import model_name  # noqa: PLC0415

    export_folder = openrr_folder(benchmarks, has_method=bool(models or predictions)) if export else None
    config, parts = _config(**settings), _read_benchmarks(benchmarks, limit)
    if burst and not (models and any(case.frames for part in parts for case in part.cases)):
        raise click.UsageError("--burst needs a --model and a benchmark with bursts, such as bursts=FOLDER.")
    named = [(name or model_name(model), model, False) for name, model in models]
    named += [(f"{name} burst", model, True) for name, model, _ in named if burst]
    methods: list[Method] = [IdentityBaseline()]
    for name, model, is_burst in named:
        folder = out / "predictions" / name
        methods.append(ModelMethod(name, model, folder, config.quality, device, is_burst))
    methods += [PredictionFolder(name, Path(folder)) for name, folder in predictions]
    is_complete = _print_remarks(parts, quiet=quiet)
    if dry_run:
        evaluation.check(parts, methods, config)
        _print_cases(parts, methods)
        context.exit(0 if is_complete else 1)
    case_count = sum(len(part.cases) for part in parts)
    with progress(len(methods) * case_count, shown=not quiet) as update_progress:
        results = evaluation.evaluate(
            parts,
            methods,
            config,
            out,
            workers=workers or _default_workers(case_count),
            max_report_cases=pictures,
            intervals=intervals,
            on_progress=lambda done, _, row: update_progress(
                done, f"{row.benchmark}/{row.case} {row.method}"
            ),
        )
    if as_json:
        print_out(json.dumps(results))
    elif not quiet:
        _print_tables(results, intervals=intervals)
        print_status(
            f"the results are in {out}; {out / evaluation.REPORT_FILE} shows the images, and tables.md has intervals and differences"
        )
    if export_folder:
        _export(export_folder, methods[1:], out / "export", quiet=quiet)  # without the baseline
    context.exit(0 if _print_failures(results, quiet=quiet) and is_complete else 1)


def _config(
    protocol: str,
    quality: Quality,
    metrics: str | None,
    size: int | str | None,
    thresholds: tuple[float, ...] | None,
) -> EvaluationConfig:
    from brewster.evaluate.protocols import protocol_config  # noqa: PLC0415

    changes: dict[str, Any] = {"quality": quality}
    if size is not None:
        changes["short_side_px"] = None if size == _NATIVE else size
    if metrics is not None:
        changes["metrics"] = tuple(name.strip() for name in metrics.split(","))
    if thresholds is not None:
        changes["thresholds"] = thresholds
    return protocol_config(protocol.lower(), **changes)


def _read_benchmarks(folders: Sequence[tuple[str, str]], limit: int | None) -> list[Benchmark]:
    from brewster.benchmarks.registry import read_benchmark  # noqa: PLC0415
    from brewster.benchmarks.selection import spread, with_unique_names  # noqa: PLC0415

    read = [(part, Path(folder)) for name, folder in folders for part in read_benchmark(name, Path(folder))]
    unique = with_unique_names(read)
    return [spread(part, limit) for part in unique] if limit else unique


def _print_cases(benchmarks: Sequence[Benchmark], methods: Sequence[Method]) -> None:
    for benchmark in benchmarks:
        print_status(f"{benchmark.title}: {counted(len(benchmark.cases), 'image')}")
        names = "".join(f"{benchmark.name}/{case.name}\n" for case in benchmark.cases)
        write_out(names.encode(errors=_ENCODE_ERRORS))
    for method in methods:
        print_status(f"method: {method.name}")


def _export(folder: Path, methods: Sequence[Method], out: Path, *, quiet: bool) -> None:
    from brewster.evaluate.submission import export_ntire2026  # noqa: PLC0415

    for method in methods:
        for path in export_ntire2026(
            folder, method, out / method.name, on_progress=lambda _: interrupts.raise_pending()
        ):
            if not quiet:
                print_status(f"wrote {path}")


def _print_remarks(benchmarks: Sequence[Benchmark], *, quiet: bool) -> bool:
    """Prints remarks and errors about benchmarks. Returns whether no image was left out."""
    for benchmark in benchmarks:
        for remark in () if quiet else benchmark.remarks:
            print_status(f"{benchmark.title}: {remark}")
        for reason in benchmark.excluded:
            print_error(f"{benchmark.title}: {reason}")
    return not any(benchmark.excluded for benchmark in benchmarks)


def _print_tables(results: Results, *, intervals: bool = False) -> None:
    """Prints the tables on standard output. They fit the width of the terminal."""
    from brewster.evaluate.report.tables import to_terminal  # noqa: PLC0415

    width = shutil.get_terminal_size((100, 24)).columns
    write_out(to_terminal(results, width, intervals=intervals).encode(errors=_ENCODE_ERRORS))


def _default_workers(case_count: int) -> int:
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(processors, case_count // _CASES_PER_WORKER))


def _print_failures(results: Results, *, quiet: bool) -> bool:
    """Prints remarks about methods, metrics without scores, and errors. Returns whether all predictions were scored."""
    from brewster.evaluate.report.tables import failures, remarks, unavailable_metrics  # noqa: PLC0415

    for remark in () if quiet else remarks(results):
        print_status(remark)
    for name in () if quiet else results["unmeasured"]:
        print_status(f"{name} was not computed: no image has the ground truth that it needs")
    for metrics in unavailable_metrics(results):
        print_error(f"not computed: {metrics}")
    if results["unavailable"] and not quiet:
        print_status(
            "run the same command again to add the missing metrics; all other scores are kept in scores.jsonl"
        )
    for error in failures(results):
        print_error(error)
    if count := sum(len(picture["errors"]) for picture in results["cases"]):
        print_error(f"{counted(count, 'prediction')} could not be scored")
    return not count and not results["unavailable"]
