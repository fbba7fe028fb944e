"""Aggregates score rows into the content of results.json: means and paired differences with
confidence intervals.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np

import brewster
from brewster.evaluation.benchmarks.image_files import Case
from brewster.evaluation.benchmarks.registry import PAPER_SEED, Benchmark, paper_subset
from brewster.evaluation.config import (
    DEFAULT_METRICS,
    PAPER_METRICS,
    EvaluationConfig,
    describe_protocol,
)
from brewster.evaluation.methods import Method
from brewster.evaluation.runner import ScoreRow
from brewster.evaluation.statistics import Stratum, differences, estimate

AVERAGE: Final = "average"
PAPER_COUNTS: Final = {
    "real20": 20,
    "nature20": 20,
    "postcard": 20,
    "solidobject": 20,
    "wildscene": 101,
}
"""The benchmarks in the paper's average -> the number of images of each."""
_DIGITS: Final = 6
_AVERAGE_NOTE: Final = (
    "The average is over images, not over benchmarks: each image has the same weight."
)

Results = dict[str, Any]
"""The content of results.json; docs/evaluation.md describes it."""


def summarise(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    config: EvaluationConfig,
    rows: Sequence[ScoreRow],
    unavailable: Mapping[str, str] | None = None,
) -> Results:
    """Returns the content of results.json. The order of the rows does not matter. `unavailable` is
    column -> reason, for the columns that could not be computed. Raises BrewsterError if the
    subsets of the paper are requested, but the file names of a benchmark do not identify its
    scenes.
    """
    by_id = {row.id: row for row in rows}
    method_names = [method.name for method in methods]
    measured = {column for row in rows for column, score in row.scores.items() if score is not None}
    columns = {name: metric for name, metric in config.columns().items() if name in measured}
    full = [part for part in benchmarks if part.cases]
    subsets = paper_subsets(benchmarks) if config.paper_subset else []
    averaged = _averaged(full, subsets, config)
    selections: dict[str, Sequence[Benchmark]] = {part.name: [part] for part in (*full, *subsets)}
    selections |= {AVERAGE: averaged} if averaged else {}
    series = [(method, column) for method in method_names for column in columns]
    directions = {name: metric.higher_is_better for name, metric in columns.items()}
    strata = {
        key: [_stratum(part, series, by_id) for part in group] for key, group in selections.items()
    }
    return {
        "brewster": brewster.__version__,
        "protocol": _describe_settings(config, averaged),
        "metrics": {name: metric.to_dict() for name, metric in columns.items()},
        "benchmarks": {part.name: _describe_benchmark(part) for part in benchmarks},
        "selections": {key: _describe_selection(key, group) for key, group in selections.items()},
        "methods": {method.name: method.about() for method in methods},
        "unavailable": dict(unavailable or {}),
        "unmeasured": _unmeasured(config, {*measured, *(unavailable or {})}),
        "draw": {"seed": PAPER_SEED}
        | {subset.name: [case.name for case in subset.cases] for subset in subsets},
        "cases": [
            _describe_case(
                [by_id[case.benchmark, case.name, name] for name in method_names], case, columns
            )
            for part in benchmarks
            for case in part.cases
        ],
        "tables": {key: _table(strata[key], series) for key in selections},
        "differences": {
            key: [
                _rounded(row.pop("estimate") | row)
                for row in map(asdict, differences(strata[key], series, directions))
            ]
            for key in selections
        },
    }


def _describe_settings(config: EvaluationConfig, averaged: Sequence[Benchmark]) -> dict[str, Any]:
    return {
        "name": config.protocol,
        "size": config.short_side_px or "native",
        "quality": config.quality,
        "region_thresholds": [config.threshold],
        "choices": _choices(config, averaged),
    }


def _describe_selection(name: str, benchmarks: Sequence[Benchmark]) -> dict[str, Any]:
    return {
        "title": "Average" if name == AVERAGE else benchmarks[0].title,
        "cases": sum(len(part.cases) for part in benchmarks),
    }


def _unmeasured(config: EvaluationConfig, explained: Collection[str]) -> list[str]:
    """Returns the columns that were asked for, but whose ground truth no case has.

    Args:
        config: the settings of the evaluation.
        explained: the columns with scores, and those that could not be computed.
    """
    if config.metrics in (DEFAULT_METRICS, PAPER_METRICS):
        return []
    return [name for name in config.columns() if name not in explained]


