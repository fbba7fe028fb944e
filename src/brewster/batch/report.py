"""The report of a batch: a CSV table with a row for each photo."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, final

from brewster.base.files import write_atomically
from brewster.batch.task import FileResult

COLUMNS: Final = {
    "path": ("source",),
    "verdict": ("assessment", "verdict"),
    "removed_light": ("assessment", "removed_light"),
    "changed_area": ("assessment", "changed_area"),
    "seconds": ("seconds",),
    "status": ("status",),
    "note": ("note",),
    "error": ("error",),
}
"""Name of a column -> where its value is in a line of `--json`. The seconds are their sum."""


@final
class CsvReport:
    """A CSV table with a row for each photo of a run. `close` writes it, also after an error.

    A photo that is skipped because its layers exist keeps the row of an earlier report."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows = list[list[object]]([[*COLUMNS]])
        text = path.read_text("utf-8", "replace") if is_report(path) else ""
        earlier = csv.DictReader(io.StringIO(text, newline=""))
        self._earlier = {
            row["path"]: list(row.values()) for row in earlier if row["status"] == "separated"
        }

    def append(self, result: FileResult) -> None:
        """Adds the row of a result."""
        values = result.as_dict()
        values["seconds"] = sum(result.seconds.values()) if result.seconds else None
        row = [_cell(values, names) for names in COLUMNS.values()]
        self._rows.append(
            self._earlier.get(str(result.source), row) if result.status == "skipped" else row
        )

    def close(self) -> None:
        """Writes the table. An earlier report is replaced. Raises OutputError."""
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows(self._rows)
        # File names that are not UTF-8 are written as escapes
        write_atomically(
            self._path, text.getvalue().encode(errors="backslashreplace"), overwrite=True
        )


def _cell(values: Any, names: Sequence[str]) -> object:  # noqa: ANN401  (JSON)
    """Returns the value of these names in nested dictionaries; floats with four decimals."""
    for name in names:
        values = values and values[name]
    return f"{values:.4f}" if isinstance(values, float) else values


def is_report(path: Path) -> bool:
    """Returns whether a file is a report of an earlier run, by its first line."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return file.readline().strip() == ",".join(COLUMNS)
    except OSError:
        return False
