"""Ablation studies: trains a model for each of several values of one key of a training recipe, and compares their
scores.

A study is a TOML file with a base recipe, the key, its values and the benchmarks. The first value is the reference
of the comparisons. A stopped study resumes both training and evaluation."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, final

from pydantic import AfterValidator, Field

from brewster.benchmarks.registry import Benchmark, read_benchmark
from brewster.benchmarks.selection import with_unique_names
from brewster.evaluate.config import PAPER_METRICS, EvaluationConfig
from brewster.evaluate.evaluation import check, evaluate
from brewster.evaluate.methods import IdentityBaseline, ModelMethod
from brewster.evaluate.results import AVERAGE, Results
from brewster.files import write_atomically
from brewster.scene.recipe_file import read_toml
from brewster.scene.values import FrozenModel, KeyNote
from brewster.training import loop
from brewster.training.recipe import CompactRecipe, LoraRecipe, data_folder, read_recipe, with_value
from brewster.training.trainers import open_trainer

Value = str | int | float | bool
AblationCallback = Callable[[str, int, int, Mapping[str, float], bool], None]
"""Called with (label, step, steps, losses, is_logged) after each training step; `label` names the value of the key."""

PLOT_FILE: Final = "plot.png"


def _all_different(values: list[Value]) -> list[Value]:
    if len({str(value) for value in values}) < len(values):
        raise ValueError("a value occurs twice; expected different values")
    return values


@final
class AblationStudy(FrozenModel):
    """An ablation: one key of a training recipe gets each of several values. All other keys stay the same."""

    base: Path
    """The training recipe to change, relative to this file."""
    key: str
    """The key whose value changes, with its tables: "data.rendered.blend_space"."""
    values: Annotated[
        list[Value],
        Field(min_length=2),
        AfterValidator(_all_different),
        KeyNote("list of values", "all different"),
    ]
    """The values to compare. The first one is the reference for the others."""
    benchmarks: Annotated[
        dict[str, Path],
        Field(min_length=1),
        KeyNote("table of name = folder", "at least 1 entry", replaces_constraints=True),
    ]
    """The benchmarks to score on: a name and a folder relative to BREWSTER_DATA for each."""
    metrics: tuple[str, ...] = PAPER_METRICS
    """The metrics to compute. Metrics of the reflection (`*_reflection`) need benchmarks with a ground-truth reflection, and
    removed_content, removed_white and kept_reflection need rendered sets."""

    def label(self, value: Value) -> str:
        """The name of a value in tables: "blend_space srgb"."""
        return f"{self.key.rpartition('.')[2]} {str(value).replace('/', ' ')}"

    def open_benchmarks(self) -> list[Benchmark]:
        """Reads the benchmarks of the study. Raises RecipeError if BREWSTER_DATA is not a folder, and PhotoError if a
        benchmark cannot be read."""
        root = data_folder()
        folders = [(name, root / folder) for name, folder in self.benchmarks.items()]
        return with_unique_names(
            [(part, folder) for name, folder in folders for part in read_benchmark(name, folder)]
        )


def read_study(path: Path) -> AblationStudy:
    """Reads and validates a study. The path `base` is resolved relative to the folder of the file. Raises RecipeError
    if the file is missing or not TOML, or its values are missing, unknown or invalid."""
    study = read_toml(AblationStudy, path, reference="docs/recipes.md")
    return study.model_copy(update={"base": path.parent / study.base})


def ablate(
    study: AblationStudy,
    benchmarks: Sequence[Benchmark],
    out: Path,
    *,
    workers: int = 1,
    on_progress: AblationCallback = lambda _label, _step, _steps, _numbers, _logged: None,
) -> Results:
    """Trains and evaluates a model for every value. `out` gets one folder per value and the files that `evaluate`
    writes. If all values are numbers and any metric has a score, plot.png shows the metrics against the values. The
    results are those of `evaluate`; the model of each value is a method. Raises RecipeError if the base recipe, the
    key or a value is invalid, or data is missing, and BrewsterError as training and `evaluate` do."""
    config = EvaluationConfig(metrics=study.metrics)
    # A wrong name or a download must not fail after hours of training.
    labels = map(study.label, study.values)
    check(benchmarks, [IdentityBaseline(), *(ModelMethod(label, "", out) for label in labels)], config)
    for metric in config.columns().values():
        if metric.prepare:
            metric.prepare()
    base = read_recipe(study.base)
    recipes = {study.label(value): with_value(base, study.key, value) for value in study.values}
    models = []
    for label, recipe in recipes.items():
        folder = out / label.replace(" ", "-")

        def on_step(*values: Any, label: str = label) -> None:  # noqa: ANN401  (the arguments of the training callback)
            on_progress(label, *values)

        model = _train(recipe, folder, on_step)
        models.append(ModelMethod(label, str(model), out / "predictions" / folder.name))
    results = evaluate(benchmarks, [IdentityBaseline(), *models], config, out, workers=workers)
    numbers = [
        value for value in study.values if isinstance(value, int | float) and not isinstance(value, bool)
    ]
    if len(numbers) == len(study.values) and results["metrics"]:
        write_atomically(out / PLOT_FILE, _plot(study, numbers, results), overwrite=True)
    return results


def _train(recipe: CompactRecipe | LoraRecipe, folder: Path, on_step: loop.StepCallback) -> Path:
    """Trains a recipe and returns the path of its model. A local trainer is freed on return, so that memory does not grow."""
    trainer = open_trainer(recipe)
    loop.run(trainer, folder, on_step)
    return trainer.export(folder)


def _plot(study: AblationStudy, numbers: Sequence[float], results: Results) -> bytes:
    """Plots PSNR, SSIM and LPIPS, or all metrics if these have no scores. The bands are 95 % intervals."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (only needed for plots)

    measured = list(results["metrics"])
    metrics = [name for name in ("psnr", "ssim", "lpips") if name in measured] or measured
    figure = Figure(figsize=(4 * len(metrics), 3.4), layout="constrained")
    for panel, metric in zip(figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True):
        for key, selection in results["selections"].items():
            means = {number: results["tables"][key][study.label(number)].get(metric) for number in numbers}
            scored = [number for number in numbers if means[number]]
            rows = [means[number] for number in scored]
            if not rows:
                continue
            style = {"linewidth": 2.4, "color": "black"} if key == AVERAGE else {"linewidth": 1.2}
            (line,) = panel.plot(
                scored, [row["mean"] for row in rows], marker="o", label=selection["title"], **style
            )
            if all(row["low"] is not None for row in rows):
                ends = ([row[end] for row in rows] for end in ("low", "high"))
                panel.fill_between(scored, *ends, color=line.get_color(), alpha=0.12, linewidth=0)
        entry = results["metrics"][metric]
        panel.set_title(f"{entry['title']}{', ' + entry['unit'] if entry['unit'] else ''}")
        panel.set_xlabel(study.key)
        # Values such as 0, 10, ... 1000 need a logarithmic axis that is linear near 0.
        if len(numbers) > 2 and max(numbers) > 20 * max(1, sorted(numbers)[1]):
            panel.set_xscale("symlog", linthresh=max(1, sorted(numbers)[1]))
            panel.set_xticks(numbers, [f"{number:g}" for number in numbers])
    figure.axes[0].legend(fontsize="small")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=160, metadata={"Software": None})
    return data.getvalue()
