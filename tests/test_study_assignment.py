"""Assignment of trials: balanced, without repeats, and reproducible."""

from collections import Counter
from itertools import islice

from hypothesis import given
from hypothesis import strategies as st

from brewster.user_study.assignment import comparison_sequence, draw_trials
from small_studies import make_description

SIZES = st.integers(1, 60).flatmap(lambda count: st.tuples(st.just(count), st.integers(1, count)))


def assigned(count, pairs, seed, participants):
    row = list(islice(comparison_sequence(count, pairs, seed), participants * pairs))
    return [row[i * pairs : (i + 1) * pairs] for i in range(participants)]


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_nobody_sees_a_pair_twice_and_every_pair_is_seen_equally_often_within_one(sizes, seed, participants):
    count, pairs = sizes
    seen = Counter(dict.fromkeys(range(count), 0))
    for own in assigned(count, pairs, seed, participants):
        numbers = [comparison for comparison, _ in own]
        assert len(set(numbers)) == pairs
        seen.update(numbers)
        assert max(seen.values()) - min(seen.values()) <= 1


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_each_comparison_has_its_first_method_left_and_right_equally_often_within_one(
    sizes, seed, participants
):
    balance = Counter()
    for own in assigned(*sizes, seed, participants):
        balance.update({comparison: 1 if flipped else -1 for comparison, flipped in own})
        assert all(abs(value) <= 1 for value in balance.values())


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_no_participant_sees_one_method_much_more_often_on_one_side(sizes, seed, participants):
    for own in assigned(*sizes, seed, participants):
        right = sum(flipped for _, flipped in own)
        assert abs(2 * right - len(own)) <= 4


def test_a_study_of_the_paper_s_size_is_balanced():
    """100 participants with 40 of 2 x 181 pairs each."""
    participants = assigned(362, 40, 1, 100)
    rights = [sum(flipped for _, flipped in own) for own in participants]
    assert min(rights) >= 18
    assert max(rights) <= 22
    assert set(Counter(comparison for own in participants for comparison, _ in own).values()) == {11, 12}


def test_trials_depend_on_seed_and_number_only():
    study = make_description()
    trials = [draw_trials(study, number) for number in range(6)]
    assert trials == [draw_trials(study, number) for number in range(6)]
    assert len(set(trials)) == 6
    assert draw_trials(make_description(seed=8), 0) != trials[0]


def test_trials_are_the_same_in_every_version():
    """Participants keep their links, and a study may continue after an update of brewster."""
    first = [
        (trial.comparison, trial.flipped)
        for trial in draw_trials(make_description(pictures=4, pairs=4, catches=0), 0)
    ]
    assert first == [(4, False), (1, True), (5, False), (7, True)]


def test_sides_and_pictures_agree_with_what_the_trial_says():
    study = make_description()
    for trial in draw_trials(study, 3):
        if trial.comparison is not None:
            row = study.comparisons[trial.comparison]
            assert row.photo == trial.photo
            assert row.outputs == ((trial.right, trial.left) if trial.flipped else (trial.left, trial.right))


def test_catch_trials_are_of_both_kinds_and_on_photos_that_are_not_the_participant_s_own():
    study = make_description(catches=4)
    for number in range(20):
        trials = draw_trials(study, number)
        catches = [trial for trial in trials if trial.expected]
        assert Counter("equal" if trial.left == trial.right else "spoilt" for trial in catches) == {
            "equal": 2,
            "spoilt": 2,
        }
        assert not {trial.photo for trial in catches} & {
            trial.photo for trial in trials if not trial.expected
        }
        for trial in catches:
            pressed = {"left": trial.left, "right": trial.right, "similar": trial.left}[trial.expected]
            assert pressed == "good"
            assert (trial.expected == "similar") == (trial.left == trial.right)


def test_the_order_does_not_reveal_the_catch_trials():
    places = Counter(
        place
        for number in range(120)
        for place, trial in enumerate(draw_trials(make_description(), number))
        if trial.expected
    )
    assert len(places) == 10
    assert min(places.values()) > 10
