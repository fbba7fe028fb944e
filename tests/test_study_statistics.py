"""Statistics of studies: coverage of intervals, and comparisons with published and independent
results.
"""

import math
from statistics import NormalDist

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from brewster.evaluation.study.report import statistics
from brewster.evaluation.study.report.statistics import averages, rates

RATES = np.array([0.45, 0.28, 0.27])


def simulate_counts(rng, participants, studies, *, chances=RATES, pairs=40, correlation=0.05):
    """Counts (participants, studies, 1, 3). Probabilities of participants vary around `chances`,
    with this correlation.

    For Dirichlet probabilities with concentration a, the intraclass correlation of every score is 1
    / (1 + a).
    """
    probabilities = rng.dirichlet(
        np.array(chances) * (1 / correlation - 1), (participants, studies)
    )
    return rng.multinomial(pairs, probabilities)[:, :, None].astype(float)


def intervals(counts, pictures=None):
    """Intervals (2, studies, rows, 4) of independent studies."""
    participants, studies = counts.shape[:2]
    draws = statistics.resampled_counts(statistics.bootstrap_weights(participants, 1000), counts)
    pictures = np.ones((studies, 1)) if pictures is None else pictures
    return statistics.bootstrap_interval(rates(draws, pictures), participants)


@pytest.mark.parametrize("participants", [100, 12])
def test_intervals_contain_the_true_rates_in_95_percent_of_studies(participants):
    """400 studies with 40 pairs for each participant: 95 % within three standard errors."""
    lows, highs = intervals(simulate_counts(np.random.default_rng(1), participants, 400))[:, :, 0]
    true_values = np.append(RATES, RATES[0] - RATES[2])
    covered = ((lows <= true_values) & (true_values <= highs)).mean(axis=0)
    assert np.all(np.abs(covered - 0.95) < 3 * np.sqrt(0.95 * 0.05 / 400)), covered


def test_the_sign_flip_test_rejects_equal_methods_in_5_percent_of_studies():
    """400 studies of 12 participants whose wins and losses are equally likely: within three
    standard errors.
    """
    counts = simulate_counts(np.random.default_rng(8), 12, 400, chances=[0.4, 0.2, 0.4], pairs=20)
    p_values = statistics.sign_flip_test(counts, np.ones((400, 1)), resamples=1000)[:, 0]
    assert abs((p_values <= 0.05).mean() - 0.05) < 3 * np.sqrt(0.05 * 0.95 / 400)


def test_an_average_weights_datasets_by_their_pictures_or_equally():
    """Every picture has the same number of answers: by pictures, the average is that of all."""
    rng = np.random.default_rng(3)
    datasets = [rng.dirichlet(RATES * 9, size) for size in (20, 3, 101)]  # rates of each picture
    shares = np.array([pictures.mean(axis=0) for pictures in datasets])
    by_pictures, by_datasets = averages(shares, np.array([20.0, 3, 101]))
    assert by_pictures == pytest.approx(np.concatenate(datasets).mean(axis=0))
    assert by_datasets == pytest.approx(sum(shares) / 3)
    assert by_pictures != pytest.approx(by_datasets, abs=1e-3)


def test_rates_have_a_row_for_each_dataset_and_three_averages():
    counts = np.array([[6.0, 2, 2], [0, 10, 30]])
    pictures = np.array([30.0, 10])
    rows = rates(counts, pictures)
    assert rows[:2, :3] == pytest.approx(np.array([[0.6, 0.2, 0.2], [0, 0.25, 0.75]]))
    assert rows[2] == pytest.approx([0.45, 0.2125, 0.3375, 0.1125])
    assert rows[3] == pytest.approx([0.3, 0.225, 0.475, -0.175])
    assert rows[4] == pytest.approx([6 / 50, 12 / 50, 32 / 50, -26 / 50])


