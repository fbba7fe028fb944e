"""`brewster evaluate`: benchmarks and methods in; tables, a page, and every picture's scores out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final, get_args

import click

from brewster.cli.extras import require_extra
from brewster.cli.terminal import complain, interrupts, progress, say, write_out
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
def evaluate(context: click.Context, /, *, dry_run: bool, **asked: Any) -> None:  # noqa: ANN401  (the fields of _Order)
    """Measure models and other methods' pictures on benchmarks, with the unprocessed input as baseline.

    The tables go to standard output; results.json (every picture), tables.md, table.tex, table.csv and report.html (a
    page to look at) into the folder named with -o. A run that was stopped goes on from there.

    Pictures are paired by name. What has no partner, and what a method failed on, is named; the rest is measured, and
    the exit code is 1.
    """
    require_extra("evaluate", "evaluating")
    order = _EvaluateRequest(**asked)
    context.exit(0 if (order.tell() if dry_run else order.run()) else 1)


@final
@dataclass(frozen=True)
class _EvaluateRequest:
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

    def tell(self) -> bool:
        """Says what there is; whether all of it can be measured."""
        from brewster.evaluate.evaluation import check  # noqa: PLC0415

        found, methods = self._found(), self._methods()
        is_whole = tell_of(found, quiet=self.quiet)
        check(found, methods, self._protocol())
        for part in found:
            say(f"{part.title}: {len(part.cases)} pictures")
            write_out("".join(f"{part.name}/{case.name}\n" for case in part.cases).encode(errors=_ODD))
        for method in methods:
            say(f"method: {method.name}")
        return is_whole

    def run(self) -> bool:
        """Measures and prints; whether nothing was left out and nothing failed."""
        from brewster.evaluate.evaluation import PAGE  # noqa: PLC0415
        from brewster.evaluate.evaluation import evaluate as measure  # noqa: PLC0415

        protocol, found, methods = self._protocol(), self._found(), self._methods()
        is_whole = tell_of(found, quiet=self.quiet)
        total = len(methods) * sum(len(part.cases) for part in found)
        with progress(total, shown=not self.quiet) as advance:

            def on_progress(done: int, _of: int, row: ScoreRow) -> None:
                interrupts.heed()
                advance(done, f"{row.benchmark}/{row.case} {row.method}")

            results = measure(
                found,
                methods,
                protocol,
                self.out,
                workers=self.workers,
                shown=self.pictures,
                on_progress=on_progress,
            )
        if self.as_json:
            write_out(f"{json.dumps(results)}\n".encode())
        elif not self.quiet:
            print_tables(results)
            say(f"all of it is in {self.out}; {self.out / PAGE} shows the pictures")
        return tell_failures(results, quiet=self.quiet) and is_whole

    def _found(self) -> list[Benchmark]:
        from brewster.benchmarks.registry import read_benchmark  # noqa: PLC0415

        return [part for name, folder in self.benchmarks for part in read_benchmark(name, Path(folder))]

    def _protocol(self) -> EvaluationConfig:
        from brewster.evaluate.config import EvaluationConfig  # noqa: PLC0415

        chosen: dict[str, Any] = {"size": self.size, "quality": self.quality, "paper": self.paper}
        if self.metrics is not None:
            chosen["metrics"] = tuple(name.strip() for name in self.metrics.split(","))
        if self.thresholds is not None:
            chosen["thresholds"] = self.thresholds
        return EvaluationConfig(**chosen)

    def _methods(self) -> list[Method]:
        from brewster.evaluate.methods import IdentityBaseline, ModelMethod, PredictionFolder  # noqa: PLC0415
        from brewster.models.zoo import model_name  # noqa: PLC0415

        models = [(name or model_name(model), model) for name, model in self.models]
        answers = self.out / "predictions"
        return [
            IdentityBaseline(),
            *(ModelMethod(name, model, answers / name, self.quality, self.device) for name, model in models),
            *(PredictionFolder(name, Path(folder)) for name, folder in self.predictions),
        ]


_ODD: Final = "backslashreplace"
"""How names are printed that are no text."""


def tell_of(parts: Sequence[Benchmark], *, quiet: bool) -> bool:
    """Says what is odd about benchmarks; whether nothing was left out."""
    for part in parts:
        for remark in () if quiet else part.remarks:
            say(f"{part.title}: {remark}")
        for reason in part.refused:
            complain(f"{part.title}: {reason}")
    return not any(part.refused for part in parts)


def print_tables(results: Results) -> None:
    """The tables, on standard output."""
    from brewster.evaluate.report.tables import overview  # noqa: PLC0415

    write_out(overview(results).encode(errors=_ODD))


def tell_failures(results: Results, *, quiet: bool) -> bool:
    """Says what is odd about methods and names what could not be scored; whether there was nothing of the second."""
    from brewster.evaluate.report.tables import failures, remarks  # noqa: PLC0415

    for remark in () if quiet else remarks(results):
        say(remark)
    for name in results["unmeasured"]:
        say(f"{name} was not measured: no picture has the truth that it needs")
    for error in failures(results):
        complain(error)
    count = sum(len(picture["errors"]) for picture in results["pictures"])
    if count:
        complain(f"{count} {'answer' if count == 1 else 'answers'} could not be scored")
    return not count
