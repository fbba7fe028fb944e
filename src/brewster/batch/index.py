"""The index of an archive: a Parquet table with a row for each photo, index.parquet; and a CSV report of a run.

About every 30 seconds, rows are written to small tables in the folder .brewster-index. At the end of the run, they are
merged into index.parquet, together with the rows of earlier runs. A killed run loses the rows after its last one."""

import contextlib
import csv
import importlib
import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, final

from brewster.batch.manifest import import_parquet
from brewster.batch.plan import FileResult
from brewster.errors import OutputError
from brewster.files import exists, write_atomically
from brewster.remote_path import Location

INDEX_FILE: Final = "index.parquet"
PARTS_FOLDER: Final = ".brewster-index"
MAX_PART_ROWS: Final = 5000
_PART_INTERVAL_S: Final = 30.0

COLUMNS: Final[dict[str, tuple[str, Callable[[FileResult], object]]]] = {
    "path": ("string", lambda result: result.source),
    "photo_sha256": ("string", lambda result: result.photo_sha256),
    "status": ("string", lambda result: result.status),
    "verdict": ("string", lambda result: result.assessment and result.assessment.verdict),
    "confidence": ("float64", lambda result: result.assessment and result.assessment.confidence),
    "removed_light": ("float64", lambda result: result.assessment and result.assessment.removed_light),
    "changed_area": ("float64", lambda result: result.assessment and result.assessment.changed_area),
    "residual": ("float64", lambda result: result.residual),
    "seconds": ("float64", lambda result: sum(result.seconds.values()) if result.seconds else None),
    "model_sha256": ("string", lambda result: result.model_sha256),
    "outputs": ("strings", lambda result: list(result.outputs.values())),
    "note": ("string", lambda result: result.note),
    "error": ("string", lambda result: result.error),
}
"""Name of a column -> its type, and the function that returns its value for a result."""

REPORT_COLUMNS: Final = (
    "path", "verdict", "removed_light", "changed_area", "seconds", "status", "note", "error",
)  # fmt: skip


@final
class IndexWriter:
    """Writes the index of an output folder. `close` merges all rows into index.parquet. Raises OutputError if the
    folder cannot be written to, or has another index.parquet, and MissingExtra without pyarrow."""

    def __init__(self, folder: Location) -> None:
        self._index, self._parts_folder = folder / INDEX_FILE, folder / PARTS_FOLDER
        self._parquet, self._arrow = import_parquet(str(self._index)), importlib.import_module("pyarrow")
        self._run, self._part_count = f"{time.time_ns():020d}", 0
        self._rows: list[FileResult] = []
        if exists(self._index):
            self._read(self._index)
        self._write_part()  # empty: without write access, this raises an error before the first photo

    def append(self, result: FileResult) -> None:
        """Adds the row of a result, and writes a part if it is time. If this fails, the next part has these rows."""
        self._rows.append(result)
        is_due = time.monotonic() > self._written_at + _PART_INTERVAL_S
        if is_due or len(self._rows) % MAX_PART_ROWS == 0:
            with contextlib.suppress(OutputError):  # if the error persists, `close` raises it
                self._write_part()

    def close(self) -> None:
        """Merges the parts of this run and of killed runs into index.parquet, and deletes them. Raises OutputError if
        the index cannot be written (the next run then merges the parts), and UnreadablePhoto if they cannot be read."""
        self._write_part()
        parts = sorted(path for path in self._parts_folder.iterdir() if path.suffix == ".parquet")
        if not parts:
            raise OutputError(
                f"the folder {self._parts_folder} is empty",
                "expected the rows of this run",
                "run the same command again: finished files are kept, and no other program may change this folder",
            )
        tables = [self._read(path) for path in [*([self._index] if exists(self._index) else []), *parts]]
        table = self._arrow.concat_tables(tables, promote_options="default").select(list(COLUMNS))
        # the last row of each path; for a photo that was separated and later skipped, that of the run that separated it
        last: dict[str, int] = {}
        statuses = table.column("status").to_pylist()
        for row, path in enumerate(table.column("path").to_pylist()):
            if not (statuses[row] == "skipped" and path in last and statuses[last[path]] == "separated"):
                last[path] = row
        last_rows = table.take(self._arrow.array(list(last.values()), "int64"))
        self._write(self._index, last_rows.sort_by("path"))
        for part in parts:
            part.unlink()
        with contextlib.suppress(OSError):  # the folder contains parts of another run
            self._parts_folder.rmdir()

    def _write_part(self) -> None:
        self._written_at = time.monotonic()
        arrow, columns = self._arrow, {}
        for name, (kind, value) in COLUMNS.items():
            type_ = arrow.list_(arrow.string()) if kind == "strings" else getattr(arrow, kind)()
            columns[name] = arrow.array([_as_unicode(value(row)) for row in self._rows], type_)
        name = f"{self._run}-{self._part_count:06d}.parquet"
        self._write(self._parts_folder / name, arrow.table(columns))
        self._part_count += 1
        self._rows.clear()

    def _write(self, path: Location, table: Any) -> None:  # noqa: ANN401
        buffer = io.BytesIO()
        self._parquet.write_table(table, buffer)
        write_atomically(path, buffer.getvalue(), overwrite=True)

    def _read(self, path: Location) -> Any:  # noqa: ANN401
        try:
            table = self._parquet.read_table(io.BytesIO(path.read_bytes()))
            # An index of an earlier version may have fewer columns.
            others = COLUMNS.keys() & {*table.column_names} - {"path", "status"}
            return table.select(["path", "status", *others])
        except (OSError, ValueError, KeyError) as error:  # the errors of pyarrow are subclasses
            raise OutputError(
                f"{path} is not an index ({str(error).partition(chr(10))[0]})",
                "expected no such file, or the index of an earlier run",
                "move it to another folder, or choose another output folder",
            ) from error


@final
class CsvReport:
    """A CSV table with a row for each photo of a run. `close` writes it, also after an error."""

    def __init__(self, path: Path) -> None:
        self._path, self._text = path, io.StringIO(newline="")
        self._rows = csv.writer(self._text, lineterminator="\n")
        self._rows.writerow(REPORT_COLUMNS)

    def append(self, result: FileResult) -> None:
        """Adds the row of a result."""
        values = (COLUMNS[name][1](result) for name in REPORT_COLUMNS)
        self._rows.writerow(f"{v:.4f}" if isinstance(v, float) else _as_unicode(v) for v in values)

    def close(self) -> None:
        """Writes the table. An earlier report is replaced. Raises OutputError."""
        write_atomically(self._path, self._text.getvalue().encode(), overwrite=True)


def is_report(path: Path) -> bool:
    """Returns whether a file is a report of an earlier run, by its first line."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return file.readline().strip() == ",".join(REPORT_COLUMNS)
    except OSError:
        return False


def _as_unicode(value: object) -> object:
    """Returns a value whose text can be stored: bytes of file names that are not UTF-8 are written as escapes."""
    if isinstance(value, list):
        return [_as_unicode(item) for item in value]
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value
