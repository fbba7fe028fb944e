"""`brewster evaluate`: benchmarks and methods in; tables, a page, and every picture's scores out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final, get_args

import click

from brewster.cli.extras import require_extra
from brewster.cli.terminal import interrupts, print_error, print_status, progress, write_out
from brewster.options import Device, Quality

if TYPE_CHECKING:
    from brewster.benchmarks.registry import Benchmark
    from brewster.evaluate.config import EvaluationConfig
    from brewster.evaluate.methods import Method
    from brewster.evaluate.results import Results
    from brewster.evaluate.runner import ScoreRow


@final
class NamedValue(click.ParamType[tuple[str, str]]):
    """NAME=VALUE, as two strings; without a name that is empty, where this is allowed."""

    name = "named"

    def __init__(self, example: str, *, needs_name: bool = True) -> None:
        self.example, self.needs_name = example, needs_name

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        """Name and value, or a usage error."""
        if isinstance(value, tuple):
            return value
        name, equals, rest = str(value).partition("=")
        if not equals and not self.needs_name:
            return "", name
        if not (name and rest):
            self.fail(f"{value!r} is not NAME=VALUE; {self.example} is.", param, ctx)
        return name, rest


@final
class _NumberList(click.ParamType[tuple[float, ...]]):
    """Numbers with commas between."""

    name = "numbers"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers, or a usage error."""
        if isinstance(value, tuple):
            return value
        try:
            return tuple(float(number) for number in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers, such as 0.05,0.1.", param, ctx)


@final
class _Size(click.ParamType[int]):
    """native, or a number of pixels."""

    name = "native|420|512"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int | None:  # type: ignore[override]
        """The pixels, None for native, or a usage error."""
        if value == "native":
            return None
        if not str(value).isdecimal() or int(str(value)) < 1:
            self.fail(f"{value!r} is neither native nor a number of pixels.", param, ctx)
        return int(str(value))


@click.command
@click.option(
    "--benchmark",
    "benchmarks",
    metavar="NAME=DIR",
    type=NamedValue("real20=data/real20"),
    multiple=True,
    required=True,
    help="A benchmark and the folder of your copy; may be given again. NAME is one of docs/evaluation.md, such as real20, "
    "sir2, pairs (any folder of pairs) or rendered (a set of brewster render); an unknown one is answered with all.",
)
@click.option(
    "--model",
    "models",
    metavar="[NAME=]MODEL",
    type=NamedValue("ours=model.onnx", needs_name=False),
    multiple=True,
    help="A model to run, as `brewster --model` takes it; may be given again.",
)
@click.option(
    "--predictions",
    metavar="NAME=DIR",
    type=NamedValue("RDNet=out/rdnet"),
    multiple=True,
    help="A folder of another method's pictures, called like the cases; may be given again.",
)
@click.option(
    "-o",
    "--output",
    "out",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("out/evaluate"),
    show_default=True,
    help="Where results, tables, the page and the models' layers go.",
)
@click.option(
    "--metrics",
    metavar="NAME,...",
    help="What to measure; by default all but ssim_gaussian, where there is truth for it.",
)
@click.option(
    "--size",
    type=_Size(),
    default="native",
    show_default=True,
    help="Reduce larger pictures to this shorter side first, photo and truth alike.",
)
@click.option(
    "--paper",
    is_flag=True,
    help="Report the paper's protocol too: one picture a scene of Postcard and SolidObject, drawn with a published seed.",
)
@click.option(
    "--region-threshold",
    "thresholds",
    type=_NumberList(),
    metavar="NUMBER,...",
    help="How much photo and truth differ where there is reflection, as a share of the full scale; several are swept.",
)
@click.option(
    "--quality",
    type=click.Choice(get_args(Quality)),
    default="standard",
    show_default=True,
    help="How closely models look.",
)
@click.option(
    "--device",
    type=click.Choice(get_args(Device)),
    default="auto",
    show_default=True,
    help="Where models run.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="How many processes score at once.",
)
@click.option(
    "--pictures",
    type=click.IntRange(min=0),
    default=50,
    show_default=True,
    metavar="NUMBER",
    help="How many pictures of each benchmark the page shows, the worst of the first method first.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the results as JSON instead of the tables.")
@click.option("--quiet", is_flag=True, help="Say nothing but errors, and print no tables.")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Check all that was named, print the names of the cases, and measure nothing.",
)
@click.pass_context
def evaluate(context: click.Context, /, *, dry_run: bool, **options: Any) -> None:  # noqa: ANN401  (the fields of _EvaluateCommand)
    """Measure models and other methods' pictures on benchmarks, with the unprocessed input as baseline.

    The tables go to standard output; results.json (every picture), tables.md, table.tex, table.csv and report.html (a
    page to look at) into the folder named with -o. A run that was stopped goes on from there.

    Pictures are paired by name. What has no partner, and what a method failed on, is named; the rest is measured, and
    the exit code is 1.
    """
    require_extra("evaluate", "evaluating")
    command = _EvaluateCommand(**options)
    context.exit(0 if (command.list_cases() if dry_run else command.run()) else 1)


