"""`brewster evaluate`: score methods on benchmarks, and write tables, a report and the scores of
every image.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, final

import click

from brewster.cli.extras import require_extra
from brewster.cli.parameters import FOLDER, Fraction, Number, named_value, settings_options
from brewster.cli.terminal import print_error, print_out, print_status, progress, write_out
from brewster.errors import counted
from brewster.options import PYDANTIC_CONFIG, Device, Quality

if TYPE_CHECKING:
    from brewster.evaluation.benchmarks.registry import Benchmark
    from brewster.evaluation.config import EvaluationConfig
    from brewster.evaluation.methods import Method
    from brewster.evaluation.results import Results

_ENCODE_ERRORS: Final = "backslashreplace"
"""The error handler for file names with bytes that are not valid text: these bytes are printed as
escapes.
"""
_PROTOCOLS: Final = ("brewster", "paper", "xreflection", "windowseat", "ERRNet", "ntire2026")
_CASES_PER_WORKER: Final = 25
"""A worker process imports torch and loads the weights of LPIPS, which takes as long as it takes to
score some images.
"""


def _size(text: str) -> int:
    if text != "native" and not (text.isdecimal() and int(text)):
        raise click.BadParameter(f"{text!r} is neither native nor a positive number of pixels.")
    return 0 if text == "native" else int(text)


@final
@dataclass(frozen=True)
class _Settings:
    __pydantic_config__ = PYDANTIC_CONFIG

    benchmarks: Annotated[
        tuple[tuple[str, str], ...],
        {
            "names": ["--benchmark"],
            "metavar": "NAME=FOLDER",
            "type": named_value("real20=data/real20"),
        },
    ]
    """The name of a benchmark and the folder of your copy; repeatable. docs/evaluation.md lists the
    names, such as real20, sir2, pairs (any folder of pairs) or rendered (a set of brewster render).
    An unknown NAME gives an error that lists all names.
    """
    models: Annotated[
        tuple[tuple[str, str], ...],
        {
            "names": ["--model"],
            "metavar": "[NAME=]MODEL",
            "type": named_value("ours=a.onnx", needs_name=False),
        },
    ] = ()
    """A model to run, given in the same way as for `brewster --model`; NAME is its name in the
    tables; repeatable.
    """
    burst: bool = False
    """Runs each model a second time, on all photos of each burst (the method NAME burst)."""
    predictions: Annotated[
        tuple[tuple[str, str], ...],
        {"metavar": "NAME=FOLDER", "type": named_value("RDNet=out/rdnet")},
    ] = ()
    """The name of another method and the folder of its predictions, named like the photos of the
    benchmark; repeatable.
    """
    out: Annotated[Path, FOLDER, {"names": ["-o", "--output"]}] = Path("out/evaluate")
    """The folder for results, tables, the report and the models' predictions."""
    metrics: Annotated[str | None, {"metavar": "NAME,..."}] = None
    """The metrics to compute; by default those of the protocol. docs/evaluation.md lists them. A
    metric is skipped if the benchmark has no ground truth for it.
    """
    protocol: Annotated[str, click.Choice(_PROTOCOLS, case_sensitive=False)] = "brewster"
    """The choices of a paper or contest: metrics, sizes, border and subsets. The report lists them
    with their sources. paper: also report one image per scene of Postcard and SolidObject, chosen
    at random with a fixed seed.
    """
    size: Annotated[int | None, {"type": _size, "metavar": "native|420|512"}] = None
    """First downscale larger images, both photo and ground truth, so that their shorter side has
    this number of pixels; by default as in the protocol.
    """
    region_threshold: Annotated[float | None, Fraction(0, 1, min_open=True, max_open=True)] = None
    """The smallest difference between photo and ground truth inside the reflection region, as a
    fraction of the full range; by default 0.08.
    """
    quality: Quality = "standard"
    """Number and size of the input scales of the models."""
    device: Device = "auto"
    """The device that runs the models."""
    workers: Annotated[int | None, Number(1)] = None
    """The number of processes that compute scores; by default one for each 25 images, but at most
    one for each processor.
    """
    only: Annotated[tuple[str, ...], {"metavar": "NAME"}] = ()
    """Score only the images with this name, such as 12 or real20/12; * stands for any text;
    repeatable. --dry-run prints all names.
    """
    limit: Annotated[int | None, Number(1)] = None
    """For a first look: score at most this number of images of each benchmark, evenly spread over
    it.
    """
    pictures: Annotated[int, Number(0)] = 50
    """The number of images of each benchmark that the report shows: those with the worst scores of
    the first method.
    """
    intervals: bool = False
    """Print 95 % confidence intervals in the terminal and in table.tex."""
    as_json: Annotated[bool, {"names": ["--json"]}] = False
    """Print the results as JSON instead of the tables."""
    quiet: bool = False
    """Print only errors, and no tables."""
    dry_run: bool = False
    """Check benchmarks and methods, print the names of the images, and score nothing."""


