"""Results as tables: for a terminal, in Markdown, in LaTeX in the layout of the paper's Table 1,
and as CSV.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from brewster.base.tables import csv_table, escape_latex, latex_table, markdown_table, plain_table
from brewster.errors import counted
from brewster.evaluation.results import Results

_MAIN_METRICS: Final = ("psnr", "ssim", "lpips")
_ARROWS: Final = {True: "↑", False: "↓"}
_UNEQUAL_COUNTS_NOTE: Final = (
    "\n\nDo not compare a mean over fewer images with the others. "
    "Differences use the images of both methods."
)
_MINUS: Final = "\N{MINUS SIGN}"
_MARKS: Final = ("\\textbf", "\\underline", "\\uuline")
"""The paper's marks for the best, the second and the third value of a column."""
_DAGGER: Final = "$^\\dagger$"
_DAGGER_NOTE: Final = f"{_DAGGER} mean over fewer images than in the other rows; do not compare"


def main_metrics(results: Results) -> list[str]:
    """Returns the metrics of the overview: PSNR, SSIM and LPIPS if the results have all three, else
    the first three.
    """
    names = list(results["metrics"])
    return list(_MAIN_METRICS) if set(_MAIN_METRICS) <= set(names) else names[:3]


def to_markdown(results: Results) -> str:
    """Returns all tables as Markdown: an overview, one per benchmark with intervals and
    differences, notes.
    """
    metrics = (f"{entry['title']}: {entry['definition']}" for entry in results["metrics"].values())
    text = tables_to_markdown(results)
    settings = "Settings and definitions", [*results["protocol"]["choices"], *metrics]
    for title, lines in (*notes(results), settings):
        if lines:
            text += "\n".join([f"\n### {title}\n", *(f"- {line}" for line in lines)]) + "\n"
    return text


def tables_to_markdown(results: Results) -> str:
    """Returns the tables as Markdown without notes and settings, for model cards."""
    parts = [_overview(results)]
    for key in results["selections"]:
        rows = [*_rows(results, key, intervals=True), *_difference_rows(results, key)]
        parts.append(f"### {_title(results, key)}\n\n{markdown_table(zip(*rows, strict=True))}")
    return "\n\n".join(filter(None, parts)) + "\n"


