"""Results as tables: Markdown to read, LaTeX in the layout of the paper's Table 1, CSV to go on with."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from typing import Any, Final

from brewster.evaluate.results import AVERAGE, Results
from brewster.latex import escaped

_MAIN: Final = ("psnr", "ssim", "lpips")
_SIR2: Final = ("postcard", "solidobject", "wildscene")
_ARROWS: Final = {True: "↑", False: "↓"}
_MINUS: Final = "\N{MINUS SIGN}"


# --- Markdown


def to_markdown(results: Results) -> str:
    """All tables: an overview, one for each benchmark with intervals and differences, what was left out, the choices."""
    parts = [
        _overview(results),
        *(_details(results, key) for key in results["selections"]),
        _told(results),
        _choices(results),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def overview(results: Results) -> str:
    """The tables alone, as a terminal shows them."""
    return (
        "\n\n".join([_overview(results), *(_details(results, key) for key in results["selections"])]) + "\n"
    )


def _overview(results: Results) -> str:
    """A row a method, a column a selection, the main metrics in each cell."""
    metrics = [name for name in _MAIN if name in results["metrics"]]
    if not metrics:
        return ""
    titles = " / ".join(_heading(results, name) for name in metrics)
    rows = [["", *(f"{part['title']} ({part['pictures']})" for part in results["selections"].values())]]
    rows += [
        [method, *(_cell(results, key, method, metrics) for key in results["selections"])]
        for method in results["methods"]
    ]
    return f"{titles}\n\n{_grid(rows)}"


def _cell(results: Results, key: str, method: str, metrics: Iterable[str]) -> str:
    row, pictures = results["tables"][key][method], results["selections"][key]["pictures"]
    text = " / ".join(_number(results, name, row[name]["mean"]) if name in row else "-" for name in metrics)
    counts = sorted({row[name]["count"] if name in row else 0 for name in metrics})
    return text if counts == [pictures] else f"{text} ({' to '.join(map(str, counts))} of {pictures})"


def _details(results: Results, key: str) -> str:
    """A selection: a row a metric; means with intervals, then differences to doing nothing and between the others."""
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
            [_heading(results, metric), *means, *(_apart(results, metric, found.get(pair)) for pair in pairs)]
        )
    return f"### {selection['title']} ({selection['pictures']} pictures)\n\n{_grid(rows)}"


def _mean(results: Results, metric: str, entry: Mapping[str, Any] | None, pictures: int) -> str:
    if entry is None:
        return "-"
    some = f", {entry['count']} of {pictures}" if entry["count"] != pictures else ""
    return f"{_number(results, metric, entry['mean'])}{_interval(results, metric, entry)}{some}"


def _apart(results: Results, metric: str, row: Mapping[str, Any] | None) -> str:
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


def _told(results: Results) -> str:
    """What should be said aloud: remarks, files left out, failures."""
    lines = [
        f"- {part['title']}: {text}"
        for part in results["benchmarks"].values()
        for text in (*part["remarks"], *(f"left out: {reason}" for reason in part["refused"]))
    ]
    lines += [
        f"- {method}: {text}" for method, about in results["methods"].items() if (text := about.get("remark"))
    ]
    lines += [f"- {name}: no picture has the truth that it needs" for name in results["unmeasured"]]
    lines += [f"- {error}" for error in failures(results)]
    return "\n".join(["### Said aloud", "", *lines]) if lines else ""


def failures(results: Results) -> list[str]:
    """What methods failed on, each said once."""
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


# --- LaTeX


def to_latex(results: Results) -> str:
    """The layout of the paper's Table 1: a row a method, three metrics a set, SIR2 under one head, the best in bold.

    A dagger marks means over fewer pictures than others have. Needs the packages booktabs and multirow.
    """
    metrics = [name for name in _MAIN if name in results["metrics"]]
    keys = _of_the_paper(results)
    if not metrics or not keys:
        return "% none of PSNR, SSIM and LPIPS was measured\n"
    columns = "|".join("c" * len(metrics) for _ in keys)
    marks = [_latex_heading(results, name) for name in metrics]
    rows = [
        " & ".join(
            [
                escaped(method),
                *(cell for key in keys for cell in _latex_cells(results, key, method, metrics)),
            ]
        )
        for method in results["methods"]
    ]
    return "\n".join([
        "% brewster evaluate; needs \\usepackage{booktabs,multirow}",
        f"\\begin{{tabular}}{{l|{columns}}}",
        "\\toprule",
        *_latex_heads(results, keys, len(metrics)),
        " & ".join(["", *(marks * len(keys))]) + r" \\",
        "\\midrule",
        *(f"{row} \\\\" for row in rows),
        "\\bottomrule",
        "\\end{tabular}",
        "",
    ])  # fmt: skip


def _of_the_paper(results: Results) -> list[str]:
    """The selections that the table has: of a benchmark the paper's draw rather than all, SIR2 together, average last."""
    keys = [
        key for key in results["selections"] if f"{key}:paper" not in results["selections"] and key != AVERAGE
    ]
    keys.sort(key=lambda key: _SIR2.index(name) if (name := key.partition(":")[0]) in _SIR2 else -1)
    return [*keys, *([AVERAGE] if AVERAGE in results["selections"] else [])]


