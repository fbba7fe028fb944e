"""The answers by participant, and who is left out: by a rule that is stated beforehand and nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Final, Literal, final

from brewster.user_study.assignment import Choice, TrialDraw
from brewster.user_study.store import Participant, StoredAnswer

OUTCOMES: Final = ("win", "tie", "lose")
"""Of the first method of a comparison."""

Reason = Literal["failed", "fast"]


@final
@dataclass(frozen=True)
class ParticipantAnswers:
    """What a participant answered.

    `votes` has the outcome (0, 1, 2 of OUTCOMES) of each comparison by its number; of `catches` trials they answered,
    `failed` wrongly. `seconds` is their median time for a trial.
    """

    number: int
    votes: Mapping[int, int]
    catches: int
    failed: int
    seconds: float
    is_complete: bool


@final
@dataclass(frozen=True)
class ExclusionRule:
    """Who is left out: who fails more than this share of the catch trials, or is faster than this median time."""

    most_failed: float = 0.25
    least_seconds: float = 1.5

    def __str__(self) -> str:
        return (
            f"left out is who answers more than {self.most_failed:.0%} of the catch trials wrongly, or takes less "
            f"than {self.least_seconds:g} s for half of all trials"
        )

    def reason(self, person: ParticipantAnswers) -> Reason | None:
        """Why somebody is left out; None if they are not."""
        if person.failed > self.most_failed * person.catches:
            return "failed"
        return "fast" if person.seconds < self.least_seconds else None


def people(everything: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]]) -> list[ParticipantAnswers]:
    """All participants who answered anything; what they did answer counts, whether or not they came to the end."""
    return [_person(participant, answers) for participant, answers in everything if answers]


def _person(participant: Participant, answers: Mapping[int, StoredAnswer]) -> ParticipantAnswers:
    shown = [(participant.trials[trial], answer.choice) for trial, answer in answers.items()]
    caught = [trial.expected == choice for trial, choice in shown if trial.expected]
    return ParticipantAnswers(
        participant.number,
        {trial.comparison: outcome(trial, choice) for trial, choice in shown if trial.comparison is not None},
        len(caught),
        caught.count(False),
        median(answer.seconds for answer in answers.values()),
        len(answers) == len(participant.trials),
    )


def outcome(trial: TrialDraw, choice: Choice) -> int:
    """What a choice means for the comparison's first method: 0, 1 or 2 of OUTCOMES."""
    if choice == "similar":
        return 1
    return 0 if (choice == "right") == trial.flipped else 2