@final
@dataclass(frozen=True)
class _EvaluateCommand:
    """What was asked for; imports wait until it is carried out, as torch takes two seconds to wake."""

    benchmarks: tuple[tuple[str, str], ...]
    models: tuple[tuple[str, str], ...]
    predictions: tuple[tuple[str, str], ...]
    out: Path
    metrics: str | None
    size: int | None
    paper: bool
    thresholds: tuple[float, ...] | None
    quality: Quality
    device: Device
    workers: int
    pictures: int
    as_json: bool
    quiet: bool

    def list_cases(self) -> bool:
        """Says what there is; whether all of it can be measured."""
        from brewster.evaluate.evaluation import check  # noqa: PLC0415

        benchmarks, methods = self._read_benchmarks(), self._methods()
        is_complete = print_remarks(benchmarks, quiet=self.quiet)
        check(benchmarks, methods, self._config())
        for benchmark in benchmarks:
            print_status(f"{benchmark.title}: {len(benchmark.cases)} pictures")
            write_out(
                "".join(f"{benchmark.name}/{case.name}\n" for case in benchmark.cases).encode(
                    errors=_ENCODE_ERRORS
                )
            )
        for method in methods:
            print_status(f"method: {method.name}")
        return is_complete

    def run(self) -> bool:
        """Measures and prints; whether nothing was left out and nothing failed."""
        from brewster.evaluate.evaluation import PAGE  # noqa: PLC0415
        from brewster.evaluate.evaluation import evaluate as measure  # noqa: PLC0415

        config, benchmarks, methods = self._config(), self._read_benchmarks(), self._methods()
        is_complete = print_remarks(benchmarks, quiet=self.quiet)
        total = len(methods) * sum(len(benchmark.cases) for benchmark in benchmarks)
        with progress(total, shown=not self.quiet) as advance:

            def report(done: int, _of: int, row: ScoreRow) -> None:
                interrupts.raise_pending()
                advance(done, f"{row.benchmark}/{row.case} {row.method}")

            results = measure(
                benchmarks,
                methods,
                config,
                self.out,
                workers=self.workers,
                shown=self.pictures,
                report=report,
            )
        if self.as_json:
            write_out(f"{json.dumps(results)}\n".encode())
        elif not self.quiet:
            print_tables(results)
            print_status(f"all of it is in {self.out}; {self.out / PAGE} shows the pictures")
        return print_failures(results, quiet=self.quiet) and is_complete

    def _read_benchmarks(self) -> list[Benchmark]:
        from brewster.benchmarks.registry import read_benchmark  # noqa: PLC0415

        return [
            benchmark for name, folder in self.benchmarks for benchmark in read_benchmark(name, Path(folder))
        ]

    def _config(self) -> EvaluationConfig:
        from brewster.evaluate.config import EvaluationConfig  # noqa: PLC0415

        values: dict[str, Any] = {"size": self.size, "quality": self.quality, "paper": self.paper}
        if self.metrics is not None:
            values["metrics"] = tuple(name.strip() for name in self.metrics.split(","))
        if self.thresholds is not None:
            values["thresholds"] = self.thresholds
        return EvaluationConfig(**values)

    def _methods(self) -> list[Method]:
        from brewster.evaluate.methods import IdentityBaseline, ModelMethod, PredictionFolder  # noqa: PLC0415
        from brewster.models.zoo import model_name  # noqa: PLC0415

        models = [(name or model_name(model), model) for name, model in self.models]
        predictions = self.out / "predictions"
        return [
            IdentityBaseline(),
            *(
                ModelMethod(name, model, predictions / name, self.quality, self.device)
                for name, model in models
            ),
            *(PredictionFolder(name, Path(folder)) for name, folder in self.predictions),
        ]


_ENCODE_ERRORS: Final = "backslashreplace"
"""How names are printed that are no text."""


def print_remarks(benchmarks: Sequence[Benchmark], *, quiet: bool) -> bool:
    """Says what is odd about benchmarks; whether nothing was left out."""
    for benchmark in benchmarks:
        for remark in () if quiet else benchmark.remarks:
            print_status(f"{benchmark.title}: {remark}")
        for reason in benchmark.refused:
            print_error(f"{benchmark.title}: {reason}")
    return not any(benchmark.refused for benchmark in benchmarks)


def print_tables(results: Results) -> None:
    """The tables, on standard output."""
    from brewster.evaluate.report.tables import overview  # noqa: PLC0415

    write_out(overview(results).encode(errors=_ENCODE_ERRORS))


def print_failures(results: Results, *, quiet: bool) -> bool:
    """Says what is odd about methods and names what could not be scored; whether there was nothing of the second."""
    from brewster.evaluate.report.tables import failures, remarks  # noqa: PLC0415

    for remark in () if quiet else remarks(results):
        print_status(remark)
    for name in results["unmeasured"]:
        print_status(f"{name} was not measured: no picture has the truth that it needs")
    for error in failures(results):
        print_error(error)
    count = sum(len(picture["errors"]) for picture in results["pictures"])
    if count:
        print_error(f"{count} {'answer' if count == 1 else 'predictions'} could not be scored")
    return not count
