"""Ablations: one value of a training recipe changed at a time, each choice trained and measured alike.

    study = read_study(Path("recipes/ablations/mixing.toml"))
    ablate(study, study.open_benchmarks(), Path("out/ablations/mixing"))

A study is a TOML file that names a base recipe, the value, its choices and the benchmarks; the first choice is what
the others are compared with. Both training and measuring go on where they were stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, final

from pydantic import AfterValidator, Field

from brewster.benchmarks.registry import Benchmark, read_benchmark
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.evaluation import evaluate
from brewster.evaluate.methods import IdentityBaseline, ModelMethod
from brewster.evaluate.results import AVERAGE, Results
from brewster.files import write_atomically
from brewster.scene.recipe_file import read_toml
from brewster.scene.values import FrozenModel, KeyNote
from brewster.training import loop
from brewster.training.recipe import CompactRecipe, LoraRecipe, data_folder, read_recipe, with_value
from brewster.training.trainers import open_trainer

Choice = str | int | float | bool
Report = Callable[[str, int, int, Mapping[str, float], bool], None]
"""Called with (choice, step, steps, numbers, logged) after every step of training."""

PLOT: Final = "plot.png"


def _all_different(choices: list[Choice]) -> list[Choice]:
    if len({str(choice) for choice in choices}) < len(choices):
        raise ValueError("a value occurs twice; expected different values")
    return choices


@final
class AblationStudy(FrozenModel):
    """An ablation: one value of a training recipe takes each of several choices; everything else stays the same."""

    base: Path
    """The training recipe to change, relative to this file."""
    value: str
    """The key that changes, with its tables: "data.rendered.mixing"."""
    choices: Annotated[
        list[Choice],
        Field(min_length=2),
        AfterValidator(_all_different),
        KeyNote("list of values", "all different"),
    ]
    """The values to compare. The first one is the reference for the others."""
    benchmarks: Annotated[
        dict[str, Path],
        Field(min_length=1),
        KeyNote("table of name = folder", "at least 1 entry", instead=True),
    ]
    """The benchmarks to score on: a name and a folder relative to BREWSTER_DATA for each."""

    def label(self, choice: Choice) -> str:
        """What tables call a choice: "mixing 8-bit"."""
        return f"{self.value.rpartition('.')[2]} {str(choice).replace('/', ' ')}"

    def open_benchmarks(self) -> list[Benchmark]:
        """Its benchmarks.

        Raises:
            RecipeError: BREWSTER_DATA names no folder.
            PhotoError: a benchmark cannot be read.
        """
        root = data_folder()
        return [
            part for name, folder in self.benchmarks.items() for part in read_benchmark(name, root / folder)
        ]


def read_study(path: Path) -> AblationStudy:
    """Reads and checks a study.

    Raises:
        RecipeError: missing, not TOML, or with values that are missing, unknown or impossible.
    """
    study = read_toml(AblationStudy, path, compare="docs/recipes.md")
    return study.model_copy(update={"base": path.parent / study.base})


def ablate(
    study: AblationStudy,
    benchmarks: Sequence[Benchmark],
    out: Path,
    *,
    workers: int = 1,
    report: Report = lambda _choice, _step, _steps, _numbers, _logged: None,
) -> Results:
    """Trains and measures every choice; `out` receives a folder for each, and what `evaluate` writes.

    Where the choices are numbers, plot.png shows the metrics over them.

    Args:
        study: the question.
        benchmarks: what to measure on, such as `study.open_benchmarks()`.
        out: a folder of this study's own.
        workers: processes that score at once.
        report: called after every step of training.

    Raises:
        RecipeError: the base recipe or the value is wrong, or data is missing.
        BrewsterError: what training and `evaluate` raise.
    """
    base = read_recipe(study.base)
    recipes = {study.label(choice): with_value(base, study.value, choice) for choice in study.choices}
    models = []
    for label, recipe in recipes.items():
        folder = out / label.replace(" ", "-")

        def tell(*told: Any, label: str = label) -> None:  # noqa: ANN401  (what train tells)
            report(label, *told)

        models.append(
            ModelMethod(label, str(_trained(recipe, folder, tell)), out / "predictions" / folder.name)
        )
    results = evaluate(benchmarks, [IdentityBaseline(), *models], EvaluationConfig(), out, workers=workers)
    numbers = [
        choice for choice in study.choices if isinstance(choice, int | float) and not isinstance(choice, bool)
    ]
    if len(numbers) == len(study.choices):
        write_atomically(out / PLOT, _plot(study, numbers, results), overwrite=True)
    return results


def _trained(recipe: CompactRecipe | LoraRecipe, folder: Path, tell: loop.Report) -> Path:
    """The model of this recipe, in memory no longer than it learns."""
    trainer = open_trainer(recipe)
    loop.run(trainer, folder, tell)
    return trainer.export(folder)


def _plot(study: AblationStudy, numbers: Sequence[float], results: Results) -> bytes:
    """PSNR, SSIM and LPIPS over the numbers, a line a set, intervals as bands: a PNG."""
    import io  # noqa: PLC0415

    from matplotlib.figure import Figure  # noqa: PLC0415  (only those who ablate numbers need it)

    metrics = [name for name in ("psnr", "ssim", "lpips") if name in results["metrics"]]
    figure = Figure(figsize=(4 * len(metrics), 3.4), layout="constrained")
    for panel, metric in zip(figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True):
        for key, selection in results["selections"].items():
            rows = [results["tables"][key][study.label(number)][metric] for number in numbers]
            style = {"linewidth": 2.4, "color": "black"} if key == AVERAGE else {"linewidth": 1.2}
            (line,) = panel.plot(
                numbers, [row["mean"] for row in rows], marker="o", label=selection["title"], **style
            )
            if all(row["low"] is not None for row in rows):
                ends = ([row[end] for row in rows] for end in ("low", "high"))
                panel.fill_between(numbers, *ends, color=line.get_color(), alpha=0.12, linewidth=0)
        entry = results["metrics"][metric]
        panel.set_title(f"{entry['title']}{', ' + entry['unit'] if entry['unit'] else ''}")
        panel.set_xlabel(study.value)
        if len(numbers) > 2 and max(numbers) > 20 * max(1, sorted(numbers)[1]):
            panel.set_xscale("symlog", linthresh=max(1, sorted(numbers)[1]))
            panel.set_xticks(numbers, [f"{number:g}" for number in numbers])
    figure.axes[0].legend(fontsize="small")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=160, metadata={"Software": None})
    return data.getvalue()
