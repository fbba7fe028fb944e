"""Aggregates score rows into the content of results.json: means and paired differences with confidence intervals."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, final

import numpy as np

import brewster
from brewster.benchmarks.registry import Benchmark, Case
from brewster.benchmarks.selection import PAPER_SEED, paper_draw
from brewster.evaluate.config import DEFAULT_METRICS, EvaluationConfig
from brewster.evaluate.methods import Method
from brewster.evaluate.protocols import describe_protocol
from brewster.evaluate.score_log import ScoreRow
from brewster.evaluate.statistics import Stratum, differences, estimate

AVERAGE: Final = "average"
PAPER_COUNTS: Final = {"real20": 20, "nature20": 20, "postcard": 20, "solidobject": 20, "wildscene": 101}
"""The benchmarks in the paper's average -> the number of images of each."""
_DIGITS: Final = 6
_AVERAGE_NOTE: Final = "The average is over images, not over benchmarks: each image has the same weight."

Results = dict[str, Any]
"""The content of results.json; docs/evaluation.md describes it."""


@final
@dataclass(frozen=True)
class Selection:
    """The cases of a table: a whole benchmark, or the paper's draw from it."""

    key: str
    title: str
    cases: tuple[Case, ...]


def summarise(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Sequence[ScoreRow],
    unavailable: Mapping[str, str] | None = None,
) -> Results:
    """Returns the content of results.json. The order of the rows does not matter.

    `unavailable` is column -> reason, for the columns that could not be computed.

    Raises:
        BrewsterError: the paper's draw is requested, but the file names of a benchmark do not identify its scenes.
    """
    by_id = {row.id: row for row in rows}
    method_names = [method.name for method in methods]
    measured = {column for row in rows for column, score in row.scores.items() if score is not None}
    columns = {name: metric for name, metric in config.columns().items() if name in measured}
    full = [Selection(part.name, part.title, part.cases) for part in benchmarks if part.cases]
    drawn = paper_draws(benchmarks) if config.paper_subset else []
    tables = [[selection] for selection in (*full, *drawn)]
    averaged = _average_selections(
        [part for part in full if part.key in PAPER_COUNTS] if config.paper_subset else full, drawn
    )
    selections = {group[0].key: group for group in tables} | ({AVERAGE: averaged} if averaged else {})
    series = [(method, column) for method in method_names for column in columns]
    directions = {name: metric.higher_is_better for name, metric in columns.items()}
    strata = {key: [_stratum(part, series, by_id) for part in group] for key, group in selections.items()}
    return {
        "brewster": brewster.__version__,
        "protocol": {
            "name": config.protocol,
            "size": config.short_side_px or "native",
            "quality": config.quality,
            "region_thresholds": list(config.thresholds),
            "choices": _choices(config, averaged),
        },
        "metrics": {name: metric.to_dict() for name, metric in columns.items()},
        "benchmarks": {part.name: _describe_benchmark(part) for part in benchmarks},
        "selections": {key: _describe_selection(key, group) for key, group in selections.items()},
        "methods": {method.name: method.about() for method in methods},
        "unavailable": dict(unavailable or {}),
        "unmeasured": [
            name
            for name in ([] if config.metrics == DEFAULT_METRICS else _unmeasured(config, measured))
            if name not in (unavailable or {})
        ],
        "draw": {"seed": PAPER_SEED} | {part.key: [case.name for case in part.cases] for part in drawn},
        "cases": [
            _describe_case(case, method_names, by_id, columns) for part in benchmarks for case in part.cases
        ],
        "tables": {key: _table(strata[key], series) for key in selections},
        "differences": {
            key: [
                _describe_difference(difference)
                for difference in differences(strata[key], series, directions)
            ]
            for key in selections
        },
    }


def _unmeasured(config: EvaluationConfig, measured: set[str]) -> list[str]:
    """Returns the requested metrics without a score: no case has the ground truth that they need."""
    return [name for name in config.columns() if name not in measured]


def paper_draws(benchmarks: Sequence[Benchmark]) -> list[Selection]:
    """Returns the paper's draw from each benchmark of which it uses only a part.

    Raises:
        BrewsterError: the file names of a benchmark do not identify its scenes.
    """
    draws = [(part, paper_draw(part)) for part in benchmarks if part.cases]
    return [
        Selection(f"{part.name}:paper", f"{part.title}, the paper's draw", cases)
        for part, cases in draws
        if len(cases) < len(part.cases)
    ]


def _average_selections(full: Sequence[Selection], drawn: Sequence[Selection]) -> list[Selection]:
    """Returns the selections of the average: the draw from each benchmark, or the benchmark if there is no draw.

    The list is empty if there is only one benchmark.
    """
    draws = {part.key.partition(":")[0]: part for part in drawn}
    return [draws.get(part.key, part) for part in full] if len(full) > 1 else []


def _describe_selection(key: str, group: Sequence[Selection]) -> dict[str, Any]:
    image_count = sum(len(part.cases) for part in group)
    return {"title": "Average" if key == AVERAGE else group[0].title, "cases": image_count}


def _choices(config: EvaluationConfig, averaged: Sequence[Selection]) -> list[str]:
    """Returns sentences: the settings, how the average is computed, and how it differs from that of the paper."""
    choices = [*describe_protocol(config), *config.describe(), *([_AVERAGE_NOTE] if averaged else [])]
    counts = {part.key.partition(":")[0]: len(part.cases) for part in averaged}
    if not config.paper_subset or counts == PAPER_COUNTS:
        return choices
    found = ", ".join(f"{count} of {name}" for name, count in counts.items()) or "too few benchmarks"
    return [
        *choices,
        f"The paper's average is over {sum(PAPER_COUNTS.values())} images; this one is over {found}.",
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


def _describe_difference(difference: Any) -> dict[str, Any]:  # noqa: ANN401  (a Difference)
    row = asdict(difference)
    return _rounded(row.pop("estimate") | row)


def _rounded(row: dict[str, Any]) -> dict[str, Any]:
    return {name: round(value, _DIGITS) if isinstance(value, float) else value for name, value in row.items()}


def _describe_benchmark(part: Benchmark) -> dict[str, Any]:
    return {
        "title": part.title,
        "cases": len(part.cases),
        "expected": list(part.expected_counts),
        "remarks": list(part.remarks),
        "excluded": list(part.excluded),
    }


def _describe_case(
    case: Case,
    methods: Sequence[str],
    rows: Mapping[tuple[str, str, str], ScoreRow],
    columns: Collection[str],
) -> dict[str, Any]:
    case_rows = {method: rows[case.benchmark, case.name, method] for method in methods}
    scored = next((row for row in case_rows.values() if not row.error), None)
    return {
        "benchmark": case.benchmark,
        "name": case.name,
        "scene": case.scene,
        "width": scored.width if scored else None,
        "height": scored.height if scored else None,
        "region_share": scored.region_share if scored else None,
        "scores": {
            method: {column: row.scores[column] for column in columns if column in row.scores}
            for method, row in case_rows.items()
            if not row.error
        },
        "errors": {method: row.error for method, row in case_rows.items() if row.error},
    }
