"""The file scores.jsonl: one line for each scored prediction, from which a stopped run is resumed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final, final

from brewster.errors import OutputError

SCORES_FILE: Final = "scores.jsonl"
SCORE_FORMAT_VERSION: Final = 5
"""Increase this version when the scores of a prediction or the fields of `ScoreRow` change. Rows of other versions are
scored again. test_conventions_formats checks the scores."""

RowId = tuple[str, str, str]


@final
@dataclass(frozen=True)
class ScoreRow:
    """The scores of one method on one case, or the error; a line of scores.jsonl has these fields.

    `score_key` and `prediction_key` are digests of all inputs of the scores and of the prediction, which are reused if
    it is unchanged. `columns` were computed; those that are not in `scores` do not apply to the case. `registration`
    says how a prediction of a folder is flipped or shifted. `digest` is the SHA-256 of the files of the prediction, if
    it has files."""

    benchmark: str
    case: str
    method: str
    prediction_key: str
    score_key: str
    scores: dict[str, float | None] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    error: str | None = None
    seconds: float | None = None
    digest: str | None = None
    width: int = 0
    height: int = 0
    region_share: float = 0.0
    registration: str = ""

    @property
    def id(self) -> RowId:
        """(benchmark, case, method)."""
        return self.benchmark, self.case, self.method


def append_row(path: Path, row: ScoreRow) -> None:
    """Appends a line to scores.jsonl, which the first call creates. Raises OutputError if the file cannot be
    written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - 1))
            # a killed run can leave an incomplete line, which must not swallow this one
            newline = b"" if file.read(1) in (b"", b"\n") else b"\n"
            file.write(newline + json.dumps(asdict(row)).encode() + b"\n")
    except OSError as error:
        raise OutputError(
            f"{path} was not written ({error.strerror or error})",
            "expected a writable output folder",
            "free disk space or choose another folder with -o, and run again (scores that were saved are not computed again)",
        ) from error


def read_score_rows(path: Path) -> dict[RowId, ScoreRow]:
    """Returns the last row for each id. Skips rows with errors, incomplete lines and lines with other fields. A row may
    be outdated: the caller compares its `score_key`."""
    rows = {}
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
        try:
            values = json.loads(line)
            row = ScoreRow(**(values | {"columns": tuple(values["columns"])}))
        except (ValueError, TypeError, LookupError):
            continue
        if not row.error:
            rows[row.id] = row
    return rows
