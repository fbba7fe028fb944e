"""The arithmetic of the joint optimisation, compiled by numba: samples of the layers, and the terms
of the loss with their gradients.

A pixel has four channels, the last of which is 0, so that it fills a vector register. A kernel
works on the items `begin` to `end` and holds no lock, so that threads share the items. The rows of
a frame are cut into parts, and each part adds its gradients to a canvas of its own: no two threads
write the same value, and the sums do not depend on the number of threads.

Shapes: C candidates, L layers, K frames of (h, w) pixels, canvases of (H, W) pixels, splines of (r,
c) knots. Where a row of pixels is one array (4 w,), `4 * x + c` is channel c of pixel x.
"""

from collections.abc import Callable
from typing import Any, Final

import numba
import numpy as np
from numba import njit

MARGIN: Final = 0.15
"""The canvases extend beyond each edge of the reference frame by this share of its size."""
OFFSET: Final = np.float32(0.003)
"""Added to linear light below the square root, so that noise in the shadows counts less."""
CLIPPED: Final = np.float32(0.98)
"""Above this value, a pixel of a frame is clipped, and a brighter sum of the layers is no error."""
CHARBONNIER: Final = np.float32(0.01)
"""Errors below are squared, larger ones are absolute."""

_F = np.float32
_U = np.uint64
_ZERO, _HALF, _ONE, _TWO, _QUARTER, _THIRD = (_F(value) for value in (0, 0.5, 1, 2, 0.25, 1 / 3))
_1, _2, _3, _4, _5, _6, _7 = (_U(value) for value in range(1, 8))
_CANVAS: Final = _F(1 / (1 + 2 * MARGIN))
MIN_DENOMINATOR: Final = _F(0.1)
"""Of a projection: points at infinity would be outside of every canvas."""
_CLIPPED_ROOT: Final = _F(np.sqrt(CLIPPED + OFFSET))
_EPSILON: Final = CHARBONNIER
_EPSILON_SQUARED: Final = CHARBONNIER * CHARBONNIER
_BETA1 = _F(0.9)
_BETA2 = _F(0.99)
_ADAM_EPSILON = _F(1e-8)

# off by default; without it, the arithmetic of the four channels stays scalar
numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]
_OPTIONS: Final[dict[str, Any]] = {
    "fastmath": {"reassoc", "contract", "arcp", "nsz"}, "error_model": "numpy", "nogil": True
}  # fmt: skip