def to_terminal(results: Results, width: int = 100, *, intervals: bool = False) -> str:
    """Returns the means for a terminal with `width` columns: a table per selection, with one row
    per method. Wide tables are continued below, and long names of methods shortened. `intervals`
    adds the 95 % intervals.
    """
    parts = []
    for key in results["selections"]:
        header, *rows = _rows(results, key, intervals=intervals)
        shown = [header, *([_shortened(row[0], max(12, width // 3)), *row[1:]] for row in rows)]
        parts.append(f"{_title(results, key)}\n{plain_table(shown, align='>', width=width)}")
    return "\n\n".join(parts) + "\n"


def _title(results: Results, key: str) -> str:
    selection = results["selections"][key]
    return f"{selection['title']} ({counted(selection['cases'], 'image')})"


def _shortened(name: str, length: int) -> str:
    """Replaces the middle of a longer name by "…", because names often differ at the end."""
    half = (length - 1) // 2
    return name if len(name) <= length else f"{name[: length - 1 - half]}…{name[-half:]}"


def _metrics_of(results: Results, key: str) -> list[str]:
    return [
        name
        for name in results["metrics"]
        if any(name in r for r in results["tables"][key].values())
    ]


def _rows(results: Results, key: str, *, intervals: bool) -> list[list[str]]:
    """Returns the means of a selection: a header, and a row for each method with a cell for each
    metric.
    """
    metrics = _metrics_of(results, key)
    image_count = results["selections"][key]["cases"]

    def cell(metric: str, entry: Mapping[str, Any] | None) -> str:
        if entry is None:
            return "-"
        count = "" if entry["count"] == image_count else f", {entry['count']} of {image_count}"
        interval = _interval(results, metric, entry) if intervals else ""
        return f"{_number(results, metric, entry['mean'])}{interval}{count}"

    rows = [["", *(_heading(results, metric) for metric in metrics)]]
    for method in results["methods"]:
        row = results["tables"][key][method]
        rows.append([method, *(cell(metric, row.get(metric)) for metric in metrics)])
    return rows


def _difference_rows(results: Results, key: str) -> Iterator[list[str]]:
    pairs: dict[tuple[str, str], dict[str, Any]] = {}
    for row in results["differences"][key]:
        pairs.setdefault((row["method"], row["reference"]), {})[row["metric"]] = row
    for (method, reference), changes in pairs.items():
        cells = (
            _difference_cell(results, name, changes.get(name)) for name in _metrics_of(results, key)
        )
        yield [f"{method} {_MINUS} {reference}", *cells]


def _overview(results: Results) -> str:
    """Returns a table with one row per method and one column per selection. Each cell has the main
    metrics.
    """
    metrics = main_metrics(results)
    if not metrics:
        return ""
    titles = " / ".join(_heading(results, name) for name in metrics)
    selections = results["selections"]
    rows = [
        ["", *(f"{selection['title']} ({selection['cases']})" for selection in selections.values())]
    ]
    rows += [
        [method, *(_cell(results, key, method, metrics) for key in selections)]
        for method in results["methods"]
    ]
    is_noted = any(cell.endswith(")") for _, *cells in rows[1:] for cell in cells)
    return f"{titles}\n\n{markdown_table(rows)}{_UNEQUAL_COUNTS_NOTE if is_noted else ''}"


def _cell(results: Results, key: str, method: str, metrics: Iterable[str]) -> str:
    row = results["tables"][key][method]
    image_count = results["selections"][key]["cases"]
    text = " / ".join(
        _number(results, name, row[name]["mean"]) if name in row else "-" for name in metrics
    )
    counts = {row[name]["count"] if name in row else 0 for name in metrics}
    if counts == {image_count}:
        return text
    least = min(counts)
    most = max(counts)
    return f"{text} ({least if least == most else f'{least} to {most}'} of {image_count})"


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


def notes(results: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Returns lists with their titles: errors, missing metrics, excluded files and remarks."""
    images = results["cases"]
    benchmarks = results["benchmarks"].values()
    counts = Counter(name for case in images for name in case["errors"])
    total = counted(len(images), "image")
    failed = ", ".join(f"{method} on {count} of {total}" for method, count in counts.items())
    excluded, all_remarks = (
        [f"{benchmark['title']}: {text}" for benchmark in benchmarks for text in benchmark[kind]]
        for kind in ("excluded", "remarks")
    )
    all_remarks += remarks(results)
    cure = (
        "Metrics that were not computed. Correct the cause, then run the evaluation again to "
        "add them."
    )
    return [
        (f"Failed: {failed}", failures(results)),
        (cure, unavailable_metrics(results)),
        (f"{counted(len(excluded), 'file')} excluded", excluded),
        (counted(len(all_remarks), "remark"), all_remarks),
    ]


def remarks(results: Mapping[str, Any]) -> list[str]:
    """Returns the remarks on methods, and the metrics without scores."""
    found = [
        f"{name}: {about['remark']}"
        for name, about in results["methods"].items()
        if "remark" in about
    ]
    unmeasured = "was not computed: no image has the ground truth that it needs"
    return [*found, *(f"{name} {unmeasured}" for name in results["unmeasured"])]


def unavailable_metrics(results: Mapping[str, Any]) -> list[str]:
    """Returns each reason why metrics were not computed, once, after the names of these metrics."""
    names: dict[str, list[str]] = {}
    for name, reason in results["unavailable"].items():
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(metrics)}: {reason}" for reason, metrics in names.items()]


def failures(results: Mapping[str, Any]) -> list[str]:
    """Returns the errors of methods, without repetitions."""
    return list(
        dict.fromkeys(error for case in results["cases"] for error in case["errors"].values())
    )


def _heading(results: Results, metric: str) -> str:
    entry = results["metrics"][metric]
    unit = f", {entry['unit']}" if entry["unit"] else ""
    return f"{entry['title']}{unit} {_ARROWS[entry['higher_is_better']]}"


def _number(results: Results, metric: str, value: float, *, sign: str = "") -> str:
    return f"{value:{sign}.{results['metrics'][metric]['digits']}f}"


def ranking(table: Mapping[str, Any], metric: str, metric_info: Mapping[str, Any]) -> list[str]:
    """Returns the distinct means in descending order of quality, as they are printed. The list has
    no means of methods with scores on fewer images than other methods. It is empty if fewer than
    two methods remain.
    """
    means = [
        row[metric]["mean"] for method, row in table.items() if is_complete(table, method, metric)
    ]
    if len(means) < 2:
        return []
    means.sort(reverse=metric_info["higher_is_better"])
    return list(dict.fromkeys(f"{mean:.{metric_info['digits']}f}" for mean in means))


def is_complete(table: Mapping[str, Any], method: str, metric: str) -> bool:
    """Returns whether no other method has this score on more images."""
    counts = {name: row[metric]["count"] for name, row in table.items() if row.get(metric)}
    return counts.get(method) == max(counts.values(), default=0)


def to_latex(results: Results, *, intervals: bool = False) -> str:
    """Returns a table with one row per method and up to three metrics per benchmark. Subsets of the
    paper replace their benchmark. The best three values of a column, but not the worst, are marked.
    A dagger marks a mean over fewer images. With `intervals`, each mean has its 95 % interval. The
    first line names the LaTeX packages.
    """
    metrics = main_metrics(results)
    selections = results["selections"]
    keys = [key for key in selections if f"{key}:paper" not in selections]
    if not metrics or not keys:
        return "% there are no scores\n"
    header = ["Method"]
    for key in keys:
        name = (
            f"{escape_latex(selections[key]['title'].partition(',')[0])} "
            f"({selections[key]['cases']})"
        )
        header.append(
            f"\\multicolumn{{{len(metrics)}}}{{{'c' if key == keys[-1] else 'c|'}}}{{{name}}}"
        )
    arrows = {True: "$\\uparrow$", False: "$\\downarrow$"}
    titles = [
        row["title"] + arrows[row["higher_is_better"]]
        for row in map(results["metrics"].get, metrics)
    ]
    rows = [
        [
            escape_latex(method),
            *(cell for key in keys for cell in _cells(results, key, method, metrics, intervals)),
        ]
        for method in results["methods"]
    ]
    is_noted = any(_DAGGER in cell for row in rows for cell in row)
    note = [[f"\\multicolumn{{{len(rows[0])}}}{{l}}{{{_DAGGER_NOTE}}}"]] if is_noted else []
    columns = "l|" + "|".join("c" * len(metrics) for _ in keys)
    table = latex_table(columns, [header, ["", *(titles * len(keys))]], rows, note)
    packages = "\\usepackage{booktabs} and \\usepackage[normalem]{ulem}"
    return f"% brewster evaluate; needs {packages}\n{table}"


def _cells(
    results: Results, key: str, method: str, metrics: Iterable[str], intervals: bool
) -> Iterator[str]:
    table = results["tables"][key]
    for metric in metrics:
        about = results["metrics"][metric]
        entry = table[method].get(metric)
        if entry is None:
            yield "--"
            continue
        text = _number(results, metric, entry["mean"])
        marks = dict(zip(ranking(table, metric, about)[:-1], _MARKS, strict=False))
        if not is_complete(table, method, metric):
            text += _DAGGER
        elif text in marks:
            text = f"{marks[text]}{{{text}}}"
        interval = _interval(results, metric, entry) if intervals else ""
        yield text + (f" {{\\scriptsize{interval}}}" if interval else "")


def scores_to_csv(results: Results) -> str:
    """Returns a CSV table in long form: one line for each image, method and metric with a score."""
    rows: list[list[Any]] = [["benchmark", "image", "scene", "method", "metric", "value"]]
    for image in results["cases"]:
        for method, scores in image["scores"].items():
            for name, value in scores.items():
                if value is not None:
                    rows.append(
                        [image["benchmark"], image["name"], image["scene"], method, name, value]
                    )
    return csv_table(rows)
