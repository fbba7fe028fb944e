"""The store of answers: durable before acknowledgement, no duplicates, concurrent writers and
killed processes.
"""

import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import pytest

from brewster.errors import BrewsterError
from brewster.evaluation.study.assignment import draw_trials
from brewster.evaluation.study.store import AnswerStore
from brewster.evaluation.study.study import read_study, write_study
from small_studies import make_description, make_empty_study


@pytest.fixture
def store(tmp_path):
    with closing(AnswerStore(make_empty_study(tmp_path / "study"))) as store:
        yield store


def answers_by_participant(store):
    return {participant.number: answers for participant, answers in store.all_answers()}


def test_a_participant_gets_the_assigned_trials_and_continues_where_they_stopped(store):
    tokens = [store.admit() for _ in range(3)]
    participant = store.participant(tokens[2])
    assert participant.trials == draw_trials(store.study.description, 2)
    for trial in range(len(participant.trials)):
        assert store.next_and_last_trial(participant) == (trial, trial - 1 if trial else None)
        store.record_answer(participant, trial, "similar", seconds=2)
    assert store.next_and_last_trial(participant) == (None, len(participant.trials) - 1)


def test_the_first_answer_is_final(store):
    participant = store.participant(store.admit())
    assert store.record_answer(participant, 0, "left", seconds=2) == "left"
    assert store.record_answer(participant, 0, "right", seconds=9) == "left"
    (answer,) = answers_by_participant(store)[0].values()
    assert (answer.choice, answer.seconds) == ("left", 2)


def test_a_withdrawn_choice_belongs_to_its_own_trial(store):
    participant = store.participant(store.admit())
    store.record_answer(participant, 0, "left", seconds=2)
    for choice in ("right", "similar"):
        store.record_answer(participant, 1, choice, seconds=2)
        store.withdraw_answer(participant, 1)
    store.record_answer(participant, 1, "left", seconds=2)
    answers = answers_by_participant(store)[0]
    assert [answers[trial].withdrawn for trial in (0, 1)] == [(), ("right", "similar")]


def test_tokens_are_random_and_only_number_date_and_trials_are_stored_with_them(store):
    tokens = {store.admit() for _ in range(20)}
    assert len(tokens) == 20
    assert all(re.fullmatch(r"[\w-]{32}", token) for token in tokens)
    assert store.participant("0") is None
    with closing(sqlite3.connect(store.study.answers_file)) as database:
        columns = [row[1] for row in database.execute("PRAGMA table_info(participants)")]
        ((day,),) = database.execute("SELECT DISTINCT consented_on FROM participants").fetchall()
    assert columns == ["number", "token", "consented_on", "trials", "practice"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", day)


def test_the_number_of_participants_is_limited(store):
    assert [store.admit(max_participants=2) is not None for _ in range(4)] == [
        True,
        True,
        False,
        False,
    ]
    assert store.count_participants() == 2


def test_impossible_times_are_clipped(store):
    participant = store.participant(store.admit())
    store.record_answer(participant, 0, "left", seconds=-5)
    store.record_answer(participant, 1, "left", seconds=1e9)
    assert [answer.seconds for answer in answers_by_participant(store)[0].values()] == [0, 3600]


def test_two_servers_and_many_threads_lose_no_answer_and_assign_each_number_once(store):
    other = AnswerStore(store.study)

    def take_part(number):
        own = (store, other)[number % 2]
        participant = own.participant(own.admit())
        for trial in range(len(participant.trials)):
            own.record_answer(participant, trial, ("left", "right")[number % 2], seconds=number)
        return participant.number

    with ThreadPoolExecutor(8) as pool:
        numbers = list(pool.map(take_part, range(16)))
    assert sorted(numbers) == list(range(16))
    assert [len(answers) for answers in answers_by_participant(other).values()] == [10] * 16
    other.close()


WRITER = """
import sys
from pathlib import Path
from brewster.evaluation.study.store import AnswerStore
from brewster.evaluation.study.study import read_study

store = AnswerStore(read_study(Path(sys.argv[1])))
while True:
    token = store.admit()
    participant = store.participant(token)
    for trial in range(len(participant.trials)):
        store.record_answer(participant, trial, "left", seconds=1)
        print(participant.number, trial, flush=True)
"""


def test_acknowledged_answers_survive_kill_9_without_duplicates(tmp_path):
    write_study(tmp_path, make_description())
    acknowledged = []
    for _ in range(2):
        command = [sys.executable, "-c", WRITER, str(tmp_path)]
        writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        acknowledged += [tuple(map(int, writer.stdout.readline().split())) for _ in range(15)]
        os.kill(writer.pid, signal.SIGKILL)
        rest = writer.communicate()[0].splitlines()
        acknowledged += [
            tuple(map(int, line.split())) for line in rest if re.fullmatch(r"\d+ \d+", line)
        ]
    store = AnswerStore(read_study(tmp_path))
    stored = answers_by_participant(store)
    store.close()
    assert len(set(acknowledged)) == len(acknowledged) >= 30
    assert all(trial in stored[number] for number, trial in acknowledged)
    assert (
        sum(map(len, stored.values())) <= len(acknowledged) + 2
    )  # and the last one of each writer


def test_closing_a_store_moves_all_answers_into_the_file(store, tmp_path):
    participant = store.participant(store.admit())
    store.record_answer(participant, 0, "left", seconds=2)
    store.close()
    (tmp_path / "alone").mkdir()
    shutil.copy(store.study.answers_file, tmp_path / "alone")  # without its log
    alone = AnswerStore(replace(store.study, folder=tmp_path / "alone"))
    assert len(answers_by_participant(alone)[0]) == 1


def test_a_reader_creates_no_database_and_sees_new_answers(store):
    participant = store.participant(store.admit())
    store.record_answer(participant, 0, "left", seconds=2)
    reader = AnswerStore(store.study, read_only=True)
    store.record_answer(participant, 1, "right", seconds=2)
    assert answers_by_participant(reader) == answers_by_participant(store)
    with pytest.raises(BrewsterError, match="cannot be used"):
        reader.admit()
    reader.close()
    empty = make_empty_study(store.study.folder / "empty")
    assert answers_by_participant(AnswerStore(empty, read_only=True)) == {}
    assert not empty.answers_file.exists()


def test_all_answers_are_read_from_one_state_of_the_database(store):
    """Another process withdraws an answer and admits a participant while the answers are being
    read.
    """
    participant = store.participant(store.admit())
    store.record_answer(participant, 0, "left", seconds=2)
    other = AnswerStore(store.study)

    def change(statement):
        if "FROM withdrawn" in statement:
            other.withdraw_answer(participant, 0)
            other.admit()

    store._database.set_trace_callback(change)
    read = answers_by_participant(store)
    store._database.set_trace_callback(None)
    ((number, answers),) = read.items()
    assert (number, {trial: answer.withdrawn for trial, answer in answers.items()}) == (0, {0: ()})
    assert answers_by_participant(store) == {0: {}, 1: {}}
    other.close()
