"""Writes the HTML report: one self-contained page with all scores, the images and their error maps.

The Jinja2 template page.html has the whole page, which is readable without JavaScript; page.js
sorts it and compares images. Cases are written one at a time, so that memory does not grow with
their number.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from brewster.base.files import atomic_path
from brewster.errors import counted
from brewster.evaluation.methods import BASELINE
from brewster.evaluation.report.images import COLOUR_MAP, MAX_ERROR, MAX_SIDE_PX, CaseThumbnails
from brewster.evaluation.report.tables import is_complete, notes, ranking

Results = Mapping[str, Any]

_FOLDER: Final = Path(__file__).parent


def write_report(results: Results, cases: Iterable[CaseThumbnails], path: Path) -> None:
    """Writes the page atomically and replaces an older one. Equal arguments give equal bytes.
    `results` is the content of results.json. The cases are read one at a time. Raises OutputError
    if the file cannot be written.
    """
    import jinja2  # noqa: PLC0415 - an extra

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"has": _has, "number": _number, "count": counted, "verdict": _verdict}
    entries = {(entry["benchmark"], entry["name"]): entry for entry in results["cases"]}

    def best_mean(table: Mapping[str, Any], method: str, key: str) -> str | None:
        """Returns the best printed mean of a column, if the mean of this method may be compared
        with it.
        """
        metric = results["metrics"][key]
        best = (
            next(iter(ranking(table, key, metric)), None)
            if is_complete(table, method, key)
            else None
        )
        return best and best.replace("-", "\u2212")

    rows = [row for table in results["tables"].values() for row in table.values()]
    parts = environment.get_template("page.html").generate(
        results=results,
        baseline=BASELINE,
        methods=[BASELINE, *(name for name in results["methods"] if name != BASELINE)],
        metrics={
            key: row
            for key, row in results["metrics"].items()
            if any(line.get(key) for line in rows)
        },
        notes=notes(results),
        failed=any(image["errors"] for image in results["cases"]),
        best_mean=best_mean,
        to_baseline=_differences(results, is_baseline=True),
        between_methods=_differences(results, is_baseline=False),
        cases=((case, entries[case.benchmark, case.name]) for case in cases),
        colours=COLOUR_MAP.tolist(),
        max_error=MAX_ERROR,
        max_side_px=MAX_SIDE_PX,
        script=(_FOLDER / "page.js").read_text("utf-8"),
    )
    with (
        atomic_path(path) as part,
        part.open("x", encoding="utf-8", errors="replace", newline="\n") as file,
    ):
        file.writelines(parts)


def _differences(results: Results, *, is_baseline: bool) -> dict[str, dict[str, dict[str, Any]]]:
    """Returns selection -> row title -> metric -> difference: from the baseline, or between two
    other methods.
    """
    tables: dict[str, dict[str, dict[str, Any]]] = {}
    for name, differences in results["differences"].items():
        for row in differences:
            if (row["reference"] == BASELINE) == is_baseline:
                pair = row["method"] if is_baseline else f"{row['method']} minus {row['reference']}"
                tables.setdefault(name, {}).setdefault(pair, {})[row["metric"]] = row
    return tables


def _has(rows: Iterable[Mapping[str, float | None]], metric: str) -> bool:
    """Returns whether a row has a score."""
    return any(row.get(metric) is not None for row in rows)


def _number(value: float | None, metric: Mapping[str, Any], sign: str = "") -> str:
    # A value that is missing in the results is Undefined in the template, which is false like None.
    if not isinstance(value, int | float):
        return "\u2013"
    return f"{value:{sign}.{metric['digits']}f}".replace("-", "\u2212")


def _verdict(row: Mapping[str, Any], metric: Mapping[str, Any]) -> str:
    if row["low"] is None or row["low"] <= 0 <= row["high"]:
        return "inconclusive"
    return "better" if (row["mean"] > 0) == metric["higher_is_better"] else "worse"
