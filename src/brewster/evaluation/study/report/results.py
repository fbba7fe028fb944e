"""Compute the results of a study from its answers, as plain JSON values, and write the files of the
report.

All results are given twice: for the participants after the exclusion rule, and for all
participants.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import brewster
from brewster.base.files import write_atomically
from brewster.errors import BrewsterError
from brewster.evaluation.study.report import statistics
from brewster.evaluation.study.report.participants import (
    OUTCOMES,
    ExclusionRule,
    ParticipantAnswers,
)
from brewster.evaluation.study.report.tables import answers_csv, to_latex, to_markdown
from brewster.evaluation.study.study import Study

AVERAGES: Final = {
    "/average": "Average",
    "/datasets": "Mean of the datasets",
    "/answers": "All answers together",
}
"""Keys and titles of the rows below the datasets. Keys begin with a slash, which no dataset name
contains.

The first row weights each dataset by its number of pictures, as the paper does.
"""
_DIGITS: Final = 6

Results = dict[str, Any]
"""The content of report.json; docs/study.md describes it."""
Floats = NDArray[np.float64]


def summarise(
    study: Study, participants: Sequence[ParticipantAnswers], rule: ExclusionRule
) -> Results:
    """Compute the results of a study from the answers of all participants: the content of
    report.json. Raises BrewsterError if there is no answer yet.
    """
    if not any(participant.votes for participant in participants):
        raise BrewsterError(
            f"{study.folder} has no answers yet",
            "expected at least one answer to a comparison",
            "send participants the address that `brewster study serve` prints",
        )
    left_out = {str(one.number): reason for one in participants if (reason := rule.reason(one))}
    included = [
        participant for participant in participants if str(participant.number) not in left_out
    ]
    description = study.description
    reasons = list(left_out.values())
    return {
        "brewster": brewster.__version__,
        "study": {
            "seed": description.seed,
            "methods": list(description.methods),
            "datasets": {name: _dataset_title(name) for name in description.datasets},
            "comparisons": len(description.comparisons),
            "pairs": description.pairs,
            "catch_trials": description.catch_trials,
        },
        "rule": str(rule),
        "excluded": {reason: reasons.count(reason) for reason in ("failed", "fast")},
        "left_out": left_out,
        "included": _group(study, included),
        "everyone": _group(study, participants),
    }


def _dataset_title(dataset: str) -> str:
    return f"{dataset} (dataset)" if dataset in AVERAGES.values() else dataset or "All pictures"


def _group(study: Study, participants: Sequence[ParticipantAnswers]) -> dict[str, Any]:
    participants = [participant for participant in participants if participant.votes]
    summary = {
        "participants": len(participants),
        "complete": sum(one.is_complete for one in participants),
        "answers": sum(len(one.votes) for one in participants),
        "catch_trials": sum(one.catch_trials for one in participants),
        "failed": sum(one.failed for one in participants),
        "tables": [],
        "agreement": None,
    }
    if not participants:
        return summary
    pairs = {pair: i for i, pair in enumerate(study.pairs_of_methods)}
    datasets = {name: i for i, name in enumerate(study.description.datasets)}
    indices = [(pairs[row.methods], datasets[row.dataset]) for row in study.description.comparisons]
    shape = len(pairs), len(datasets)
    pictures = np.zeros(shape)
    ratings = np.zeros((len(indices), len(OUTCOMES)))
    np.add.at(pictures, tuple(np.array(indices).T), 1)
    # wins, ties and losses of the first method: (participants, pairs of methods, datasets, 3)
    counts = np.zeros((len(participants), *shape, len(OUTCOMES)))
    for i, participant in enumerate(participants):
        for comparison, outcome in participant.votes.items():
            counts[i, *indices[comparison], outcome] += 1
            ratings[comparison, outcome] += 1
    weights = statistics.bootstrap_weights(len(participants))
    return summary | {
        "tables": _tables(study, counts, pictures, weights),
        "agreement": _round(statistics.alpha(ratings)),
    }


def _tables(
    study: Study, counts: Floats, pictures: Floats, weights: Floats
) -> list[dict[str, Any]]:
    """A table for each pair of methods, with a row for each dataset and a row for each of the
    AVERAGES.
    """

    def with_averages(values: Floats, pooled: Floats) -> NDArray[np.int64]:
        """Appends a column for each of the AVERAGES: (pairs of methods, datasets + 3)."""
        return np.concatenate(
            [values, np.repeat(pooled[:, None], len(AVERAGES), axis=1)], axis=1
        ).astype(int)

    means = statistics.rates(counts.sum(axis=0), pictures)
    draws = statistics.rates(statistics.resampled_counts(weights, counts), pictures)
    ends = statistics.bootstrap_interval(draws, len(counts))
    lows, highs = statistics.with_agreement_bounds(
        means, ends, statistics.agreement_bounds(counts, pictures)
    )
    p_values = statistics.sign_flip_test(counts, pictures)
    answers = counts.sum(axis=(0, 3))
    answered = counts.sum(axis=-1) > 0
    numbers = {
        "pictures": with_averages(pictures, pictures.sum(axis=1)),
        "answers": with_averages(answers, answers.sum(axis=1)),
        "participants": with_averages(answered.sum(axis=0), answered.any(axis=-1).sum(axis=0)),
    }
    p_values[numbers["participants"] < statistics.MIN_PARTICIPANTS] = np.nan
    titles = {name: _dataset_title(name) for name in study.description.datasets} | AVERAGES
    return [
        {
            "first": first,
            "second": second,
            "rows": [
                {
                    "key": key,
                    "title": title,
                    **{name: int(values[i, j]) for name, values in numbers.items()},
                    "p": _round(p_values[i, j]),
                }
                | {
                    name: _estimate(means[i, j, k], lows[i, j, k], highs[i, j, k])
                    for k, name in enumerate((*OUTCOMES, "difference"))
                }
                for j, (key, title) in enumerate(titles.items())
            ],
        }
        for i, (first, second) in enumerate(study.pairs_of_methods)
    ]


def _estimate(mean: float, low: float, high: float) -> dict[str, float | None]:
    return {"mean": _round(mean), "low": _round(low), "high": _round(high)}


def _round(value: float | None) -> float | None:
    """Round to 6 decimal places; None for None, NaN and infinity."""
    return None if value is None or not math.isfinite(value) else round(float(value), _DIGITS)


def write(
    results: Results, study: Study, participants: Sequence[ParticipantAnswers], out: Path
) -> None:
    """Write all files of a report into the folder `out`, and replace older ones. Raises OutputError
    if it cannot.
    """
    files = {
        "report.json": f"{json.dumps(results, indent=1, ensure_ascii=False)}\n".encode(),
        "report.md": to_markdown(results).encode(),
        "table.tex": to_latex(results).encode(),
        "answers.csv": answers_csv(study.description, participants, results["left_out"]).encode(),
    }
    for name, data in files.items():
        write_atomically(out / name, data, overwrite=True)
