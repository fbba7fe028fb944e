"""Store the answers of a study in SQLite, with a write-ahead log and a disk sync after each commit.

A participant has a number, the token of the personal link, the date of the consent and the trials;
no name and no address. The trials are drawn once, at admission, and stored, so a later version of
brewster cannot change them. A second answer to a trial is ignored: a browser repeats an answer if
the response was lost. To change their last answer, participants withdraw it first. Withdrawn
answers are kept.
"""

import json
import os
import secrets
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Annotated, Final, Literal, cast, final

from pydantic import ConfigDict, Field, TypeAdapter

from brewster.errors import BrewsterError, OutputError
from brewster.evaluation.study.assignment import Choice, Trial, draw_practice, draw_trials
from brewster.evaluation.study.study import ANSWERS_FILE, Study

MAX_SECONDS: Final = 3600.0
"""Longer times are stored as this value."""
_TIMEOUT_SECONDS: Final = 30.0
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS participants (
    number INTEGER PRIMARY KEY, token TEXT NOT NULL UNIQUE, consented_on TEXT NOT NULL, \
trials TEXT NOT NULL,
    practice TEXT NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS answers (
    participant INTEGER NOT NULL REFERENCES participants, trial INTEGER NOT NULL, \
choice TEXT NOT NULL,
    seconds REAL NOT NULL, answered_at TEXT NOT NULL, conditions TEXT NOT NULL, \
PRIMARY KEY (participant, trial)
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS withdrawn (
    participant INTEGER NOT NULL REFERENCES participants, trial INTEGER NOT NULL, \
choice TEXT NOT NULL,
    seconds REAL NOT NULL, answered_at TEXT NOT NULL, conditions TEXT NOT NULL
) STRICT;
"""
_PARTICIPANTS: Final = "SELECT number, trials, practice FROM participants"


@final
@dataclass(frozen=True)
class Participant:
    """A participant: the number, counted from 0, the trials in order of presentation, and the
    practice trial.
    """

    number: int
    trials: tuple[Trial, ...]
    practice: Trial


Px = Annotated[int, Field(ge=0, le=100_000)]


@final
@dataclass(frozen=True)
class ViewingConditions:
    """How the pictures of a trial were shown. Lengths are in CSS px. Multiply them by `pixel_ratio`
    to get screen pixels. `view` is the arrangement at the time of the answer: three pictures, the
    pair A and B, or one picture at a time. `switches` counts how often the picture was replaced by
    another one in place; `zoomed` is true if the pictures were enlarged at any time.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    viewport_width: Px
    viewport_height: Px
    pixel_ratio: Annotated[float, Field(gt=0, le=100)]
    picture_width: Px
    theme: Literal["light", "dark"]
    pointer: Literal["fine", "coarse"]
    view: Literal["all", "pair", "single"]
    switches: Annotated[int, Field(ge=0, le=100_000)]
    zoomed: bool


_CONDITIONS: Final = TypeAdapter(ViewingConditions | None)


@final
@dataclass(frozen=True)
class StoredAnswer:
    """A choice, and the seconds for which the pictures were shown before it. `answered_at` is the
    time in UTC, ISO
    8601. `withdrawn` has the choices that the participant withdrew before this one.
    """

    choice: Choice
    seconds: float
    answered_at: str = ""
    conditions: ViewingConditions | None = None
    withdrawn: tuple[Choice, ...] = ()


@final
class AnswerStore:
    """The answers of one study; safe to use from many threads and many processes at the same time.
    With `read_only`, nothing can be written, and no database file is created for a study without
    answers.
    """

    def __init__(self, study: Study, *, read_only: bool = False) -> None:
        self.study = study
        self._lock = Lock()
        with self._database_errors():
            self._database = sqlite3.connect(
                _read_only_uri(study.answers_file) if read_only else study.answers_file,
                timeout=_TIMEOUT_SECONDS,
                check_same_thread=False,
                isolation_level=None,
                uri=read_only,
            )
            if not read_only:
                self._database.execute("PRAGMA journal_mode = WAL")
                self._database.execute("PRAGMA synchronous = FULL")
            if not read_only or not study.answers_file.exists():
                self._database.executescript(_SCHEMA)

    def close(self) -> None:
        """Close the database. If no other process uses it, SQLite moves all answers from the log
        into the main file.
        """
        with self._lock:
            self._database.close()

    def count_participants(self) -> int:
        """The number of admitted participants."""
        with self._transaction() as database:
            return _count(database)

    def admit(self, *, max_participants: int | None = None) -> str | None:
        """Add a participant who has given consent. Returns the token of their link, or None for too
        many.
        """
        with self._transaction("IMMEDIATE") as database:
            if max_participants is not None and _count(database) >= max_participants:
                return None
            number = _count(database)
            token = secrets.token_urlsafe(24)
            drawn = draw_trials(self.study.description, number)
            trials = json.dumps([asdict(trial) for trial in drawn])
            practice = json.dumps(asdict(draw_practice(self.study.description, number, drawn)))
            row = number, token, datetime.now(UTC).date().isoformat(), trials, practice
            database.execute("INSERT INTO participants VALUES (?, ?, ?, ?, ?)", row)
            return token

    def participant(self, token: str) -> Participant | None:
        """The participant with this token, or None if the token is unknown."""
        with self._transaction() as database:
            row = database.execute(f"{_PARTICIPANTS} WHERE token = ?", (token,)).fetchone()
        return row and _participant(*row)

    def next_and_last_trial(self, participant: Participant) -> tuple[int | None, int | None]:
        """The index of the first trial without an answer, and that of the last trial with one, or
        None.
        """
        with self._transaction() as database:
            answered = _answered(database, participant)
        remaining = (trial for trial in range(len(participant.trials)) if trial not in answered)
        return next(remaining, None), max(answered, default=None)

    def withdraw_answer(self, participant: Participant, trial: int) -> None:
        """Withdraw the answer to the last answered trial, so that the trial can be answered again.
        The answer is kept. Nothing is changed if the trial has no answer, for example because it
        was withdrawn already. Raises BrewsterError if a later trial has an answer, and OutputError
        if the database cannot be written.
        """
        key = (participant.number, trial)
        with self._transaction("IMMEDIATE") as database:
            last = max(_answered(database, participant), default=trial)
            if last > trial:
                raise BrewsterError(
                    f"the answer to pair {trial + 1} cannot be withdrawn",
                    f"expected pair {last + 1}, because only the last answer can be withdrawn",
                    "load the page again",
                )
            database.execute(
                "INSERT INTO withdrawn SELECT * FROM answers WHERE participant = ? AND trial = ?",
                key,
            )
            database.execute("DELETE FROM answers WHERE participant = ? AND trial = ?", key)

    def record_answer(
        self,
        participant: Participant,
        trial: int,
        choice: Choice,
        *,
        seconds: float,
        conditions: ViewingConditions | None = None,
    ) -> Choice:
        """Store an answer, unless the trial already has one. The answer is synced to the disk on
        return. `trial` is the index of the trial, from 0. `seconds` is how long the pictures were
        shown, clipped to 0..MAX_SECONDS. Returns the stored choice, which is that of the first
        answer. Raises OutputError if the database cannot be written.
        """
        shown = min(max(seconds, 0.0), MAX_SECONDS)
        answered_at = datetime.now(UTC).isoformat(timespec="seconds")
        row = (
            participant.number,
            trial,
            choice,
            shown,
            answered_at,
            _CONDITIONS.dump_json(conditions).decode(),
        )
        with self._transaction("IMMEDIATE") as database:
            database.execute("INSERT OR IGNORE INTO answers VALUES (?, ?, ?, ?, ?, ?)", row)
            (stored,) = database.execute(
                "SELECT choice FROM answers WHERE participant = ? AND trial = ?", row[:2]
            ).fetchone()
        return cast("Choice", stored)

    def all_answers(self) -> Iterator[tuple[Participant, dict[int, StoredAnswer]]]:
        """Yield every participant, in order of number, and a dict of the answers by trial, which
        may be empty.
        """
        with self._transaction() as database:
            answer_rows = database.execute("SELECT * FROM answers").fetchall()
            withdrawn_rows = database.execute(
                "SELECT participant, trial, choice FROM withdrawn ORDER BY rowid"
            ).fetchall()
            participants = database.execute(f"{_PARTICIPANTS} ORDER BY number").fetchall()
        answers: dict[int, dict[int, StoredAnswer]] = {number: {} for number, *_ in participants}
        for number, trial, choice, seconds, answered_at, conditions_json in answer_rows:
            conditions = _CONDITIONS.validate_json(conditions_json)
            before = tuple(row[2] for row in withdrawn_rows if row[:2] == (number, trial))
            answers[number][trial] = StoredAnswer(choice, seconds, answered_at, conditions, before)
        for row in participants:
            yield _participant(*row), dict(sorted(answers[row[0]].items()))

    @contextmanager
    def _transaction(
        self, kind: Literal["DEFERRED", "IMMEDIATE"] = "DEFERRED"
    ) -> Iterator[sqlite3.Connection]:
        """A transaction. All statements of the block read the same state of the database. DEFERRED
        is for a block that only reads. IMMEDIATE is for a block that writes: it waits for other
        writers, and the changes are synced to the disk at the end of the block.
        """
        with self._database_errors(), self._lock:
            database = self._database
            database.execute(f"BEGIN {kind}")
            try:
                yield database
                database.execute("COMMIT")
            except BaseException:
                # SQLite has already rolled back after some errors, such as a full disk
                if database.in_transaction:
                    database.execute("ROLLBACK")
                raise

    @contextmanager
    def _database_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise OutputError(
                # Without the folder: participants may see this message
                f"{ANSWERS_FILE} cannot be used ({error})",
                "expected a database created by brewster, on a local disk with free space",
                "free disk space or restore the file, then start the server again; all "
                "acknowledged answers are stored",
            ) from error


def _read_only_uri(file: Path) -> str:
    """The SQLite URI that opens a file read-only, or an empty database in memory if the file does
    not exist. A reader of a database in WAL mode creates a shared-memory file in the same folder.
    In a folder that is not writable, `immutable=1` avoids that; it is correct only if the log is
    empty.
    """
    if not file.exists():
        return "file::memory:"
    log = file.with_name(f"{file.name}-wal")
    is_immutable = not os.access(file.parent, os.W_OK) and not (log.exists() and log.stat().st_size)
    return f"{file.resolve().as_uri()}?mode=ro{'&immutable=1' if is_immutable else ''}"


def _count(database: sqlite3.Connection) -> int:
    (number,) = database.execute("SELECT count(*) FROM participants").fetchone()
    return int(number)


def _answered(database: sqlite3.Connection, participant: Participant) -> set[int]:
    rows = database.execute(
        "SELECT trial FROM answers WHERE participant = ?", (participant.number,)
    )
    return {trial for (trial,) in rows}


def _participant(number: int, trials: str, practice: str) -> Participant:
    return Participant(
        number, tuple(Trial(**row) for row in json.loads(trials)), Trial(**json.loads(practice))
    )
