"""Do raters agree? Krippendorff's alpha for names without order, where not everybody has rated everything."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Float64


def alpha(ratings: Float64[NDArray[np.float64], "u c"]) -> float | None:
    """1 where all agree, 0 where they agree as chance would; None where nobody rated the same, or all said one thing.

    Args:
        ratings: how often each unit was given each category. Units with fewer than two ratings do not count.

    Krippendorff 2011, "Computing Krippendorff's alpha-reliability", part D: 1 - observed / expected disagreement.
    """
    paired = ratings[ratings.sum(axis=1) >= 2]
    sizes, totals = paired.sum(axis=1), paired.sum(axis=0)
    count = sizes.sum()
    expected = count**2 - (totals**2).sum()
    if expected == 0:
        return None
    observed = ((sizes**2 - (paired**2).sum(axis=1)) / (sizes - 1)).sum()
    return float(1 - (count - 1) * observed / expected)
