"""The penalties of the edges: their lengths, and what both layers have at the same place."""

from typing import Final

import numpy as np

from brewster.film.motion.model.kernels import CHARBONNIER
from brewster.film.motion.model.kernels.compiled import ONE, QUARTER, THIRD, ZERO, F, kernel

_SQUARED: Final = CHARBONNIER * CHARBONNIER


@kernel
def gradient_lengths(begin, end, layers, squared_density, weights, parts, gradient, losses):
    """Computes the mean lengths of the gradients of the layers (total variation), and the gradient
    of this loss. An item is one of `parts` strips of rows of a layer.

    The length of the gradient, not the sum of its components, which favours edges along the axes.

    Args:
        begin: the first item.
        end: the item after the last.
        layers: (C, L, H, W, 4), square roots of light.
        squared_density: the square of the number of pixels of a canvas per pixel of a frame.
        weights: (L,), those of the layers in the loss.
        parts: the number of strips of a layer.
        gradient: (C, L, H, W, 4), gets the gradient.
        losses: (C * L * parts,), gets the losses of the items.
    """
    _, layer_count, height, width, _ = layers.shape
    size = (width - 1) * 4
    for item in range(begin, end):
        candidate = item // (layer_count * parts)
        layer = item // parts % layer_count
        part = item % parts
        first = height * part // parts
        last = height * (part + 1) // parts
        # With d2 = squared_density and dx, dy the differences of a value to those right and below:
        #   length = sqrt(d2 (dx^2 + dy^2) + CHARBONNIER^2)
        #   loss   = weight * sum over rows, columns and channels of length - CHARBONNIER
        #   across = weight d2 dx / length, down = weight d2 dy / length    (4 (W - 1),)
        #   gradient = -across - down + across of the left pixel + down of the pixel above
        weight = weights[layer] / (3 * (height - 1) * (width - 1))
        factor = F(weight) * squared_density
        above = np.zeros(size + 4, np.float32)
        across = np.zeros(size + 4, np.float32)
        down = np.zeros(size + 4, np.float32)
        total = 0.0
        for y in range(max(first - 1, 0), last):
            here = layers[candidate, layer, y].reshape(-1)
            if y < height - 1:
                below = layers[candidate, layer, y + 1].reshape(-1)
                loss = ZERO
                for x in range(size):
                    dx = here[x + 4] - here[x]
                    dy = below[x] - here[x]
                    length = np.sqrt(squared_density * (dx * dx + dy * dy) + _SQUARED)
                    loss += length - CHARBONNIER
                    across[x] = factor * dx / length
                    down[x] = factor * dy / length
                total += loss if y >= first else ZERO
            else:
                for x in range(size):
                    across[x] = ZERO
                    down[x] = ZERO
            if y >= first:
                out = gradient[candidate, layer, y].reshape(-1)
                for x in range(4):
                    out[x] = above[x] - across[x] - down[x]
                for x in range(4, size):
                    out[x] = above[x] - across[x] - down[x] + across[x - 4]
                for x in range(size, size + 4):
                    out[x] = across[x - 4]
            for x in range(size):
                above[x] = down[x]
        losses[item] = total * weight


@kernel
def halved(begin, end, images, out):
    """Writes the means of 2 x 2 pixels of the first and the last layer. An item is a row of `out`.

    Args:
        begin: the first item.
        end: the item after the last.
        images: (C, L, H, W, 4).
        out: (C, 2, H // 2, W // 2, 4), gets the means.
    """
    _, _, height, width, _ = out.shape
    for item in range(begin, end):
        candidate = item // (2 * height)
        layer = item // height % 2
        y = item % height
        which = layer * (images.shape[1] - 1)
        row = out[candidate, layer, y].reshape(-1)
        above = images[candidate, which, 2 * y].reshape(-1)
        below = images[candidate, which, 2 * y + 1].reshape(-1)
        # row (4 W/2,) = (above left + above right + below left + below right) / 4
        for x in range(width):
            for c in range(4):
                left = 8 * x + c
                right = 8 * x + 4 + c
                row[4 * x + c] = QUARTER * (above[left] + above[right] + below[left] + below[right])


