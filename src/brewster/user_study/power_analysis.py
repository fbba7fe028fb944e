"""How many participants a study needs, before anybody is asked.

required_participants(difference=0.1, tie=0.25).participants    # 45
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import final

from brewster.errors import BrewsterError


@final
@dataclass(frozen=True)
class PowerAnalysis:
    """The number of participants and what it follows from.

    `design_effect` is how many answers of people do what one independent answer would; `deviation` is how far
    participants' own differences scatter about the mean.
    """

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
    """The least number of participants that shows a difference between win and lose rate with this power.

    An answer scores 1, 0 or -1 (win, tie, lose), with mean d and variance s^2 = 1 - tie - d^2. Answers of one
    participant are alike by the intra-participant `correlation` r, so that k of them are worth k / (1 + (k - 1) r)
    (design effect: Donner and Klar 2000, section 5.2). Two-sided z test, with Guenther's 1981 correction for the variance
    being estimated: n = (z_level + z_power)^2 s^2 (1 + (k - 1) r) / (k d^2) + z_level^2 / 2.

    Args:
        difference: the win rate less the lose rate, 0 to 1.
        tie: the rate of "similar", 0 to 1.
        pairs: how many pairs of these two methods a participant sees.
        correlation: of the scores of one participant; reports estimate it.
        power: the probability of showing the difference if it is there.
        level: the probability of showing one that is not.

    Raises:
        BrewsterError: the rates are none.
    """
    win, lose = (1 - tie + difference) / 2, (1 - tie - difference) / 2
    if not (0 < difference <= 1 and 0 <= tie < 1 and lose >= 0):
        raise BrewsterError(
            f"a difference of {difference:g} with {tie:g} ties would be {win:.0%} wins and {lose:.0%} losses",
            "a difference above 0 and rates that sum to 1",
            "choose a smaller difference, or fewer ties",
        )
    variance = 1 - tie - difference**2
    design_effect = 1 + (pairs - 1) * correlation
    critical, reached = NormalDist().inv_cdf(1 - level / 2), NormalDist().inv_cdf(power)
    minimum = (critical + reached) ** 2 * variance * design_effect / (pairs * difference**2) + critical**2 / 2
    count = math.ceil(minimum)
    return PowerAnalysis(count, count * pairs, win, lose, design_effect, math.sqrt(variance * correlation))
