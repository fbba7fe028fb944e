"""Results as tables in Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from typing import Any, Final

from brewster.evaluate.results import Results

MAIN_METRICS: Final = ("psnr", "ssim", "lpips")
"""The metrics of the overview table."""

_ARROWS: Final = {True: "↑", False: "↓"}
_UNEQUAL_COUNTS: Final = (
    "\n\nDo not compare a mean over fewer pictures with the others; differences are over common pictures."
)
_MINUS: Final = "\N{MINUS SIGN}"


# --- Markdown


def to_markdown(results: Results) -> str:
    """All tables: an overview, details of each benchmark with intervals and differences, notes, and the settings."""
    parts = [
        _overview(results),
        *(_details(results, key) for key in results["selections"]),
        _notes(results),
        _choices(results),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def overview(results: Results) -> str:
    """The tables without notes and settings, for the terminal."""
    return (
        "\n\n".join([_overview(results), *(_details(results, key) for key in results["selections"])]) + "\n"
    )


def _overview(results: Results) -> str:
    """One row per method, one column per selection, the main metrics in each cell."""
    metrics = [name for name in MAIN_METRICS if name in results["metrics"]]
    if not metrics:
        return ""
    titles = " / ".join(_heading(results, name) for name in metrics)
    rows = [["", *(f"{part['title']} ({part['pictures']})" for part in results["selections"].values())]]
    rows += [
        [method, *(_cell(results, key, method, metrics) for key in results["selections"])]
        for method in results["methods"]
    ]
    return f"{titles}\n\n{_grid(rows)}{_UNEQUAL_COUNTS if _has_unequal_counts(results, metrics) else ''}"


def _has_unequal_counts(results: Results, metrics: Iterable[str]) -> bool:
    """Whether a method has a mean over fewer pictures than another."""
    return any(
        metric in row and not is_complete(table, method, metric)
        for table in results["tables"].values()
        for method, row in table.items()
        for metric in metrics
    )


def _cell(results: Results, key: str, method: str, metrics: Iterable[str]) -> str:
    row, pictures = results["tables"][key][method], results["selections"][key]["pictures"]
    text = " / ".join(_number(results, name, row[name]["mean"]) if name in row else "-" for name in metrics)
    counts = sorted({row[name]["count"] if name in row else 0 for name in metrics})
    if counts == [pictures]:
        return text
    return f"{text} ({' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} of {pictures})"


def _details(results: Results, key: str) -> str:
    """A table of one selection: one row per metric, with the means of the methods and the differences between them."""
    selection, table = results["selections"][key], results["tables"][key]
    methods, apart = list(results["methods"]), results["differences"][key]
    pairs = list(dict.fromkeys((row["method"], row["than"]) for row in apart))
    rows = [["", *methods, *(f"{method} {_MINUS} {than}" for method, than in pairs)]]
    for metric in results["metrics"]:
        if not any(metric in table[method] for method in methods):
            continue
        found = {(row["method"], row["than"]): row for row in apart if row["metric"] == metric}
        means = [
            _mean(results, metric, table[method].get(metric), selection["pictures"]) for method in methods
        ]
        rows.append(
            [
                _heading(results, metric),
                *means,
                *(_difference_cell(results, metric, found.get(pair)) for pair in pairs),
            ]
        )
    return f"### {selection['title']} ({selection['pictures']} pictures)\n\n{_grid(rows)}"


def _mean(results: Results, metric: str, entry: Mapping[str, Any] | None, pictures: int) -> str:
    if entry is None:
        return "-"
    some = f", {entry['count']} of {pictures}" if entry["count"] != pictures else ""
    return f"{_number(results, metric, entry['mean'])}{_interval(results, metric, entry)}{some}"


def _difference_cell(results: Results, metric: str, row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    mean, interval = (
        _number(results, metric, row["mean"], sign="+"),
        _interval(results, metric, row, sign="+"),
    )
    return f"{mean}{interval}, better on {row['better']} of {row['count']}"


def _interval(results: Results, metric: str, entry: Mapping[str, Any], *, sign: str = "") -> str:
    if entry["low"] is None:
        return ""
    low, high = (_number(results, metric, entry[end], sign=sign) for end in ("low", "high"))
    return f" ({low} to {high})"


def _notes(results: Results) -> str:
    """Remarks, refused files, metrics without a score, and failures."""
    lines = [
        f"- {part['title']}: {text}"
        for part in results["benchmarks"].values()
        for text in (*part["remarks"], *(f"left out: {reason}" for reason in part["refused"]))
    ]
    lines += [f"- {remark}" for remark in remarks(results)]
    lines += [f"- {name}: no picture has the ground truth that it needs" for name in results["unmeasured"]]
    lines += [f"- {error}" for error in failures(results)]
    return "\n".join(["### Notes", "", *lines]) if lines else ""


def remarks(results: Mapping[str, Any]) -> list[str]:
    """The remarks on methods."""
    return [f"{name}: {about['remark']}" for name, about in results["methods"].items() if "remark" in about]


def failures(results: Results) -> list[str]:
    """The errors of methods, without repetitions."""
    errors = (error for picture in results["pictures"] for error in picture["errors"].values())
    return list(dict.fromkeys(errors))


def _choices(results: Results) -> str:
    metrics = (f"{entry['title']}: {entry['about']}" for entry in results["metrics"].values())
    lines = [*results["protocol"]["choices"], *metrics]
    return "\n".join(["### How it was measured", "", *(f"- {line}" for line in lines)])


def _grid(rows: Iterable[Iterable[str]]) -> str:
    head, *body = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(head, *body, strict=True)]
    lines = [head, [":" + "-" * max(2, width - 1) for width in widths], *body]
    return "\n".join(
        f"| {' | '.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))} |"
        for line in lines
    )


def _heading(results: Results, metric: str) -> str:
    entry = results["metrics"][metric]
    unit = f", {entry['unit']}" if entry["unit"] else ""
    return f"{entry['title']}{unit} {_ARROWS[entry['higher_is_better']]}"


def _number(results: Results, metric: str, value: float, *, sign: str = "") -> str:
    return f"{value:{sign}.{results['metrics'][metric]['digits']}f}"


def ranking(table: Mapping[str, Any], metric: str, about: Mapping[str, Any]) -> list[str]:
    """The means as printed, the best first, without repetitions; equal printed means get the same mark.

    Methods with a score on fewer pictures than others are left out. With fewer than two methods the list is empty.
    """
    means = [row[metric]["mean"] for method, row in table.items() if is_complete(table, method, metric)]
    if len(means) < 2:
        return []
    means.sort(reverse=about["higher_is_better"])
    return list(dict.fromkeys(f"{mean:.{about['digits']}f}" for mean in means))


def is_complete(table: Mapping[str, Any], method: str, metric: str) -> bool:
    """Whether no other method has a score in this metric on more pictures."""
    counts = {name: row[metric]["count"] for name, row in table.items() if row.get(metric)}
    return counts.get(method) == max(counts.values(), default=0)


# --- CSV


def to_csv(results: Results) -> str:
    """One line for each set, method and metric, and for each difference; `than` is the other method."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["set", "method", "than", "metric", "unit", "mean", "low", "high", "better", "count"])
    for key in results["selections"]:
        for method, row in results["tables"][key].items():
            for metric, entry in row.items():
                table.writerow([key, method, "", *_csv_cells(results, metric, entry)])
        for row in results["differences"][key]:
            table.writerow([key, row["method"], row["than"], *_csv_cells(results, row["metric"], row)])
    return text.getvalue()


def _csv_cells(results: Results, metric: str, entry: Mapping[str, Any]) -> list[Any]:
    unit = results["metrics"][metric]["unit"]
    return [metric, unit, entry["mean"], entry["low"], entry["high"], entry.get("better", ""), entry["count"]]