@kernel
def edge_strengths(begin, end, images, parts, across, down, sums):
    """Writes the strengths of the edges of the first and the last layer: the mean absolute
    differences of the channels. An item is one of `parts` strips of rows of a candidate.

    Args:
        begin: the first item.
        end: the item after the last.
        images: (C, L, H, W, 4).
        parts: the number of strips of a candidate.
        across: (C, 2, H, W), gets the differences along x, but none in the last column.
        down: (C, 2, H, W), gets the differences along y, but none in the last row.
        sums: (C, parts, 2, 2), gets the sums of both, along x and y, in both layers.
    """
    _, layer_count, height, width, _ = images.shape
    for item in range(begin, end):
        candidate = item // parts
        part = item % parts
        # across (W - 1,) = mean over 3 channels of |right - here|, down (W,) of |below - here|
        for layer in range(2):
            sum_x = 0.0
            sum_y = 0.0
            for y in range(height * part // parts, height * (part + 1) // parts):
                here = images[candidate, layer * (layer_count - 1), y].reshape(-1)
                sum_x += _differences(here, here[4:], across[candidate, layer, y], width - 1)
                if y < height - 1:
                    below = images[candidate, layer * (layer_count - 1), y + 1].reshape(-1)
                    sum_y += _differences(here, below, down[candidate, layer, y], width)
            sums[candidate, part, 0, layer] = sum_x
            sums[candidate, part, 1, layer] = sum_y


@kernel
def _differences(first, second, out, count):
    """Writes the mean absolute differences of the channels of `count` pixels, and returns their
    sum. first and second are (4 w,), out is (w,).
    """
    total = ZERO
    for x in range(count):
        out[x] = THIRD * (
            abs(second[4 * x] - first[4 * x])
            + abs(second[4 * x + 1] - first[4 * x + 1])
            + abs(second[4 * x + 2] - first[4 * x + 2])
        )
        total += out[x]
    return total


@kernel
def edge_products(begin, end, parts, scales, across, down, losses):
    """Replaces the strengths of edges by the gradient of the mean product of tanh(scale * strength)
    of both layers. An item is one of `parts` strips of rows of a candidate.

    Args:
        begin: the first item.
        end: the item after the last.
        parts: the number of strips of a candidate.
        scales: (C, 2, 2), for each axis and layer. The gradient treats them as constants.
        across: (C, 2, H, W), from `edge_strengths`; gets the gradient.
        down: (C, 2, H, W), the same.
        losses: (C * parts,), gets the losses of the items.
    """
    _, _, height, width = across.shape
    for item in range(begin, end):
        candidate = item // parts
        part = item % parts
        loss = 0.0
        for y in range(height * part // parts, height * (part + 1) // parts):
            for axis, strengths, count, size in (
                (0, across, width - 1, height * (width - 1)),
                (1, down, width if y < height - 1 else 0, (height - 1) * width),
            ):
                first = strengths[candidate, 0, y]
                second = strengths[candidate, 1, y]
                scale0 = scales[candidate, axis, 0]
                scale1 = scales[candidate, axis, 1]
                # loss = weight * sum over x of a b
                # with a = tanh(scale0 first) and b = tanh(scale1 second), (W,)
                # d loss / d first (W,) = weight scale0 (1 - a^2) b; d loss / d second likewise
                # weight: a mean of each axis, and of two axes and three scales
                weight = F(1 / (6.0 * size))
                total = ZERO
                for x in range(count):
                    a = _tanh(first[x] * scale0)
                    b = _tanh(second[x] * scale1)
                    total += a * b
                    first[x] = (ONE - a * a) * b * scale0 * weight
                    second[x] = (ONE - b * b) * a * scale1 * weight
                loss += total * weight
        losses[item] = loss


@kernel
def _tanh(x):
    """An approximation for x >= 0, within 1e-4, which is vectorised: the continued fraction of
    Lambert.
    """
    x = min(x, F(4.97))
    s = x * x
    return (
        x
        * (F(135135) + s * (F(17325) + s * (F(378) + s)))
        / (F(135135) + s * (F(62370) + s * (F(3150) + s * F(28))))
    )


@kernel
def edge_gradient(begin, end, images, across, down, weight, coarse, gradient):
    """Adds to the gradient that of the edges, and a quarter of that of the halved images. An item
    is a row of the first or the last layer.

    Args:
        begin: the first item.
        end: the item after the last.
        images: (C, L, H, W, 4).
        across: (C, 2, H, W), the gradient of the strengths along x, from `edge_products`.
        down: (C, 2, H, W), that of the strengths along y.
        weight: the weight of the term in the loss.
        coarse: (C, 2, H // 2, W // 2, 4), the gradient of the halved images, or one without rows.
        gradient: (C, L, H, W, 4), to which the gradient is added.
    """
    _, layer_count, height, width, _ = images.shape
    beside = np.zeros(4 * width + 4, np.float32)
    below = np.empty(4 * width, np.float32)
    above = np.empty(4 * width, np.float32)
    for item in range(begin, end):
        candidate = item // (2 * height)
        layer = item // height % 2
        y = item % height
        which = layer * (layer_count - 1)
        here = images[candidate, which, y].reshape(-1)
        out = gradient[candidate, which, y].reshape(-1)
        # With f = across weight / 3 (W, 3 channels) and sign = that of right - here:
        #   here -= f sign, right += f sign
        # The first four of `beside` (4 + 4 W,) are 0: nothing is left of the first pixel
        _spread(across[candidate, layer, y], F(weight) * THIRD, beside[4:])
        for x in range(4 * (width - 1)):
            beside[x + 4] *= _sign(here[x + 4] - here[x])
        for x in range(4 * (width - 1)):
            out[x] += beside[x] - beside[x + 4]
        for x in range(4 * (width - 1), 4 * width):
            out[x] += beside[x]
        # The same for the differences to the rows below and above, the strengths of which are
        # `down` of this row and of the row above
        if 0 < y < height - 1:
            _spread(down[candidate, layer, y], F(weight) * THIRD, below)
            _spread(down[candidate, layer, y - 1], F(weight) * THIRD, above)
            lower = images[candidate, which, y + 1].reshape(-1)
            upper = images[candidate, which, y - 1].reshape(-1)
            for x in range(4 * width):
                out[x] += below[x] * _sign(here[x] - lower[x]) + above[x] * _sign(
                    here[x] - upper[x]
                )
        else:
            other = 1 if y == 0 else y - 1
            lower = images[candidate, which, other].reshape(-1)
            _spread(down[candidate, layer, min(y, other)], F(weight) * THIRD, below)
            for x in range(4 * width):
                out[x] += below[x] * _sign(here[x] - lower[x])
        # The adjoint of `halved`: each of four pixels gets a quarter
        if y // 2 < coarse.shape[2]:
            half = coarse[candidate, layer, y // 2].reshape(-1)
            for x in range(len(half) // 4):
                for c in range(4):
                    value = QUARTER * half[4 * x + c]
                    out[8 * x + c] += value
                    out[8 * x + 4 + c] += value


@kernel
def _spread(values, factor, out):
    """Writes the values (w,) of pixels, times a factor, to the three channels of out (4 w,), and 0
    to the fourth.
    """
    for x in range(len(values)):
        value = factor * values[x]
        out[4 * x] = value
        out[4 * x + 1] = value
        out[4 * x + 2] = value
        out[4 * x + 3] = ZERO


@kernel
def _sign(x):
    """Returns -1, 0 or 1."""
    return ONE if x > ZERO else (-ONE if x < ZERO else ZERO)
