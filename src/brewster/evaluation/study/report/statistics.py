"""Rates and their confidence intervals. The bootstrap resamples whole participants, since their
answers are correlated.

Arrays of counts are (participants, pairs of methods, datasets, 3): wins, ties and losses of the
first method. In shapes, p is the number of participants, r of resamples and d of datasets.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Final

import krippendorff
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from brewster.base.bootstrap import RESAMPLES, cluster_draws

if TYPE_CHECKING:
    from jaxtyping import Float64

SEED: Final = 20_261_121
MIN_PARTICIPANTS: Final = 6
"""With fewer participants, `sign_flip_test` cannot reach the 5 % level: its smallest p-value is 2 /
2^n.
"""
_TOLERANCE: Final = 1e-9

Floats = NDArray[np.float64]


def bootstrap_weights(participants: int, resamples: int = RESAMPLES) -> Float64[Floats, "r p"]:
    """How often each participant, with all answers, is in each resample. The seed is fixed."""
    return cluster_draws(participants, [SEED, participants], resamples)


def resampled_counts(
    weights: Float64[Floats, "r p"], counts: Float64[Floats, "p ..."]
) -> Float64[Floats, "r ..."]:
    """The counts of each resample, summed over its participants."""
    totals: Floats = (weights @ counts.reshape(len(counts), -1)).reshape(
        len(weights), *counts.shape[1:]
    )
    return totals


def rates(
    counts: Float64[Floats, "... d 3"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... d+3 4"]:
    """Rates of win, tie and lose, and the difference win - lose. `pictures` is the number of
    pictures of each dataset. Returns a row for each dataset, then three averages: the mean weighted
    by the number of pictures (as in the paper), the mean of the datasets, and the rates of all
    answers together. Rows without answers are NaN.
    """
    with np.errstate(invalid="ignore"):
        shares = counts / counts.sum(axis=-1, keepdims=True)
        pooled = counts.sum(axis=-2, keepdims=True)
        pooled = pooled / pooled.sum(axis=-1, keepdims=True)
    rows = np.concatenate([shares, averages(shares, pictures), pooled], axis=-2)
    return np.concatenate([rows, rows[..., :1] - rows[..., 2:]], axis=-1)


def averages(
    shares: Float64[Floats, "... d k"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... 2 k"]:
    """Two means over datasets: one weighted by the number of pictures, as in the paper's Table 3,
    and one unweighted. The leading axes of the two arguments broadcast: `shares` may have an axis
    of resamples that `pictures` lacks.
    """
    weights = pictures / pictures.sum(axis=-1, keepdims=True)
    return np.stack([(shares * weights[..., None]).sum(axis=-2), shares.mean(axis=-2)], axis=-2)


def bootstrap_interval(
    draws: Float64[Floats, "r ..."], participants: int
) -> Float64[Floats, "2 ..."]:
    """The 95 % expanded percentile interval (Hesterberg 2015, section 4.3.2) of a statistic with
    these values, one for each resample; NaN is ignored. Its percentiles are slightly wider than 2.5
    and 97.5, because the plain percentile interval is too narrow for few participants. The ends are
    NaN for a single participant.
    """
    if participants < 2:
        return np.full((2, *draws.shape[1:]), np.nan)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")  # a dataset without answers
        return np.nanpercentile(draws, _expanded_percentiles(participants), axis=0)


def sign_flip_test(
    counts: Float64[Floats, "p ... d 3"],
    pictures: Float64[Floats, "... d"],
    resamples: int = RESAMPLES,
) -> Float64[Floats, "... d+3"]:
    """The two-sided p-values of the differences win - lose, for each row of `rates`; NaN without
    answers.

    The test exchanges wins and losses of whole participants at random, because their answers are
    correlated. It assumes that, without a difference of the methods, each participant is as likely
    to prefer one as the other. (A randomisation test, Good 2005, "Permutation, Parametric and
    Bootstrap Tests of Hypotheses", 3.2; one is added to both counts as in Phipson and Smyth 2010.)
    The p-values are random estimates of the exact ones over all 2^n exchanges of n participants.
    """
    rng = np.random.default_rng([SEED, len(counts), 1])
    signs = rng.choice([-1.0, 1.0], (resamples, len(counts)))
    half_sum = counts.copy()
    half_difference = np.zeros_like(counts)
    half_sum[..., ::2] = (counts[..., :1] + counts[..., 2:]) / 2
    half_difference[..., 0] = (counts[..., 0] - counts[..., 2]) / 2
    half_difference[..., 2] = -half_difference[..., 0]
    found = np.abs(rates(counts.sum(axis=0), pictures)[..., 3])
    draws = np.abs(
        rates(half_sum.sum(axis=0) + resampled_counts(signs, half_difference), pictures)[..., 3]
    )
    p_values = (1 + (draws >= found - _TOLERANCE).sum(axis=0)) / (1 + resamples)
    return np.where(np.isfinite(found), p_values, np.nan)


def agreement_bounds(
    counts: Float64[Floats, "p ... d 3"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... d+3"]:
    """The lower end of the 95 % interval for an observed rate of 1, for each row of `rates`; NaN
    without answers. If all answers agree, the bootstrap has no spread. The bound is then that of
    Clopper and Pearson (1934) for n successes of n trials, 0.025^(1 / n). Here n is the number of
    participants, not of answers, since answers of one participant are not independent. The bound of
    an average of rates is the average of their bounds.
    """
    sizes = counts.sum(axis=-1)
    with np.errstate(divide="ignore"):
        bounds = 0.025 ** (1 / (sizes > 0).sum(axis=0))
        pooled = 0.025 ** (1 / (sizes.sum(axis=-1) > 0).sum(axis=0))
    bounds = np.where((sizes > 0).any(axis=0), bounds, np.nan)
    return np.concatenate(
        [bounds, averages(bounds[..., None], pictures)[..., 0], pooled[..., None]], axis=-1
    )


def with_agreement_bounds(
    rows: Float64[Floats, "... n 4"],
    ends: Float64[Floats, "2 ... n 4"],
    bounds: Float64[Floats, "... n"],
) -> Float64[Floats, "2 ... n 4"]:
    """The intervals of `rates`, with those of width 0 replaced by intervals from
    `agreement_bounds`. An interval is NaN if its width is 0 although answers differ, for example if
    only one participant has answered for a dataset.
    """
    bound = bounds[..., None]
    shares = rows[..., :3]
    is_one = shares > 1 - _TOLERANCE
    is_zero = shares < _TOLERANCE
    lows = np.where(is_one, bound, np.where(is_zero, 0.0, np.nan))
    highs = np.where(is_one, 1.0, np.where(is_zero, 1 - bound, np.nan))
    lows, highs = (
        np.concatenate([own, own[..., :1] - other[..., 2:]], axis=-1)
        for own, other in ((lows, highs), (highs, lows))
    )
    return np.where(ends[1] - ends[0] < _TOLERANCE, np.stack([lows, highs]), ends)


def _expanded_percentiles(participants: int) -> tuple[float, float]:
    """The percentiles of a bootstrap that match the 95 % interval of Student's t with n - 1 degrees
    of freedom. They also correct the bootstrap's spread, which is too small by the factor sqrt((n -
    1) / n).
    """
    t = stdtrit(participants - 1, 0.975)
    tail = 100 * float(ndtr(-t * math.sqrt(participants / (participants - 1))))
    return tail, 100 - tail


def alpha(ratings: Float64[NDArray[np.float64], "u c"]) -> float | None:
    """Krippendorff's alpha, the agreement of raters on nominal categories: 1 - observed / expected
    disagreement (Krippendorff 2011, "Computing Krippendorff's alpha-reliability", part D), 1 for
    perfect agreement and 0 for agreement by chance. `ratings` is the number of ratings by unit and
    category; units with fewer than two are ignored. None if no unit has two ratings, or all ratings
    are equal.
    """
    paired = ratings[ratings.sum(axis=1) >= 2]
    if np.count_nonzero(paired.sum(axis=0)) < 2:
        return None
    return float(krippendorff.alpha(value_counts=paired, level_of_measurement="nominal"))
