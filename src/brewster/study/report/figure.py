"""The results as one plot: a bar for each dataset and pair of methods, win, tie and lose side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, Final

_COLOURS: Final = {"win": "#1f6f8b", "tie": "#d9d9d4", "lose": "#d98243"}
_INSIDE: Final = {"win": "white", "tie": "#333333", "lose": "#222222"}
_INKS: Final = {"win": "#1f6f8b", "tie": "#666666", "lose": "#a8561b"}
_NARROW: Final = 0.06
"""A share too narrow for its number."""
_SHOWN: Final = ("/average",)


def plot(results: Mapping[str, Any]) -> bytes:
    """A PNG of the group that the rule keeps, or of everyone where it keeps nobody."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (an extra, and slow to wake)

    tables = results["kept"]["tables"] or results["everyone"]["tables"]
    shown = [_shown(results, table) for table in tables]
    heights = [len(rows) + 0.9 for rows in shown]
    figure = Figure(figsize=(7.2, 0.36 * sum(heights) + 0.3), layout="constrained")
    axes = figure.subplots(len(tables), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for table, rows, axis in zip(tables, shown, axes, strict=True):
        _bars(axis, table, rows)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=160, metadata={"Software": None})
    return data.getvalue()


def _shown(results: Mapping[str, Any], table: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The datasets, where there are several, and the average."""
    datasets = results["study"]["datasets"]
    keys = [*(datasets if len(datasets) > 1 else ()), *_SHOWN]
    return [row for row in table["rows"] if row["key"] in keys and row["win"]["mean"] is not None]


def _bars(axis: Any, table: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:  # noqa: ANN401  (matplotlib)
    labels = [row["title"] for row in rows]
    starts = [0.0] * len(rows)
    for name, colour in _COLOURS.items():
        widths = [row[name]["mean"] for row in rows]
        axis.barh(labels, widths, left=starts, color=colour, height=0.72, edgecolor="white", linewidth=0.8)
        for i, (start, width) in enumerate(zip(starts, widths, strict=True)):
            if width >= _NARROW:
                axis.text(
                    start + width / 2,
                    i,
                    f"{100 * width:.0f} %",
                    color=_INSIDE[name],
                    ha="center",
                    va="center",
                    fontsize=8,
                )
        starts = [start + width for start, width in zip(starts, widths, strict=True)]
    axis.invert_yaxis()
    axis.set(xlim=(0, 1), xticks=[])
    axis.tick_params(left=False, labelsize=9)
    axis.spines[:].set_visible(False)
    heads = (
        (0.0, "left", f"{table['first']} better", _INKS["win"]),
        (0.5, "center", "similar", _INKS["tie"]),
        (1.0, "right", f"{table['second']} better", _INKS["lose"]),
    )
    for place, side, text, colour in heads:
        axis.text(
            place, 1.02, text, transform=axis.transAxes, ha=side, color=colour, fontsize=9, weight="bold"
        )
