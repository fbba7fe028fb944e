"""Results as tables: Markdown, LaTeX in the layout of the paper's Table 3, and CSV."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Final

from brewster.base.tables import csv_table, escape_latex, latex_table, markdown_table
from brewster.errors import counted
from brewster.evaluation.study.assignment import Trial
from brewster.evaluation.study.report.participants import OUTCOMES, ParticipantAnswers, outcome
from brewster.evaluation.study.store import ViewingConditions
from brewster.evaluation.study.study import StudyDescription

_GROUPS: Final = {"included": "After the exclusion rule", "everyone": "All participants"}
_DEFINITIONS: Final = """\
Rates are shares of the answers about a pair of methods. Average weights each dataset by its \
number of pictures, as the paper's Table 3 does; the rows below it are the unweighted mean of the \
datasets and the rates of all answers together.
Intervals are 95 % expanded percentile intervals of 10,000 bootstrap resamples of whole \
participants; if all answers agree, they are those of Clopper and Pearson with one answer for each \
participant. They apply to other participants who see these pictures; they do not apply to other \
pictures.
Difference is win minus lose. N is the number of participants with an answer. The p-value is that \
of a two-sided randomisation test of the difference, which exchanges wins and losses of whole \
participants; it is not corrected for the number of tests. With fewer than 6 participants, no \
result can be significant at the 5 % level, and the table says "too few participants".
Agreement is Krippendorff's alpha of win, tie and lose over comparisons; 1 is perfect, 0 is \
chance."""

_CONDITIONS: Final = tuple(field.name for field in fields(ViewingConditions))
ANSWER_COLUMNS: Final = (
    "participant",
    "position",
    "kind",
    "dataset",
    "name",
    "first",
    "second",
    "left",
    "right",
    "choice",
    "outcome",
    "expected",
    "seconds",
    "answered_at",
    "withdrawn",
    *_CONDITIONS,
    "left_out",
)
"""The columns of answers.csv; docs/study.md describes them."""

Results = Mapping[str, Any]


def to_markdown(results: Results) -> str:
    """The whole report: participants, tables with and without the exclusion rule, agreement,
    definitions.
    """
    groups = [_group(results, key, heading) for key, heading in _GROUPS.items()]
    definitions = [f"- {line}" for line in (_rule(results), *_DEFINITIONS.splitlines())]
    title = f"# {' · '.join(results['study']['methods'])}"
    return "\n\n".join([title, *groups, "## Methods", "\n".join(definitions)]) + "\n"


def overview(results: Results) -> str:
    """The text for a terminal: the results after the exclusion rule."""
    return f"{_group(results, 'included', _GROUPS['included'])}\n\n{_rule(results)}\n"


def _rule(results: Results) -> str:
    excluded = results["excluded"]
    rule = results["rule"]
    return (
        f"{rule[0].upper()}{rule[1:]}: {excluded['failed']} for wrong answers, {excluded['fast']} "
        "for short times. Participants who stopped early are included with the answers they gave."
    )


def _group(results: Results, key: str, heading: str) -> str:
    group = results[key]
    counts = (
        f"{counted(group['participants'], 'participant')} ({group['complete']} complete), "
        f"{counted(group['answers'], 'answer')}; {group['failed']} of {group['catch_trials']} "
        "catch trials failed."
    )
    parts = [f"## {heading}", counts, *map(_table, group["tables"])]
    if group["tables"]:
        agreement = "has no value" if group["agreement"] is None else f"is {group['agreement']:.3f}"
        parts.append(f"Krippendorff's alpha {agreement}.")
    return "\n\n".join(parts)


def _table(table: Mapping[str, Any]) -> str:
    filled = _filled(table["rows"])
    if sum(not row["key"].startswith("/") for row in filled) == 1:
        filled = filled[:1]  # the averages over a single dataset are equal to its row
    rows = [["", table["first"], "Tie", table["second"], "Difference", "Test", "N", "Answers"]]
    rows += [
        [
            row["title"],
            *(_percent(row[name]) for name in ("win", "tie", "lose")),
            _percent(row["difference"], "+"),
            _p_value(row["p"]),
            str(row["participants"]),
            str(row["answers"]),
        ]
        for row in filled
    ]
    return f"### {table['first']} and {table['second']}\n\n{markdown_table(rows)}"