def test_a_dataset_without_answers_has_no_rate_and_does_not_affect_others():
    counts = np.zeros((10, 1, 2, 3))
    counts[:, 0, 0] = [3, 1, 1]
    ends = intervals(counts, np.array([[5.0, 5]]))[:, 0]
    assert ends[:, 0, :3] == pytest.approx(np.array([[0.6, 0.2, 0.2]] * 2))
    assert np.isnan(ends[:, 1]).all()


def test_the_p_value_of_unanimous_participants_is_that_of_all_exchanges():
    """Of the 2^n exchanges of n participants, two are as extreme: all or none exchanged."""
    for participants in (6, 8):
        counts = np.tile([5.0, 1, 0], (participants, 1, 1, 1))
        (p_values,) = statistics.sign_flip_test(counts, np.ones((1, 1)))
        assert p_values == pytest.approx([2 / 2**participants] * 4, abs=0.01)
    assert statistics.sign_flip_test(np.tile([2.0, 1, 2], (6, 1, 1, 1)), np.ones((1, 1))).min() == 1


def test_alpha_of_the_example_of_krippendorff_is_reproduced():
    """Krippendorff 2011, part C: four observers, twelve units, missing values; nominal alpha is
    0.743.
    """
    observers = "123321412...", "1233224125.3", ".3332342251.", "12332441251."
    ratings = np.array(
        [[sum(row[unit] == value for row in observers) for value in "12345"] for unit in range(12)],
        float,
    )
    assert statistics.alpha(ratings) == pytest.approx(0.743, abs=5e-4)


def test_alpha_is_1_for_agreement_0_for_chance_and_none_where_undefined(rng):
    assert statistics.alpha(np.array([[4.0, 0, 0], [0, 3, 0]])) == 1
    assert statistics.alpha(rng.multinomial(20, RATES, 2000).astype(float)) == pytest.approx(
        0, abs=0.01
    )
    assert statistics.alpha(np.array([[4.0, 0, 0], [5, 0, 0]])) is None
    assert statistics.alpha(np.array([[1.0, 0, 0], [0, 1, 0]])) is None


def estimate(*counts, pictures=(1.0,)):
    """Means, lower and upper ends of the intervals, (3, rows, 4), from the counts (datasets, 3) of
    each participant.
    """
    counts = np.array(counts, float)[:, None]
    pictures = np.array([pictures], float)
    means = rates(counts.sum(axis=0), pictures)
    bounds = statistics.agreement_bounds(counts, pictures)
    ends = statistics.with_agreement_bounds(means, intervals(counts, pictures), bounds)
    return np.stack([means, *ends])[:, 0]


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
    one = [[1, 1, 0], [2, 1, 1]]
    none = [[5, 0, 1], [0, 0, 0]]
    _, low, high = estimate(one, none, none, pictures=(1.0, 1))
    assert np.isnan(low[1]).all()
    assert np.isnan(high[1]).all()
    assert np.isfinite(low[0]).all()


def test_near_1_the_interval_of_few_participants_contains_the_true_rate_in_19_of_20():
    """The exact coverage for 30 participants with one answer each and a true rate of 0.95; 78 %
    without the bound.
    """
    coverage = 0.0
    for wins in range(20, 31):
        _, low, high = estimate(*[[[1, 0, 0]]] * wins, *[[[0, 0, 1]]] * (30 - wins))[:, 0, 0]
        coverage += binom.pmf(wins, 30, 0.95) * (low <= 0.95 <= high)
    assert coverage > 0.93


@pytest.mark.parametrize(("participants", "quantile"), [(5, 2.776), (20, 2.093), (1000, 1.962)])
def test_intervals_of_few_participants_are_as_wide_as_students_t(participants, quantile):
    """Resamples spread too little by sqrt((n - 1) / n); `quantile` is that of t with n - 1 degrees
    of freedom.
    """
    draws = np.array([NormalDist().inv_cdf((i + 0.5) / 50_000) for i in range(50_000)])
    low, high = statistics.bootstrap_interval(draws[:, None], participants)[:, 0]
    assert high == pytest.approx(quantile * math.sqrt(participants / (participants - 1)), rel=0.02)
    assert low == pytest.approx(-high, rel=0.02)
