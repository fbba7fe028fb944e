"""What others have published, kept apart from what is measured here: published.toml as rows and as Markdown.

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
    """A method's figures as one source printed them.

    `scores` is set -> metric -> value: PSNR in dB, SSIM and LPIPS without a unit. A value prints as it was printed.
    `protocol` says in words which pictures, how many and at what size, and what is unknown of that.
    """

    method: str
    source: str
    read_in: str
    protocol: str
    scores: dict[str, dict[str, float]]


class _PrintedNumber(float):
    """A number that remembers how it was printed: 26.60 is not 26.6."""

    def __new__(cls, printed: str) -> _PrintedNumber:
        figure = super().__new__(cls, printed)
        figure._printed = printed
        return figure

    _printed: str

    def __str__(self) -> str:
        return self._printed


def read_published() -> list[PublishedScores]:
    """Every row of published.toml, in its order."""
    tables = tomllib.loads(_FILE.read_text("utf-8"), parse_float=_PrintedNumber)["table"]
    return [
        PublishedScores(method, table["source"], table["read_in"], table["protocol"].strip(), scores)
        for table in tables
        for method, scores in table["rows"].items()
    ]


def to_markdown(published: Sequence[PublishedScores]) -> str:
    """A section of Markdown: a table for each protocol, which stands above it with its sources.

    Rows of one protocol belong together only if they follow each other.
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
    places = _names((row.source, row.read_in) for row in rows)
    methods = {place: [row.method for row in rows if (row.source, row.read_in) == place] for place in places}
    return [f"- {', '.join(methods[place])}: {place[0]}; read in {place[1]}" for place in places]


def _cell(row: PublishedScores, name: str, metrics: list[str]) -> str:
    scores = row.scores.get(name)
    return " / ".join(str(scores.get(metric, "-")) for metric in metrics) if scores else "-"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _names(names: Iterable[_Name]) -> list[_Name]:
    """Each once, in the order of their first mention."""
    return list(dict.fromkeys(names))
