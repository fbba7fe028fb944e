"""The results as one plot: a bar for each dataset and pair of methods, win, tie and lose side by side."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Final

_COLOURS: Final = {"win": "#1f6f8b", "tie": "#d9d9d4", "lose": "#d98243"}
_INSIDE: Final = {"win": "white", "tie": "#333333", "lose": "#222222"}
_INKS: Final = {"win": "#1f6f8b", "tie": "#666666", "lose": "#a8561b"}
_NARROW: Final = 0.06
"""A share too narrow for its number."""
_SHOWN: Final = ("/average",)
_EVERYONE: Final = "Everyone: the rule leaves nobody"


def plot(results: Mapping[str, Any]) -> bytes:
    """A PNG of the group that the rule keeps, or of everyone where it keeps nobody, which it says then."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (an extra, and slow to wake)

    kept = results["included"]["tables"]
    tables = kept or results["everyone"]["tables"]
    shown = [_shown(results, table) for table in tables]
    heights = [len(rows) + 0.9 for rows in shown]
    height = 0.36 * sum(heights) + (0.3 if kept else 0.7)
    figure = Figure(figsize=(7.2, height), layout="constrained")
    axes = figure.subplots(len(tables), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for table, rows, axis in zip(tables, shown, axes, strict=True):
        _bars(axis, table, rows)
    if not kept:
        figure.suptitle(_EVERYONE, fontsize=9, color="#a8561b")
    data = io.BytesIO()
    with warnings.catch_warnings():  # a letter that the font does not have is a box; the tables have the name
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure.savefig(data, format="png", dpi=160, metadata={"Software": None})
    return data.getvalue()


def _shown(results: Mapping[str, Any], table: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The datasets, where there are several, and the average."""
    datasets = results["study"]["datasets"]
    keys = [*(datasets if len(datasets) > 1 else ()), *_SHOWN]
    return [row for row in table["rows"] if row["key"] in keys and row["win"]["mean"] is not None]


def _bars(axis: Any, table: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:  # noqa: ANN401  (matplotlib)
    places = range(len(rows))  # not the titles: of two that are alike, matplotlib would make one
    starts = [0.0] * len(rows)
    for name, colour in _COLOURS.items():
        widths = [row[name]["mean"] for row in rows]
        axis.barh(places, widths, left=starts, color=colour, height=0.72, edgecolor="white", linewidth=0.8)
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
    axis.set_yticks(places, [row["title"] for row in rows], parse_math=False)
    axis.tick_params(left=False, labelsize=9)
    axis.spines[:].set_visible(False)
    heads = (
        (0.0, "left", f"{table['first']} better", _INKS["win"]),
        (0.5, "center", "similar", _INKS["tie"]),
        (1.0, "right", f"{table['second']} better", _INKS["lose"]),
    )
    for place, side, text, colour in heads:
        axis.text(
            place,
            1.02,
            text,
            transform=axis.transAxes,
            ha=side,
            color=colour,
            fontsize=9,
            weight="bold",
            parse_math=False,
        )
