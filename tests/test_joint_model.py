"""The joint model of a burst: its loss and gradients, which are those of the NumPy reference, and
what does not depend on the machine.
"""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

import joint_model_reference as reference
from brewster.film.motion import threads
from brewster.film.motion.model.joint_model import (
    JointModel,
    bicubic_weights,
    with_fourth_channel,
)
from brewster.film.motion.model.kernels import MARGIN, adam, data_term, edges, rows, sampling
from brewster.film.motion.model.optimiser import Rates, Weights, _Loss, compile_kernels, optimise
from other_processes import finished

WEIGHTS = Weights(common_edges=0.05, prior=0.1)
NO_EDGES = Weights(common_edges=0, prior=0.1)
ONLY_DATA = Weights(common_edges=0, prior=0)


def smooth(rng, *shape):
    """Noise without the finest structure, 0..1."""
    noise = rng.random(shape).astype(np.float32)
    return np.stack([cv2.GaussianBlur(image, (0, 0), 1.5) for image in noise])


def moved_model(rng, candidates=2, layers=2, size=(24, 32), density=1.3):
    """A model with motion, splines and gains, some frames and a prior; its last candidate is
    locked.
    """
    frames = with_fourth_channel(smooth(rng, 3, *size, 3))
    motions = np.tile(np.eye(3), (candidates, layers, 3, 1, 1))
    motions += rng.normal(0, 0.02, motions.shape)
    is_locked = np.arange(candidates) == candidates - 1
    model = JointModel.start(frames, motions, is_locked, 1, density).resized(
        frames, density, (3, 4)
    )
    model.layers[..., :3] += rng.normal(0, 0.05, model.layers[..., :3].shape)
    model.splines[:] = rng.normal(0, 0.02, model.splines.shape)
    model.log_gains[:] = rng.normal(0, 0.1, model.log_gains.shape)
    return model, frames, with_fourth_channel(smooth(rng, 1, *size, 3))[0]


def loss_and_gradients(model, frames, prior, weights=NO_EDGES):
    loss = _Loss(model, frames, prior, weights)
    penalties, data_losses, (homographies, splines, log_gains) = loss.gradients()
    count, layer_count, height, width, _ = model.layers.shape
    scattered = loss._scatter.reshape(count, -1, layer_count, height, width, 4).sum(1)
    layers = loss._gradients[0] + 2 * model.layers * scattered
    found = {
        "layers": layers,
        "homographies": homographies,
        "splines": splines,
        "log_gains": log_gains,
    }
    return penalties + data_losses, found


PARAMETERS = st.sampled_from(["layers", "homographies", "splines", "log_gains"])


# --- against the reference in NumPy


def reference_losses(model, frames, prior, weights, constants=None):
    """(C,): the sum of all terms. See `reference.common_edges` for the constants."""
    return np.array([
        reference.data_term(model, candidate, frames)
        + reference.gradient_lengths(model, candidate, frames.shape[2])
        + weights.common_edges * reference.common_edges(model, candidate, constants or model)
        + weights.prior * reference.prior_term(model, candidate, prior)
        + reference.motion_penalties(model, candidate)
        for candidate in range(len(model.layers))
    ])  # fmt: skip


def opaque_model(rng):
    """Three layers, of which the second one is transparent, half opaque and opaque in places."""
    model, frames, prior = moved_model(rng, layers=3)
    opacity = rng.choice([0.0, 0.5, 1.5], model.layers.shape[2:4])
    opacity = cv2.GaussianBlur(opacity, (0, 0), 2)
    opacity[10:25, 10:30] = 1.5
    model.layers[:, 1, ..., 3] = np.sqrt(opacity)
    return model, frames, prior


def clipped_model(rng):
    """Two layers, and frames of which a part is clipped, where the model is too bright."""
    model, frames, prior = moved_model(rng)
    frames[:, 5:12, 5:20, :3] = 1
    model.layers[:, :, 8:, :, :3] += 0.3
    return model, frames, prior


MODELS = st.sampled_from(
    [
        (moved_model, WEIGHTS),
        (clipped_model, WEIGHTS),
        (
            opaque_model,
            Weights(common_edges=0.05, prior=0),
        ),  # the prior does not change the opacity
    ]
)


