"""Samples of layers and frames at any place, and layers at full size."""

import numpy as np

from brewster.film.motion.model.kernels import OFFSET
from brewster.film.motion.model.kernels.compiled import HALF, ONE, ZERO, F, kernel


@kernel
def _bilinear(canvas, top, left, a, b, c):
    """Returns the sample of channel c of a canvas (H, W, 4), at the distances a and b to the right
    of and below a pixel.
    """
    p = canvas[top, left, c]
    upper = p + a * (canvas[top, left + 1, c] - p)
    r = canvas[top + 1, left, c]
    lower = r + a * (canvas[top + 1, left + 1, c] - r)
    return upper + b * (lower - upper)


@kernel
def sample(canvas, x, y, out):
    """Writes bilinear samples of a canvas.

    Args:
        canvas: (H, W, 4).
        x: (h, w), in pixels of the canvas, 0 is the first centre.
        y: (h, w), the same.
        out: (h, w, 4), gets the samples.
    """
    height, width, _ = canvas.shape
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            u = min(max(x[i, j], ZERO), F(width - 1))
            v = min(max(y[i, j], ZERO), F(height - 1))
            left = min(int(u), width - 2)
            top = min(int(v), height - 2)
            a = u - F(left)
            b = v - F(top)
            for c in range(4):
                out[i, j, c] = _bilinear(canvas, top, left, a, b, c)


@kernel
def darken(frame, x, y, first, second):
    """Keeps the least and the second least of the samples of frames so far, in each channel. A
    place outside of the frame has no sample.

    Args:
        frame: (h, w, 4).
        x: (H, W), in pixels of the frame, 0 is the first centre.
        y: (H, W), the same.
        first: (H, W, 4), the least values so far, to which those of this frame are compared.
        second: (H, W, 4), the second least values so far.
    """
    height, width, _ = frame.shape
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            u = x[i, j]
            v = y[i, j]
            # The edges of the frame are half a pixel beyond the outer centres
            if -HALF <= u <= F(width) - HALF and -HALF <= v <= F(height) - HALF:
                u = min(max(u, ZERO), F(width - 1))
                v = min(max(v, ZERO), F(height - 1))
                left = min(int(u), width - 2)
                top = min(int(v), height - 2)
                a = u - F(left)
                b = v - F(top)
                for c in range(4):
                    value = _bilinear(frame, top, left, a, b, c)
                    least = first[i, j, c]
                    first[i, j, c] = min(least, value)
                    second[i, j, c] = min(second[i, j, c], max(least, value))


@kernel
def collect(values, x, y, out):
    """Adds values to the four pixels around each position, and their weights. The adjoint of
    `sample`.

    Args:
        values: (h, w).
        x: (h, w), in pixels of `out`, 0 is the first centre.
        y: (h, w), the same.
        out: (H, W, 2), gets the sums of the values and of their weights.
    """
    height, width, _ = out.shape
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            left = int(np.floor(x[i, j]))
            top = int(np.floor(y[i, j]))
            a = x[i, j] - F(left)
            b = y[i, j] - F(top)
            # The weights of the four pixels are those of `sample`
            for row, column, weight in (
                (top, left, (ONE - a) * (ONE - b)),
                (top, left + 1, a * (ONE - b)),
                (top + 1, left, (ONE - a) * b),
                (top + 1, left + 1, a * b),
            ):
                if 0 <= row < height and 0 <= column < width:
                    out[row, column, 0] += weight * values[i, j]
                    out[row, column, 1] += weight


@kernel
def apply_linear(picture, linear, slope, offset, codes, out):
    """Writes a layer of a picture: slope * light + offset, with slope and offset enlarged.

    Args:
        picture: (h, w, 3), 8-bit codes.
        linear: (256,), the light of each code.
        slope: (h', w', 3), smaller.
        offset: (h', w', 3).
        codes: (n,), the 8-bit codes of light from 0 to 1. Other light becomes the nearest of them.
        out: (h, w, 3), gets the codes of the layer.
    """
    height, width, _ = picture.shape
    rows, columns, _ = slope.shape
    last = F(len(codes) - 1)
    left = np.empty(width, np.int64)
    right = np.empty(width, np.int64)
    fraction = np.empty(width, np.float32)
    for x in range(width):
        place = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
        left[x] = int(place)
        right[x] = min(left[x] + 1, columns - 1)
        fraction[x] = place - left[x]
    slopes = np.empty((columns, 3), np.float32)
    offsets = np.empty((columns, 3), np.float32)
    for y in range(height):
        place = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
        top = int(place)
        bottom = min(top + 1, rows - 1)
        b = F(place - top)
        # slopes (w', 3) = (1 - b) slope_top + b slope_bottom; offsets likewise
        for x in range(columns):
            for c in range(3):
                slopes[x, c] = slope[top, x, c] + b * (slope[bottom, x, c] - slope[top, x, c])
                offsets[x, c] = offset[top, x, c] + b * (offset[bottom, x, c] - offset[top, x, c])
        for x in range(width):
            i = left[x]
            j = right[x]
            a = fraction[x]
            for c in range(3):
                factor = slopes[i, c] + a * (slopes[j, c] - slopes[i, c])
                value = offsets[i, c] + a * (offsets[j, c] - offsets[i, c])
                value += factor * linear[picture[y, x, c]]
                out[y, x, c] = codes[int(min(max(value, ZERO), ONE) * last)]


@kernel
def encoded_transmission(begin, end, light, x, y, encoded, visible):
    """Writes the square roots of T at some places of the canvases. An item is a row of places of a
    candidate.

    Args:
        begin: the first item.
        end: the item after the last.
        light: (C, L, H, W, 4), the layers in linear light.
        x: (h, w), in pixels of the canvases, 0 is the first centre.
        y: (h, w), the same.
        encoded: (C, h, w, 4), gets the roots of T + OFFSET.
        visible: (C, h, w), gets the share of the first layer that the second one does not hide.
    """
    _, layer_count, canvas_height, canvas_width, _ = light.shape
    rows, columns = x.shape
    for item in range(begin, end):
        candidate = item // rows
        i = item % rows
        for j in range(columns):
            u = min(max(x[i, j], ZERO), F(canvas_width - 1))
            v = min(max(y[i, j], ZERO), F(canvas_height - 1))
            left = min(int(u), canvas_width - 2)
            top = min(int(v), canvas_height - 2)
            a = u - F(left)
            b = v - F(top)
            opacity = _bilinear(light[candidate, 1], top, left, a, b, 3)
            share = max(ONE - opacity, ZERO)
            visible[candidate, i, j] = share
            # T (4,) = samples_0 (1 - opacity) + samples_1 + ... + samples_(L - 2)
            for c in range(3):
                total = share * _bilinear(light[candidate, 0], top, left, a, b, c)
                for layer in range(1, layer_count - 1):
                    total += _bilinear(light[candidate, layer], top, left, a, b, c)
                encoded[candidate, i, j, c] = np.sqrt(total + OFFSET)
            encoded[candidate, i, j, 3] = np.sqrt(OFFSET)
