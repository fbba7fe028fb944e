"""Results as LaTeX, in the layout of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from brewster.evaluate.report.tables import MAIN, is_complete, ranking
from brewster.evaluate.results import AVERAGE, Results
from brewster.latex import escaped

_SIR2: Final = ("postcard", "solidobject", "wildscene")
_MARKS: Final = ("\\textbf", "\\underline", "\\uuline")
"""How the paper marks the first, the second and the third."""
_DAGGER: Final = "$^\\dagger$"


def to_latex(results: Results) -> str:
    """The layout of the paper's Table 1: a row a method, three metrics a set, SIR2 under one head, the average last.

    The best three are marked as there, but never the last of a column; a dagger marks means over fewer pictures than
    others have. Needs the packages multirow and ulem.
    """
    metrics = [name for name in MAIN if name in results["metrics"]]
    keys = _of_the_paper(results)
    if not metrics or not keys:
        return "% none of PSNR, SSIM and LPIPS was measured\n"
    columns = "|".join("c" * len(metrics) for _ in keys)
    titles = [_title(results, name) for name in metrics]
    rows = [
        _line([escaped(method), *(cell for key in keys for cell in _cells(results, key, method, metrics))])
        for method in results["methods"]
    ]
    note = f"{_DAGGER} over fewer pictures than others, and not to be compared with them"
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
    """The selections that the table has: of a benchmark the paper's draw rather than all, SIR2 together, average last."""
    keys = [
        key for key in results["selections"] if f"{key}:paper" not in results["selections"] and key != AVERAGE
    ]
    keys.sort(key=lambda key: _SIR2.index(name) if (name := key.partition(":")[0]) in _SIR2 else -1)
    return [*keys, *([AVERAGE] if AVERAGE in results["selections"] else [])]


def _heads(results: Results, keys: Sequence[str], width: int) -> list[str]:
    """The names of the sets, SIR2's below a common one."""
    sir2 = [key for key in keys if key.partition(":")[0] in _SIR2]

    def head(key: str, rows: int) -> str:
        selection = results["selections"][key]
        name = selection["title"].partition(",")[0].removeprefix("SIR2 ")
        text = f"{escaped(name)} ({selection['pictures']})"
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
    """Means, with one digit more in the average, as in the paper."""
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
