"""Writes the HTML report: one self-contained page with all scores, the images and their error maps.

    write_report(json.loads(Path("results.json").read_text()), cases, Path("report.html"))

The template page.html contains the style and the controls, page.js the sorting and the viewer. This module adds the content, which is readable
without JavaScript. It writes one case at a time, so that memory does not grow with the number of cases.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from brewster.evaluate.methods import BASELINE
from brewster.evaluate.report.images import (
    COLOUR_MAP,
    MAX_ERROR,
    MAX_SIDE_PX,
    CaseThumbnails,
)
from brewster.evaluate.report.tables import is_complete, ranking, remarks, unavailable_metrics
from brewster.files import atomic_path

Results = Mapping[str, Any]

_TEMPLATE: Final = Path(__file__).with_name("page.html")
_SCRIPT: Final = Path(__file__).with_name("page.js")
_DASH: Final = "&ndash;"


def write_report(results: Results, cases: Iterable[CaseThumbnails], path: Path) -> None:
    """Writes the page atomically and replaces an older one. Equal arguments give equal bytes.

    Args:
        results: the content of results.json.
        cases: the cases to show, in this order. The function reads one at a time.
        path: the HTML file.

    Raises:
        OutputError: the file cannot be written.
    """
    with (
        atomic_path(path) as part,
        part.open("x", encoding="utf-8", errors="replace", newline="\n") as file,
    ):
        file.writelines(_page(results, cases))


def _page(results: Results, cases: Iterable[CaseThumbnails]) -> Iterator[str]:
    """Yields the template with its comments <!--part--> replaced.

    "data" follows "cases", because it needs the scores of all cases.
    """
    scores: list[Any] = []
    parts: dict[str, Iterable[str]] = {
        "results": _results(results),
        "cases": _cases(results, cases, scores),
        "data": _data(results, scores),
        "script": [_SCRIPT.read_text("utf-8")],
    }
    for i, text in enumerate(re.split(r"<!--(\w+)-->", _TEMPLATE.read_text("utf-8"))):
        if i % 2:  # `re.split` alternates between text and the names of parts
            yield from parts[text]
        else:
            yield text


def _data(results: Results, scores: list[Any]) -> Iterator[str]:
    """Yields the data for sorting, as JSON. "<" is escaped, so that a name cannot close the script element."""
    data = {
        "metrics": {
            name: {"title": metric["title"], "unit": metric["unit"], "higher": metric["higher_is_better"]}
            | {"digits": metric["digits"]}
            for name, metric in results["metrics"].items()
        },
        "methods": [*results["methods"]],
        "benchmarks": {name: benchmark["title"] for name, benchmark in results["benchmarks"].items()},
        "baseline": BASELINE,
        "scores": scores,
    }
    yield json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


# --- numbers


def _results(results: Results) -> Iterator[str]:
    images, methods = results["cases"], results["methods"]
    benchmarks, config = results["benchmarks"], results["protocol"]
    size = "original size" if config["size"] == "native" else f"shorter side of at most {config['size']} px"
    yield (
        f"<p class=lede>{_count(len(methods), 'method')} on {_count(len(images), 'image')} of "
        f"{_count(len(benchmarks), 'benchmark')}: {escape(size)}, quality "
        f"{escape(str(config['quality']))}, brewster {escape(results['brewster'])}.</p>\n"
    )
    yield from _problems(results)
    yield _means(results)
    yield _differences(results)
    yield from _method_notes(results)


def _problems(results: Results) -> Iterator[str]:
    """Yields the errors of methods, the excluded files and the remarks."""
    images, benchmarks = results["cases"], results["benchmarks"].values()
    errors = [
        (f"{image['benchmark']}/{image['name']}", *error)
        for image in images
        for error in image["errors"].items()
    ]
    counts = Counter(method for _, method, _ in errors)
    counted = ", ".join(
        f"{method} on {count} of {_count(len(images), 'image')}" for method, count in counts.items()
    )
    yield _note(f"Failed: {counted}", [f"{name}, {method}: {error}" for name, method, error in errors])
    excluded, benchmark_remarks = (
        [f"{benchmark['title']}: {text}" for benchmark in benchmarks for text in benchmark[kind]]
        for kind in ("excluded", "remarks")
    )
    all_remarks = benchmark_remarks + remarks(results)
    yield _note(
        "Metrics that were not computed. Correct the cause, then run the evaluation again to add them.",
        unavailable_metrics(results),
    )
    yield _note(_count(len(excluded), "file excluded"), excluded)
    yield _note(_count(len(all_remarks), "remark"), all_remarks)
    if not errors:
        yield "<p>No method failed on any image.</p>\n"


def _note(title: str, items: Sequence[str]) -> str:
    """Returns a collapsible list, which is open if it has at most five items; "" if there are no items."""
    if not items:
        return ""
    is_open = " open" if len(items) <= 5 else ""
    return f"<details class=note{is_open}><summary>{escape(title)}</summary>{_list(items)}</details>\n"


def _list(items: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(item)}</li>' for item in items)}</ul>"


def _count(number: int, noun: str) -> str:
    """Returns a number and its noun. The first word of the noun has the plural."""
    first, *rest = noun.split()
    return " ".join([f"{number:,}", first if number == 1 else f"{first}s", *rest])


def _scored_metrics(results: Results) -> dict[str, Any]:
    """Returns the metrics that have a value in any table."""
    rows = [row for table in results["tables"].values() for row in table.values()]
    return {name: metric for name, metric in results["metrics"].items() if any(row.get(name) for row in rows)}


def _title(results: Results, name: str) -> str:
    return str(results["selections"][name]["title"])


def _table(caption: str, metrics: Mapping[str, Any], bodies: Iterable[str]) -> str:
    columns = "".join(
        f"<th scope=col>{escape(metric['title'])} <small>{escape(metric['unit'] or '')} "
        f"{'&uarr;' if metric['higher_is_better'] else '&darr;'}</small></th>"
        for metric in metrics.values()
    )
    return (
        f"<p class=caption>{escape(caption)}</p>\n<div class=scroll tabindex=0 role=region aria-label='{escape(caption)}'>"
        f"<table>\n<thead><tr><th scope=col>Method</th>{columns}</tr></thead>\n{''.join(bodies)}</table></div>\n"
    )


def _body(title: str, metrics: Mapping[str, Any], rows: Iterable[tuple[str, Iterable[str]]]) -> str:
    rows_html = (f"<tr><th scope=row>{escape(name)}</th>{''.join(cells)}</tr>\n" for name, cells in rows)
    span = len(metrics) + 1
    return f"<tbody><tr><th scope=rowgroup colspan={span}><span>{title}</span></th></tr>\n{''.join(rows_html)}</tbody>\n"


def _means(results: Results) -> str:
    metrics = _scored_metrics(results)
    bodies = []
    for name, table in results["tables"].items():
        best = {key: next(iter(ranking(table, key, metric)), None) for key, metric in metrics.items()}
        image_count = results["selections"][name]["cases"]
        rows = (
            (
                method,
                [
                    _mean(
                        row.get(key),
                        metric,
                        best[key] if is_complete(table, method, key) else None,
                        image_count,
                    )
                    for key, metric in metrics.items()
                ],
            )
            for method, row in table.items()
        )
        count = f" <small>{_count(image_count, 'image')}</small>"
        bodies.append(_body(escape(_title(results, name)) + count, metrics, rows))
    return _table(
        "Means and their 95 % intervals. A star marks the best mean of each metric on each benchmark",
        metrics,
        bodies,
    )


def _mean(
    estimate: Mapping[str, Any] | None, metric: Mapping[str, Any], best: str | None, image_count: int
) -> str:
    if not estimate:
        return f"<td>{_DASH}</td>"
    mean, is_best = _number(estimate["mean"], metric), f"{estimate['mean']:.{metric['digits']}f}" == best
    style = " class=best" if is_best else ""
    star = "<span class=star>&starf;<span class=hidden> best </span></span>" if is_best else ""
    count = f"<small>{estimate['count']} of {image_count}</small>" if estimate["count"] != image_count else ""
    return f"<td{style}>{star}<b>{mean}</b>{_interval(estimate, metric)}{count}</td>"


def _interval(estimate: Mapping[str, Any], metric: Mapping[str, Any], sign: str = "") -> str:
    if estimate["low"] is None or estimate["high"] is None:
        return ""
    ends = [_number(estimate[end], metric, sign) for end in ("low", "high")]
    return f"<small>{ends[0]} to {ends[1]}</small>"


def _number(value: float | None, metric: Mapping[str, Any], sign: str = "") -> str:
    if value is None:
        return _DASH
    return f"{value:{sign}.{metric['digits']}f}".replace("-", "&minus;")


def _differences(results: Results) -> str:
    """Returns two tables: differences from the unprocessed input and, collapsed, differences between methods."""
    to_baseline, between = (_difference_bodies(results, is_baseline) for is_baseline in (True, False))
    legend = "Mean difference, its 95 % interval, and the number of images with a better score"
    first = (
        _table(f"Differences from the unprocessed input. {legend}", _scored_metrics(results), to_baseline)
        if to_baseline
        else ""
    )
    if not between:
        return first
    second = _table(f"Differences between methods. {legend}", _scored_metrics(results), between)
    return f"{first}<details><summary>Differences between methods</summary>{second}</details>\n"


def _difference_bodies(results: Results, is_baseline: bool) -> list[str]:
    """Returns the table bodies: differences from the baseline if `is_baseline`, else those between other methods."""
    metrics, bodies = _scored_metrics(results), []
    for name, differences in results["differences"].items():
        rows: dict[str, dict[str, Mapping[str, Any]]] = {}
        for row in differences:
            if (row["reference"] == BASELINE) == is_baseline:
                pair = row["method"] if is_baseline else f"{row['method']} minus {row['reference']}"
                rows.setdefault(pair, {})[row["metric"]] = row
        cells = (
            (pair, [_difference(row.get(key), metric) for key, metric in metrics.items()])
            for pair, row in rows.items()
        )
        if rows:
            bodies.append(_body(escape(_title(results, name)), metrics, cells))
    return bodies


def _difference(row: Mapping[str, Any] | None, metric: Mapping[str, Any]) -> str:
    if not row:
        return f"<td>{_DASH}</td>"
    is_inconclusive = row["low"] is None or row["low"] <= 0 <= row["high"]
    is_better = (row["mean"] > 0) == metric["higher_is_better"]
    verdict, mark = (
        ("inconclusive", "")
        if is_inconclusive
        else ("better", "&#9650; ")
        if is_better
        else ("worse", "&#9660; ")
    )
    return (
        f"<td class={verdict}>{mark}<span class=hidden>{verdict}: </span><b>{_number(row['mean'], metric, '+')}</b>"
        f"{_interval(row, metric, '+')}<small>{row['improved_count']} of {row['count']}</small></td>"
    )


def _method_notes(results: Results) -> Iterator[str]:
    yield f"<details><summary>Settings and definitions</summary>{_list(results['protocol']['choices'])}<dl>"
    for name, metric in results["metrics"].items():
        better = "higher is better" if metric["higher_is_better"] else "lower is better"
        yield f"<dt>{escape(metric['title'])} <code>{escape(name)}</code></dt><dd>{escape(metric['definition'])} ({better})</dd>\n"
    yield "</dl></details>\n<details><summary>Methods</summary><dl>"
    for name, method in results["methods"].items():
        facts = (f"{key} {value}" for key, value in method.items())
        yield f"<dt>{escape(name)}</dt><dd>{escape(', '.join(facts))}</dd>\n"
    yield "</dl></details>\n"


# --- images


def _cases(results: Results, cases: Iterable[CaseThumbnails], scores: list[Any]) -> Iterator[str]:
    entries = {(entry["benchmark"], entry["name"]): entry for entry in results["cases"]}
    colours = (f"<i style='background:rgb({red},{green},{blue})'></i>" for red, green, blue in COLOUR_MAP)
    yield (
        f"<p class=legend>Colours of error maps, in 8-bit levels: 0 <span>{''.join(colours)}</span> {MAX_ERROR} or more. "
        f"The longer side of embedded images has at most {MAX_SIDE_PX} px; the viewer opens the files at full size.</p>\n"
    )
    for case in cases:
        entry = entries.get((case.benchmark, case.name), {"scores": {}, "errors": {}})
        scores.append(entry["scores"])
        yield _case(results, case, entry)
    if len(scores) < len(entries):
        yield (
            f"<p>This page shows {len(scores):,} of {_count(len(entries), 'image')}: for each benchmark, first the images on "
            "which the first method after the baseline failed, then the images on which this method has its worst scores in the first metric.</p>\n"
        )


def _case(results: Results, case: CaseThumbnails, entry: Mapping[str, Any]) -> str:
    facts = [
        escape(_title(results, case.benchmark)),
        f"{case.size[0]} &times; {case.size[1]} px",
    ]
    if (share := entry.get("region_share")) is not None:
        facts.append(f"reflection region {share:.0%}")
    others = [name for name in results["methods"] if name != BASELINE]
    rows = [_row(results, entry, BASELINE, case.photo)]
    rows += [_row(results, entry, method, case.methods.get(method, "")) for method in others]
    return (
        f'<article data-benchmark="{escape(case.benchmark)}" data-name="{escape(case.name)}" '
        f'data-width="{case.size[0]}" data-height="{case.size[1]}">\n'
        f"<h3>{escape(case.name)}</h3><p>{' &middot; '.join(facts)} <span class=key></span></p>\n{''.join(rows)}</article>\n"
    )


def _row(results: Results, entry: Mapping[str, Any], method: str, thumbnails: str) -> str:
    error = entry["errors"].get(method)
    failure = f"<p class=failure>Failed: {escape(error)}</p>" if error else ""
    title = "photo, input (unprocessed)" if method == BASELINE else method
    return (
        f"<section><div><h4>{escape(title)}</h4>{failure}{_scores(results, entry['scores'], method)}</div>"
        f"<div class=thumbnails>{thumbnails}</div></section>\n"
    )


def _scores(results: Results, scores: Mapping[str, Any], method: str) -> str:
    """Returns a table with the scores of a method on one image, and their differences from the unprocessed input."""
    method_scores, baseline_scores = scores.get(method, {}), scores.get(BASELINE, {})
    lines = []
    for name, metric in results["metrics"].items():
        if all(row.get(name) is None for row in scores.values()) or method not in scores:
            continue
        value, baseline = method_scores.get(name), baseline_scores.get(name)
        has_change = method != BASELINE and value is not None and baseline is not None and value != baseline
        change = _gain(value - baseline, metric) if has_change else ""
        lines.append(
            f"<tr><th scope=row>{escape(metric['title'])}</th><td>{_number(value, metric)}</td><td>{change}</td></tr>"
        )
    return f"<table>{''.join(lines)}</table>" if lines else ""


def _gain(change: float, metric: Mapping[str, Any]) -> str:
    is_better = (change > 0) == metric["higher_is_better"]
    verdict, mark = ("better", "&#9650;") if is_better else ("worse", "&#9660;")
    return f"<span class={verdict}>{_number(change, metric, '+')} {mark}<span class=hidden>{verdict}</span></span>"
