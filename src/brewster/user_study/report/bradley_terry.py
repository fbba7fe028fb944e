"""The model of Bradley and Terry (1952): one strength for each method, from all comparisons together.

P(a beats b) = 1 / (1 + exp(strength_b - strength_a)). A tie counts as half a win for each of the two methods. Strengths sum
to 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jaxtyping import Float64

Floats = NDArray[np.float64]
_MAX_ITERATIONS: Final = 200
_TOLERANCE: Final = 1e-10


def strengths(wins: Float64[Floats, "... m m"]) -> Float64[Floats, "... m"]:
    """The maximum-likelihood strengths for each table of wins.

    Damped Newton's method: each step is divided by 1 + its length, so the likelihood always increases (Nesterov 2004,
    section 4.1.5).

    Args:
        wins: `wins[a, b]` is the number of wins of method a against method b; a tie adds 0.5 to both orders.

    Returns:
        The strengths, with mean 0; NaN for a table without a maximum, where some methods never lose to the others
        (Ford 1957).
    """
    wins = wins * (1 - np.eye(wins.shape[-1]))
    total = wins + np.swapaxes(wins, -1, -2)
    is_bounded = all_connected(wins)
    strength = np.zeros(wins.shape[:-1])
    for _ in range(_MAX_ITERATIONS):
        probability = 1 / (1 + np.exp(strength[..., None, :] - strength[..., :, None]))
        gradient = (wins - total * probability).sum(axis=-1)
        curvature = total * probability * (1 - probability)
        weights = np.where(is_bounded[..., None, None], curvature, 1.0)
        # the graph Laplacian; plus 1 in every entry, which makes it invertible and keeps the sum of each step at 0
        hessian = np.eye(wins.shape[-1]) * weights.sum(axis=-1)[..., None] - weights + 1.0
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        length = np.abs(step).max(axis=-1, keepdims=True)
        strength = strength + np.where(is_bounded[..., None], step / (1 + length), 0.0)
        if length[is_bounded].max(initial=0.0) < _TOLERANCE:
            break
    strength -= strength.mean(axis=-1, keepdims=True)
    return np.where(is_bounded[..., None], strength, np.nan)


def all_connected(wins: Float64[Floats, "... m m"]) -> NDArray[np.bool_]:
    """Whether each method has beaten each other one, directly or through a chain of wins; one value for each table."""
    reach = (wins > 0) | np.eye(wins.shape[-1], dtype=bool)
    for _ in range(wins.shape[-1].bit_length()):
        reach = (reach.astype(np.int64) @ reach.astype(np.int64)) > 0
    return np.asarray(reach.all(axis=(-1, -2)))
