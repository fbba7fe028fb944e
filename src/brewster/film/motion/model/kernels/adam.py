"""The step of the layers: Adam."""

from typing import Final

import numpy as np

from brewster.film.motion.model.kernels.compiled import ONE, TWO, ZERO, F, kernel

BETA1: Final = 0.9
"""Of the first moments."""
BETA2: Final = 0.99
"""Of the second moments."""
_ADAM_EPSILON: Final = F(1e-8)


@kernel
def layer_step(
    begin, end, layers, light, gradient, scatter, touched, parts, first, second, rate, correction
):
    """Takes a step of Adam (Kingma and Ba 2015), and empties `scatter` for the next one. An item is
    a row of a layer.

    Args:
        begin: the first item.
        end: the item after the last.
        layers: (C, L, H, W, 4), the square roots of `light`, which are optimised.
        light: (C, L, H, W, 4), gets their squares.
        gradient: (C, L, H, W, 4), that of the penalties with respect to `layers`.
        scatter: (C * parts, L, H * W * 4), that of the data term with respect to `light`.
        touched: (C * parts, L, 2), see `data_term`.
        parts: the number of strips of a candidate.
        first: (C, L, H, W, 4), the first moments.
        second: (C, L, H, W, 4), the second moments.
        rate: the learning rate, divided by the correction of the first moment.
        correction: of the root of the second moment.
    """
    beta1 = F(BETA1)
    beta2 = F(BETA2)
    _, layer_count, height, width, _ = layers.shape
    for item in range(begin, end):
        candidate = item // (layer_count * height)
        layer = item // height % layer_count
        y = item % height
        g = gradient[candidate, layer, y].reshape(-1)
        p = layers[candidate, layer, y].reshape(-1)
        s = light[candidate, layer, y].reshape(-1)
        m = first[candidate, layer, y].reshape(-1)
        v = second[candidate, layer, y].reshape(-1)
        # g (4 W,) = d penalties / d p + sum over strips of 2 p d data term / d light, light = p^2
        for strip in range(candidate * parts, (candidate + 1) * parts):
            if touched[strip, layer, 0] <= y < touched[strip, layer, 1]:
                found = scatter[strip, layer, y * width * 4 : (y + 1) * width * 4]
                for x in range(4 * width):
                    g[x] += TWO * p[x] * found[x]
                    found[x] = ZERO
        # m = beta1 m + (1 - beta1) g, v = beta2 v + (1 - beta2) g^2, all of them (4 W,)
        # p -= rate m / (correction sqrt(v) + epsilon)
        for x in range(4 * width):
            m[x] = beta1 * m[x] + (ONE - beta1) * g[x]
            v[x] = beta2 * v[x] + (ONE - beta2) * g[x] * g[x]
            value = p[x] - rate * m[x] / (np.sqrt(v[x]) * correction + _ADAM_EPSILON)
            p[x] = value
            s[x] = value * value
