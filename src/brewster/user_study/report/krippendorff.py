"""Krippendorff's alpha: agreement of raters on nominal categories, with missing ratings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Float64


def alpha(ratings: Float64[NDArray[np.float64], "u c"]) -> float | None:
    """Krippendorff's alpha for nominal data: 1 - observed / expected disagreement.

    Krippendorff 2011, "Computing Krippendorff's alpha-reliability", part D.

    Args:
        ratings: number of ratings by unit and category. Units with fewer than two ratings are ignored.

    Returns:
        1 for perfect agreement, 0 for agreement by chance; None if no unit has two ratings, or all ratings are equal.
    """
    paired = ratings[ratings.sum(axis=1) >= 2]
    sizes, totals = paired.sum(axis=1), paired.sum(axis=0)
    count = sizes.sum()
    expected = count**2 - (totals**2).sum()
    if expected == 0:
        return None
    observed = ((sizes**2 - (paired**2).sum(axis=1)) / (sizes - 1)).sum()
    return float(1 - (count - 1) * observed / expected)
