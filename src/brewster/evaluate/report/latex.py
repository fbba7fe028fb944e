"""Results as a LaTeX table in the layout of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from brewster.evaluate.report.tables import is_complete, main_metrics, ranking
from brewster.evaluate.results import AVERAGE, Results
from brewster.tables import escape_latex

_SIR2: Final = ("postcard", "solidobject", "wildscene")
_MARKS: Final = ("\\textbf", "\\underline", "\\uuline")
"""The paper's marks for the best, the second and the third value of a column."""
_PACKAGES: Final = {
    "\\multirow": "\\usepackage{multirow}",
    "\\uuline": "\\usepackage[normalem]{ulem}",
}
_DAGGER: Final = "$^\\dagger$"


def to_latex(results: Results, *, intervals: bool = False) -> str:
    """Returns a table with one row per method and up to three metrics per benchmark. The average is the last column
    group. The best three values of a column are marked as in the paper, but the worst one is not. A dagger marks a mean
    over fewer images than those of other methods. With `intervals`, each mean has its 95 % interval. The first line
    names the LaTeX packages."""
    metrics = main_metrics(results)
    keys = _table_selections(results)
    if not metrics or not keys:
        return "% there are no scores\n"
    columns = "|".join("c" * len(metrics) for _ in keys)
    arrows = {True: "$\\uparrow$", False: "$\\downarrow$"}
    titles = [row["title"] + arrows[row["higher_is_better"]] for row in map(results["metrics"].get, metrics)]
    rows = []
    for method in results["methods"]:
        cells = [cell for key in keys for cell in _cells(results, key, method, metrics, intervals)]
        rows.append(_line([escape_latex(method), *cells]))
    note = f"{_DAGGER} mean over fewer images than in the other rows; do not compare"
    is_noted = any(_DAGGER in row for row in rows)
    lines = [
        f"\\begin{{tabular}}{{l|{columns}}}",
        "\\hline",
        *_header_rows(results, keys, len(metrics)),
        "\\hline",
        _line(["", *(titles * len(keys))]),
        "\\hline",
        *rows,
        "\\hline",
        *([_line([f"\\multicolumn{{{1 + len(metrics) * len(keys)}}}{{l}}{{{note}}}"])] if is_noted else []),
        "\\end{tabular}",
        "",
    ]
    text = "\n".join(lines)
    needed = " and ".join(package for command, package in _PACKAGES.items() if command in text)
    return f"% brewster evaluate{'; needs ' if needed else ''}{needed}\n{text}"


def _table_selections(results: Results) -> list[str]:
    """Returns the selections of the table: subsets of the paper replace their benchmark, SIR2 is adjacent, the average is last."""
    keys = [
        key for key in results["selections"] if f"{key}:paper" not in results["selections"] and key != AVERAGE
    ]
    keys.sort(key=lambda key: _SIR2.index(name) if (name := key.partition(":")[0]) in _SIR2 else -1)
    return [*keys, *([AVERAGE] if AVERAGE in results["selections"] else [])]


def _header_rows(results: Results, keys: Sequence[str], width: int) -> list[str]:
    """Returns the header rows with the names of the benchmarks. The subsets of SIR2 have a common heading."""
    sir2 = [key for key in keys if key.partition(":")[0] in _SIR2]

    def heading(key: str, rows: int) -> str:
        selection = results["selections"][key]
        name = selection["title"].partition(",")[0].removeprefix("SIR2 ")
        text = f"{escape_latex(name)} ({selection['cases']})"
        return _multicolumn(width, _multirow(text) if rows > 1 else text, is_last=key == keys[-1])

    if len(sir2) < 2:
        return [_line(["Method", *(heading(key, 1) for key in keys)])]
    image_count = sum(results["selections"][key]["cases"] for key in sir2)
    above, below = [_multirow("Method")], [""]
    for key in keys:
        if key == sir2[0]:
            title, is_last = f"SIR$^2$ ({image_count})", keys[-len(sir2) :] == sir2
            above.append(_multicolumn(width * len(sir2), title, is_last=is_last))
        elif key not in sir2:
            above.append(heading(key, 2))
        below.append(heading(key, 1) if key in sir2 else _multicolumn(width, "", is_last=key == keys[-1]))
    first = 2 + width * keys.index(sir2[0])
    return [_line(above), f"\\cline{{{first}-{first + width * len(sir2) - 1}}}", _line(below)]


def _line(cells: Iterable[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _multirow(text: str) -> str:
    return f"\\multirow{{2}}{{*}}{{{text}}}"


def _multicolumn(columns: int, text: str, *, is_last: bool) -> str:
    return f"\\multicolumn{{{columns}}}{{{'c' if is_last else 'c|'}}}{{{text}}}"


def _cells(results: Results, key: str, method: str, metrics: Iterable[str], intervals: bool) -> Iterator[str]:
    table = results["tables"][key]
    for metric in metrics:
        about, entry = results["metrics"][metric], table[method].get(metric)
        if entry is None:
            yield "--"
            continue
        text = f"{entry['mean']:.{about['digits']}f}"
        marks = dict(zip(ranking(table, metric, about)[:-1], _MARKS, strict=False))
        if not is_complete(table, method, metric):
            text += _DAGGER
        elif text in marks:
            text = f"{marks[text]}{{{text}}}"
        if intervals and entry["low"] is not None:
            ends = (f"{entry[end]:.{about['digits']}f}" for end in ("low", "high"))
            text += f" {{\\scriptsize [{', '.join(ends)}]}}"
        yield text
