"""All answers of a study as CSV: one line for each answer, with the trial, the choice and the viewing conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Final

from brewster.tables import csv_table
from brewster.user_study.answer_file import ViewingConditions
from brewster.user_study.assignment import Trial
from brewster.user_study.report.participants import OUTCOMES, ParticipantAnswers, outcome
from brewster.user_study.study import StudyDescription

_CONDITIONS: Final = tuple(field.name for field in fields(ViewingConditions))
COLUMNS: Final = (
    "participant", "position", "kind", "dataset", "name", "first", "second", "left", "right",
    "choice", "outcome", "expected", "seconds", "answered_at", "withdrawn", *_CONDITIONS, "left_out",
)  # fmt: skip
"""docs/study.md describes the columns."""


def answers_csv(
    description: StudyDescription, participants: Sequence[ParticipantAnswers], left_out: Mapping[str, str]
) -> str:
    """The answers of all participants, in the order of presentation. `left_out` is the number of a participant -> why excluded."""
    rows: list[Sequence[object]] = [COLUMNS]
    for participant in participants:
        for position, trial, answer in participant.trials:
            shown = _comparison(description, trial) if trial.expected is None else _catch(description, trial)
            row = shown | (asdict(answer.conditions) if answer.conditions else {})
            row |= {
                "participant": participant.number,
                "position": position + 1,
                "choice": answer.choice,
                "outcome": None if trial.expected else OUTCOMES[outcome(trial, answer.choice)],
                "seconds": round(answer.seconds, 3),
                "answered_at": answer.answered_at,
                "withdrawn": " ".join(answer.withdrawn),
                "left_out": left_out.get(str(participant.number)),
            }
            rows.append([row.get(name) for name in COLUMNS])
    return csv_table(rows)


def _comparison(description: StudyDescription, trial: Trial) -> dict[str, object]:
    assert trial.comparison is not None
    row = description.comparisons[trial.comparison]
    left, right = row.methods[::-1] if trial.flipped else row.methods
    return {
        "kind": "comparison", "dataset": row.dataset, "name": row.name,
        "first": row.methods[0], "second": row.methods[1], "left": left, "right": right,
    }  # fmt: skip


def _catch(description: StudyDescription, trial: Trial) -> dict[str, object]:
    """A catch trial: the sides have an unchanged output or its degraded copy, and no methods are compared."""
    catch = next(catch for catch in description.catch_pool if catch.photo == trial.photo)
    left, right = (
        "degraded" if side == catch.degraded else "unchanged" for side in (trial.left, trial.right)
    )
    return {
        "kind": "catch", "dataset": catch.dataset, "name": catch.name,
        "left": left, "right": right, "expected": trial.expected,
    }  # fmt: skip