@click.command
@settings_options(_Settings)
@click.pass_context
def evaluate(context: click.Context, settings: _Settings, /) -> None:
    """Score methods on benchmarks, with the unprocessed input as baseline.

    The tables are printed on standard output. The output folder gets results.json and scores.csv
    (the scores of every image), tables.md (also intervals and differences), table.tex and
    report.html. To resume an interrupted run, run the same command again.

    Photos and ground truth are paired by file name. If a photo has no ground truth, or if a method
    fails on it, it is listed, all other photos are scored, and the exit code is 1.
    """
    require_extra("evaluate", "evaluating")
    from brewster.evaluation import evaluation  # noqa: PLC0415  (imports torch, two seconds)
    from brewster.evaluation.methods import IdentityBaseline, ModelMethod, PredictionFolder  # noqa: PLC0415
    from brewster.separation import registry  # noqa: PLC0415

    config = _config(settings)
    parts = _read_benchmarks(settings)
    if settings.burst and not (
        settings.models and any(case.frames for part in parts for case in part.cases)
    ):
        raise click.UsageError(
            "--burst needs a --model and a benchmark with bursts, such as bursts=FOLDER."
        )
    named = [(name or registry.find(model).name, model, False) for name, model in settings.models]
    named += [(f"{name} burst", model, True) for name, model, _ in named if settings.burst]
    methods: list[Method] = [IdentityBaseline()]
    for name, model, is_burst in named:
        folder = settings.out / "predictions" / name
        methods.append(ModelMethod(name, model, folder, config.quality, settings.device, is_burst))
    methods += [PredictionFolder(name, Path(folder)) for name, folder in settings.predictions]
    is_complete = _print_remarks(parts, quiet=settings.quiet)
    if settings.dry_run:
        evaluation.check(parts, methods, config)
        _print_cases(parts, methods)
        context.exit(0 if is_complete else 1)
    case_count = sum(len(part.cases) for part in parts)
    with progress(len(methods) * case_count, shown=not settings.quiet) as update_progress:
        results = evaluation.evaluate(
            parts,
            methods,
            config,
            settings.out,
            workers=settings.workers or _default_workers(case_count),
            max_report_cases=settings.pictures,
            intervals=settings.intervals,
            on_progress=lambda done, _, row: update_progress(
                done, f"{row.benchmark}/{row.case} {row.method}"
            ),
        )
    if settings.as_json:
        print_out(json.dumps(results))
    elif not settings.quiet:
        _print_tables(results, intervals=settings.intervals)
        print_status(
            f"the results are in {settings.out}; {settings.out / evaluation.REPORT_FILE} shows the "
            "images, and tables.md has intervals and differences"
        )
    context.exit(0 if _print_failures(results, quiet=settings.quiet) and is_complete else 1)


def _config(settings: _Settings) -> EvaluationConfig:
    from brewster.evaluation.config import protocol_config  # noqa: PLC0415

    changes: dict[str, Any] = {"quality": settings.quality}
    if settings.size is not None:
        changes["short_side_px"] = settings.size or None
    if settings.metrics is not None:
        changes["metrics"] = tuple(name.strip() for name in settings.metrics.split(","))
    if settings.region_threshold is not None:
        changes["threshold"] = settings.region_threshold
    return protocol_config(settings.protocol.lower(), **changes)


def _read_benchmarks(settings: _Settings) -> list[Benchmark]:
    from brewster.evaluation.benchmarks import registry  # noqa: PLC0415

    folders = [(name, Path(folder)) for name, folder in settings.benchmarks]
    parts = [(part, path) for name, path in folders for part in registry.read_benchmark(name, path)]
    unique = registry.with_unique_names(parts)
    if settings.only:
        unique = registry.named(unique, settings.only)
    return [registry.spread(part, settings.limit) for part in unique] if settings.limit else unique


def _print_cases(benchmarks: Sequence[Benchmark], methods: Sequence[Method]) -> None:
    for benchmark in benchmarks:
        print_status(f"{benchmark.title}: {counted(len(benchmark.cases), 'image')}")
        names = "".join(f"{benchmark.name}/{case.name}\n" for case in benchmark.cases)
        write_out(names.encode(errors=_ENCODE_ERRORS))
    for method in methods:
        print_status(f"method: {method.name}")


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
    from brewster.evaluation.report.tables import to_terminal  # noqa: PLC0415

    width = shutil.get_terminal_size((100, 24)).columns
    write_out(to_terminal(results, width, intervals=intervals).encode(errors=_ENCODE_ERRORS))


def _default_workers(case_count: int) -> int:
    processors = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return max(1, min(processors, case_count // _CASES_PER_WORKER))


def _print_failures(results: Results, *, quiet: bool) -> bool:
    """Prints remarks about methods, metrics without scores, and errors. Returns whether all
    predictions were scored.
    """
    from brewster.evaluation.report.tables import failures, remarks, unavailable_metrics  # noqa: PLC0415

    for remark in () if quiet else remarks(results):
        print_status(remark)
    for metrics in unavailable_metrics(results):
        print_error(f"not computed: {metrics}")
    if results["unavailable"] and not quiet:
        print_status(
            "run the same command again to add the missing metrics; all other scores are kept in "
            "scores.jsonl"
        )
    for error in failures(results):
        print_error(error)
    if count := sum(len(picture["errors"]) for picture in results["cases"]):
        print_error(f"{counted(count, 'prediction')} could not be scored")
    return not count and not results["unavailable"]
