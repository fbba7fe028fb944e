"""Published scores of other methods (published.toml), as rows and as Markdown. They are never mixed with measured scores.

for row in read_published():
    print(row.method, row.scores["real20"]["psnr"], row.protocol)
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final, TypeVar, final

_FILE: Final = Path(__file__).with_name("published.toml")
_HEADING: Final = "Published by others, not measured here; protocols differ"
_METRICS: Final = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS", "lpips_region": "regional LPIPS"}

_Name = TypeVar("_Name")


@final
@dataclass(frozen=True)
class PublishedScores:
    """The scores of a method as one source printed them.

    `scores` is set -> metric -> value: PSNR in dB, SSIM and LPIPS without a unit; str(value) has the printed digits.
    `protocol` describes the pictures, their number and size, and what is unknown.
    """

    method: str
    source: str
    copied_from: str
    protocol: str
    scores: dict[str, dict[str, float]]


class _PrintedNumber(float):
    """A number that keeps its printed digits: 26.60, not 26.6."""

    def __new__(cls, printed: str) -> _PrintedNumber:
        figure = super().__new__(cls, printed)
        figure._printed = printed
        return figure

    _printed: str

    def __str__(self) -> str:
        return self._printed


def read_published() -> list[PublishedScores]:
    """The rows of published.toml, in file order."""
    tables = tomllib.loads(_FILE.read_text("utf-8"), parse_float=_PrintedNumber)["table"]
    return [
        PublishedScores(method, table["source"], table["copied_from"], table["protocol"].strip(), scores)
        for table in tables
        for method, scores in table["rows"].items()
    ]


def to_markdown(published: Sequence[PublishedScores]) -> str:
    """A Markdown section with one table per protocol, below the protocol and its sources.

    Only consecutive rows of one protocol share a table.
    """
    groups = groupby(published, key=lambda row: row.protocol)
    parts = [_table(protocol, list(rows)) for protocol, rows in groups]
    return "\n\n".join([f"## {_HEADING}", *parts]) + "\n"


def _table(protocol: str, rows: list[PublishedScores]) -> str:
    sets = _names(name for row in rows for name in row.scores)
    metrics = _names(metric for row in rows for scores in row.scores.values() for metric in scores)
    said = " / ".join(_METRICS.get(metric, metric) for metric in metrics)
    lines = [
        f"**Protocol.** {protocol}",
        "",
        *_sources(rows),
        "",
        _line([f"published: {said}", *sets]),
        _line(["---"] * (1 + len(sets))),
        *(_line([row.method, *(_cell(row, name, metrics) for name in sets)]) for row in rows),
    ]
    return "\n".join(lines)


def _sources(rows: list[PublishedScores]) -> list[str]:
    places = _names((row.source, row.copied_from) for row in rows)
    methods = {
        place: [row.method for row in rows if (row.source, row.copied_from) == place] for place in places
    }
    return [f"- {', '.join(methods[place])}: {place[0]}; read in {place[1]}" for place in places]


def _cell(row: PublishedScores, name: str, metrics: list[str]) -> str:
    scores = row.scores.get(name)
    return " / ".join(str(scores.get(metric, "-")) for metric in metrics) if scores else "-"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _names(names: Iterable[_Name]) -> list[_Name]:
    """The distinct names, in the order of their first occurrence."""
    return list(dict.fromkeys(names))
