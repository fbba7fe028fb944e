"""Reads published scores of other methods from published.toml. Reports show them in a section of their own."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final, final

from brewster.tables import markdown_table

_PUBLISHED_FILE: Final = Path(__file__).with_name("published.toml")
_HEADING: Final = "Published scores of other methods (not measured here; the protocols differ)"
_METRICS: Final = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS", "lpips_region": "regional LPIPS"}


@final
@dataclass(frozen=True)
class PublishedScores:
    """The scores of a method as a paper printed them. `source` is the paper, `copied_from` the table that the numbers
    were copied from. `protocol` describes the images, and says what is unknown. `scores` is benchmark -> metric -> the
    printed number: PSNR in dB, SSIM and LPIPS without a unit."""

    method: str
    source: str
    copied_from: str
    protocol: str
    scores: dict[str, dict[str, str]]


def read_published() -> list[PublishedScores]:
    """Returns the rows of published.toml, in the order of the file."""
    tables = tomllib.loads(_PUBLISHED_FILE.read_text("utf-8"), parse_float=str)["table"]
    return [
        PublishedScores(method, table["source"], table["copied_from"], table["protocol"].strip(), scores)
        for table in tables
        for method, scores in table["rows"].items()
    ]


def to_markdown(published: Sequence[PublishedScores]) -> str:
    """Returns a Markdown section with one table per protocol. The protocol and the sources are above the table.
    Consecutive rows with the same protocol are in one table."""
    parts = [_table(protocol, list(rows)) for protocol, rows in groupby(published, lambda row: row.protocol)]
    return "\n\n".join([f"## {_HEADING}", *parts]) + "\n"


def _table(protocol: str, rows: list[PublishedScores]) -> str:
    benchmarks = dict.fromkeys(name for row in rows for name in row.scores)
    metrics = dict.fromkeys(metric for row in rows for scores in row.scores.values() for metric in scores)
    methods: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        methods.setdefault((row.source, row.copied_from), []).append(row.method)
    sources = [
        f"- {', '.join(names)}: {where[0]}; copied from {where[1]}" for where, names in methods.items()
    ]
    titles = " / ".join(_METRICS.get(metric, metric) for metric in metrics)
    table = [[f"published: {titles}", *benchmarks]]
    for row in rows:
        cells = (row.scores.get(name, {}) for name in benchmarks)
        table.append([row.method, *(" / ".join(c.get(m, "-") for m in metrics) if c else "-" for c in cells)])
    return "\n".join([f"**Protocol.** {protocol}", "", *sources, "", markdown_table(table)])
