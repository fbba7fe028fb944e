"""The draw: what a participant is shown, blind, as a function of the seed and their number alone.

All participants walk along one endless row: round after round, each a shuffle of all comparisons. So at any time every
comparison was given out equally often, or once more; in every second round each has its sides swapped, so both methods
stood on either side equally often, too. Nothing needs to be remembered to go on with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, Literal, final

from brewster.user_study.study import CatchTrial, StudyDescription

Choice = Literal["left", "similar", "right"]
CHOICES: Final[tuple[Choice, ...]] = ("left", "similar", "right")


@final
@dataclass(frozen=True)
class TrialDraw:
    """Three pictures, by name, and what they are: the `comparison` by its number, or a catch with its right answer.

    `flipped` says that the comparison's first method is on the right.
    """

    photo: str
    left: str
    right: str
    comparison: int | None = None
    flipped: bool = False
    expected: Choice | None = None


def draw_trials(description: StudyDescription, number: int) -> tuple[TrialDraw, ...]:
    """The trials of the participant of this number (from 0), in their order.

    Walks the row from its start: 0.3 s for the ten-thousandth participant.
    """
    count, pairs = len(description.comparisons), description.pairs
    sequence = comparison_sequence(count, pairs, description.seed)
    own = list(itertools.islice(sequence, number * pairs, (number + 1) * pairs))
    rng = Random(f"{description.seed}/participant/{number}")  # noqa: S311  (no secret: a published seed)
    trials = [_comparison_trial(description, comparison, flipped) for comparison, flipped in own]
    trials += _catch_trials(description, {comparison for comparison, _ in own}, rng)
    rng.shuffle(trials)
    return tuple(trials)


def comparison_sequence(count: int, pairs: int, seed: int) -> Iterator[tuple[int, bool]]:
    """The row without end: numbers of comparisons, and whether their sides are swapped.

    Each `pairs` of it (at most `count`) are a participant's, and hold no comparison twice. Sides are as many left as
    right within one in each comparison at any time, and nearly so in each participant.
    """
    flips: dict[int, bool] = {}
    order: list[int] = []
    for round_number in itertools.count():
        rng = Random(f"{seed}/round/{round_number}")  # noqa: S311
        handed_out = (
            round_number * count % pairs
        )  # of these pairs, the last round has given so many to somebody
        seen, missing = set(order[len(order) - handed_out :]), -handed_out % pairs
        order = _unseen_first(rng.sample(range(count), count), seen, missing)
        if round_number % 2:  # the sides are those of the round before, swapped; left and right by turns
            sides = [
                _unseen_first([c for c in order if flips[c] is flip], seen, missing // 2)
                for flip in (False, True)
            ]
            order = _unseen_first(_interleave(*sides), seen, missing)
            flips = {comparison: not flip for comparison, flip in flips.items()}
        else:
            start = rng.random() < 0.5
            flips = {comparison: start ^ bool(i % 2) for i, comparison in enumerate(order)}
        yield from ((comparison, flips[comparison]) for comparison in order)


def _unseen_first(order: Sequence[int], seen: Collection[int], count: int) -> list[int]:
    """The same with `count` in front that were not seen: who has begun in the round before gets none twice."""
    front = dict.fromkeys([comparison for comparison in order if comparison not in seen][:count])
    return [*front, *(comparison for comparison in order if comparison not in front)]


def _interleave(first: Sequence[int], second: Sequence[int]) -> list[int]:
    longer, shorter = (first, second) if len(first) >= len(second) else (second, first)
    interleaved = itertools.chain.from_iterable(itertools.zip_longest(longer, shorter))
    return [comparison for comparison in interleaved if comparison is not None]


def _comparison_trial(description: StudyDescription, number: int, flipped: bool) -> TrialDraw:
    comparison = description.comparisons[number]
    left, right = comparison.outputs[::-1] if flipped else comparison.outputs
    return TrialDraw(comparison.photo, left, right, number, flipped)


def _catch_trials(description: StudyDescription, own: Collection[int], rng: Random) -> list[TrialDraw]:
    """As many as the study asks for, one half of each kind, on photos that are not the participant's own if possible."""
    photos = {description.comparisons[number].photo for number in own}
    pool = rng.sample(description.catch_pool, len(description.catch_pool))
    pool.sort(key=lambda catch: catch.photo in photos)
    return [_catch_trial(catch, i, rng) for i, catch in enumerate(pool[: description.catches])]


def _catch_trial(catch: CatchTrial, i: int, rng: Random) -> TrialDraw:
    if i % 2 == 0:
        return TrialDraw(catch.photo, catch.good, catch.good, expected="similar")
    if rng.random() < 0.5:
        return TrialDraw(catch.photo, catch.good, catch.spoilt, expected="left")
    return TrialDraw(catch.photo, catch.spoilt, catch.good, expected="right")
