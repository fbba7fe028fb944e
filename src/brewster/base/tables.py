"""Tables as text, for reports of evaluations and user studies. A table is a list of rows, with the
header first.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

_LATEX_ESCAPES: Final = str.maketrans(
    {letter: f"\\{letter}" for letter in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}
)


def markdown_table(rows: Iterable[Iterable[str]]) -> str:
    """Returns a table in Markdown, with aligned columns."""
    header, *body = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *body, strict=True)]
    lines = [header, [":" + "-" * max(2, width - 1) for width in widths], *body]
    return "\n".join(
        f"| {' | '.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))} |"
        for line in lines
    )


def plain_table(
    rows: Iterable[Iterable[str]], *, align: str = "<", width: int | None = None
) -> str:
    """Returns a table for a terminal. `align` is "<" (left) or ">" (right), for all columns after
    the first. Columns that do not fit into `width` are continued below, each time after the first
    column.
    """
    first, *columns = zip(*rows, strict=True)
    blocks = [[first]]
    used = max(map(len, first))
    for column in columns:
        needed = 2 + max(map(len, column))
        if width is not None and used + needed > width and len(blocks[-1]) > 1:
            blocks.append([first])
            used = max(map(len, first))
        blocks[-1].append(column)
        used += needed
    return "\n".join(line for block in blocks for line in _lines(block, align))


def _lines(columns: Sequence[Sequence[str]], align: str) -> Iterator[str]:
    widths = [max(map(len, column)) for column in columns]
    for first, *cells in zip(*columns, strict=True):
        aligned = (f"{cell:{align}{width}}" for cell, width in zip(cells, widths[1:], strict=True))
        yield "  ".join([first.ljust(widths[0]), *aligned]).rstrip()


def csv_table(rows: Iterable[Iterable[object]]) -> str:
    """Returns a table as CSV; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def latex_table(columns: str, *sections: Sequence[Sequence[str]]) -> str:
    """Returns a table for the LaTeX package booktabs, with a rule between sections of rows. Cells
    are LaTeX; `columns` is the column specification, such as "l|cc".
    """
    blocks = [
        "\n".join(f"{' & '.join(row)} \\\\" for row in section) for section in sections if section
    ]
    lines = [
        f"\\begin{{tabular}}{{{columns}}}",
        "\\toprule",
        "\n\\midrule\n".join(blocks),
        "\\bottomrule",
    ]
    return "\n".join([*lines, "\\end{tabular}", ""])


def escape_latex(text: str) -> str:
    """Returns the text with LaTeX's special characters escaped."""
    return text.translate(_LATEX_ESCAPES)
