"""The joint model of a burst in NumPy, in double precision: what the kernels must compute.

A model has the arrays of `JointModel`: of C candidates, L layers and K frames of (h, w) pixels.
The loss of a candidate is the sum of the terms below.
"""

import numpy as np

from brewster.film.motion.model.kernels import CHARBONNIER, CLIPPED, MARGIN, MIN_DENOMINATOR, OFFSET

EPSILON = float(CHARBONNIER)
GRADIENTS = 0.03, 0.05, 0.05
RIGIDITY = 1.0, 2.0, 2.0
CURVATURE = 5.0
GAIN_PENALTY = 0.5


def fixed(model, candidate):
    """Homographies (L, K, 8), splines (L, K, 2, r, c) and gains (K, 3) that hold."""
    homographies = model.homographies[candidate].copy()
    splines = model.splines[candidate].copy()
    gains = np.exp(model.log_gains[candidate])
    if model.is_locked[candidate]:
        homographies[-1] = homographies[0]
        splines[-1] = splines[0]
    homographies[:, model.reference] = 1, 0, 0, 0, 1, 0, 0, 0
    splines[:, model.reference] = 0
    gains[model.reference] = 1
    return homographies, splines, gains


def positions(h, spline, size):
    """The coordinates (2, h, w) in the reference frame of the pixels of a frame; h: (8,)."""
    y, x = np.meshgrid(*((2 * np.arange(n) + 1) / n - 1 for n in size), indexing="ij")
    denominator = np.maximum(h[6] * x + h[7] * y + 1, MIN_DENOMINATOR)
    projected = np.stack([h[0] * x + h[1] * y + h[2], h[3] * x + h[4] * y + h[5]]) / denominator
    rows, columns = (cubic_weights(*each) for each in zip(size, spline.shape[1:], strict=True))
    return projected + np.einsum("yi,aij,xj->ayx", rows, spline, columns)


def cubic_weights(length, knots):
    """(length, knots): cubic convolution (Keys 1981), parameter -0.75; outer knots repeated."""
    weights = np.zeros((length, knots))
    for pixel in range(length):
        place = pixel * (knots - 1) / (length - 1)
        for knot in range(int(place) - 1, int(place) + 3):
            d = abs(place - knot)
            near = 1.25 * d**3 - 2.25 * d**2 + 1
            far = -0.75 * (d**3 - 5 * d**2 + 8 * d - 4)
            weights[pixel, min(max(knot, 0), knots - 1)] += near if d <= 1 else far
    return weights


def bilinear(canvas, x, y):
    """Samples (h, w, 4) of a canvas (H, W, 4) at pixels x and y (h, w). The border is repeated."""
    x, y = (np.clip(each, 0, n - 1) for each, n in zip((x, y), canvas.shape[1::-1], strict=True))
    left = np.minimum(x.astype(int), canvas.shape[1] - 2)
    top = np.minimum(y.astype(int), canvas.shape[0] - 2)
    a, b = (x - left)[..., None], (y - top)[..., None]
    upper = (1 - a) * canvas[top, left] + a * canvas[top, left + 1]
    lower = (1 - a) * canvas[top + 1, left] + a * canvas[top + 1, left + 1]
    return (1 - b) * upper + b * lower


def layers_of_frame(model, candidate, frame, size):
    """The light (L, h, w, 4) at the places that a frame shows. Canvases are larger by `MARGIN`."""
    homographies, splines, _ = fixed(model, candidate)
    samples = []
    for root, h, spline in zip(model.layers[candidate], homographies, splines, strict=True):
        x, y = positions(h[frame], spline[frame], size) / (1 + 2 * MARGIN)
        height, width, _ = root.shape
        x, y = (x + 1) * width / 2 - 0.5, (y + 1) * height / 2 - 0.5
        samples.append(bilinear(root.astype(float) ** 2, x, y))
    return np.stack(samples)


def transmission(samples):
    """(h, w, 3): the first layer where the second one does not hide it, and all but the last."""
    visible = 1 - np.minimum(samples[1, ..., 3:], 1)
    return samples[0, ..., :3] * visible + samples[1:-1, ..., :3].sum(0)


def data_term(model, candidate, frames):
    """The mean over all values of the Charbonnier function of the difference of square roots of
    light, which is 0 where a frame is clipped and the model is brighter. frames: (K, h, w, 4).
    """
    gains = fixed(model, candidate)[2]
    losses = []
    for k, frame in enumerate(frames[..., :3].astype(float)):
        samples = layers_of_frame(model, candidate, k, frame.shape[:2])
        total = transmission(samples) + samples[-1, ..., :3]
        error = np.sqrt(gains[k] * total + OFFSET) - np.sqrt(frame + OFFSET)
        error[(frame > CLIPPED) & (error > 0)] = 0
        losses.append((np.hypot(error, EPSILON) - EPSILON).mean())
    return np.mean(losses)


def gradient_lengths(model, candidate, width):
    """The total variation of the roots of light, per pixel of frames with this width."""
    loss = 0.0
    for root, weight in zip(model.layers[candidate].astype(float), GRADIENTS, strict=False):
        density = root.shape[1] / (width * (1 + 2 * MARGIN))
        across = np.diff(root, axis=1)[:-1] * density
        down = np.diff(root, axis=0)[:, :-1] * density
        lengths = np.sqrt(across**2 + down**2 + EPSILON**2) - EPSILON
        loss += weight * lengths.sum(-1).mean() / 3
    return loss


def edge_strengths(layers):
    """The mean absolute differences along y and x of two layers (2, H, W, 3), at three scales."""
    strengths = []
    for _ in range(3):
        strengths += [np.abs(np.diff(layers, axis=axis)).mean(-1) for axis in (1, 2)]
        height, width = (length // 2 for length in layers.shape[1:3])
        even = layers[:, : 2 * height, : 2 * width]
        layers = even.reshape(2, height, 2, width, 2, 3).mean((2, 4))
    return strengths


def common_edges(model, candidate, constants):
    """The mean product of tanh(strength / (2 mean strength)) of both layers (Zhang et al. 2018).
    The means are those of the model `constants`: the gradient does not depend on them.
    """
    ends = (each.layers[candidate][[0, -1], ..., :3].astype(float) for each in (model, constants))
    products = []
    for strengths, others in zip(*map(edge_strengths, ends), strict=True):
        means = others.mean((1, 2), keepdims=True)
        products.append(np.tanh(strengths / (2 * means + 1e-4)).prod(0).mean())
    return np.mean(products)


def prior_term(model, candidate, prior):
    """The mean difference of T and the prior, as roots of light, in boxes of each second pixel."""
    own = transmission(layers_of_frame(model, candidate, model.reference, prior.shape[:2]))
    low = []
    for light in (own, prior[..., :3].astype(float)):
        padded = np.pad(np.sqrt(light[::2, ::2] + OFFSET), ((2, 2), (2, 2), (0, 0)))
        boxes = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), (0, 1))
        low.append(boxes.mean((-1, -2))[::2, ::2])
    return np.abs(low[0] - low[1]).mean()


def motion_penalties(model, candidate):
    """The squares of splines, of their second differences, and of the logarithms of gains."""
    loss = GAIN_PENALTY * (model.log_gains[candidate] ** 2).mean()
    for spline, weight in zip(model.splines[candidate], RIGIDITY, strict=False):
        bends = sum((np.diff(spline, 2, axis) ** 2).mean() for axis in (-1, -2))
        loss += weight * ((spline**2).mean() + CURVATURE * bends)
    return loss
