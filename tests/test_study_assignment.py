"""Assignment of trials: balanced, without repeats, and reproducible."""

from collections import Counter
from itertools import islice

from hypothesis import given
from hypothesis import strategies as st

from brewster.user_study.assignment import comparison_sequence, draw_trials
from small_studies import make_description

SIZES = st.integers(1, 60).flatmap(lambda count: st.tuples(st.just(count), st.integers(1, count)))


def assigned_items(count, pairs, seed, participants):
    row = list(islice(comparison_sequence(count, pairs, seed), participants * pairs))
    return [row[i * pairs : (i + 1) * pairs] for i in range(participants)]


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_no_participant_gets_a_comparison_twice_and_counts_differ_by_at_most_one(sizes, seed, participants):
    count, pairs = sizes
    seen = Counter(dict.fromkeys(range(count), 0))
    for items in assigned_items(count, pairs, seed, participants):
        numbers = [comparison for comparison, _ in items]
        assert len(set(numbers)) == pairs
        seen.update(numbers)
        assert max(seen.values()) - min(seen.values()) <= 1


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_left_and_right_counts_of_a_comparison_differ_by_at_most_one(sizes, seed, participants):
    balance = Counter()
    for items in assigned_items(*sizes, seed, participants):
        balance.update({comparison: 1 if flipped else -1 for comparison, flipped in items})
        assert all(abs(value) <= 1 for value in balance.values())


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_no_participant_sees_one_method_much_more_often_on_one_side(sizes, seed, participants):
    for items in assigned_items(*sizes, seed, participants):
        right = sum(flipped for _, flipped in items)
        assert abs(2 * right - len(items)) <= 4


def test_a_study_with_the_size_of_the_paper_is_balanced():
    """100 participants; each answers 40 of the 362 comparisons (181 photos, 2 comparisons each)."""
    participants = assigned_items(362, 40, 1, 100)
    rights = [sum(flipped for _, flipped in items) for items in participants]
    assert min(rights) >= 18
    assert max(rights) <= 22
    assert set(Counter(comparison for items in participants for comparison, _ in items).values()) == {11, 12}


def test_trials_depend_on_seed_and_number_only():
    study = make_description()
    trials = [draw_trials(study, number) for number in range(6)]
    assert trials == [draw_trials(study, number) for number in range(6)]
    assert len(set(trials)) == 6
    assert draw_trials(make_description(seed=8), 0) != trials[0]


def test_trials_are_the_same_in_every_version():
    """Participants keep their links, and a study may continue after an update of brewster."""
    trials = draw_trials(make_description(pictures=4, pairs=4, catch_trials=0), 0)
    found = [(trial.comparison, trial.flipped) for trial in trials]
    assert found == [(4, False), (1, True), (5, False), (7, True)]


def test_the_pictures_of_a_trial_match_its_comparison_and_sides():
    study = make_description()
    for trial in draw_trials(study, 3):
        if trial.comparison is not None:
            row = study.comparisons[trial.comparison]
            assert row.photo == trial.photo
            assert row.outputs == ((trial.right, trial.left) if trial.flipped else (trial.left, trial.right))


def test_catch_trials_have_both_kinds_and_use_photos_of_no_other_trial():
    study = make_description(catch_trials=4)
    for number in range(20):
        trials = draw_trials(study, number)
        catch_trials = [trial for trial in trials if trial.expected]
        assert Counter(trial.left == trial.right for trial in catch_trials) == {True: 2, False: 2}
        others = {trial.photo for trial in trials if not trial.expected}
        assert not {trial.photo for trial in catch_trials} & others
        for trial in catch_trials:
            chosen = {"left": trial.left, "right": trial.right, "similar": trial.left}[trial.expected]
            assert chosen == "good"
            assert (trial.expected == "similar") == (trial.left == trial.right)


def test_the_order_does_not_reveal_the_catch_trials():
    sessions = [draw_trials(make_description(), number) for number in range(120)]
    positions = Counter(i for trials in sessions for i, trial in enumerate(trials) if trial.expected)
    assert len(positions) == 10
    assert min(positions.values()) > 10


def test_each_half_of_a_session_has_each_comparison_equally_often_and_on_both_sides():
    """Participants tire: the order of presentation must not depend on the comparison or on its sides."""
    description = make_description(pictures=10, pairs=20, catch_trials=0)
    first_half, flipped_first = Counter(), Counter()
    for number in range(200):
        trials = draw_trials(description, number)
        first_half.update(trial.comparison for trial in trials[:10])
        flipped_first[trials[0].flipped] += 1
    assert len(first_half) == 20
    assert min(first_half.values()) > 75  # of 200; the standard deviation is 7
    assert len(flipped_first) == 2
    assert min(flipped_first.values()) > 70


def test_each_round_begins_with_another_side():
    starts = Counter(next(comparison_sequence(6, 3, seed))[1] for seed in range(100))
    assert len(starts) == 2
    assert min(starts.values()) > 30
