"""The data term: how the sum of the moved layers differs from the frames, and its gradients."""

from typing import Final

import numpy as np

from brewster.film.motion.model.kernels import CHARBONNIER, CLIPPED, OFFSET
from brewster.film.motion.model.kernels.compiled import ONE, ZERO, F, U, kernel
from brewster.film.motion.model.kernels.rows import (
    add_row_motion,
    gather,
    row_positions,
    scatter_back,
)

_CLIPPED_ROOT: Final = F(np.sqrt(CLIPPED + OFFSET))
_SQUARED: Final = CHARBONNIER * CHARBONNIER


@kernel
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

        place_l   = project(homographies_lk, x) + spline_lk(x)       row_positions
        s_l       = light_l at place_l, bilinear                     gather
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
    scale = F(0.5 * every / (frame_count * height * width * 3))
    stride = U(canvas_width * 4)
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
                down = F((y + 0.5) * 2 / height - 1)
                for layer in range(layer_count):
                    # knots (2, 1 + c + 2) = rows_y (r,) times splines_lk (2, r, c), then the outer
                    # columns are repeated
                    for j in range(knot_columns):
                        for axis in range(2):
                            value = ZERO
                            for i in range(knot_rows):
                                value += rows[y, i] * splines[candidate, layer, k, axis, i, j]
                            knots[axis, j + 1] = value
                    for axis in range(2):
                        knots[axis, 0] = knots[axis, 1]
                        knots[axis, knot_columns + 1] = knots[axis, knot_columns]
                        knots[axis, knot_columns + 2] = knots[axis, knot_columns]
                    low, high = row_positions(
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
                    gather(
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
                        add_row_motion(
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
                        gradients[0, x] += F(every) * more[x]
                for layer in range(layer_count):
                    scatter_back(
                        scatter[item, layer],
                        stride,
                        corners[layer],
                        points[layer],
                        gradients[layer],
                    )


@kernel
def _first(start, phase, stride):
    """Returns the first of the numbers phase, phase + stride and so on from `start` on."""
    return start + (phase - start) % stride


@kernel
def _compose(samples, total):
    """Writes the light of a row: the sum of the layers, of which the second one hides a share of
    the first one.

    Args:
        samples: (L, 4 w), the light of the layers.
        total: (4 w,), gets the sum.
    """
    # total (4 w,) = samples_0 (1 - min(opacity, 1)) + samples_1; opacity: channel 3 of samples_1
    for x in range(samples.shape[1] // 4):
        visible = ONE - min(samples[1, 4 * x + 3], ONE)
        for c in range(4):
            total[4 * x + c] = samples[0, 4 * x + c] * visible + samples[1, 4 * x + c]
    # total (4 w,) += samples_2 + ...
    for layer in range(2, len(samples)):
        for x in range(len(total)):
            total[x] += samples[layer, x]


@kernel
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
    # length = sqrt(error^2 + CHARBONNIER^2), all of them (4 w,):
    #   loss = sum of length - CHARBONNIER
    #   d loss / d total = error / length * gain / (2 root), where the half is in `scale`
    # A clipped pixel (goal > _CLIPPED_ROOT) has no error if the model is brighter
    loss = ZERO
    for x in range(len(total)):
        root = np.sqrt(total[x] * gain[x] + OFFSET)
        error = root - goal[x]
        error = ZERO if (goal[x] > _CLIPPED_ROOT) & (error > ZERO) else error
        length = np.sqrt(error * error + _SQUARED)
        gradient[x] = scale * gain[x] * error / (length * root)
        loss += length - CHARBONNIER
    return loss


@kernel
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
        hidden = ZERO
        for c in range(3):
            hidden += gradients[0, 4 * x + c] * samples[0, 4 * x + c]
            gradients[0, 4 * x + c] *= ONE - min(opacity, ONE)
        gradients[1, 4 * x + 3] = -hidden if opacity < ONE else ZERO
