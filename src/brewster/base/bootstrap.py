"""The bootstrap of evaluations and of user studies. It resamples whole clusters, whose values are
correlated.

A cluster is a scene with all its images, or a participant with all answers.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

RESAMPLES: Final = 10_000


def cluster_draws(
    clusters: int, seed: Sequence[int], resamples: int = RESAMPLES
) -> NDArray[np.float64]:
    """Returns how often each cluster is in each resample: (resamples, clusters), float64. Equal
    seeds give equal draws.

    Drawing k of k clusters with replacement is a multinomial distribution (Davison and Hinkley
    1997, section 3.8).
    """
    rng = np.random.default_rng(seed)
    return rng.multinomial(clusters, np.full(clusters, 1 / clusters), resamples).astype(float)
