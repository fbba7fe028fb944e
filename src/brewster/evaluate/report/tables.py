"""Results as tables in Markdown and CSV."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from brewster.errors import counted
from brewster.evaluate.results import Results
from brewster.tables import csv_table, markdown_table, plain_table

_MAIN_METRICS: Final = ("psnr", "ssim", "lpips")

_ARROWS: Final = {True: "↑", False: "↓"}
_UNEQUAL_COUNTS_NOTE: Final = "\n\nDo not compare a mean over fewer images with the other means. Differences use the images that both methods have."
_MINUS: Final = "\N{MINUS SIGN}"


def main_metrics(results: Results) -> list[str]:
    """Returns the metrics of the overview: PSNR, SSIM and LPIPS if the results have all three, else the first three metrics."""
    names = list(results["metrics"])
    return list(_MAIN_METRICS) if set(_MAIN_METRICS) <= set(names) else names[:3]


# --- Markdown


def to_markdown(results: Results) -> str:
    """Returns all tables as Markdown: an overview, a table per benchmark with intervals and differences, notes, settings."""
    notes = []
    for entry in results["benchmarks"].values():
        notes += [f"{entry['title']}: {remark}" for remark in entry["remarks"]]
        notes += [f"{entry['title']}: excluded: {reason}" for reason in entry["excluded"]]
    notes += remarks(results)
    notes += [f"not computed: {metrics}" for metrics in unavailable_metrics(results)]
    unmeasured = "is not scored: no image has the ground truth that it needs"
    notes += [f"{name} {unmeasured}" for name in results["unmeasured"]]
    notes += failures(results)
    metrics = (f"{entry['title']}: {entry['definition']}" for entry in results["metrics"].values())
    text = tables_to_markdown(results)
    for title, lines in (
        ("Notes", notes),
        ("Settings and definitions", [*results["protocol"]["choices"], *metrics]),
    ):
        if lines:
            text += "\n".join([f"\n### {title}\n", *(f"- {line}" for line in lines)]) + "\n"
    return text


def tables_to_markdown(results: Results) -> str:
    """Returns the tables as Markdown without notes and settings, for model cards."""
    details = [_details(results, key) for key in results["selections"]]
    return "\n\n".join([part for part in (_overview(results), *details) if part]) + "\n"


def to_terminal(results: Results, width: int = 100, *, intervals: bool = False) -> str:
    """Returns the means for a terminal with `width` columns: a table per selection, with one row per method. A table
    that is too wide is continued below, and long names of methods are shortened. With `intervals`, each mean has its
    95 % interval."""
    parts = [
        f"{selection['title']} ({counted(selection['cases'], 'image')})\n{_terminal_table(results, key, width, intervals)}"
        for key, selection in results["selections"].items()
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _terminal_table(results: Results, key: str, width: int, intervals: bool) -> str:
    table = results["tables"][key]
    # "…" replaces the middle of longer names, because names often differ at the end
    kept = max(12, width // 3) - 1
    names = [
        name if len(name) <= kept + 1 else f"{name[: kept - kept // 2]}…{name[-(kept // 2) :]}"
        for name in results["methods"]
    ]
    columns = []
    for metric in results["metrics"]:
        if any(metric in row for row in table.values()):
            means = _means(results, metric, key, intervals=intervals)
            counted = [f"{mean} ({count})" if count else mean for mean, count in means]
            columns.append([_heading(results, metric), *counted])
    blocks, used = list[list[list[str]]](), width
    for column in columns:
        column_width = 2 + max(map(len, column))
        if used + column_width > width:
            blocks.append([["", *names]])
            used = max(map(len, names))
        blocks[-1].append(column)
        used += column_width
    return "\n".join(plain_table(zip(*block, strict=True), align=">") for block in blocks)


def _overview(results: Results) -> str:
    """Returns a table with one row per method and one column per selection. Each cell has the main metrics."""
    metrics = main_metrics(results)
    if not metrics:
        return ""
    titles = " / ".join(_heading(results, name) for name in metrics)
    selections = results["selections"]
    rows = [["", *(f"{selection['title']} ({selection['cases']})" for selection in selections.values())]]
    rows += [
        [method, *(_cell(results, key, method, metrics) for key in selections)]
        for method in results["methods"]
    ]
    tables = results["tables"].values()
    is_fair = all(
        is_complete(table, method, metric)
        for table in tables
        for method, row in table.items()
        for metric in set(metrics) & set(row)
    )
    return f"{titles}\n\n{markdown_table(rows)}{'' if is_fair else _UNEQUAL_COUNTS_NOTE}"


def _cell(results: Results, key: str, method: str, metrics: Iterable[str]) -> str:
    row, image_count = results["tables"][key][method], results["selections"][key]["cases"]
    text = " / ".join(_number(results, name, row[name]["mean"]) if name in row else "-" for name in metrics)
    counts = {row[name]["count"] if name in row else 0 for name in metrics}
    if counts == {image_count}:
        return text
    least, most = min(counts), max(counts)
    return f"{text} ({least if least == most else f'{least} to {most}'} of {image_count})"


def _details(results: Results, key: str) -> str:
    """Returns the table of a selection: one row per metric, with the means of the methods and their differences."""
    selection, table = results["selections"][key], results["tables"][key]
    methods, differences = list(results["methods"]), results["differences"][key]
    pairs = list(dict.fromkeys((row["method"], row["reference"]) for row in differences))
    rows = [["", *methods, *(f"{method} {_MINUS} {than}" for method, than in pairs)]]
    for metric in results["metrics"]:
        if not any(metric in table[method] for method in methods):
            continue
        by_pair = {(row["method"], row["reference"]): row for row in differences if row["metric"] == metric}
        cells = _means(results, metric, key, intervals=True)
        means = [f"{mean}, {count}" if count else mean for mean, count in cells]
        changes = [_difference_cell(results, metric, by_pair.get(pair)) for pair in pairs]
        rows.append([_heading(results, metric), *means, *changes])
    return f"### {selection['title']} ({counted(selection['cases'], 'image')})\n\n{markdown_table(rows)}"


def _means(results: Results, metric: str, key: str, *, intervals: bool) -> Iterator[tuple[str, str]]:
    """Yields the text of the mean of each method, and that of the number of images, which is empty if it is the usual one."""
    image_count = results["selections"][key]["cases"]
    for method in results["methods"]:
        if entry := results["tables"][key][method].get(metric):
            count = f"{entry['count']} of {image_count}" if entry["count"] != image_count else ""
            interval = _interval(results, metric, entry) if intervals else ""
            yield f"{_number(results, metric, entry['mean'])}{interval}", count
        else:
            yield "-", ""


def _difference_cell(results: Results, metric: str, row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    mean = _number(results, metric, row["mean"], sign="+")
    interval = _interval(results, metric, row, sign="+")
    return f"{mean}{interval}, better on {row['improved_count']} of {row['count']}"


def _interval(results: Results, metric: str, entry: Mapping[str, Any], *, sign: str = "") -> str:
    if entry["low"] is None:
        return ""
    low, high = (_number(results, metric, entry[end], sign=sign) for end in ("low", "high"))
    return f" ({low} to {high})"


def remarks(results: Mapping[str, Any]) -> list[str]:
    """Returns the remarks on methods."""
    return [f"{name}: {about['remark']}" for name, about in results["methods"].items() if "remark" in about]


def unavailable_metrics(results: Mapping[str, Any]) -> list[str]:
    """Returns each reason why metrics were not computed, once, after the names of these metrics."""
    names: dict[str, list[str]] = {}
    for name, reason in results["unavailable"].items():
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(metrics)}: {reason}" for reason, metrics in names.items()]


def failures(results: Results) -> list[str]:
    """Returns the errors of methods, without repetitions."""
    return list(dict.fromkeys(error for case in results["cases"] for error in case["errors"].values()))


def _heading(results: Results, metric: str) -> str:
    entry = results["metrics"][metric]
    unit = f", {entry['unit']}" if entry["unit"] else ""
    return f"{entry['title']}{unit} {_ARROWS[entry['higher_is_better']]}"


def _number(results: Results, metric: str, value: float, *, sign: str = "") -> str:
    return f"{value:{sign}.{results['metrics'][metric]['digits']}f}"


def ranking(table: Mapping[str, Any], metric: str, metric_info: Mapping[str, Any]) -> list[str]:
    """Returns the distinct means in descending order of quality, as they are printed. The list has no means of methods
    with scores on fewer images than other methods. It is empty if fewer than two methods remain."""
    means = [row[metric]["mean"] for method, row in table.items() if is_complete(table, method, metric)]
    if len(means) < 2:
        return []
    means.sort(reverse=metric_info["higher_is_better"])
    return list(dict.fromkeys(f"{mean:.{metric_info['digits']}f}" for mean in means))


def is_complete(table: Mapping[str, Any], method: str, metric: str) -> bool:
    """Returns whether no other method has this score on more images."""
    counts = {name: row[metric]["count"] for name, row in table.items() if row.get(metric)}
    return counts.get(method) == max(counts.values(), default=0)


# --- CSV


def to_csv(results: Results) -> str:
    """Returns a CSV table: one line for each mean, and one for each difference of `method` minus `reference`."""
    rows: list[list[Any]] = [["set", "method", "reference", "metric", "unit", "mean", "low", "high", "improved_count", "count"]]  # fmt: skip
    for key in results["selections"]:
        for method, row in results["tables"][key].items():
            rows += [[key, method, "", *_csv_cells(results, name, entry)] for name, entry in row.items()]
        for row in results["differences"][key]:
            rows.append([key, row["method"], row["reference"], *_csv_cells(results, row["metric"], row)])
    return csv_table(rows)


def scores_to_csv(results: Results) -> str:
    """Returns a CSV table in long form: one line for each image, method and metric with a score."""
    rows: list[list[Any]] = [["benchmark", "image", "scene", "method", "metric", "value"]]
    for image in results["cases"]:
        for method, scores in image["scores"].items():
            for name, value in scores.items():
                if value is not None:
                    rows.append([image["benchmark"], image["name"], image["scene"], method, name, value])
    return csv_table(rows)


def _csv_cells(results: Results, metric: str, entry: Mapping[str, Any]) -> list[Any]:
    unit, ends = results["metrics"][metric]["unit"], [entry[key] for key in ("mean", "low", "high")]
    return [metric, unit, *ends, entry.get("improved_count"), entry["count"]]
