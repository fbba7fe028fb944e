"""Power analysis: the formula, and simulated studies of the computed size."""

import numpy as np
import pytest

from brewster.errors import BrewsterError
from brewster.user_study.report.statistics import (
    bootstrap_interval,
    bootstrap_weights,
    rates,
    required_participants,
    resampled_counts,
)


def detection_rate(rng, participants, pairs, rates_of_outcomes, correlation, studies):
    """The share of simulated studies whose interval of the difference does not contain 0."""
    probabilities = rng.dirichlet(
        np.array(rates_of_outcomes) * (1 / correlation - 1), (participants, studies)
    )
    counts = rng.multinomial(pairs, probabilities)[:, :, None].astype(float)
    draws = rates(resampled_counts(bootstrap_weights(participants, 1000), counts), np.ones((studies, 1)))
    lows, highs = bootstrap_interval(draws, participants)[..., 0, 3]
    return ((lows > 0) | (highs < 0)).mean()


@pytest.mark.parametrize(
    ("difference", "tie", "pairs", "correlation"),
    [(0.1, 0.25, 40, 0.05), (0.15, 0.4, 20, 0.02), (0.1, 0.1, 40, 0.15)],
)
def test_a_study_of_the_computed_size_detects_the_difference_with_the_given_power(
    difference, tie, pairs, correlation
):
    analysis = required_participants(difference=difference, tie=tie, pairs=pairs, correlation=correlation)
    rng = np.random.default_rng(6)
    power = detection_rate(
        rng, analysis.participants, pairs, (analysis.win, tie, analysis.lose), correlation, 400
    )
    assert power == pytest.approx(0.8, abs=3 * np.sqrt(0.8 * 0.2 / 400))


def test_the_number_of_participants_equals_a_manual_calculation():
    """(1.95996 + 0.84162)^2 x 0.74 x 2.95 / (40 x 0.01) + 1.95996^2 / 2 = 42.84 + 1.92."""
    analysis = required_participants(difference=0.1, tie=0.25)
    assert (analysis.participants, analysis.answers) == (45, 1800)
    assert analysis.design_effect == pytest.approx(2.95)
    assert (analysis.win, analysis.lose) == pytest.approx((0.425, 0.325))


def test_a_study_without_losses_is_possible():
    for tie in np.arange(1, 100) / 100:
        assert required_participants(difference=round(1 - tie, 2), tie=tie).lose == 0


@pytest.mark.parametrize(("difference", "tie"), [(0, 0.2), (-0.1, 0.2), (0.9, 0.2), (0.1, 1)])
def test_impossible_rates_are_refused(difference, tie):
    with pytest.raises(BrewsterError, match="a difference above 0"):
        required_participants(difference=difference, tie=tie)
