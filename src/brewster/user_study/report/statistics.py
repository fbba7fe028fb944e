"""Rates and their confidence intervals. The bootstrap resamples whole participants, since their answers are correlated.

Arrays of counts are (participants, pairs of methods, datasets, 3): wins, ties and losses of the first method. In
shapes, p is the number of participants, r of resamples and d of datasets."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import NDArray

from brewster.bootstrap import RESAMPLES, cluster_draws
from brewster.errors import BrewsterError

if TYPE_CHECKING:
    from jaxtyping import Float64

SEED: Final = 20_261_121
MIN_PARTICIPANTS: Final = 6
"""With fewer participants, `sign_flip_test` cannot reach the 5 % level: its smallest p-value is 2 / 2^n."""
_TOLERANCE: Final = 1e-9
_MAX_NEWTON_STEPS: Final = 200
_MIN_NEWTON_STEP: Final = 1e-10

Floats = NDArray[np.float64]


def bootstrap_weights(participants: int, resamples: int = RESAMPLES) -> Float64[Floats, "r p"]:
    """How often each participant, with all answers, is in each resample. The seed is fixed."""
    return cluster_draws(participants, [SEED, participants], resamples)


def resampled_counts(weights: Float64[Floats, "r p"], counts: Float64[Floats, "p ..."]) -> Float64[Floats, "r ..."]:
    """The counts of each resample, summed over its participants."""
    totals: Floats = (weights @ counts.reshape(len(counts), -1)).reshape(len(weights), *counts.shape[1:])
    return totals


def rates(counts: Float64[Floats, "... d 3"], pictures: Float64[Floats, "... d"]) -> Float64[Floats, "... d+3 4"]:
    """Rates of win, tie and lose, and the difference win - lose. `pictures` is the number of pictures of each dataset.
    Returns a row for each dataset, then three averages: the mean weighted by the number of pictures (as in the
    paper), the mean of the datasets, and the rates of all answers together. Rows without answers are NaN."""
    with np.errstate(invalid="ignore"):
        shares = counts / counts.sum(axis=-1, keepdims=True)
        pooled = counts.sum(axis=-2, keepdims=True)
        pooled = pooled / pooled.sum(axis=-1, keepdims=True)
    rows = np.concatenate([shares, averages(shares, pictures), pooled], axis=-2)
    return np.concatenate([rows, rows[..., :1] - rows[..., 2:]], axis=-1)


def averages(shares: Float64[Floats, "... d k"], pictures: Float64[Floats, "... d"]) -> Float64[Floats, "... 2 k"]:
    """Two means over datasets: one weighted by the number of pictures, as in the paper's Table 3, and one unweighted.
    The leading axes of the two arguments broadcast: `shares` may have an axis of resamples that `pictures` lacks."""
    weights = pictures / pictures.sum(axis=-1, keepdims=True)
    return np.stack([(shares * weights[..., None]).sum(axis=-2), shares.mean(axis=-2)], axis=-2)


def bootstrap_interval(draws: Float64[Floats, "r ..."], participants: int) -> Float64[Floats, "2 ..."]:
    """The 95 % expanded percentile interval (Hesterberg 2015, section 4.3.2) of a statistic with these values, one for
    each resample; NaN is ignored. Its percentiles are slightly wider than 2.5 and 97.5, because the plain percentile
    interval is too narrow for few participants. The ends are NaN for a single participant."""
    if participants < 2:
        return np.full((2, *draws.shape[1:]), np.nan)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")  # a dataset without answers
        return np.nanpercentile(draws, _expanded_percentiles(participants), axis=0)


def sign_flip_test(
    counts: Float64[Floats, "p ... d 3"], pictures: Float64[Floats, "... d"], resamples: int = RESAMPLES
) -> Float64[Floats, "... d+3"]:
    """The two-sided p-values of the differences win - lose, for each row of `rates`; NaN without answers.

    The test exchanges wins and losses of whole participants at random, because their answers are correlated. It assumes
    that, without a difference of the methods, each participant is as likely to prefer one as the other. (A
    randomisation test, Good 2005, "Permutation, Parametric and Bootstrap Tests of Hypotheses", 3.2; one is added to
    both counts as in Phipson and Smyth 2010.) The p-values are random estimates of the exact ones over all 2^n
    exchanges of n participants."""
    rng = np.random.default_rng([SEED, len(counts), 1])
    signs = rng.choice([-1.0, 1.0], (resamples, len(counts)))
    half_sum, half_difference = counts.copy(), np.zeros_like(counts)
    half_sum[..., ::2] = (counts[..., :1] + counts[..., 2:]) / 2
    half_difference[..., 0] = (counts[..., 0] - counts[..., 2]) / 2
    half_difference[..., 2] = -half_difference[..., 0]
    found = np.abs(rates(counts.sum(axis=0), pictures)[..., 3])
    draws = np.abs(rates(half_sum.sum(axis=0) + resampled_counts(signs, half_difference), pictures)[..., 3])
    p_values = (1 + (draws >= found - _TOLERANCE).sum(axis=0)) / (1 + resamples)
    return np.where(np.isfinite(found), p_values, np.nan)


def agreement_bounds(
    counts: Float64[Floats, "p ... d 3"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... d+3"]:
    """The lower end of the 95 % interval for an observed rate of 1, for each row of `rates`; NaN without answers. If
    all answers agree, the bootstrap has no spread. The bound is then that of Clopper and Pearson (1934) for n
    successes of n trials, 0.025^(1 / n). Here n is the number of participants, not of answers, since answers of one
    participant are not independent. The bound of an average of rates is the average of their bounds."""
    sizes = counts.sum(axis=-1)
    with np.errstate(divide="ignore"):
        bounds = 0.025 ** (1 / (sizes > 0).sum(axis=0))
        pooled = 0.025 ** (1 / (sizes.sum(axis=-1) > 0).sum(axis=0))
    bounds = np.where((sizes > 0).any(axis=0), bounds, np.nan)
    return np.concatenate([bounds, averages(bounds[..., None], pictures)[..., 0], pooled[..., None]], axis=-1)


def with_agreement_bounds(
    rows: Float64[Floats, "... n 4"], ends: Float64[Floats, "2 ... n 4"], bounds: Float64[Floats, "... n"]
) -> Float64[Floats, "2 ... n 4"]:
    """The intervals of `rates`, with those of width 0 replaced by intervals from `agreement_bounds`. An interval is NaN
    if its width is 0 although answers differ, for example if only one participant has answered for a dataset."""
    bound, shares = bounds[..., None], rows[..., :3]
    is_one, is_zero = shares > 1 - _TOLERANCE, shares < _TOLERANCE
    lows = np.where(is_one, bound, np.where(is_zero, 0.0, np.nan))
    highs = np.where(is_one, 1.0, np.where(is_zero, 1 - bound, np.nan))
    lows, highs = (
        np.concatenate([own, own[..., :1] - other[..., 2:]], axis=-1) for own, other in ((lows, highs), (highs, lows))
    )
    return np.where(ends[1] - ends[0] < _TOLERANCE, np.stack([lows, highs]), ends)


def _expanded_percentiles(participants: int) -> tuple[float, float]:
    """The percentiles of a bootstrap that match the 95 % interval of Student's t with n - 1 degrees of freedom. They
    also correct the bootstrap's spread, which is too small by the factor sqrt((n - 1) / n). The quantile of t is the
    expansion 26.7.5 of Abramowitz and Stegun 1972."""
    z, v = NormalDist().inv_cdf(0.975), participants - 1
    t = z + (z**3 + z) / (4 * v) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * v**2)
    tail = 100 * NormalDist().cdf(-t * math.sqrt(participants / v))
    return tail, 100 - tail


def intraclass_correlation(counts: Float64[Floats, "p 3"]) -> float | None:
    """The intraclass correlation of the scores 1, 0, -1 for win, tie, lose, with participants as classes. The estimator
    from the analysis of variance (Donner 1986, equation 2.1). It can be below 0 by chance. It is None with fewer
    than two participants, one answer for each participant, or no variance."""
    counts = counts[counts.sum(axis=1) > 0]
    sizes, sums, squares = counts.sum(axis=1), counts[:, 0] - counts[:, 2], counts[:, 0] + counts[:, 2]
    participants, answers = len(sizes), float(sizes.sum())
    if participants < 2 or answers <= participants:
        return None
    # the mean squares between and within participants, and Donner's mean size of unequal groups
    between = ((sums**2 / sizes).sum() - sums.sum() ** 2 / answers) / (participants - 1)
    within = (squares - sums**2 / sizes).sum() / (answers - participants)
    size = (answers - (sizes**2).sum() / answers) / (participants - 1)
    spread = between + (size - 1) * within
    return float((between - within) / spread) if spread > 0 else None


def strengths(wins: Float64[Floats, "... m m"]) -> Float64[Floats, "... m"]:
    """The maximum-likelihood strengths of methods (Bradley and Terry 1952), for each table of wins, with mean 0.

    P(a beats b) = 1 / (1 + exp(strength_b - strength_a)); `wins[a, b]` is the number of wins of method a against method
    b, and a tie adds 0.5 to both orders. NaN for a table without a maximum, where some methods never lose to the others
    (Ford 1957). Damped Newton's method: each step is divided by 1 + its length, so the likelihood always increases
    (Nesterov 2004, 4.1.5). All tables are fitted together: the package choix fits one at a time, and needs 70 times as
    long for 10,000 resamples."""
    wins = wins * (1 - np.eye(wins.shape[-1]))
    total = wins + np.swapaxes(wins, -1, -2)
    is_bounded = all_connected(wins)
    strength = np.zeros(wins.shape[:-1])
    for _ in range(_MAX_NEWTON_STEPS):
        probability = 1 / (1 + np.exp(strength[..., None, :] - strength[..., :, None]))
        gradient = (wins - total * probability).sum(axis=-1)
        curvature = total * probability * (1 - probability)
        weights = np.where(is_bounded[..., None, None], curvature, 1.0)
        # the graph Laplacian; plus 1 in every entry, which makes it invertible and keeps the sum of each step at 0
        hessian = np.eye(wins.shape[-1]) * weights.sum(axis=-1)[..., None] - weights + 1.0
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        length = np.abs(step).max(axis=-1, keepdims=True)
        strength = strength + np.where(is_bounded[..., None], step / (1 + length), 0.0)
        if length[is_bounded].max(initial=0.0) < _MIN_NEWTON_STEP:
            break
    strength -= strength.mean(axis=-1, keepdims=True)
    return np.where(is_bounded[..., None], strength, np.nan)


def all_connected(wins: Float64[Floats, "... m m"]) -> NDArray[np.bool_]:
    """Whether each method has beaten each other one, directly or through a chain of wins; one value for each table."""
    steps = (wins > 0) + np.eye(wins.shape[-1])
    return np.asarray((np.linalg.matrix_power(steps, wins.shape[-1]) > 0).all(axis=(-1, -2)))


def alpha(ratings: Float64[NDArray[np.float64], "u c"]) -> float | None:
    """Krippendorff's alpha, the agreement of raters on nominal categories: 1 - observed / expected disagreement
    (Krippendorff 2011, "Computing Krippendorff's alpha-reliability", part D), 1 for perfect agreement and 0 for
    agreement by chance. `ratings` is the number of ratings by unit and category; units with fewer than two are
    ignored. None if no unit has two ratings, or all ratings are equal."""
    paired = ratings[ratings.sum(axis=1) >= 2]
    sizes, totals = paired.sum(axis=1), paired.sum(axis=0)
    count = sizes.sum()
    expected = count**2 - (totals**2).sum()
    if expected == 0:
        return None
    observed = ((sizes**2 - (paired**2).sum(axis=1)) / (sizes - 1)).sum()
    return float(1 - (count - 1) * observed / expected)


# --- power analysis: the number of participants that a study needs


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
