"""The joint model of a burst: the gradients of its loss, and what does not depend on the
machine.
"""

import os
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from brewster.burst import threads
from brewster.burst.joint_model import JointModel, bicubic_weights, with_fourth_channel
from brewster.burst.optimiser import Rates, Weights, _Loss, optimise
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
from brewster.burst.kernels import sample
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
