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

    max_failed: float = 0.25
    min_seconds: float = 1.5

    def __str__(self) -> str:
        return (
            f"left out is who answers more than {self.max_failed:.0%} of the catch trials wrongly, or takes less "
            f"than {self.min_seconds:g} s for half of all trials"
        )

    def reason(self, participant: ParticipantAnswers) -> Reason | None:
        """Why somebody is left out; None if they are not."""
        if participant.failed > self.max_failed * participant.catches:
            return "failed"
        return "fast" if participant.seconds < self.min_seconds else None


def collect_answers(
    records: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]],
) -> list[ParticipantAnswers]:
    """All participants who answered anything; what they did answer counts, whether or not they came to the end."""
    return [_participant_answers(participant, answers) for participant, answers in records if answers]


def _participant_answers(participant: Participant, answers: Mapping[int, StoredAnswer]) -> ParticipantAnswers:
    shown = [(participant.trials[trial], answer.choice) for trial, answer in answers.items()]
    passed = [trial.expected == choice for trial, choice in shown if trial.expected]
    return ParticipantAnswers(
        participant.number,
        {trial.comparison: outcome(trial, choice) for trial, choice in shown if trial.comparison is not None},
        len(passed),
        passed.count(False),
        median(answer.seconds for answer in answers.values()),
        len(answers) == len(participant.trials),
    )


def outcome(trial: TrialDraw, choice: Choice) -> int:
    """What a choice means for the comparison's first method: 0, 1 or 2 of OUTCOMES."""
    if choice == "similar":
        return 1
    return 0 if (choice == "right") == trial.flipped else 2
