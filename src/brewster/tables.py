"""Tables as text, for the reports of evaluations and of user studies. A table is a list of rows of cells, with the header first."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
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


def plain_table(rows: Iterable[Iterable[str]], *, align: str = "<") -> str:
    """Returns a table for a terminal. `align` is "<" (left) or ">" (right), for all columns after the first."""
    rows = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(
            f"{cell:{align if i else '<'}{width}}"
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def csv_table(rows: Iterable[Iterable[object]]) -> str:
    """Returns a table as CSV; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def escape_latex(text: str) -> str:
    """Returns the text with LaTeX's special characters escaped."""
    return text.translate(_LATEX_ESCAPES)
