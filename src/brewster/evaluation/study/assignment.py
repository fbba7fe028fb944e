"""Assign comparisons to participants; the result depends only on the seed and the number of the
participant.

All participants share one infinite sequence of rounds. Each round is a random permutation of all
comparisons, and each participant takes the next `pairs` items. At any time, the assignment counts
of any two comparisons differ by at most 1. Every second round swaps the sides of each comparison,
so each method is shown left and right equally often. The sequence is computed again from the seed;
no state is stored.
"""

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import Literal, final

from brewster.evaluation.study.study import CatchTrial, StudyDescription

Choice = Literal["left", "similar", "right"]


@final
@dataclass(frozen=True)
class Trial:
    """One trial: the names of its three pictures, and the comparison or the catch trial that they
    belong to. In a normal trial, `comparison` is the number of the comparison, and `flipped` is
    true if the first method of the comparison is on the right. In a catch trial, `comparison` is
    None, and `expected` is the correct choice.
    """

    photo: str
    left: str
    right: str
    comparison: int | None = None
    flipped: bool = False
    expected: Choice | None = None


def draw_trials(description: StudyDescription, number: int) -> tuple[Trial, ...]:
    """The trials of one participant, in the order of presentation; `number` counts participants
    from 0. The sequence is computed from its start, which takes 0.3 s for participant 10,000.
    """
    count = len(description.comparisons)
    pairs = description.pairs
    sequence = comparison_sequence(count, pairs, description.seed)
    rng = Random(f"{description.seed}/participant/{number}")  # noqa: S311  (not a secret: the seed is published)
    trials = []
    for index, flipped in itertools.islice(sequence, number * pairs, (number + 1) * pairs):
        comparison = description.comparisons[index]
        left, right = comparison.outputs[::-1] if flipped else comparison.outputs
        trials.append(Trial(comparison.photo, left, right, index, flipped))
    # catch trials in random order; those of photos that the participant does not see otherwise come
    # first
    photos = {trial.photo for trial in trials}
    pool = rng.sample(description.catch_pool, len(description.catch_pool))
    pool.sort(key=lambda catch: catch.photo in photos)
    trials += [
        _catch_trial(catch, i, rng) for i, catch in enumerate(pool[: description.catch_trials])
    ]
    rng.shuffle(trials)
    return tuple(trials)


def draw_practice(description: StudyDescription, number: int, trials: Sequence[Trial]) -> Trial:
    """The practice trial of the participant with these trials: an output and its degraded copy. Its
    pictures are those of a catch trial that the participant does not see otherwise, unless the
    study has too few.
    """
    seen = {trial.photo for trial in trials}
    rng = Random(f"{description.seed}/practice/{number}")  # noqa: S311
    pool = rng.sample(description.catch_pool, len(description.catch_pool))
    return _catch_trial(min(pool, key=lambda catch: catch.photo in seen), 1, rng)


def comparison_sequence(count: int, pairs: int, seed: int) -> Iterator[tuple[int, bool]]:
    """The infinite sequence of (comparison number, sides swapped). Items `n * pairs` to `(n + 1) *
    pairs - 1` belong to participant n and contain no comparison twice. For each comparison, the
    numbers of items with and without swapped sides differ by at most 1 at any time; for each
    participant they are nearly equal.
    """
    flips: dict[int, bool] = {}
    order: list[int] = []
    for round_number in itertools.count():
        rng = Random(f"{seed}/round/{round_number}")  # noqa: S311
        # a participant may take the last `carried_over` items of the previous round and the first
        # `needed` ones of this round
        carried_over = round_number * count % pairs
        seen = set(order[len(order) - carried_over :])
        needed = -carried_over % pairs
        order = _unseen_first(rng.sample(range(count), count), seen, needed)
        if round_number % 2:  # swap the sides of the previous round, and alternate left and right
            sides = [
                _unseen_first([c for c in order if flips[c] is flip], seen, needed // 2)
                for flip in (False, True)
            ]
            longer, shorter = sorted(sides, key=len, reverse=True)
            interleaved = itertools.chain.from_iterable(itertools.zip_longest(longer, shorter))
            order = _unseen_first([c for c in interleaved if c is not None], seen, needed)
            flips = {comparison: not flip for comparison, flip in flips.items()}
        else:
            start = rng.random() < 0.5
            flips = {comparison: start ^ bool(i % 2) for i, comparison in enumerate(order)}
        yield from ((comparison, flips[comparison]) for comparison in order)


def _unseen_first(order: Sequence[int], seen: Collection[int], count: int) -> list[int]:
    """Move the first `count` comparisons that are not in `seen` to the front, so that nobody gets
    one twice.
    """
    front = dict.fromkeys([comparison for comparison in order if comparison not in seen][:count])
    return [*front, *(comparison for comparison in order if comparison not in front)]


def _catch_trial(catch: CatchTrial, i: int, rng: Random) -> Trial:
    """The catch trial number i; the two kinds alternate."""
    if i % 2 == 0:
        return Trial(catch.photo, catch.good, catch.good, expected="similar")
    if rng.random() < 0.5:
        return Trial(catch.photo, catch.good, catch.degraded, expected="left")
    return Trial(catch.photo, catch.degraded, catch.good, expected="right")
