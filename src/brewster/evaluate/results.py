"""Aggregates score rows into results.json: means and paired differences with confidence intervals, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, final

import numpy as np

import brewster
from brewster.benchmarks.registry import PAPER_SEED, Benchmark, Case, paper_draw
from brewster.evaluate.config import DEFAULT_METRICS, EvaluationConfig
from brewster.evaluate.methods import Method
from brewster.evaluate.runner import ScoreRow
from brewster.evaluate.statistics import Stratum, differences, estimate

AVERAGE: Final = "average"
PAPER_COUNTS: Final = {"real20": 20, "nature20": 20, "postcard": 20, "solidobject": 20, "wildscene": 101}
"""The sets in the paper's average, with the number of pictures of each."""
_DIGITS: Final = 6
_AVERAGED: Final = "The average is over pictures, not over sets: each picture has the same weight."

Results = dict[str, Any]
"""The content of results.json: see docs/evaluation.md."""


@final
@dataclass(frozen=True)
class Selection:
    """The pictures of a table: a whole benchmark, or the paper's draw from it."""

    key: str
    title: str
    cases: tuple[Case, ...]


def summarise(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Sequence[ScoreRow],
) -> Results:
    """The content of results.json. The order of the rows does not matter.

    Raises:
        BrewsterError: the paper's draw was requested, and the names of a benchmark do not identify its scenes.
    """
    by_id = {row.id: row for row in rows}
    method_names = [method.name for method in methods]
    measured = {column for row in rows for column, score in row.scores.items() if score is not None}
    columns = {name: metric for name, metric in config.columns().items() if name in measured}
    full = [Selection(part.name, part.title, part.cases) for part in benchmarks if part.cases]
    drawn = paper_draws(benchmarks) if config.paper else []
    tables = [[selection] for selection in (*full, *drawn)]
    together = _averaged([part for part in full if part.key in PAPER_COUNTS] if config.paper else full, drawn)
    selections = {group[0].key: group for group in tables} | ({AVERAGE: together} if together else {})
    series = [(method, column) for method in method_names for column in columns]
    directions = {name: metric.higher_is_better for name, metric in columns.items()}
    strata = {key: [_stratum(part, series, by_id) for part in group] for key, group in selections.items()}
    return {
        "brewster": brewster.__version__,
        "protocol": {
            "size": config.size or "native",
            "quality": config.quality,
            "region_thresholds": list(config.thresholds),
            "choices": _choices(config, together),
        },
        "metrics": {name: metric.to_dict() for name, metric in columns.items()},
        "benchmarks": {part.name: _describe(part) for part in benchmarks},
        "selections": {key: _titled(key, group) for key, group in selections.items()},
        "methods": {method.name: method.about() for method in methods},
        "unmeasured": [] if config.metrics == DEFAULT_METRICS else _unmeasured(config, measured),
        "draw": {"seed": PAPER_SEED} | {part.key: [case.name for case in part.cases] for part in drawn},
        "pictures": [_picture(case, method_names, by_id) for part in benchmarks for case in part.cases],
        "tables": {key: _table(strata[key], series) for key in selections},
        "differences": {
            key: [_flattened(difference) for difference in differences(strata[key], series, directions)]
            for key in selections
        },
    }


def _unmeasured(config: EvaluationConfig, measured: set[str]) -> list[str]:
    """Requested metrics without a score, because no picture has the ground truth that they need."""
    return [name for name in config.columns() if name not in measured]


def paper_draws(benchmarks: Sequence[Benchmark]) -> list[Selection]:
    """The paper's draws from the benchmarks that it does not use completely.

    Raises:
        BrewsterError: the names of a benchmark do not identify its scenes.
    """
    draws = [(part, paper_draw(part)) for part in benchmarks if part.cases]
    return [
        Selection(f"{part.name}:paper", f"{part.title}, the paper's draw", cases)
        for part, cases in draws
        if len(cases) < len(part.cases)
    ]


def _averaged(full: Sequence[Selection], drawn: Sequence[Selection]) -> list[Selection]:
    """The selections of the average: each benchmark's draw if there is one; empty for a single benchmark."""
    draws = {part.key.partition(":")[0]: part for part in drawn}
    return [draws.get(part.key, part) for part in full] if len(full) > 1 else []


def _titled(key: str, group: Sequence[Selection]) -> dict[str, Any]:
    pictures = sum(len(part.cases) for part in group)
    return {"title": "Average" if key == AVERAGE else group[0].title, "pictures": pictures}


def _choices(config: EvaluationConfig, together: Sequence[Selection]) -> list[str]:
    """The settings as sentences, how the average is computed, and how it differs from the paper's."""
    choices = [*config.choices(), *([_AVERAGED] if together else [])]
    there = {part.key.partition(":")[0]: len(part.cases) for part in together}
    if not config.paper or there == PAPER_COUNTS:
        return choices
    found = ", ".join(f"{count} of {name}" for name, count in there.items()) or "too few sets"
    return [
        *choices,
        f"The paper's average is over {sum(PAPER_COUNTS.values())} pictures; this one is over {found}.",
    ]


def _stratum(
    selection: Selection, series: Sequence[tuple[str, str]], rows: Mapping[tuple[str, str, str], ScoreRow]
) -> Stratum:
    values = [
        [_score(rows[case.benchmark, case.name, method], column) for method, column in series]
        for case in selection.cases
    ]
    shape = len(selection.cases), len(series)
    scenes = [case.scene for case in selection.cases]
    return Stratum(selection.key, scenes, np.array(values, float).reshape(shape))


def _score(row: ScoreRow, column: str) -> float:
    score = row.scores.get(column)
    return float("nan") if score is None else score


def _table(strata: Sequence[Stratum], series: Sequence[tuple[str, str]]) -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = {method: {} for method, _ in series}
    for (method, column), mean in zip(series, estimate(strata), strict=True):
        if mean:
            table[method][column] = _rounded(asdict(mean))
    return table


def _flattened(difference: Any) -> dict[str, Any]:  # noqa: ANN401  (a Difference)
    row = asdict(difference)
    return _rounded(row.pop("estimate") | row)


def _rounded(row: dict[str, Any]) -> dict[str, Any]:
    return {name: round(value, _DIGITS) if isinstance(value, float) else value for name, value in row.items()}


def _describe(part: Benchmark) -> dict[str, Any]:
    return {
        "title": part.title,
        "pictures": len(part.cases),
        "expected": list(part.expected_counts),
        "remarks": list(part.remarks),
        "refused": list(part.excluded),
    }


def _picture(
    case: Case, methods: Sequence[str], rows: Mapping[tuple[str, str, str], ScoreRow]
) -> dict[str, Any]:
    own = {method: rows[case.benchmark, case.name, method] for method in methods}
    seen = next((row for row in own.values() if not row.error), None)
    return {
        "benchmark": case.benchmark,
        "name": case.name,
        "scene": case.scene,
        "width": seen.width if seen else None,
        "height": seen.height if seen else None,
        "region_share": seen.region_share if seen else None,
        "scores": {method: row.scores for method, row in own.items() if not row.error},
        "errors": {method: row.error for method, row in own.items() if row.error},
    }
