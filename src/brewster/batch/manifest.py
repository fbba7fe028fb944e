"""Reads manifests: CSV or Parquet tables that list the photos of a batch in the column `path`.

    path
    1987/box-04/0017.tif
    s3://scans/1987/box-04/0018.tif

The values of a CSV table are separated by commas, semicolons or tabs, as its header shows. A
relative path is relative to the folder of the manifest, and its layers are written to the same
relative path below the output folder. The layers of an absolute path or a URL are written to this
path below the output folder, without the root or the protocol: to `OUT/scans/1987/box-04` for the
second row. The output folder of a photo therefore does not depend on the other rows.
"""

import csv
import importlib
import io
import posixpath
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, final

from brewster.base.remote_path import Location, RemotePath, location
from brewster.errors import ManifestError, MissingExtra, UnreadablePhoto, error_prefix, read_errors

COLUMN: Final = "path"
_DELIMITERS: Final = (",", ";", "\t")
SUFFIXES: Final = (".csv", ".parquet")
_EXPECTED: Final = f"expected a CSV or Parquet table with the column {COLUMN!r}"


@final
class ManifestRow(NamedTuple):
    """A row of a manifest, for messages."""

    manifest: Location
    number: int
    """For CSV, the line of the file; the header is line 1. For Parquet, the row of the table, from
    1.
    """

    def __str__(self) -> str:
        """Returns `line 3 of scans.csv` or `row 3 of scans.parquet`."""
        unit = "line" if _is_csv(self.manifest) else "row"
        return f"{unit} {self.number} of {self.manifest}"


def is_manifest(source: Location) -> bool:
    """Whether the name of the file has the suffix of a manifest."""
    return source.suffix.lower() in SUFFIXES


def read_manifest(
    manifest: Location, output_folder: Location | None = None
) -> Iterator[tuple[ManifestRow, Location, Location]]:
    """Yields each row of a manifest with its photo and the folder for its layers. Files that do not
    exist are included.

    Layers are written below `output_folder`, by default next to their photo. Raises ManifestError
    if the manifest cannot be read, is not a table, or has no rows, or if a row has no path, a
    relative path outside the folder of the manifest, or more values than the header; BrewsterError
    if a row has a URL that `location` refuses; MissingExtra if the package is not installed that a
    Parquet table (pyarrow) or a URL needs.
    """
    with read_errors(manifest, ManifestError, _EXPECTED, "check its name", (UnreadablePhoto,)):
        data = manifest.read_bytes()
    row = None
    for row, text in (
        _csv_paths(manifest, data) if _is_csv(manifest) else _parquet_paths(manifest, data)
    ):
        photo, mirrored = _photo(row, text)
        yield (
            row,
            photo,
            photo.parent if output_folder is None else output_folder.joinpath(*mirrored),
        )
    if row is None:
        happened = f"{manifest} has only the names of its columns, and no rows"
        raise ManifestError(
            happened, "expected a row for each photo", "add the paths of the photos"
        )


def _photo(row: ManifestRow, text: object) -> tuple[Location, tuple[str, ...]]:
    """Returns the photo of a row, and the parts of the folder for its layers below the output
    folder.
    """
    if not isinstance(text, str) or not text.strip():
        raise ManifestError(
            f"{row} has the path {text!r}", "expected the path of a photo", "correct the row"
        )
    with error_prefix(row):
        photo = location(text)
    normal = posixpath.normpath(photo.as_posix())
    if isinstance(photo, RemotePath) or photo.is_absolute():
        return photo, Path(normal).parent.parts[1:]
    if normal.startswith("../"):
        raise ManifestError(
            f"{row} has the path {text}, which is outside the folder of the manifest",
            "expected a relative path below this folder, an absolute path, or a URL",
            "move the manifest, or write absolute paths",
        )
    return row.manifest.parent / normal, tuple(normal.split("/")[:-1])


def _is_csv(manifest: Location) -> bool:
    return manifest.suffix.lower() == ".csv"


def _csv_paths(manifest: Location, data: bytes) -> Iterator[tuple[ManifestRow, object]]:
    try:
        file = io.StringIO(data.decode("utf-8-sig"), newline="")
        delimiter = _delimiter(file.readline())
        file.seek(0)
        rows = csv.DictReader(file, delimiter=delimiter, strict=True)
        _check_columns(manifest, rows.fieldnames or [])
        for values in rows:
            row = ManifestRow(manifest, rows.line_num)
            if any(values.get(None, ())):
                cure = f"write a path that contains {delimiter!r} in double quotes"
                raise ManifestError(
                    f"{row} has more values than the header",
                    "expected one value for each column",
                    cure,
                )
            yield row, values[COLUMN]
    except UnicodeDecodeError as error:
        raise _not_a_table(manifest, error, "save the file as UTF-8") from error
    except csv.Error as error:
        raise _not_a_table(manifest, error) from error


def _delimiter(header: str) -> str:
    """Returns the delimiter that splits the header of a CSV into columns with `path`, or into the
    most columns.
    """

    def split(delimiter: str) -> list[str]:
        try:
            return next(csv.reader([header], delimiter=delimiter, strict=True), [])
        except csv.Error:  # a quoted name is followed by another delimiter
            return []

    columns = {delimiter: split(delimiter) for delimiter in _DELIMITERS}
    return max(
        _DELIMITERS, key=lambda delimiter: (COLUMN in columns[delimiter], len(columns[delimiter]))
    )


def _parquet_paths(manifest: Location, data: bytes) -> Iterator[tuple[ManifestRow, object]]:
    parquet = import_parquet(str(manifest))
    try:
        table = parquet.ParquetFile(io.BytesIO(data))
        _check_columns(manifest, table.schema_arrow.names)
        batches = table.iter_batches(columns=[COLUMN])
        paths = (path for batch in batches for path in batch.column(0).to_pylist())
        yield from ((ManifestRow(manifest, number), path) for number, path in enumerate(paths, 1))
    except (OSError, ValueError) as error:  # the errors of pyarrow are subclasses
        raise _not_a_table(manifest, error) from error


def _check_columns(manifest: Location, names: list[str] | Any) -> None:  # noqa: ANN401
    if COLUMN not in names:
        found = f"the columns {', '.join(map(repr, list(names)[:8]))}" if names else "no columns"
        similar = next((name for name in names if name.strip().lower() == COLUMN), None)
        cure = (
            f"rename the column {similar!r} to {COLUMN!r}"
            if similar
            else f"name a column {COLUMN!r}"
        )
        raise ManifestError(f"{manifest} has {found}", _EXPECTED, cure)


def _not_a_table(
    manifest: Location, error: Exception, cure: str = "check the file"
) -> ManifestError:
    reason = str(error).partition("\n")[0][:120]
    return ManifestError(f"{manifest} is not a table ({reason})", _EXPECTED, cure)


def import_parquet(purpose: str) -> Any:  # noqa: ANN401  (pyarrow has no types)
    """Imports `pyarrow.parquet`. Raises MissingExtra if pyarrow is not installed."""
    try:
        return importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        expected = f"expected pyarrow, because {purpose} is a Parquet table"
        raise MissingExtra.for_extra(
            "cluster", "the package pyarrow is not installed", expected
        ) from error