def _averaged(
    full: Sequence[Benchmark], subsets: Sequence[Benchmark], config: EvaluationConfig
) -> list[Benchmark]:
    """Returns the benchmarks in the average, none if there is only one: the subset of each, or all
    of it if it has no subset.

    Args:
        full: the benchmarks with cases.
        subsets: those of the paper, if they are requested.
        config: the settings of the evaluation.
    """
    subset_of = {subset.name.partition(":")[0]: subset for subset in subsets}
    whole = [part for part in full if not config.paper_subset or part.name in PAPER_COUNTS]
    return [subset_of.get(part.name, part) for part in whole] if len(whole) > 1 else []


def _table(
    strata: Sequence[Stratum], series: Sequence[tuple[str, str]]
) -> dict[str, dict[str, Any]]:
    """Returns the means by method and column.

    Args:
        strata: the scores of the benchmarks of a selection.
        series: the method and the column of each series of scores.
    """
    table: dict[str, dict[str, Any]] = {method: {} for method, _ in series}
    for (method, column), mean in zip(series, estimate(strata), strict=True):
        if mean:
            table[method][column] = _rounded(asdict(mean))
    return table


def _describe_benchmark(benchmark: Benchmark) -> dict[str, Any]:
    return {
        "title": benchmark.title,
        "cases": len(benchmark.cases),
        "expected": list(benchmark.expected_counts),
        "remarks": list(benchmark.remarks),
        "excluded": list(benchmark.excluded),
    }


def paper_subsets(benchmarks: Sequence[Benchmark]) -> list[Benchmark]:
    """Returns the subset that the paper uses of each benchmark, without the benchmarks that it uses
    as a whole. Raises BrewsterError if the file names of a benchmark do not identify its scenes.
    """
    return [
        replace(
            part, name=f"{part.name}:paper", title=f"{part.title}, subset of the paper", cases=cases
        )
        for part in benchmarks
        if part.cases and len(cases := paper_subset(part)) < len(part.cases)
    ]


def _choices(config: EvaluationConfig, averaged: Sequence[Benchmark]) -> list[str]:
    """Returns sentences: the settings, how the average is computed, and how it differs from that of
    the paper.
    """
    choices = [
        *describe_protocol(config),
        *config.describe(),
        *([_AVERAGE_NOTE] if averaged else []),
    ]
    counts = {part.name.partition(":")[0]: len(part.cases) for part in averaged}
    if not config.paper_subset or counts == PAPER_COUNTS:
        return choices
    found = ", ".join(f"{count} of {name}" for name, count in counts.items())
    missing = (
        "This evaluation has no average, because it has fewer than two of the paper's benchmarks."
    )
    difference = f"The average of this evaluation is over {found}." if found else missing
    return [
        *choices,
        f"The paper's average is over {sum(PAPER_COUNTS.values())} images. {difference}",
    ]


def _stratum(
    part: Benchmark,
    series: Sequence[tuple[str, str]],
    rows: Mapping[tuple[str, str, str], ScoreRow],
) -> Stratum:
    values = [
        [rows[case.benchmark, case.name, method].scores.get(column) for method, column in series]
        for case in part.cases
    ]
    scenes = [case.scene for case in part.cases]
    array = np.array(values, float).reshape(len(part.cases), len(series))  # None becomes NaN
    return Stratum(part.name, scenes, array)


def _rounded(row: dict[str, Any]) -> dict[str, Any]:
    return {
        name: round(value, _DIGITS) if isinstance(value, float) else value
        for name, value in row.items()
    }


def _describe_case(
    rows: Sequence[ScoreRow], case: Case, columns: Collection[str]
) -> dict[str, Any]:
    scored = [row for row in rows if not row.error]
    return {
        "benchmark": case.benchmark,
        "name": case.name,
        "scene": case.scene,
        **{
            name: getattr(scored[0], name) if scored else None
            for name in ("width", "height", "region_share")
        },
        "scores": {
            row.method: {column: row.scores[column] for column in columns if column in row.scores}
            for row in scored
        },
        "errors": {row.method: row.error for row in rows if row.error},
    }
