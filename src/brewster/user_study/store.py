"""The answers, on the disk before they are acknowledged: SQLite with a write-ahead log, each commit synced.

    store = Store(study)
    participant = store.participant(store.admit())
    store.record_answer(participant, 0, "left", seconds=4.2)

A participant is a number and the token of their link: no name, no address, no clock beyond the day of the consent.
Their trials are drawn once, on admission, and kept, so that no other version of anything can ever change them. The
first answer to a trial stays: sent again, perhaps because the acknowledgement was lost, it changes nothing.
"""

from __future__ import annotations

import json
import os
import secrets
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Final, final

from brewster.errors import BrewsterError, TargetError
from brewster.user_study.assignment import CHOICES, Choice, TrialDraw, draw_trials
from brewster.user_study.study import ANSWERS_FILE, Study

MAX_SECONDS: Final = 3600.0
_TIMEOUT_SECONDS: Final = 30.0
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS participants (
    number INTEGER PRIMARY KEY, token TEXT NOT NULL UNIQUE, consented_on TEXT NOT NULL, trials TEXT NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS answers (
    participant INTEGER NOT NULL REFERENCES participants, trial INTEGER NOT NULL, choice TEXT NOT NULL,
    seconds REAL NOT NULL, PRIMARY KEY (participant, trial)
) STRICT, WITHOUT ROWID;
"""


@final
@dataclass(frozen=True)
class Participant:
    """Somebody with a link: their number from 0, and what they are shown."""

    number: int
    trials: tuple[TrialDraw, ...]


@final
@dataclass(frozen=True)
class StoredAnswer:
    """A choice, and how long the pictures were seen until then."""

    choice: Choice
    seconds: float


@final
class AnswerStore:
    """The answers of one study. Thread-safe, and several processes may use one study at once.

    Where it `read_only`, no answer can be written, and a study that nobody has answered stays without a database.
    """

    def __init__(self, study: Study, *, read_only: bool = False) -> None:
        self.study = study
        self._lock, self._read_only = Lock(), read_only
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
                self._checkpoint()
            if not read_only or not study.answers_file.exists():
                self._database.executescript(_SCHEMA)

    def close(self) -> None:
        """Lets the file go, with all answers in it."""
        with self._lock:
            if not self._read_only:
                with suppress(sqlite3.Error):  # of a full disk, perhaps: then the log has them
                    self._checkpoint()
            self._database.close()

    def _checkpoint(self) -> None:
        """Moves into the file what a killed server may have left in the log beside it."""
        self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    def count_participants(self) -> int:
        """How many participants were admitted."""
        with self._reading() as database:
            (number,) = database.execute("SELECT count(*) FROM participants").fetchone()
        return int(number)

    def admit(self, *, max_participants: int | None = None) -> str | None:
        """The token of a new participant, who has agreed to take part; None where `max_participants` were admitted already."""
        with self._writing() as database:
            (number,) = database.execute("SELECT count(*) FROM participants").fetchone()
            if max_participants is not None and number >= max_participants:
                return None
            token = secrets.token_urlsafe(24)
            trials = json.dumps([asdict(trial) for trial in draw_trials(self.study.description, number)])
            today = datetime.now(UTC).date().isoformat()
            database.execute("INSERT INTO participants VALUES (?, ?, ?, ?)", (number, token, today, trials))
        return token

    def participant(self, token: str) -> Participant | None:
        """Whose link this is; None if it is nobody's."""
        with self._reading() as database:
            row = database.execute(
                "SELECT number, trials FROM participants WHERE token = ?", (token,)
            ).fetchone()
        return None if row is None else Participant(row[0], _parse_trials(row[1]))

    def next_trial(self, participant: Participant) -> int | None:
        """The first trial without an answer; None where all have one."""
        with self._reading() as database:
            rows = database.execute("SELECT trial FROM answers WHERE participant = ?", (participant.number,))
            answered = {trial for (trial,) in rows}
        return next((trial for trial in range(len(participant.trials)) if trial not in answered), None)

    def record_answer(
        self, participant: Participant, trial: int, choice: Choice, *, seconds: float
    ) -> Choice:
        """Keeps an answer, unless the trial has one; what is kept is on the disk when this returns it.

        Raises:
            BrewsterError: there is no such trial or choice.
            TargetError: it cannot be written.
        """
        if not 0 <= trial < len(participant.trials) or choice not in CHOICES:
            raise BrewsterError(
                f"trial {trial} was answered with {choice!r}",
                f"trials 0 to {len(participant.trials) - 1} and {', '.join(CHOICES)} are known",
                "load the page again",
            )
        seconds_shown = min(max(seconds, 0.0), MAX_SECONDS)
        with self._writing() as database:
            database.execute(
                "INSERT INTO answers VALUES (?, ?, ?, ?) ON CONFLICT DO NOTHING",
                (participant.number, trial, choice, seconds_shown),
            )
            row = database.execute(
                "SELECT choice FROM answers WHERE participant = ? AND trial = ?", (participant.number, trial)
            ).fetchone()
        stored: Choice = row[0]
        return stored

    def all_answers(self) -> Iterator[tuple[Participant, dict[int, StoredAnswer]]]:
        """Every participant with their answers by trial, in order of number; also those with none."""
        with self._reading() as database:
            rows = database.execute("SELECT participant, trial, choice, seconds FROM answers").fetchall()
            # people second: who answered before is there, whatever another process writes meanwhile
            participants = database.execute(
                "SELECT number, trials FROM participants ORDER BY number"
            ).fetchall()
        answers: dict[int, dict[int, StoredAnswer]] = {number: {} for number, _ in participants}
        for number, trial, choice, seconds in rows:
            answers[number][trial] = StoredAnswer(choice, seconds)
        for number, trials in participants:
            yield Participant(number, _parse_trials(trials)), dict(sorted(answers[number].items()))

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._database_errors(), self._lock:
            yield self._database

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """A transaction that no other writer is beside; it is on the disk when this is left."""
        with self._reading() as database:
            database.execute("BEGIN IMMEDIATE")
            try:
                yield database
                database.execute("COMMIT")
            except BaseException:
                if database.in_transaction:  # a full disk has ended it already
                    database.execute("ROLLBACK")
                raise

    @contextmanager
    def _database_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise TargetError(
                f"{ANSWERS_FILE} cannot be used ({error})",  # without its folder: participants may read this
                "a database that brewster has made, on a disk of this machine with free space",
                "mend that and start again: what was acknowledged is kept",
            ) from error


def _read_only_uri(file: Path) -> str:
    """The address under which SQLite only reads a file; an empty database where there is none.

    A reader keeps a little file beside it, for the log. Where it cannot, and no log is there, none is needed.
    """
    if not file.exists():
        return "file::memory:"
    log = file.with_name(f"{file.name}-wal")
    is_immutable = not os.access(file.parent, os.W_OK) and not (log.exists() and log.stat().st_size)
    return f"{file.resolve().as_uri()}?mode=ro{'&immutable=1' if is_immutable else ''}"


def _parse_trials(text: str) -> tuple[TrialDraw, ...]:
    return tuple(TrialDraw(**row) for row in json.loads(text))
