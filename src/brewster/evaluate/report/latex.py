"""Results as a LaTeX table in the layout of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from brewster.evaluate.report.tables import MAIN_METRICS, is_complete, ranking
from brewster.evaluate.results import AVERAGE, Results

_SIR2: Final = ("postcard", "solidobject", "wildscene")
_MARKS: Final = ("\\textbf", "\\underline", "\\uuline")
"""The paper's marks of the first, second and third place."""
_DAGGER: Final = "$^\\dagger$"
_ESCAPES: Final = str.maketrans(
    {letter: f"\\{letter}" for letter in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}
)


def to_latex(results: Results) -> str:
    """One row per method, three metrics per set, SIR2's subsets under one heading, the average last.

    The best three values of a column are marked as in the paper, but never the last one. A dagger marks means over fewer
    pictures than those of other methods. The table needs the packages multirow and ulem.
    """
    metrics = [name for name in MAIN_METRICS if name in results["metrics"]]
    keys = _of_the_paper(results)
    if not metrics or not keys:
        return "% PSNR, SSIM and LPIPS were not measured\n"
    columns = "|".join("c" * len(metrics) for _ in keys)
    titles = [_title(results, name) for name in metrics]
    rows = [
        _line([_escape(method), *(cell for key in keys for cell in _cells(results, key, method, metrics))])
        for method in results["methods"]
    ]
    note = f"{_DAGGER} over fewer pictures than others; do not compare"
    is_noted = any(_DAGGER in row for row in rows)
    return "\n".join([
        "% brewster evaluate; needs \\usepackage{multirow} and \\usepackage[normalem]{ulem}",
        f"\\begin{{tabular}}{{l|{columns}}}",
        "\\hline",
        *_heads(results, keys, len(metrics)),
        "\\hline",
        _line(["", *(titles * len(keys))]),
        "\\hline",
        *rows,
        "\\hline",
        *([_line([f"\\multicolumn{{{1 + len(metrics) * len(keys)}}}{{l}}{{{note}}}"])] if is_noted else []),
        "\\end{tabular}",
        "",
    ])  # fmt: skip


def _of_the_paper(results: Results) -> list[str]:
    """The selections of the table: a benchmark's draw instead of the whole, SIR2's subsets side by side, the average last."""
    keys = [
        key for key in results["selections"] if f"{key}:paper" not in results["selections"] and key != AVERAGE
    ]
    keys.sort(key=lambda key: _SIR2.index(name) if (name := key.partition(":")[0]) in _SIR2 else -1)
    return [*keys, *([AVERAGE] if AVERAGE in results["selections"] else [])]


def _heads(results: Results, keys: Sequence[str], width: int) -> list[str]:
    """The header rows with the names of the sets. SIR2's subsets get a common heading."""
    sir2 = [key for key in keys if key.partition(":")[0] in _SIR2]

    def head(key: str, rows: int) -> str:
        selection = results["selections"][key]
        name = selection["title"].partition(",")[0].removeprefix("SIR2 ")
        text = f"{_escape(name)} ({selection['pictures']})"
        return _over(width, _tall(text) if rows > 1 else text, is_last=key == keys[-1])

    if len(sir2) < 2:
        return [_line(["Method", *(head(key, 1) for key in keys)])]
    pictures = sum(results["selections"][key]["pictures"] for key in sir2)
    above, below = [_tall("Method")], [""]
    for key in keys:
        if key == sir2[0]:
            above.append(
                _over(width * len(sir2), f"SIR$^2$ ({pictures})", is_last=keys[-len(sir2) :] == sir2)
            )
        elif key not in sir2:
            above.append(head(key, 2))
        below.append(head(key, 1) if key in sir2 else _over(width, "", is_last=key == keys[-1]))
    first = 2 + width * keys.index(sir2[0])
    return [_line(above), f"\\cline{{{first}-{first + width * len(sir2) - 1}}}", _line(below)]


def _line(cells: Iterable[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _tall(text: str) -> str:
    return f"\\multirow{{2}}{{*}}{{{text}}}"


def _over(columns: int, text: str, *, is_last: bool) -> str:
    return f"\\multicolumn{{{columns}}}{{{'c' if is_last else 'c|'}}}{{{text}}}"


def _title(results: Results, metric: str) -> str:
    about = results["metrics"][metric]
    return f"{about['title']}$\\{'uparrow' if about['higher_is_better'] else 'downarrow'}$"


def _cells(results: Results, key: str, method: str, metrics: Iterable[str]) -> Iterator[str]:
    """The means, with one more digit in the average, as in the paper."""
    table = results["tables"][key]
    for metric in metrics:
        about: dict[str, Any] = results["metrics"][metric]
        about = about | {"digits": about["digits"] + (key == AVERAGE)}
        if metric not in table[method]:
            yield "--"
            continue
        text = f"{table[method][metric]['mean']:.{about['digits']}f}"
        if not is_complete(table, method, metric):
            yield f"{text}{_DAGGER}"
            continue
        marks = dict(zip(ranking(table, metric, about)[:-1], _MARKS, strict=False))
        yield f"{marks[text]}{{{text}}}" if text in marks else text


def _escape(text: str) -> str:
    """The text with LaTeX's special characters escaped."""
    return text.translate(_ESCAPES)
