"""The report of a batch: a CSV table with a row for each photo."""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Final, final

from brewster.batch.plan import FileResult
from brewster.files import write_atomically

COLUMNS: Final[dict[str, Callable[[FileResult], object]]] = {
    "path": lambda result: result.source,
    "verdict": lambda result: result.assessment and result.assessment.verdict,
    "removed_light": lambda result: result.assessment and result.assessment.removed_light,
    "changed_area": lambda result: result.assessment and result.assessment.changed_area,
    "seconds": lambda result: sum(result.seconds.values()) if result.seconds else None,
    "status": lambda result: result.status,
    "note": lambda result: result.note,
    "error": lambda result: result.error,
}
"""Name of a column -> the function that returns its value for a result."""


@final
class CsvReport:
    """A CSV table with a row for each photo of a run. `close` writes it, also after an error."""

    def __init__(self, path: Path) -> None:
        self._path, self._text = path, io.StringIO(newline="")
        self._rows = csv.writer(self._text, lineterminator="\n")
        self._rows.writerow(COLUMNS)

    def append(self, result: FileResult) -> None:
        """Adds the row of a result."""
        values = (value(result) for value in COLUMNS.values())
        self._rows.writerow(f"{v:.4f}" if isinstance(v, float) else v for v in values)

    def close(self) -> None:
        """Writes the table. An earlier report is replaced. Raises OutputError."""
        # File names that are not UTF-8 are written as escapes
        text = self._text.getvalue().encode(errors="backslashreplace")
        write_atomically(self._path, text, overwrite=True)


def is_report(path: Path) -> bool:
    """Returns whether a file is a report of an earlier run, by its first line."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return file.readline().strip() == ",".join(COLUMNS)
    except OSError:
        return False
