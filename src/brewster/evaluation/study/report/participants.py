"""The answers of each participant, the rule that excludes participants, and the progress of a
running study.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final, Literal, final

from brewster.errors import counted
from brewster.evaluation.study.assignment import Choice, Trial
from brewster.evaluation.study.store import Participant, StoredAnswer
from brewster.evaluation.study.study import StudyDescription

OUTCOMES: Final = ("win", "tie", "lose")
"""The outcomes of a comparison for its first method."""

Reason = Literal["failed", "fast"]


@final
@dataclass(frozen=True)
class ParticipantAnswers:
    """The answers of one participant. `votes` maps the number of a comparison to an index of
    OUTCOMES. Of the answered `catch_trials`, `failed` have a wrong answer. `seconds` is the median
    time for a trial. `trials` has the position of each answered trial in the order of presentation,
    from 0, the trial, and its answer.
    """

    number: int
    votes: Mapping[int, int]
    catch_trials: int
    failed: int
    seconds: float
    is_complete: bool
    trials: Sequence[tuple[int, Trial, StoredAnswer]] = ()


@final
@dataclass(frozen=True)
class ExclusionRule:
    """Excludes a participant if failed / catch_trials > `max_failed`, or the median time of a trial
    is < `min_seconds`.
    """

    max_failed: float = 0.25
    min_seconds: float = 1.5

    def __str__(self) -> str:
        return (
            f"participants are excluded if they answer more than {self.max_failed:.0%} of the "
            "catch trials wrongly, or if their median time for a trial is below "
            f"{self.min_seconds:g} s"
        )

    def reason(self, participant: ParticipantAnswers) -> Reason | None:
        """The reason why the participant is excluded, or None if the participant is included."""
        if participant.failed > self.max_failed * participant.catch_trials:
            return "failed"
        return "fast" if participant.seconds < self.min_seconds else None


def collect_answers(
    records: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]],
) -> list[ParticipantAnswers]:
    """The answers of each participant with at least one answer; incomplete participants are
    included.
    """
    collected = []
    for participant, answers in records:
        if not answers:
            continue
        trials = [(i, participant.trials[i], answer) for i, answer in answers.items()]
        passed = [trial.expected == answer.choice for _, trial, answer in trials if trial.expected]
        votes = {
            trial.comparison: outcome(trial, answer.choice)
            for _, trial, answer in trials
            if trial.comparison is not None
        }
        collected.append(
            ParticipantAnswers(
                participant.number,
                votes,
                catch_trials=len(passed),
                failed=passed.count(False),
                seconds=median(answer.seconds for answer in answers.values()),
                is_complete=len(answers) == len(participant.trials),
                trials=trials,
            )
        )
    return collected


def outcome(trial: Trial, choice: Choice) -> int:
    """The outcome of a choice for the first method of the comparison, as an index of OUTCOMES."""
    if choice == "similar":
        return 1
    return 0 if (choice == "right") == trial.flipped else 2


# --- progress: how many participants have answered how many trials, without any choice or result


def summarise_progress(
    description: StudyDescription,
    records: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]],
    rule: ExclusionRule,
) -> dict[str, Any]:
    """Counts all admitted participants, whose `records` are those of `AnswerStore.all_answers()`,
    and their answers, as plain JSON values. `answers_per_comparison` is the smallest and the
    largest number of answers to a comparison.
    """
    records = list(records)
    participants = collect_answers(records)
    counts = Counter(comparison for answered in participants for comparison in answered.votes)
    per_comparison = [counts[number] for number in range(len(description.comparisons))]
    return {
        "participants": len(records),
        "complete": sum(answered.is_complete for answered in participants),
        "excluded": sum(rule.reason(answered) is not None for answered in participants),
        "answers": sum(per_comparison),
        "answers_per_comparison": [min(per_comparison), max(per_comparison)],
    }


def progress_text(progress: Mapping[str, Any]) -> str:
    """The progress as a line of text."""
    low, high = progress["answers_per_comparison"]
    return (
        f"{counted(progress['participants'], 'participant')}, {progress['complete']} complete, "
        f"{progress['excluded']} excluded by the rule so far; "
        f"{counted(progress['answers'], 'answer')}, {low} to {high} for each comparison.\n"
    )
