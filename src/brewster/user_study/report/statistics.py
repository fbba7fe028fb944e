"""Rates and their uncertainty: whole participants are drawn, since answers of one person are alike.

Arrays of counts are (participants, pairs of methods, datasets, 3): how often the first method won, tied, lost.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Float64

RESAMPLES: Final = 10_000
SEED: Final = 20_261_121
_EQUAL: Final = 1e-9

Floats = NDArray[np.float64]


def bootstrap_weights(participants: int, resamples: int = RESAMPLES) -> Float64[Floats, "r p"]:
    """How often each participant is in each resample.

    Cluster bootstrap (Davison and Hinkley 1997, section 3.8): as many participants as there are, drawn with
    replacement, each with all their answers; a fixed seed.
    """
    rng = np.random.default_rng([SEED, participants])
    return rng.multinomial(participants, np.full(participants, 1 / participants), resamples).astype(float)


def resampled_counts(weights: Floats, counts: Floats) -> Floats:
    """The counts (p, ...) of each resample, (r, ...)."""
    totals: Floats = (weights @ counts.reshape(len(counts), -1)).reshape(len(weights), *counts.shape[1:])
    return totals


def rates(
    counts: Float64[Floats, "... d 3"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... d+3 4"]:
    """Win, tie and lose rate and win less lose: of each dataset, then the three averages; NaN where nobody answered.

    The averages: by pictures (the paper's), by datasets, and of all answers together.
    """
    with np.errstate(invalid="ignore"):
        shares = counts / counts.sum(axis=-1, keepdims=True)
        pooled = counts.sum(axis=-2, keepdims=True)
        pooled = pooled / pooled.sum(axis=-1, keepdims=True)
    rows = np.concatenate([shares, averages(shares, pictures), pooled], axis=-2)
    return np.concatenate([rows, rows[..., :1] - rows[..., 2:]], axis=-1)


def averages(
    shares: Float64[Floats, "... d 3"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... 2 3"]:
    """Averages over datasets: weighted by their number of pictures, as in the paper's Table 3; and equally."""
    weights = pictures / pictures.sum(axis=-1, keepdims=True)
    return np.stack([(shares * weights[..., None]).sum(axis=-2), shares.mean(axis=-2)], axis=-2)


def bootstrap_interval(draws: Float64[Floats, "r ..."], participants: int) -> Float64[Floats, "2 ..."]:
    """The 95 % interval of each column of resamples of so many participants, without those that have no value in it.

    The expanded percentile interval (Hesterberg 2015, section 4.3.2): slightly wider percentiles, so that few
    participants do not pass for more than they are. NaN for a single one.
    """
    if participants < 2:
        return np.full((2, *draws.shape[1:]), np.nan)
    ends = _expanded_percentiles(participants)
    if np.isfinite(draws).all():
        return np.percentile(draws, ends, axis=0)
    columns = [column[np.isfinite(column)] for column in draws.reshape(len(draws), -1).T]
    found = [np.percentile(column, ends) if column.size else np.full(2, np.nan) for column in columns]
    return np.array(found).T.reshape(2, *draws.shape[1:])


def agreement_bounds(
    counts: Float64[Floats, "p ... d 3"], pictures: Float64[Floats, "... d"]
) -> Float64[Floats, "... d+3"]:
    """The lower 95 % bound of a rate that all answers agree on, of each row of `rates`; NaN where nobody answered.

    Clopper and Pearson 1934 with n of n, 0.025^(1 / n), n being the participants of a dataset: somebody who gives several
    answers agrees in all of them no more surely than in one. Averages of the bounds bound the averages.
    """
    sizes = counts.sum(axis=-1)
    with np.errstate(divide="ignore"):
        bounds = 0.025 ** (1 / (sizes > 0).sum(axis=0))
        pooled = 0.025 ** (1 / (sizes.sum(axis=-1) > 0).sum(axis=0))
    bounds = np.where((sizes > 0).any(axis=0), bounds, np.nan)
    return np.concatenate([bounds, averages(bounds[..., None], pictures)[..., 0], pooled[..., None]], axis=-1)


def with_agreement_bounds(
    rows: Float64[Floats, "... 4"], ends: Float64[Floats, "2 ... 4"], bounds: Floats
) -> Float64[Floats, "2 ... 4"]:
    """The intervals of `rates`, where those without width, of resamples that are all alike, are those of `agreement_bounds`.

    NaN where there is no width though answers differ, as when a single participant has answered about a dataset.
    """
    bound, shares = bounds[..., None], rows[..., :3]
    is_one, is_zero = shares > 1 - _EQUAL, shares < _EQUAL
    lows = np.where(is_one, bound, np.where(is_zero, 0.0, np.nan))
    highs = np.where(is_one, 1.0, np.where(is_zero, 1 - bound, np.nan))
    lows, highs = (
        np.concatenate([own, own[..., :1] - other[..., 2:]], axis=-1)
        for own, other in ((lows, highs), (highs, lows))
    )
    return np.where(ends[1] - ends[0] < _EQUAL, np.stack([lows, highs]), ends)


def _expanded_percentiles(participants: int) -> tuple[float, float]:
    """Where 95 % of t with one degree of freedom less lie in a bootstrap, whose spread is too small by sqrt((n - 1) / n).

    The quantile of t is that of Abramowitz and Stegun 1972, 26.7.5.
    """
    z, v = NormalDist().inv_cdf(0.975), participants - 1
    t = z + (z**3 + z) / (4 * v) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * v**2)
    tail = 100 * NormalDist().cdf(-t * math.sqrt(participants / v))
    return tail, 100 - tail


def intraclass_correlation(counts: Float64[Floats, "p 3"]) -> float | None:
    """How alike the answers of one participant are: the intraclass correlation of scores 1, 0, -1 for win, tie, lose.

    The estimator from the analysis of variance (Donner 1986, equation 2.1), which may fall below 0 by chance; None where
    it has no value.
    """
    counts = counts[counts.sum(axis=1) > 0]
    sizes, sums, squares = counts.sum(axis=1), counts[:, 0] - counts[:, 2], counts[:, 0] + counts[:, 2]
    people, answers = len(sizes), float(sizes.sum())
    if people < 2 or answers <= people:
        return None
    between = ((sums**2 / sizes).sum() - sums.sum() ** 2 / answers) / (people - 1)
    within = (squares - sums**2 / sizes).sum() / (answers - people)
    size = (answers - (sizes**2).sum() / answers) / (people - 1)
    spread = between + (size - 1) * within
    return float((between - within) / spread) if spread > 0 else None
