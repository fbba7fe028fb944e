"""Smooth light that one layer of a burst has in place of the other one."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brewster.film.motion.model.joint_model import JointModel, with_fourth_channel
from brewster.film.motion.smooth_light import with_moved_light
from simulated_bursts import linear_pictures

SHIFTS_PX = np.array([-6.0, -3.0, 0.0, 3.0, 6.0])
HEIGHT, WIDTH = 120, 160


def smooth_field(seed):
    """A field of -1 to 1 that changes over a fifth of the width."""
    points = np.random.default_rng(seed).uniform(-1, 1, (5, 6, 3)).astype(np.float32)
    return cv2.resize(points, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(-1, 1)


def true_model(shifts_px=SHIFTS_PX):
    """A wall that does not move, with a reflection that moves by these distances: the frames, and
    a model that explains them.
    """
    wall, mirrored = linear_pictures((240, 180))
    layers = np.stack([0.1 + 0.5 * wall, 0.05 + 0.3 * mirrored]).astype(np.float32)
    frames = np.zeros((len(shifts_px), HEIGHT, WIDTH, 4), np.float32)
    motions = np.tile(np.eye(3), (1, 2, len(shifts_px), 1, 1))
    motions[0, 1, :, 0, 2] = shifts_px * 2 / WIDTH
    start = JointModel.start(frames, motions, np.array([False]), len(shifts_px) // 2, 1.0)
    height, width = start.layers.shape[2:4]
    canvases = np.stack([cv2.resize(layer, (width, height)) for layer in layers])
    model = replace(start, layers=np.sqrt(with_fourth_channel(canvases))[None])
    sums = [model.frame_layers(k, HEIGHT, WIDTH).sum(0) for k in range(len(shifts_px))]
    return with_fourth_channel(np.stack(sums)), model


def with_exchanged_light(model, field):
    """The model after 0.04 times the field moved from R to T."""
    height, width = model.layers.shape[2:4]
    light = np.square(model.layers)
    moved = 0.04 * cv2.resize(field, (width, height), interpolation=cv2.INTER_CUBIC)
    light[0, 0, ..., :3] += moved
    light[0, 1, ..., :3] -= moved
    return replace(model, layers=np.sqrt(light.clip(0)))


def smooth_error(model, true):
    """The mean error of the smooth light of T in the reference frame."""
    difference = model.reference_layers(HEIGHT, WIDTH)[0] - true.reference_layers(HEIGHT, WIDTH)[0]
    return float(np.abs(cv2.GaussianBlur(difference, (0, 0), 5)).mean())


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000))
def test_smooth_light_returns_to_the_layer_with_whose_motion_it_moves(seed):
    frames, true = true_model()
    wrong = with_exchanged_light(true, smooth_field(seed))
    mended = with_moved_light(wrong, frames)
    assert smooth_error(mended, true) < 0.8 * smooth_error(wrong, true)
    again = with_moved_light(mended, frames)
    assert smooth_error(again, true) < smooth_error(mended, true)


def test_layers_that_explain_the_frames_stay():
    frames, true = true_model()
    assert smooth_error(with_moved_light(true, frames), true) < 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_the_sum_of_the_layers_stays_and_no_light_is_negative(seed):
    frames, true = true_model()
    wrong = with_exchanged_light(true, 1.5 * smooth_field(seed))
    moved = with_moved_light(wrong, frames)
    assert not np.allclose(moved.layers, wrong.layers, atol=1e-3)
    assert np.isfinite(moved.layers).all()
    sums = [np.square(model.layers).sum(1) for model in (wrong, moved)]
    assert np.allclose(*sums, atol=1e-5)


def test_no_light_moves_between_layers_that_move_together():
    frames, true = true_model(np.zeros(5))
    wrong = with_exchanged_light(true, smooth_field(1))
    assert np.allclose(with_moved_light(wrong, 0.9 * frames).layers, wrong.layers, atol=1e-6)


def test_frames_that_no_light_explains_move_none():
    frames, true = true_model()
    rng = np.random.default_rng(4)
    blocks = rng.uniform(0, 1, (len(frames), HEIGHT // 8, WIDTH // 8, 4)).astype(np.float32)
    other = np.stack([cv2.resize(block, (WIDTH, HEIGHT)) for block in blocks])
    assert with_moved_light(true, other) is None


def test_clipped_pixels_do_not_move_light():
    frames, true = true_model()
    wrong = with_exchanged_light(true, smooth_field(2))
    white = np.ones_like(frames)
    assert np.allclose(with_moved_light(wrong, white).layers, wrong.layers, atol=1e-6)
