"""The progress of a running study: who has answered how many trials, and how. It contains no choice and no result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from brewster.errors import counted
from brewster.tables import plain_table
from brewster.user_study.report.participants import ExclusionRule, collect_answers
from brewster.user_study.store import Participant, StoredAnswer
from brewster.user_study.study import StudyDescription


def summarise_progress(
    description: StudyDescription,
    records: Iterable[tuple[Participant, Mapping[int, StoredAnswer]]],
    rule: ExclusionRule,
) -> dict[str, Any]:
    """Summarise the progress of all admitted participants, whose `records` are those of `AnswerStore.all_answers()`, as
    plain JSON values: totals, the smallest and the largest number of answers to a comparison, and a row for each
    participant."""
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
        f"{counted(progress['participants'], 'participant')}, {progress['complete']} complete, {progress['excluded']} excluded by the rule "
        f"so far; {counted(progress['answers'], 'answer')}, {low} to {high} for each comparison."
    )
    if not progress["rows"]:
        return f"{total}\n"
    table = [
        ("participant", "answers", "catch trials failed", "median time", "last answer", "window", "excluded")
    ]
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
