"""The answers of each participant, the rule that excludes participants, and the progress of a running study."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final, Literal, final

from brewster.errors import counted
from brewster.tables import plain_table
from brewster.user_study.assignment import Choice, Trial
from brewster.user_study.store import Participant, StoredAnswer
from brewster.user_study.study import StudyDescription

OUTCOMES: Final = ("win", "tie", "lose")
"""The outcomes of a comparison for its first method."""

Reason = Literal["failed", "fast"]


@final
@dataclass(frozen=True)
class ParticipantAnswers:
    """The answers of one participant. `votes` maps the number of a comparison to an index of OUTCOMES. Of the answered
    `catch_trials`, `failed` have a wrong answer. `seconds` is the median time for a trial. `trials` has the position of
    each answered trial in the order of presentation, from 0, the trial, and its answer."""

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
    """Excludes a participant if failed / catch_trials > `max_failed`, or the median time of a trial is <
    `min_seconds`."""

    max_failed: float = 0.25
    min_seconds: float = 1.5

    def __str__(self) -> str:
        return (
            f"participants are excluded if they answer more than {self.max_failed:.0%} of the catch trials wrongly, "
            f"or if their median time for a trial is below {self.min_seconds:g} s"
        )

    def reason(self, participant: ParticipantAnswers) -> Reason | None:
        """The reason why the participant is excluded, or None if the participant is included."""
        if participant.failed > self.max_failed * participant.catch_trials:
            return "failed"
        return "fast" if participant.seconds < self.min_seconds else None


def collect_answers(
    records: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]],
) -> list[ParticipantAnswers]:
    """The answers of each participant with at least one answer; incomplete participants are included."""
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


# --- progress: who has answered how many trials, and how; without any choice or result


def summarise_progress(
    description: StudyDescription,
    records: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]],
    rule: ExclusionRule,
) -> dict[str, Any]:
    """Summarise the progress of all admitted participants, whose `records` are those of `AnswerStore.all_answers()`, as
    plain JSON values: totals, the smallest and largest number of answers to a comparison, a row for each one."""
    records = list(records)
    by_number = {answered.number: answered for answered in collect_answers(records)}
    rows = []
    for participant, answers in records:
        answered = by_number.get(participant.number)
        last = answers[max(answers)] if answers else None
        shown = last.conditions if last else None
        rows.append(
            {
                "participant": participant.number,
                "answers": len(answers),
                "trials": len(participant.trials),
                "catch_trials": answered.catch_trials if answered else 0,
                "failed": answered.failed if answered else 0,
                "median_seconds": round(answered.seconds, 2) if answered else None,
                "last_answer": last.answered_at if last else None,
                "window": f"{shown.viewport_width}x{shown.viewport_height}" if shown else None,
                "excluded": rule.reason(answered) if answered else None,
            }
        )
    counts = Counter(comparison for answered in by_number.values() for comparison in answered.votes)
    per_comparison = [counts[number] for number in range(len(description.comparisons))]
    return {
        "participants": len(rows),
        "complete": sum(row["answers"] == row["trials"] for row in rows),
        "excluded": sum(row["excluded"] is not None for row in rows),
        "answers": sum(per_comparison),
        "answers_per_comparison": [min(per_comparison), max(per_comparison)],
        "rows": rows,
    }


def progress_text(progress: Mapping[str, Any]) -> str:
    """The progress as text for a terminal: a line of totals, and a table of participants."""
    low, high = progress["answers_per_comparison"]
    total = (
        f"{counted(progress['participants'], 'participant')}, {progress['complete']} complete, "
        f"{progress['excluded']} excluded by the rule so far; {counted(progress['answers'], 'answer')}, "
        f"{low} to {high} for each comparison."
    )
    if not progress["rows"]:
        return f"{total}\n"
    table = [("participant", "answers", "catch trials failed", "median time", "last answer", "window", "excluded")]
    table += [
        (
            str(row["participant"]),
            f"{row['answers']} of {row['trials']}",
            f"{row['failed']} of {row['catch_trials']}",
            "" if row["median_seconds"] is None else f"{row['median_seconds']:.1f} s",
            (row["last_answer"] or "")[:16].replace("T", " "),
            row["window"] or "",
            row["excluded"] or "",
        )
        for row in progress["rows"]
    ]
    return f"{total}\n\n{plain_table(table)}\n"