def _kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function without the interpreter's lock, once for all processes if the folder of
    the cache can be written.
    """
    try:
        compiled: Callable[..., Any] = njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder for the cache
        compiled = njit(**_OPTIONS)(function)
    return compiled


@_kernel
def _bilinear(canvas, top, left, a, b, c):
    """Returns the sample of channel c of a canvas (H, W, 4), at the distances a and b to the right
    of and below a pixel.
    """
    p = canvas[top, left, c]
    upper = p + a * (canvas[top, left + 1, c] - p)
    r = canvas[top + 1, left, c]
    lower = r + a * (canvas[top + 1, left + 1, c] - r)
    return upper + b * (lower - upper)


@_kernel
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
            u = min(max(x[i, j], _ZERO), _F(width - 1))
            v = min(max(y[i, j], _ZERO), _F(height - 1))
            left = min(int(u), width - 2)
            top = min(int(v), height - 2)
            a = u - _F(left)
            b = v - _F(top)
            for c in range(4):
                out[i, j, c] = _bilinear(canvas, top, left, a, b, c)


@_kernel
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
            if -_HALF <= u <= _F(width) - _HALF and -_HALF <= v <= _F(height) - _HALF:
                u = min(max(u, _ZERO), _F(width - 1))
                v = min(max(v, _ZERO), _F(height - 1))
                left = min(int(u), width - 2)
                top = min(int(v), height - 2)
                a = u - _F(left)
                b = v - _F(top)
                for c in range(4):
                    value = _bilinear(frame, top, left, a, b, c)
                    least = first[i, j, c]
                    first[i, j, c] = min(least, value)
                    second[i, j, c] = min(second[i, j, c], max(least, value))


@_kernel
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
    last = _F(len(codes) - 1)
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
        b = _F(place - top)
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
                out[y, x, c] = codes[int(min(max(value, _ZERO), _ONE) * last)]


@_kernel
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
            a = x[i, j] - _F(left)
            b = y[i, j] - _F(top)
            # The weights of the four pixels are those of `sample`
            for row, column, weight in (
                (top, left, (_ONE - a) * (_ONE - b)),
                (top, left + 1, a * (_ONE - b)),
                (top + 1, left, (_ONE - a) * b),
                (top + 1, left + 1, a * b),
            ):
                if 0 <= row < height and 0 <= column < width:
                    out[row, column, 0] += weight * values[i, j]
                    out[row, column, 1] += weight


@_kernel
def data_term(
    begin,
    end,
    light,
    target,
    homographies,
    splines,
    rows,
    columns,
    pieces,
    gains,
    extra,
    reference,
    every,
    phase,
    parts,
    scatter,
    touched,
    out,
):
    """The data term of C candidates with L layers, and its gradients. An item is one of `parts`
    strips of rows of a candidate.

    The last channel of the second layer is its opacity: it hides that share of the first layer.
    For pixel x of frame k, layer l and channel c:

        place_l   = project(homographies_lk, x) + spline_lk(x)       _row_positions
        s_l       = light_l at place_l, bilinear                     _gather
        total_c   = s_0c (1 - min(opacity, 1)) + s_1c + ... ,        _compose
                    opacity = s_1 in its fourth channel
        error_c   = sqrt(gains_kc total_c + OFFSET) - target_kc(x)   _errors
        loss      = mean over k, x, c of sqrt(error_c^2 + CHARBONNIER^2) - CHARBONNIER

    The functions after `_errors` are their adjoints, in the opposite order. The file
    tests/joint_model_reference.py is the same in NumPy.

    Args:
        begin: the first item.
        end: the item after the last.
        light: (C, L, H, W, 4), the layers in linear light.
        target: (K, h, w, 4), the square roots of the frames.
        homographies: (C, L, K, 8), frame to reference.
        splines: (C, L, K, 2, r, c), the offsets that are added.
        rows: (h, r), the weights of the rows of knots of the splines.
        columns: (4, w), the weights of the four columns of knots around each pixel.
        pieces: (c + 1,), the pixels between the columns of knots, see `bicubic_pieces`.
        gains: (C, K, 4), the last of which is 0.
        extra: (C, h, w, 4), added to the gradient of T in the reference frame.
        reference: the index of the frame whose motion and gain are fixed.
        every: the distance of the rows that are compared, each of which counts so many times.
        phase: the first of these rows.
        parts: the number of strips of a candidate.
        scatter: (C * parts, L, H * W * 4) of zeros, gets the gradient of `light`.
        touched: (C * parts, L, 2), gets the first row of the canvas with a gradient in `scatter`,
            and the one after the last.
        out: (C * parts, K, 4 + L * (8 + 2 r c)), gets the sum of which the loss is the mean, and
            the gradients of the logarithms of three gains and, for each layer, of homography and
            spline.
    """
    _, layer_count, canvas_height, canvas_width, _ = light.shape
    frame_count, height, width, _ = target.shape
    knot_rows, knot_columns = splines.shape[4:]
    motion_size = 8 + 2 * knot_rows * knot_columns
    scale = _F(0.5 * every / (frame_count * height * width * 3))
    stride = _U(canvas_width * 4)
    corners = np.empty((layer_count, width), np.int32)
    points = np.empty((layer_count, 9, width), np.float32)
    knots = np.empty((2, knot_columns + 3), np.float32)
    total = np.empty(4 * width, np.float32)
    gain = np.empty(4 * width, np.float32)
    samples = np.empty((layer_count, 4 * width), np.float32)
    gradients = np.empty((layer_count, 4 * width), np.float32)
    slopes = np.empty((layer_count, 2, 4 * width), np.float32)
    for item in range(begin, end):
        candidate = item // parts
        part = item % parts
        for layer in range(layer_count):
            touched[item, layer, 0] = canvas_height
            touched[item, layer, 1] = 0
        for k in range(frame_count):
            sums = out[item, k]
            # Loops: to assign to slices, numba would compile the formatting of error messages
            for i in range(len(sums)):
                sums[i] = 0.0
            for x in range(width):
                for c in range(4):
                    gain[4 * x + c] = gains[candidate, k, c]
            for y in range(
                _first(height * part // parts, phase, every), height * (part + 1) // parts, every
            ):
                down = _F((y + 0.5) * 2 / height - 1)
                for layer in range(layer_count):
                    # knots (2, 1 + c + 2) = rows_y (r,) times splines_lk (2, r, c), then the outer
                    # columns are repeated
                    for j in range(knot_columns):
                        for axis in range(2):
                            value = _ZERO
                            for i in range(knot_rows):
                                value += rows[y, i] * splines[candidate, layer, k, axis, i, j]
                            knots[axis, j + 1] = value
                    for axis in range(2):
                        knots[axis, 0] = knots[axis, 1]
                        knots[axis, knot_columns + 1] = knots[axis, knot_columns]
                        knots[axis, knot_columns + 2] = knots[axis, knot_columns]
                    low, high = _row_positions(
                        homographies[candidate, layer, k],
                        down,
                        knots,
                        columns,
                        pieces,
                        canvas_height,
                        canvas_width,
                        corners[layer],
                        points[layer],
                    )
                    touched[item, layer, 0] = min(touched[item, layer, 0], low)
                    touched[item, layer, 1] = max(touched[item, layer, 1], high)
                    _gather(
                        light[candidate, layer].reshape(-1),
                        stride,
                        corners[layer],
                        points[layer],
                        samples[layer],
                        slopes[layer],
                    )
                _compose(samples, total)
                sums[0] += _errors(total, gain, target[k, y].reshape(-1), scale, gradients[0])
                if k != reference:
                    # d loss / d log gain_c = sum over x of total_c * d loss / d total_c
                    for x in range(width):
                        for c in range(3):
                            sums[1 + c] += gradients[0, 4 * x + c] * total[4 * x + c]
                    _share_gradient(samples, gradients)
                    for layer in range(layer_count):
                        first = 4 + layer * motion_size
                        _row_motion(
                            points[layer],
                            slopes[layer],
                            gradients[layer],
                            down,
                            rows[y],
                            columns,
                            pieces,
                            sums[first : first + motion_size],
                        )
                else:
                    _share_gradient(samples, gradients)
                    more = extra[candidate, y].reshape(-1)
                    for x in range(4 * width):
                        gradients[0, x] += _F(every) * more[x]
                for layer in range(layer_count):
                    _scatter(
                        scatter[item, layer],
                        stride,
                        corners[layer],
                        points[layer],
                        gradients[layer],
                    )


@_kernel
def _first(start, phase, stride):
    """Returns the first of the numbers phase, phase + stride and so on from `start` on."""
    return start + (phase - start) % stride


@_kernel
def _compose(samples, total):
    """Writes the light of a row: the sum of the layers, of which the second one hides a share of
    the first one.

    Args:
        samples: (L, 4 w), the light of the layers.
        total: (4 w,), gets the sum.
    """
    # total (4 w,) = samples_0 (1 - min(opacity, 1)) + samples_1; opacity: channel 3 of samples_1
    for x in range(samples.shape[1] // 4):
        visible = _ONE - min(samples[1, 4 * x + 3], _ONE)
        for c in range(4):
            total[4 * x + c] = samples[0, 4 * x + c] * visible + samples[1, 4 * x + c]
    # total (4 w,) += samples_2 + ...
    for layer in range(2, len(samples)):
        for x in range(len(total)):
            total[x] += samples[layer, x]


@_kernel
def _errors(total, gain, goal, scale, gradient):
    """Returns the loss of a row, and writes its gradient with respect to `total`.

    Args:
        total: (4 w,), the light that the model predicts without the gain of the frame.
        gain: (4 w,), that of the frame in each channel; 0 in the fourth.
        goal: (4 w,), the square roots of the light of the frame.
        scale: half the weight of a value in the mean; the other half is from the square root.
        gradient: (4 w,), gets the gradient.
    """
    # With root = sqrt(gain total + OFFSET), error = root - goal and
    # length = sqrt(error^2 + EPSILON^2), all of them (4 w,):
    #   loss = sum of length - EPSILON
    #   d loss / d total = error / length * gain / (2 root), where the half is in `scale`
    # A clipped pixel (goal > _CLIPPED_ROOT) has no error if the model is brighter
    loss = _ZERO
    for x in range(len(total)):
        root = np.sqrt(total[x] * gain[x] + OFFSET)
        error = root - goal[x]
        error = _ZERO if (goal[x] > _CLIPPED_ROOT) & (error > _ZERO) else error
        length = np.sqrt(error * error + _EPSILON_SQUARED)
        gradient[x] = scale * gain[x] * error / (length * root)
        loss += length - _EPSILON
    return loss


@_kernel
def _share_gradient(samples, gradients):
    """The adjoint of `_compose`.

    Args:
        samples: (L, 4 w), the light of the layers.
        gradients: (L, 4 w): at first, gradients[0] is that of the sum; gets those of the layers.
    """
    # d loss / d samples_l (4 w,) = d loss / d total, l > 0
    for layer in range(1, len(samples)):
        for x in range(gradients.shape[1]):
            gradients[layer, x] = gradients[0, x]
    # d loss / d samples_0 = (1 - min(opacity, 1)) d loss / d total
    # d loss / d opacity = -sum over c of samples_0c d loss / d total_c; 0 if opacity >= 1
    for x in range(gradients.shape[1] // 4):
        opacity = samples[1, 4 * x + 3]
        hidden = _ZERO
        for c in range(3):
            hidden += gradients[0, 4 * x + c] * samples[0, 4 * x + c]
            gradients[0, 4 * x + c] *= _ONE - min(opacity, _ONE)
        gradients[1, 4 * x + 3] = -hidden if opacity < _ONE else _ZERO


@_kernel
def _row_positions(
    homography, down, knots, columns, pieces, canvas_height, canvas_width, corner, points
):
    """Computes where a row of a frame samples a canvas, and returns the first row of the canvas and
    the one after the last.

    The rows of `points` are:
        0, 1: the distances to the right of the corner and below it, in pixels.
        2, 3: the pixels of the canvas per unit of motion along x and y, 0 beyond the border.
        4, 5, 6: of the projection, 1 / denominator, x and y.
        7, 8: the offsets of the spline along x and y.

    Args:
        homography: (8,), frame to reference.
        down: the normalised coordinate y of the row.
        knots: (2, c + 3), the knots of the spline in this row along x and y; the outer ones are
            repeated, so that each piece has four.
        columns: (4, w), see `data_term`.
        pieces: (c + 1,), see `data_term`.
        canvas_height: H.
        canvas_width: W.
        corner: (w,), gets the offset in the canvas (H * W * 4,) of the pixel above and to the left.
        points: (9, w), gets the rows above.
    """
    width = len(corner)
    a = points[0]
    b = points[1]
    step_x = points[2]
    step_y = points[3]
    inverse = points[4]
    px = points[5]
    py = points[6]
    offset_x = points[7]
    offset_y = points[8]
    # Offsets (w,) = columns_0 knots_(j) + ... + columns_3 knots_(j + 3) between columns j and j + 1
    for offsets, axis_knots in ((offset_x, knots[0]), (offset_y, knots[1])):
        for j in range(len(pieces) - 1):
            k0 = axis_knots[j]
            k1 = axis_knots[j + 1]
            k2 = axis_knots[j + 2]
            k3 = axis_knots[j + 3]
            w0, w1, w2, w3, piece = _piece(columns, offsets, pieces[j], pieces[j + 1])
            for x in range(len(piece)):
                piece[x] = k0 * w0[x] + k1 * w1[x] + k2 * w2[x] + k3 * w3[x]
    # With across = 2 (x + 1/2) / w - 1 and the homography h (8,), all of them (w,):
    #   inverse = 1 / (h6 across + h7 down + 1)
    #   px = (h0 across + h1 down + h2) inverse
    #   py = (h3 across + h4 down + h5) inverse
    h0 = homography[0]
    h3 = homography[3]
    h6 = homography[6]
    c0 = homography[1] * down + homography[2]
    c1 = homography[4] * down + homography[5]
    c2 = homography[7] * down + _ONE
    pixel = _F(2.0 / width)
    last_x = _F(canvas_width - 1)
    last_y = _F(canvas_height - 1)
    scale_x = _F(canvas_width * 0.5) * _CANVAS
    scale_y = _F(canvas_height * 0.5) * _CANVAS
    middle_x = _F((canvas_width - 1) * 0.5)
    middle_y = _F((canvas_height - 1) * 0.5)
    # Several short loops: LLVM vectorises only those that write to few arrays
    for x in range(width):
        across = (_F(np.int32(x)) + _HALF) * pixel - _ONE
        q = _ONE / max(c2 + h6 * across, MIN_DENOMINATOR)
        inverse[x] = q
        px[x] = (c0 + h0 * across) * q
        py[x] = (c1 + h3 * across) * q
    # In pixels of the canvas (w,), -1 and 1 are the edges of the reference frame:
    #   column = (px + offset_x) _CANVAS W / 2 + (W - 1) / 2
    #   row    = (py + offset_y) _CANVAS H / 2 + (H - 1) / 2
    # clamped to the canvas; step_x = d column / d px, 0 where it is clamped
    for x in range(width):
        value = (px[x] + offset_x[x]) * scale_x + middle_x
        step_x[x] = scale_x if (value > _ZERO) & (value < last_x) else _ZERO
        a[x] = min(max(value, _ZERO), last_x)
    for x in range(width):
        value = (py[x] + offset_y[x]) * scale_y + middle_y
        step_y[x] = scale_y if (value > _ZERO) & (value < last_y) else _ZERO
        b[x] = min(max(value, _ZERO), last_y)
    left_limit = np.int32(canvas_width - 2)
    top_limit = np.int32(canvas_height - 2)
    stride = np.int32(canvas_width * 4)
    # corner (w,) = (top W + left) 4; a and b become the fractions column - left and row - top
    for x in range(width):
        left = min(np.int32(a[x]), left_limit)
        top = min(np.int32(b[x]), top_limit)
        corner[x] = np.int32(np.int32(top * stride) + np.int32(left << np.int32(2)))
        a[x] -= _F(left)
        b[x] -= _F(top)
    # The rows of the canvas that the samples use: from that of the lowest corner to the one below
    # the highest corner
    lowest = corner[0]
    highest = corner[0]
    for x in range(width):
        lowest = min(lowest, corner[x])
        highest = max(highest, corner[x])
    return lowest // stride, highest // stride + 2


@_kernel
def _piece(columns, values, begin, end):
    """Returns the four rows of the weights `columns` (4, w), and the values (w,), of the pixels
    `begin` to `end`.
    """
    return (
        columns[0][begin:end],
        columns[1][begin:end],
        columns[2][begin:end],
        columns[3][begin:end],
        values[begin:end],
    )


@_kernel
def _gather(canvas, stride, corner, points, samples, slopes):
    """Writes bilinear samples of a row, and their derivatives along x and y.

    Args:
        canvas: (H * W * 4,).
        stride: the length of a row of the canvas, W * 4.
        corner: (w,), see `_row_positions`.
        points: (9, w), see `_row_positions`.
        samples: (4 w,), gets the samples.
        slopes: (2, 4 w), gets the derivatives, per pixel of the canvas.
    """
    dx = slopes[0]
    dy = slopes[1]
    # For pixel x, four channels each: p and q are the upper two pixels, r and s those below.
    #   upper = p + a (q - p)
    #   dy    = r + a (s - r) - upper
    #   dx    = (q - p) + b ((s - r) - (q - p))
    #   sample = upper + b dy
    for x in range(len(corner)):
        i = _U(corner[x])
        a = points[0, x]
        b = points[1, x]
        z = _U(x) * _4
        j = i + stride
        p0 = canvas[i]
        p1 = canvas[i + _1]
        p2 = canvas[i + _2]
        p3 = canvas[i + _3]
        q0 = canvas[i + _4]
        q1 = canvas[i + _5]
        q2 = canvas[i + _6]
        q3 = canvas[i + _7]
        r0 = canvas[j]
        r1 = canvas[j + _1]
        r2 = canvas[j + _2]
        r3 = canvas[j + _3]
        s0 = canvas[j + _4]
        s1 = canvas[j + _5]
        s2 = canvas[j + _6]
        s3 = canvas[j + _7]
        u0, u1, u2, u3 = q0 - p0, q1 - p1, q2 - p2, q3 - p3
        v0, v1, v2, v3 = s0 - r0, s1 - r1, s2 - r2, s3 - r3
        p0 = p0 + a * u0
        p1 = p1 + a * u1
        p2 = p2 + a * u2
        p3 = p3 + a * u3
        r0 = r0 + a * v0 - p0
        r1 = r1 + a * v1 - p1
        r2 = r2 + a * v2 - p2
        r3 = r3 + a * v3 - p3
        dy[z], dy[z + _1], dy[z + _2], dy[z + _3] = r0, r1, r2, r3
        u0, u1, u2, u3 = (
            u0 + b * (v0 - u0),
            u1 + b * (v1 - u1),
            u2 + b * (v2 - u2),
            u3 + b * (v3 - u3),
        )
        dx[z], dx[z + _1], dx[z + _2], dx[z + _3] = u0, u1, u2, u3
        p0 = p0 + b * r0
        p1 = p1 + b * r1
        p2 = p2 + b * r2
        p3 = p3 + b * r3
        samples[z], samples[z + _1], samples[z + _2], samples[z + _3] = p0, p1, p2, p3


@_kernel
def _scatter(canvas, stride, corner, points, gradient):
    """The adjoint of `_gather`. What the next pixel of the row adds to the same place stays in
    registers.

    Args:
        canvas: (H * W * 4,), to which the gradient is added.
        stride: the length of a row of the canvas, W * 4.
        corner: (w,), see `_row_positions`.
        points: (9, w), see `_row_positions`.
        gradient: (4 w,), that of the samples.
    """
    # For pixel x with the gradient g, four channels each, the pixels of `_gather` get:
    #   p += (1 - a) (1 - b) g    q += a (1 - b) g
    #   r += (1 - a) b g          s += a b g
    # If the next pixel of the row has its corner one pixel to the right, its p and r are this q and
    # s. These are kept in c (above) and d (below), and added at `waiting` with those of the next
    # pixel, or alone if its corner is elsewhere.
    c0 = _ZERO
    c1 = _ZERO
    c2 = _ZERO
    c3 = _ZERO
    d0 = _ZERO
    d1 = _ZERO
    d2 = _ZERO
    d3 = _ZERO
    waiting = _U(corner[0])
    for x in range(len(corner)):
        i = _U(corner[x])
        a = points[0, x]
        b = points[1, x]
        z = _U(x) * _4
        if i != waiting:
            _add(canvas, waiting, c0, c1, c2, c3)
            _add(canvas, waiting + stride, d0, d1, d2, d3)
            c0 = _ZERO
            c1 = _ZERO
            c2 = _ZERO
            c3 = _ZERO
            d0 = _ZERO
            d1 = _ZERO
            d2 = _ZERO
            d3 = _ZERO
        g0 = gradient[z]
        g1 = gradient[z + _1]
        g2 = gradient[z + _2]
        g3 = gradient[z + _3]
        # l = b g, g = (1 - b) g
        l0 = b * g0
        l1 = b * g1
        l2 = b * g2
        l3 = b * g3
        g0 = g0 - l0
        g1 = g1 - l1
        g2 = g2 - l2
        g3 = g3 - l3
        # What the right pixels get: q = a g above, s = a l below; the left ones get the rest
        q0 = a * g0
        q1 = a * g1
        q2 = a * g2
        q3 = a * g3
        s0 = a * l0
        s1 = a * l1
        s2 = a * l2
        s3 = a * l3
        _add(canvas, i, c0 + g0 - q0, c1 + g1 - q1, c2 + g2 - q2, c3 + g3 - q3)
        _add(canvas, i + stride, d0 + l0 - s0, d1 + l1 - s1, d2 + l2 - s2, d3 + l3 - s3)
        c0 = q0
        c1 = q1
        c2 = q2
        c3 = q3
        d0 = s0
        d1 = s1
        d2 = s2
        d3 = s3
        waiting = i + _4
    _add(canvas, waiting, c0, c1, c2, c3)
    _add(canvas, waiting + stride, d0, d1, d2, d3)


@_kernel
def _add(canvas, i, p0, p1, p2, p3):
    """Adds the four channels of a pixel to those at the offset i of a canvas (H * W * 4,)."""
    canvas[i] += p0
    canvas[i + _1] += p1
    canvas[i + _2] += p2
    canvas[i + _3] += p3


@_kernel
def _row_motion(points, slopes, gradient, down, row, columns, pieces, out):
    """Adds the gradient of a homography and a spline that comes from a row of a frame.

    Args:
        points: (9, w), see `_row_positions`; rows 2 and 3 are overwritten.
        slopes: (2, 4 w), from `_gather`.
        gradient: (4 w,), that of the samples of the layer.
        down: the normalised coordinate y of the row.
        row: (r,), the weights of the rows of knots.
        columns: (4, w), see `data_term`.
        pieces: (c + 1,), see `data_term`.
        out: (8 + 2 r c,), to which the gradient is added.
    """
    width = points.shape[1]
    knot_columns = len(pieces) - 1
    knot_rows = len(row)
    step_x = points[2]
    step_y = points[3]
    inverse = points[4]
    px = points[5]
    py = points[6]
    dx = slopes[0]
    dy = slopes[1]
    # step_x (w,) = d loss / d px = d column / d px * sum over c of dx_c gradient_c; step_y likewise
    for slope, step in ((dx, step_x), (dy, step_y)):
        for x in range(width):
            step[x] *= (
                slope[4 * x] * gradient[4 * x]
                + slope[4 * x + 1] * gradient[4 * x + 1]
                + slope[4 * x + 2] * gradient[4 * x + 2]
                + slope[4 * x + 3] * gradient[4 * x + 3]
            )
    # out (8,), with gx = step_x inverse, gy = step_y inverse, gz = -(gx px + gy py), sums over x:
    #   out_0, out_1, out_2 = sum of gx across, gx down, gx
    #   out_3, out_4, out_5 = sum of gy across, gy down, gy
    #   out_6, out_7        = sum of gz across, gz down
    t0 = _ZERO
    t1 = _ZERO
    t2 = _ZERO
    t3 = _ZERO
    t4 = _ZERO
    t5 = _ZERO
    pixel = _F(2.0 / width)
    for x in range(width):
        across = (_F(np.int32(x)) + _HALF) * pixel - _ONE
        gx = step_x[x] * inverse[x]
        gy = step_y[x] * inverse[x]
        gz = -(gx * px[x] + gy * py[x])
        t0 += gx * across
        t1 += gx
        t2 += gy * across
        t3 += gy
        t4 += gz * across
        t5 += gz
    out[0] += t0
    out[1] += t1 * down
    out[2] += t1
    out[3] += t2
    out[4] += t3 * down
    out[5] += t3
    out[6] += t4
    out[7] += t5 * down
    # out (2, r, c) += row_i (r,) * sum over x of step columns_0..3, at the knots j - 1 to j + 2;
    # those beyond the edges are the outer ones
    for axis, step in ((0, step_x), (1, step_y)):
        for j in range(knot_columns):
            g0 = _ZERO
            g1 = _ZERO
            g2 = _ZERO
            g3 = _ZERO
            w0, w1, w2, w3, piece = _piece(columns, step, pieces[j], pieces[j + 1])
            for x in range(len(piece)):
                g0 += piece[x] * w0[x]
                g1 += piece[x] * w1[x]
                g2 += piece[x] * w2[x]
                g3 += piece[x] * w3[x]
            for knot, g in ((j - 1, g0), (j, g1), (j + 1, g2), (j + 2, g3)):
                column = min(max(knot, 0), knot_columns - 1)
                for i in range(knot_rows):
                    out[8 + (axis * knot_rows + i) * knot_columns + column] += row[i] * g


@_kernel
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
            u = min(max(x[i, j], _ZERO), _F(canvas_width - 1))
            v = min(max(y[i, j], _ZERO), _F(canvas_height - 1))
            left = min(int(u), canvas_width - 2)
            top = min(int(v), canvas_height - 2)
            a = u - _F(left)
            b = v - _F(top)
            opacity = _bilinear(light[candidate, 1], top, left, a, b, 3)
            share = max(_ONE - opacity, _ZERO)
            visible[candidate, i, j] = share
            # T (4,) = samples_0 (1 - opacity) + samples_1 + ... + samples_(L - 2)
            for c in range(3):
                total = share * _bilinear(light[candidate, 0], top, left, a, b, c)
                for layer in range(1, layer_count - 1):
                    total += _bilinear(light[candidate, layer], top, left, a, b, c)
                encoded[candidate, i, j, c] = np.sqrt(total + OFFSET)
            encoded[candidate, i, j, 3] = np.sqrt(OFFSET)


@_kernel
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
        #   length = sqrt(d2 (dx^2 + dy^2) + EPSILON^2)
        #   loss   = weight * sum over rows, columns and channels of length - EPSILON
        #   across = weight d2 dx / length, down = weight d2 dy / length    (4 (W - 1),)
        #   gradient = -across - down + across of the left pixel + down of the pixel above
        weight = weights[layer] / (3 * (height - 1) * (width - 1))
        factor = _F(weight) * squared_density
        above = np.zeros(size + 4, np.float32)
        across = np.zeros(size + 4, np.float32)
        down = np.zeros(size + 4, np.float32)
        total = 0.0
        for y in range(max(first - 1, 0), last):
            here = layers[candidate, layer, y].reshape(-1)
            if y < height - 1:
                below = layers[candidate, layer, y + 1].reshape(-1)
                loss = _ZERO
                for x in range(size):
                    dx = here[x + 4] - here[x]
                    dy = below[x] - here[x]
                    length = np.sqrt(squared_density * (dx * dx + dy * dy) + _EPSILON_SQUARED)
                    loss += length - _EPSILON
                    across[x] = factor * dx / length
                    down[x] = factor * dy / length
                total += loss if y >= first else _ZERO
            else:
                for x in range(size):
                    across[x] = _ZERO
                    down[x] = _ZERO
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


@_kernel
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
                row[4 * x + c] = _QUARTER * (
                    above[left] + above[right] + below[left] + below[right]
                )


@_kernel
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


@_kernel
def _differences(first, second, out, count):
    """Writes the mean absolute differences of the channels of `count` pixels, and returns their
    sum. first and second are (4 w,), out is (w,).
    """
    total = _ZERO
    for x in range(count):
        out[x] = _THIRD * (
            abs(second[4 * x] - first[4 * x])
            + abs(second[4 * x + 1] - first[4 * x + 1])
            + abs(second[4 * x + 2] - first[4 * x + 2])
        )
        total += out[x]
    return total


@_kernel
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
                weight = _F(1 / (6.0 * size))
                total = _ZERO
                for x in range(count):
                    a = _tanh(first[x] * scale0)
                    b = _tanh(second[x] * scale1)
                    total += a * b
                    first[x] = (_ONE - a * a) * b * scale0 * weight
                    second[x] = (_ONE - b * b) * a * scale1 * weight
                loss += total * weight
        losses[item] = loss


@_kernel
def _tanh(x):
    """An approximation for x >= 0, within 1e-4, which is vectorised: the continued fraction of
    Lambert.
    """
    x = min(x, _F(4.97))
    s = x * x
    return (
        x
        * (_F(135135) + s * (_F(17325) + s * (_F(378) + s)))
        / (_F(135135) + s * (_F(62370) + s * (_F(3150) + s * _F(28))))
    )


@_kernel
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
        _spread(across[candidate, layer, y], _F(weight) * _THIRD, beside[4:])
        for x in range(4 * (width - 1)):
            beside[x + 4] *= _sign(here[x + 4] - here[x])
        for x in range(4 * (width - 1)):
            out[x] += beside[x] - beside[x + 4]
        for x in range(4 * (width - 1), 4 * width):
            out[x] += beside[x]
        # The same for the differences to the rows below and above, the strengths of which are
        # `down` of this row and of the row above
        if 0 < y < height - 1:
            _spread(down[candidate, layer, y], _F(weight) * _THIRD, below)
            _spread(down[candidate, layer, y - 1], _F(weight) * _THIRD, above)
            lower = images[candidate, which, y + 1].reshape(-1)
            upper = images[candidate, which, y - 1].reshape(-1)
            for x in range(4 * width):
                out[x] += below[x] * _sign(here[x] - lower[x]) + above[x] * _sign(
                    here[x] - upper[x]
                )
        else:
            other = 1 if y == 0 else y - 1
            lower = images[candidate, which, other].reshape(-1)
            _spread(down[candidate, layer, min(y, other)], _F(weight) * _THIRD, below)
            for x in range(4 * width):
                out[x] += below[x] * _sign(here[x] - lower[x])
        # The adjoint of `halved`: each of four pixels gets a quarter
        if y // 2 < coarse.shape[2]:
            half = coarse[candidate, layer, y // 2].reshape(-1)
            for x in range(len(half) // 4):
                for c in range(4):
                    value = _QUARTER * half[4 * x + c]
                    out[8 * x + c] += value
                    out[8 * x + 4 + c] += value


@_kernel
def _spread(values, factor, out):
    """Writes the values (w,) of pixels, times a factor, to the three channels of out (4 w,), and 0
    to the fourth.
    """
    for x in range(len(values)):
        value = factor * values[x]
        out[4 * x] = value
        out[4 * x + 1] = value
        out[4 * x + 2] = value
        out[4 * x + 3] = _ZERO


@_kernel
def _sign(x):
    """Returns -1, 0 or 1."""
    return _ONE if x > _ZERO else (-_ONE if x < _ZERO else _ZERO)


@_kernel
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
                    g[x] += _TWO * p[x] * found[x]
                    found[x] = _ZERO
        # m = beta1 m + (1 - beta1) g, v = beta2 v + (1 - beta2) g^2, all of them (4 W,)
        # p -= rate m / (correction sqrt(v) + epsilon)
        for x in range(4 * width):
            m[x] = _BETA1 * m[x] + (_ONE - _BETA1) * g[x]
            v[x] = _BETA2 * v[x] + (_ONE - _BETA2) * g[x] * g[x]
            value = p[x] - rate * m[x] / (np.sqrt(v[x]) * correction + _ADAM_EPSILON)
            p[x] = value
            s[x] = value * value
