"""Power analysis: the number of participants that a study needs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import final

from brewster.errors import BrewsterError


@final
@dataclass(frozen=True)
class PowerAnalysis:
    """The required number of participants, and the quantities that it is computed from: `answers` of all participants,
    the assumed `win` and `lose` rates, the `design_effect` (the number of real answers that are worth one independent
    answer), and the standard `deviation`, over participants, of the difference between win and lose rate."""

    participants: int
    answers: int
    win: float
    lose: float
    design_effect: float
    deviation: float


def required_participants(
    *,
    difference: float,
    tie: float,
    pairs: int = 40,
    correlation: float = 0.05,
    power: float = 0.8,
    level: float = 0.05,
) -> PowerAnalysis:
    """The smallest number of participants that detects a difference between win and lose rate with the given power.

    An answer scores 1, 0 or -1 (win, tie, lose), with mean d and variance s^2 = 1 - tie - d^2. Answers of one
    participant have the intraclass `correlation` r, so k of them are worth k / (1 + (k - 1) r) independent answers
    (design effect: Donner and Klar 2000, section 5.2). Two-sided z test, with the correction of Guenther 1981 for an
    estimated variance: n = (z_level + z_power)^2 s^2 (1 + (k - 1) r) / (k d^2) + z_level^2 / 2. Raises BrewsterError if
    `difference` is not above 0, or the lose rate would be negative.

    Args:
        difference: the win rate minus the lose rate, 0 to 1; `tie` is the rate of "similar", 0 to 1.
        pairs: number of pairs of these two methods that a participant sees.
        power: the probability of detecting the difference if it exists; `level`, if it does not exist."""
    win, lose = (1 - tie + difference) / 2, round((1 - tie - difference) / 2, 12) + 0.0
    if not (0 < difference <= 1 and 0 <= tie < 1 and lose >= 0):
        raise BrewsterError(
            f"a difference of {difference:g} with a tie rate of {tie:g} means {win:.0%} wins and {lose:.0%} losses",
            "expected a difference above 0, and no rate below 0",
            "choose a difference above 0 that is at most 1 minus the tie rate",
        )
    variance = 1 - tie - difference**2
    design_effect = 1 + (pairs - 1) * correlation
    z_level, z_power = NormalDist().inv_cdf(1 - level / 2), NormalDist().inv_cdf(power)
    minimum = (z_level + z_power) ** 2 * variance * design_effect / (pairs * difference**2) + z_level**2 / 2
    count = math.ceil(minimum)
    return PowerAnalysis(count, count * pairs, win, lose, design_effect, math.sqrt(variance * correlation))
