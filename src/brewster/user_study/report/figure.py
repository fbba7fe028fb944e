"""Plots the results: one stacked bar of win, tie and lose rates for each pair of methods and dataset."""

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Final

_BAR_COLOURS: Final = {"win": "#1f6f8b", "tie": "#d9d9d4", "lose": "#d98243"}
_LABEL_COLOURS: Final = {"win": "white", "tie": "#333333", "lose": "#222222"}
_HEADING_COLOURS: Final = {"win": "#1f6f8b", "tie": "#666666", "lose": "#a8561b"}
_MIN_LABELLED_RATE: Final = 0.06
"""Smaller rates get no label, because a label does not fit into so short a bar."""


def plot(results: Mapping[str, Any]) -> bytes:
    """Plots the results after the exclusion rule, or of all participants if it excludes everyone, as a PNG file."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (an optional dependency, and slow to import)

    included = results["included"]["tables"]
    tables = included or results["everyone"]["tables"]
    rows_of_tables = [_plotted_rows(results, table) for table in tables]
    heights = [len(rows) + 0.9 for rows in rows_of_tables]
    height = 0.36 * sum(heights) + (0.3 if included else 0.7)
    figure = Figure(figsize=(7.2, height), layout="constrained")
    axes = figure.subplots(len(tables), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for table, rows, ax in zip(tables, rows_of_tables, axes, strict=True):
        _bars(ax, table, rows)
    if not included:
        title = "All participants: the rule excludes everyone"
        figure.suptitle(title, fontsize=9, color="#a8561b")
    data = io.BytesIO()
    with warnings.catch_warnings():  # a missing glyph is drawn as a box; the tables have the full name
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure.savefig(data, format="png", dpi=160, metadata={"Software": None})
    return data.getvalue()


def _plotted_rows(results: Mapping[str, Any], table: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Returns the rows to plot: those with answers of the datasets, if there are several, and of the average."""
    datasets = results["study"]["datasets"]
    keys = [*(datasets if len(datasets) > 1 else ()), "/average"]
    return [row for row in table["rows"] if row["key"] in keys and row["win"]["mean"] is not None]


def _bars(ax: Any, table: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:  # noqa: ANN401  (matplotlib)
    positions = range(len(rows))  # matplotlib merges bars with equal titles
    starts = [0.0] * len(rows)
    for name, colour in _BAR_COLOURS.items():
        widths = [row[name]["mean"] for row in rows]
        ax.barh(positions, widths, left=starts, color=colour, height=0.72, edgecolor="white", linewidth=0.8)
        for i, (start, width) in enumerate(zip(starts, widths, strict=True)):
            if width >= _MIN_LABELLED_RATE:
                style = {"color": _LABEL_COLOURS[name], "ha": "center", "va": "center", "fontsize": 8}
                ax.text(start + width / 2, i, f"{100 * width:.0f} %", **style)
        starts = [start + width for start, width in zip(starts, widths, strict=True)]
    ax.invert_yaxis()
    ax.set(xlim=(0, 1), xticks=[])
    ax.set_yticks(positions, [row["title"] for row in rows], parse_math=False)
    ax.tick_params(left=False, labelsize=9)
    ax.spines[:].set_visible(False)
    headings = (
        (0.0, "left", f"{table['first']} better", _HEADING_COLOURS["win"]),
        (0.5, "center", "similar", _HEADING_COLOURS["tie"]),
        (1.0, "right", f"{table['second']} better", _HEADING_COLOURS["lose"]),
    )
    for x, alignment, text, colour in headings:
        style = {"ha": alignment, "color": colour, "fontsize": 9, "weight": "bold", "parse_math": False}
        ax.text(x, 1.02, text, transform=ax.transAxes, **style)