@given(seed=st.integers(0, 99), case=MODELS, name=PARAMETERS)
@settings(max_examples=20, deadline=None)
def test_loss_and_gradients_are_those_of_the_reference(seed, case, name):
    make, weights = case
    rng = np.random.default_rng(seed)
    model, frames, prior = make(rng)
    losses, gradients = loss_and_gradients(model, frames, prior, weights)
    assert losses == pytest.approx(reference_losses(model, frames, prior, weights), rel=2e-4)
    gradient = gradients[name]
    values = getattr(model, name).astype(float)
    direction = gradient + rng.normal(0, gradient.std(), gradient.shape) * (gradient != 0)
    step = 1e-5 / np.abs(direction).max()
    ends = [
        reference_losses(
            replace(model, **{name: values + sign * step * direction}),
            frames,
            prior,
            weights,
            constants=model,
        )
        for sign in (-1, 1)
    ]
    expected = (ends[1] - ends[0]) / (2 * step)
    found = (gradient * direction).reshape(len(gradient), -1).sum(1)
    # Differences of losses in 32 bits have an error of a few percent of small gradients
    assert found == pytest.approx(expected, rel=0.03, abs=0.01 * np.abs(expected).max())


def test_the_rows_of_all_phases_together_are_the_whole_data_term():
    model, frames, prior = moved_model(np.random.default_rng(5))
    whole = np.array([reference.data_term(model, candidate, frames) for candidate in range(2)])
    _, expected = loss_and_gradients(model, frames, prior, ONLY_DATA)
    parts = []
    for step in range(3):
        loss = _Loss(model, frames, prior, ONLY_DATA)
        _, data_losses, (homographies, *_) = loss.gradients(3, step)
        parts.append((data_losses, homographies))
    assert np.mean([part[0] for part in parts], 0) == pytest.approx(whole, rel=1e-4)
    mean = np.mean([part[1] for part in parts], 0)
    assert np.abs(mean - expected["homographies"]).max() < 1e-5 * np.abs(mean).max()


def test_layers_positions_and_opacity_of_each_frame_are_those_of_the_reference():
    model, *_ = opaque_model(np.random.default_rng(6))
    size = 24, 32
    for k in range(3):
        expected = reference.layers_of_frame(model, 0, k, size)
        found = model.frame_layers(k, *size)
        assert np.abs(found[0] - reference.transmission(expected)).max() < 1e-5
        assert np.abs(found[1] - expected[-1, ..., :3]).max() < 1e-5
        homographies, splines, _ = reference.fixed(model, 1)
        for layer in range(3):
            places = reference.positions(homographies[layer, k], splines[layer, k], size)
            assert np.abs(model.positions(1, layer, k, *size) - places).max() < 1e-9
    opacity = np.minimum(reference.layers_of_frame(model, 0, 1, size)[1, ..., 3], 1)
    assert np.abs(model.reference_opacity(*size) - opacity).max() < 1e-5


