"""A row of a frame in a layer: where it samples the canvas, the samples, and both adjoints."""

from typing import Final

import numpy as np

from brewster.film.motion.model.kernels import MARGIN, MIN_DENOMINATOR
from brewster.film.motion.model.kernels.compiled import HALF, ONE, ZERO, F, U, kernel

_1, _2, _3, _4, _5, _6, _7 = (U(value) for value in range(1, 8))
_CANVAS: Final = F(1 / (1 + 2 * MARGIN))


@kernel
def row_positions(
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
    c2 = homography[7] * down + ONE
    pixel = F(2.0 / width)
    last_x = F(canvas_width - 1)
    last_y = F(canvas_height - 1)
    scale_x = F(canvas_width * 0.5) * _CANVAS
    scale_y = F(canvas_height * 0.5) * _CANVAS
    middle_x = F((canvas_width - 1) * 0.5)
    middle_y = F((canvas_height - 1) * 0.5)
    # Several short loops: LLVM vectorises only those that write to few arrays
    for x in range(width):
        across = (F(np.int32(x)) + HALF) * pixel - ONE
        q = ONE / max(c2 + h6 * across, MIN_DENOMINATOR)
        inverse[x] = q
        px[x] = (c0 + h0 * across) * q
        py[x] = (c1 + h3 * across) * q
    # In pixels of the canvas (w,), -1 and 1 are the edges of the reference frame:
    #   column = (px + offset_x) _CANVAS W / 2 + (W - 1) / 2
    #   row    = (py + offset_y) _CANVAS H / 2 + (H - 1) / 2
    # clamped to the canvas; step_x = d column / d px, 0 where it is clamped
    for x in range(width):
        value = (px[x] + offset_x[x]) * scale_x + middle_x
        step_x[x] = scale_x if (value > ZERO) & (value < last_x) else ZERO
        a[x] = min(max(value, ZERO), last_x)
    for x in range(width):
        value = (py[x] + offset_y[x]) * scale_y + middle_y
        step_y[x] = scale_y if (value > ZERO) & (value < last_y) else ZERO
        b[x] = min(max(value, ZERO), last_y)
    left_limit = np.int32(canvas_width - 2)
    top_limit = np.int32(canvas_height - 2)
    stride = np.int32(canvas_width * 4)
    # corner (w,) = (top W + left) 4; a and b become the fractions column - left and row - top
    for x in range(width):
        left = min(np.int32(a[x]), left_limit)
        top = min(np.int32(b[x]), top_limit)
        corner[x] = np.int32(np.int32(top * stride) + np.int32(left << np.int32(2)))
        a[x] -= F(left)
        b[x] -= F(top)
    # The rows of the canvas that the samples use: from that of the lowest corner to the one below
    # the highest corner
    lowest = corner[0]
    highest = corner[0]
    for x in range(width):
        lowest = min(lowest, corner[x])
        highest = max(highest, corner[x])
    return lowest // stride, highest // stride + 2


@kernel
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


@kernel
def gather(canvas, stride, corner, points, samples, slopes):
    """Writes bilinear samples of a row, and their derivatives along x and y.

    Args:
        canvas: (H * W * 4,).
        stride: the length of a row of the canvas, W * 4.
        corner: (w,), see `row_positions`.
        points: (9, w), see `row_positions`.
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
        i = U(corner[x])
        a = points[0, x]
        b = points[1, x]
        z = U(x) * _4
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


@kernel
def scatter_back(canvas, stride, corner, points, gradient):
    """The adjoint of `gather`. What the next pixel of the row adds to the same place stays in
    registers.

    Args:
        canvas: (H * W * 4,), to which the gradient is added.
        stride: the length of a row of the canvas, W * 4.
        corner: (w,), see `row_positions`.
        points: (9, w), see `row_positions`.
        gradient: (4 w,), that of the samples.
    """
    # For pixel x with the gradient g, four channels each, the pixels of `gather` get:
    #   p += (1 - a) (1 - b) g    q += a (1 - b) g
    #   r += (1 - a) b g          s += a b g
    # If the next pixel of the row has its corner one pixel to the right, its p and r are this q and
    # s. These are kept in c (above) and d (below), and added at `waiting` with those of the next
    # pixel, or alone if its corner is elsewhere.
    c0 = ZERO
    c1 = ZERO
    c2 = ZERO
    c3 = ZERO
    d0 = ZERO
    d1 = ZERO
    d2 = ZERO
    d3 = ZERO
    waiting = U(corner[0])
    for x in range(len(corner)):
        i = U(corner[x])
        a = points[0, x]
        b = points[1, x]
        z = U(x) * _4
        if i != waiting:
            _add(canvas, waiting, c0, c1, c2, c3)
            _add(canvas, waiting + stride, d0, d1, d2, d3)
            c0 = ZERO
            c1 = ZERO
            c2 = ZERO
            c3 = ZERO
            d0 = ZERO
            d1 = ZERO
            d2 = ZERO
            d3 = ZERO
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


@kernel
def _add(canvas, i, p0, p1, p2, p3):
    """Adds the four channels of a pixel to those at the offset i of a canvas (H * W * 4,)."""
    canvas[i] += p0
    canvas[i + _1] += p1
    canvas[i + _2] += p2
    canvas[i + _3] += p3


@kernel
def add_row_motion(points, slopes, gradient, down, row, columns, pieces, out):
    """Adds the gradient of a homography and a spline that comes from a row of a frame.

    Args:
        points: (9, w), see `row_positions`; rows 2 and 3 are overwritten.
        slopes: (2, 4 w), from `gather`.
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
    t0 = ZERO
    t1 = ZERO
    t2 = ZERO
    t3 = ZERO
    t4 = ZERO
    t5 = ZERO
    pixel = F(2.0 / width)
    for x in range(width):
        across = (F(np.int32(x)) + HALF) * pixel - ONE
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
            g0 = ZERO
            g1 = ZERO
            g2 = ZERO
            g3 = ZERO
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