def _latex_heads(results: Results, keys: list[str], width: int) -> list[str]:
    """The names of the sets, SIR2's below a common one."""
    sir2 = [key for key in keys if key.partition(":")[0] in _SIR2]

    def head(key: str, rows: int) -> str:
        selection = results["selections"][key]
        text = (
            f"{escaped(selection['title'].partition(',')[0].removeprefix('SIR2 '))} ({selection['pictures']})"
        )
        return _spanning(width, f"\\multirow{{{rows}}}{{*}}{{{text}}}" if rows > 1 else text)

    if len(sir2) < 2:
        return [" & ".join(["Method", *(head(key, 1) for key in keys)]) + r" \\"]
    pictures = sum(results["selections"][key]["pictures"] for key in sir2)
    above, below = ["\\multirow{2}{*}{Method}"], [""]
    for key in keys:
        if key == sir2[0]:
            above.append(_spanning(width * len(sir2), f"SIR$^2$ ({pictures})"))
        elif key not in sir2:
            above.append(head(key, 2))
        below.append(head(key, 1) if key in sir2 else _spanning(width, ""))
    first = 2 + width * keys.index(sir2[0])
    return [
        " & ".join(above) + r" \\",
        f"\\cmidrule(lr){{{first}-{first + width * len(sir2) - 1}}}",
        " & ".join(below) + r" \\",
    ]


def _spanning(columns: int, text: str) -> str:
    return f"\\multicolumn{{{columns}}}{{c}}{{{text}}}"


def _latex_heading(results: Results, metric: str) -> str:
    entry = results["metrics"][metric]
    arrow = "uparrow" if entry["higher_is_better"] else "downarrow"
    return f"{entry['title']}$\\{arrow}$"


def _latex_cells(results: Results, key: str, method: str, metrics: Iterable[str]) -> list[str]:
    """Means, the best in bold; a dagger where a method is judged on fewer pictures than others."""
    table, cells = results["tables"][key], []
    for metric in metrics:
        if metric not in table[method]:
            cells.append("--")
            continue
        text = _number(results, metric, table[method][metric]["mean"])
        if not is_complete(table, method, metric):
            cells.append(f"{text}$^\\dagger$")
        else:
            is_best = text == best_mean(table, metric, results["metrics"][metric])
            cells.append(f"\\textbf{{{text}}}" if is_best else text)
    return cells


def best_mean(table: Mapping[str, Any], metric: str, about: Mapping[str, Any]) -> str | None:
    """The best mean as it is printed, so that what prints alike is marked alike; None where nothing is compared.

    A method that was judged on fewer pictures than others, since it failed on some, is not in the running.
    """
    means = [row[metric]["mean"] for method, row in table.items() if is_complete(table, method, metric)]
    if len(means) < 2:
        return None
    return f"{(max if about['higher_is_better'] else min)(means):.{about['digits']}f}"


def is_complete(table: Mapping[str, Any], method: str, metric: str) -> bool:
    """Whether a method is judged on as many pictures in this metric as any other."""
    counts = {name: row[metric]["count"] for name, row in table.items() if row.get(metric)}
    return counts.get(method) == max(counts.values(), default=0)


# --- CSV


def to_csv(results: Results) -> str:
    """A line for each set, method and metric, and for each difference (`than` names the other method)."""
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