@given(seed=st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_collecting_is_the_adjoint_of_sampling(seed):
    rng = np.random.default_rng(seed)
    canvas = rng.random((9, 11, 4)).astype(np.float32)
    values = rng.random((5, 7)).astype(np.float32)
    x = rng.uniform(0, 9.99, values.shape).astype(np.float32)
    y = rng.uniform(0, 7.99, values.shape).astype(np.float32)
    samples = np.zeros((*values.shape, 4), np.float32)
    sampling.sample(canvas, x, y, samples)
    assert np.abs(samples - reference.bilinear(canvas, x, y)).max() < 1e-5
    collected = np.zeros((*canvas.shape[:2], 2), np.float32)
    sampling.collect(values, x, y, collected)
    for channel in range(4):
        assert (samples[..., channel] * values).sum() == pytest.approx(
            (canvas[..., channel] * collected[..., 0]).sum(), rel=1e-4
        )
    assert collected[..., 1].sum() == pytest.approx(values.size, rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_the_first_images_are_those_of_the_two_darkest_frames_that_show_a_place(seed):
    rng = np.random.default_rng(seed)
    frames = with_fourth_channel(smooth(rng, 4, 20, 26, 3))
    motions = np.tile(np.eye(3), (2, 2, 4, 1, 1))
    motions[:, :, :, :2, 2] += rng.uniform(-0.25, 0.25, (2, 2, 4, 2))
    motions[:, :, 1] = np.eye(3)
    motions[1, 0] = motions[0, 1]
    start = JointModel.start(frames, motions, np.zeros(2, bool), 1, 1.0)
    height, width = start.layers.shape[2:4]
    y, x = np.meshgrid(*(
        ((2 * np.arange(n) + 1) / n - 1) * (1 + 2 * MARGIN) for n in (height, width)
    ), indexing="ij")  # fmt: skip
    for candidate, layer in np.ndindex(2, 2):
        seen = []
        for frame, motion in zip(frames, motions[candidate, layer], strict=True):
            across, down = x - motion[0, 2], y - motion[1, 2]
            light = reference.bilinear(frame, (across + 1) * 13 - 0.5, (down + 1) * 10 - 0.5)
            light[(np.abs(across) > 1) | (np.abs(down) > 1)] = np.inf
            seen.append(light[..., :3])
        first, second = np.sort(seen, 0)[:2]
        is_seen = np.isfinite(first[..., 0])
        both = np.where(np.isfinite(second), (first + second) / 2, first)
        expected = np.maximum(0.9 * both, 1e-4) if layer == 0 else np.maximum(0.3 * first, 4e-3)
        found = np.square(start.layers[candidate, layer, ..., :3])
        assert np.abs(found - expected)[is_seen].max() < 1e-5
        assert np.isfinite(found).all()


@given(
    seed=st.integers(0, 99),
    size=st.tuples(st.integers(2, 30), st.integers(2, 30)),
    small=st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
@settings(max_examples=30, deadline=None)
def test_a_layer_of_a_picture_is_its_light_times_slope_plus_offset(seed, size, small):
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    slope, offset = rng.uniform(-0.5, 1.2, (2, *small, 3)).astype(np.float32)
    linear = np.linspace(0, 1, 256, dtype=np.float32) ** 2
    codes = (255 * np.sqrt(np.arange(4097) / 4096)).astype(np.uint8)
    out = np.empty_like(picture)
    sampling.apply_linear(picture, linear, slope, offset, codes, out)
    large = [
        cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR).reshape(*size, 3)
        for image in (slope, offset)
    ]
    light = (large[0] * linear[picture] + large[1]).clip(0, 1)
    expected = codes[(light * 4096).astype(int)].astype(int)
    near_black = light < 2e-3  # where codes are far apart
    assert np.abs(out - expected)[~near_black].max(initial=0) <= 1


def test_the_compilation_leaves_no_kernel_to_compile():
    for _ in compile_kernels():
        pass
    compiled = versions_of_kernels()
    model, frames, prior = moved_model(np.random.default_rng(1), layers=3)
    optimise(model, frames, prior, 2, rates=Rates(), weights=WEIGHTS, every=2, edges_every=2)
    model.reference_opacity(24, 32)
    assert compiled == versions_of_kernels()
    assert compiled["data_term"] == 1


def versions_of_kernels():
    """How often each kernel was compiled."""
    return {
        name: len(kernel.signatures)
        for module in (adam, data_term, edges, rows, sampling)
        for name, kernel in vars(module).items()
        if hasattr(kernel, "signatures")
    }


# --- by themselves


@given(seed=st.integers(0, 99), name=PARAMETERS, layers=st.integers(2, 3), is_opaque=st.booleans())
@settings(max_examples=20, deadline=None)
def test_the_gradients_are_those_of_finite_differences(seed, name, layers, is_opaque):
    rng = np.random.default_rng(seed)
    model, frames, prior = moved_model(rng, layers=layers)
    if is_opaque:
        model.layers[:, 1, ..., 3] = rng.uniform(0.2, 0.8, model.layers.shape[2:4])
    weights = ONLY_DATA if is_opaque else NO_EDGES  # the prior does not change the opacity
    _, gradients = loss_and_gradients(model, frames, prior, weights)
    direction = gradients[name] / np.linalg.norm(gradients[name])
    losses = []
    values = getattr(model, name).copy()
    for step in (-1, 1):
        getattr(model, name)[:] = values + step * 1e-3 * direction
        losses.append(loss_and_gradients(model, frames, prior, weights)[0])
    expected = (gradients[name] * direction).reshape(len(values), -1).sum(1)
    slope = (losses[1] - losses[0]) / 2e-3
    assert slope == pytest.approx(expected, rel=0.1, abs=0.05 * float(expected.max()))


def common_edges(layers):
    """How much the edges of both layers (C, 2, 4, H, W) coincide at three scales, for the scales as
    constants.
    """
    total = 0
    for _ in range(3):
        for axis in (-1, -2):
            strengths = layers.diff(dim=axis)[:, :, :3].abs().mean(2)
            mean = strengths.detach().mean((2, 3), keepdim=True)
            total = total + torch.tanh(strengths / (2 * mean + 1e-4)).prod(1).mean((1, 2)) / 6
        layers = functional.avg_pool2d(layers.flatten(0, 1), 2).unflatten(0, layers.shape[:2])
    return total


@pytest.mark.parametrize("candidates", [2, 5])
def test_common_edges_cost_what_automatic_differentiation_says(candidates):
    model, frames, prior = moved_model(np.random.default_rng(3), candidates, size=(25, 35))
    layers = torch.from_numpy(model.layers).movedim(-1, 2).requires_grad_()
    cost = WEIGHTS.common_edges * common_edges(layers)
    cost.sum().backward()
    with_edges, without = (
        loss_and_gradients(model, frames, prior, weights) for weights in (WEIGHTS, NO_EDGES)
    )
    assert with_edges[0] - without[0] == pytest.approx(cost.detach().numpy(), rel=1e-3)
    gradient = with_edges[1]["layers"] - without[1]["layers"]
    expected = layers.grad.movedim(2, -1).numpy()
    assert np.abs(gradient - expected).max() < 3e-3 * np.abs(expected).max()


@pytest.mark.parametrize("candidates", [2, 5])
def test_the_number_of_threads_changes_no_bit(monkeypatch, candidates):
    found = []
    for count in (1, 3):
        monkeypatch.setattr(threads, "THREADS", count)
        monkeypatch.setattr(threads, "POOL", ThreadPoolExecutor(count))
        model, frames, prior = moved_model(np.random.default_rng(1), candidates)
        model = optimise(model, frames, prior, 4, rates=Rates(), weights=WEIGHTS)
        found.append(
            (model.layers, model.homographies, model.splines, model.log_gains, model.losses)
        )
    for first, second in zip(*found, strict=True):
        assert np.array_equal(first, second)


@pytest.mark.parametrize(("value", "count"), [("3", 3), ("0", None), ("many", None)])
def test_the_threads_are_those_of_the_environment_or_one_for_each_processor(
    monkeypatch, value, count
):
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert threads._thread_count() == (count or len(os.sched_getaffinity(0)))


def test_edges_that_are_compared_in_every_third_step_have_three_times_the_weight():
    model, frames, prior = moved_model(np.random.default_rng(4))
    penalties = [
        _Loss(model, frames, prior, WEIGHTS).gradients(edge_factor=factor)[0]
        for factor in (0, 1, 3)
    ]
    assert penalties[2] - penalties[0] == pytest.approx(3 * (penalties[1] - penalties[0]))
    assert (penalties[1] > penalties[0]).all()
    ends = [
        optimise(
            model, frames, prior, 3, rates=Rates(0, 0, 0, 0), weights=WEIGHTS, edges_every=every
        )
        for every in (1, 2)
    ]
    assert ends[0].losses == pytest.approx(ends[1].losses)  # the last step compares all


def test_candidates_do_not_influence_each_other():
    model, frames, prior = moved_model(np.random.default_rng(2))
    together = optimise(model, frames, prior, 4, rates=Rates(), weights=WEIGHTS)
    alone = optimise(model.selected([1]), frames, prior, 4, rates=Rates(), weights=WEIGHTS)
    assert alone.losses == pytest.approx(together.losses[1:], rel=1e-6)
    assert np.allclose(alone.layers, together.layers[1:], atol=1e-6)


@given(length=st.integers(2, 40), knots=st.integers(2, 9), slope=st.floats(-3, 3))
def test_splines_keep_constants_and_lines_inside_and_pass_through_their_knots(length, knots, slope):
    weights = bicubic_weights(length, knots)
    assert weights.sum(1) == pytest.approx(1)
    assert weights[[0, -1]] @ (slope * np.arange(knots)) == pytest.approx(
        [0, slope * (knots - 1)], abs=1e-9
    )


def test_the_kernels_run_without_a_folder_for_their_cache():
    code = """
import numpy as np
from brewster.film.motion.model.kernels.sampling import sample
out = np.zeros((1, 1, 4), np.float32)
sample(np.ones((2, 2, 4), np.float32), *np.ones((2, 1, 1), np.float32), out)
print(out.sum())
"""
    variables = {
        "NUMBA_CACHE_DIR": os.devnull,
        "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator",
    }
    done = finished([sys.executable, "-c", code], env=os.environ | variables)
    assert done.stdout == "4.0\n", done.stderr