def _filled(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The rows that have rates. A dataset without answers has no rates, and an average over it has
    none either.
    """
    return [row for row in rows if row["win"]["mean"] is not None]


def _p_value(p: float | None) -> str:
    if p is None:
        return "too few participants"
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _percent(entry: Mapping[str, Any], sign: str = "") -> str:
    mean = f"{100 * entry['mean']:{sign}.2f} %"
    return mean if entry["low"] is None else f"{mean} ({_interval_text(entry, sign)})"


def _interval_text(entry: Mapping[str, Any], sign: str = "", join: str = " to ") -> str:
    return join.join(f"{100 * entry[end]:{sign}.1f}" for end in ("low", "high"))


def to_latex(results: Results) -> str:
    """The results after the exclusion rule, in the layout of the paper's Table 3, with intervals
    below the rates. One row for each dataset and one for the average; columns win, tie and lose for
    each pair of methods. Needs booktabs.
    """
    tables = results["included"]["tables"]
    if not tables:
        return "% the rule excludes everyone\n"
    heads = [cell for table in tables for cell in (table["first"], "Tie", table["second"])]
    answered = {row["key"] for table in tables for row in _filled(table["rows"])}
    datasets = results["study"]["datasets"]
    keys = [key for key in datasets if len(datasets) > 1 and key in answered]
    rows = [line for key in keys for line in _latex_rows(tables, key)]
    average = _latex_rows(tables, "/average" if "/average" in answered else "/answers")
    columns = f"c|{'|'.join('ccc' for _ in tables)}"
    table = latex_table(
        columns, [[escape_latex(head) for head in ("Dataset", *heads)]], rows, average
    )
    return (
        f"% brewster study report; needs \\usepackage{{booktabs}}; below each rate its 95\\% "
        f"interval\n{table}"
    )


def _latex_rows(tables: Iterable[Mapping[str, Any]], key: str) -> list[list[str]]:
    rows = [next(row for row in table["rows"] if row["key"] == key) for table in tables]
    entries = [row[name] for row in rows for name in ("win", "tie", "lose")]
    rates = [
        "--" if entry["mean"] is None else f"{100 * entry['mean']:.2f}\\%" for entry in entries
    ]
    intervals = [
        "" if entry["low"] is None else f"\\scriptsize {_interval_text(entry, join='--')}"
        for entry in entries
    ]
    return [[escape_latex(rows[0]["title"]), *rates], ["", *intervals]]


def answers_csv(
    description: StudyDescription,
    participants: Sequence[ParticipantAnswers],
    left_out: Mapping[str, str],
) -> str:
    """The answers of all participants, in the order of presentation. `left_out`: number of a
    participant -> why.
    """
    rows: list[Sequence[object]] = [ANSWER_COLUMNS]
    for participant in participants:
        for position, trial, answer in participant.trials:
            row = _shown(description, trial) | (
                asdict(answer.conditions) if answer.conditions else {}
            )
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
            rows.append([row.get(name) for name in ANSWER_COLUMNS])
    return csv_table(rows)


def _shown(description: StudyDescription, trial: Trial) -> dict[str, Any]:
    """What a trial showed: two methods, or an unchanged output next to itself or to its degraded
    copy.
    """
    if trial.comparison is None:
        catch = next(catch for catch in description.catch_pool if catch.photo == trial.photo)
        left, right = (
            "degraded" if side == catch.degraded else "unchanged"
            for side in (trial.left, trial.right)
        )
        shown = {
            "kind": "catch",
            "dataset": catch.dataset,
            "name": catch.name,
            "expected": trial.expected,
        }
        return shown | {"left": left, "right": right}
    row = description.comparisons[trial.comparison]
    left, right = row.methods[::-1] if trial.flipped else row.methods
    return {
        "kind": "comparison",
        "dataset": row.dataset,
        "name": row.name,
        "first": row.methods[0],
        "second": row.methods[1],
        "left": left,
        "right": right,
    }
