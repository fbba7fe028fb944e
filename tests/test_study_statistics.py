"""Intervals when all answers agree and the resamples have no spread: the exact bound and its coverage."""

import math
from statistics import NormalDist

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from brewster.user_study.report.statistics import (
    agreement_bounds,
    bootstrap_interval,
    bootstrap_weights,
    rates,
    resampled_counts,
    with_agreement_bounds,
)


def estimate(*counts, pictures=(1.0,)):
    """Means, lower and upper ends of the intervals, (3, rows, 4), from the counts (datasets, 3) of each participant."""
    counts, pictures = np.array(counts, float)[:, None], np.array([pictures], float)
    means = rates(counts.sum(axis=0), pictures)
    ends = bootstrap_interval(
        rates(resampled_counts(bootstrap_weights(len(counts), 500), counts), pictures), len(counts)
    )
    return np.stack([means, *with_agreement_bounds(means, ends, agreement_bounds(counts, pictures))])[:, 0]


@pytest.mark.parametrize("participants", [2, 10, 30])
def test_if_all_answers_agree_the_bound_is_that_of_clopper_and_pearson(participants):
    exact = binomtest(participants, participants).proportion_ci(method="exact").low
    for i, outcome in enumerate(np.eye(3)):
        _, low, high = estimate(*[[2 * outcome]] * participants)[:, 0]
        assert low[:3] == pytest.approx(outcome * exact)
        assert high[:3] == pytest.approx(outcome + (1 - outcome) * (1 - exact))
        ends = [(2 * exact - 1, 1), (exact - 1, 1 - exact), (-1, 1 - 2 * exact)][i]
        assert (low[3], high[3]) == pytest.approx(ends)


def test_an_outcome_without_answers_gets_the_bound_and_the_others_the_bootstrap_interval():
    _, low, high = estimate(*[[[3, 1, 0]], [[1, 3, 0]], [[2, 2, 0]], [[4, 0, 0]]])[:, 0]
    assert (low[2], high[2]) == pytest.approx((0, 1 - 0.025**0.25))
    assert 0 < low[0] < 0.625 < high[0] <= 1


def test_a_dataset_with_different_answers_of_one_participant_has_no_interval():
    one, none = [[1, 1, 0], [2, 1, 1]], [[5, 0, 1], [0, 0, 0]]
    _, low, high = estimate(one, none, none, pictures=(1.0, 1))
    assert np.isnan(low[1]).all()
    assert np.isnan(high[1]).all()
    assert np.isfinite(low[0]).all()


def test_near_1_the_interval_of_few_participants_contains_the_true_rate_in_19_of_20():
    """The exact coverage for 30 participants with one answer each and a true rate of 0.95; 78 % without the bound."""
    coverage = 0.0
    for wins in range(20, 31):
        _, low, high = estimate(*[[[1, 0, 0]]] * wins, *[[[0, 0, 1]]] * (30 - wins))[:, 0, 0]
        coverage += binom.pmf(wins, 30, 0.95) * (low <= 0.95 <= high)
    assert coverage > 0.93


@pytest.mark.parametrize(("participants", "quantile"), [(5, 2.776), (20, 2.093), (1000, 1.962)])
def test_intervals_of_few_participants_are_as_wide_as_students_t(participants, quantile):
    """Resamples spread too little by sqrt((n - 1) / n); `quantile` is that of t with n - 1 degrees of freedom."""
    draws = np.array([NormalDist().inv_cdf((i + 0.5) / 50_000) for i in range(50_000)])
    low, high = bootstrap_interval(draws[:, None], participants)[:, 0]
    assert high == pytest.approx(quantile * math.sqrt(participants / (participants - 1)), rel=0.02)
    assert low == pytest.approx(-high, rel=0.02)
