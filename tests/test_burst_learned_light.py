"""Smooth light that a network moves between the layers of a burst."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brewster.errors import ModelError
from brewster.film.motion import learned_light
from brewster.film.motion.learned_light import find_light, with_light
from brewster.film.motion.model.joint_model import JointModel
from brewster.film.motion.model.levels import Level
from brewster.film.motion.registration.candidates import motion_candidates
from brewster.film.motion.registration.tracks import layer_tracks
from brewster.film.motion.solver import solve
from brewster.photo.srgb import to_linear
from brewster.separation.models.zoo import FILM_LIGHT
from simulated_bursts import linear_pictures, simulate_burst

HEIGHT, WIDTH = 120, 160


def layers_and_photo(height=HEIGHT, width=WIDTH):
    """T and R, (2, h, w, 3), and their sum."""
    layers = np.stack([0.1 + 0.5 * image for image in linear_pictures((width, height))])
    layers[1] *= 0.4
    return layers.astype(np.float32), layers.sum(0).astype(np.float32)


@pytest.fixture(scope="module")
def model():
    """A model of two layers, each with light of its own."""
    frames = np.full((3, HEIGHT, WIDTH, 4), 0.3, np.float32)
    motions = np.tile(np.eye(3), (1, 2, 3, 1, 1))
    return JointModel.start(frames, motions, np.array([False]), 1, 1.0)


@settings(max_examples=10, deadline=None)
@given(st.floats(-2, 2))
def test_moved_light_keeps_the_sum_and_leaves_no_layer_negative(model, amount):
    moved = np.full((HEIGHT, WIDTH, 3), amount, np.float32)
    before = model.reference_layers(HEIGHT, WIDTH)
    after = with_light(model, moved).reference_layers(HEIGHT, WIDTH)
    np.testing.assert_allclose(after.sum(0), before.sum(0), atol=1e-3)
    assert after.min() >= 0
    wanted = np.clip(amount, -before[0].min(), before[1].min())
    np.testing.assert_allclose(after[0] - before[0], wanted, atol=1e-3)


@pytest.mark.parametrize("shape", [(120, 160), (90, 160), (160, 107), (8, 160)])
def test_the_network_takes_photos_of_all_shapes_and_moves_no_more_light_than_there_is(shape):
    layers, photo = layers_and_photo(*shape)
    moved = find_light(layers, photo, 0.9 * photo)
    assert moved.shape == (*shape, 3)
    assert np.isfinite(moved).all()
    assert (moved <= layers[1].max()).all()
    assert (moved >= -layers[0].max()).all()


def test_the_mirrored_layers_have_the_mirrored_light():
    layers, photo = layers_and_photo(96, 160)  # without margins, whose sides differ
    moved = find_light(layers, photo, 0.9 * photo)
    mirrored = find_light(layers[:, :, ::-1], photo[:, ::-1], 0.9 * photo[:, ::-1])
    np.testing.assert_allclose(mirrored[:, ::-1], moved, atol=0.015)


def test_light_of_large_areas_that_is_in_the_wrong_layer_moves_back():
    layers, photo = layers_and_photo()
    x = np.linspace(0, 1, WIDTH)[None, :, None]
    wrong = (0.8 * layers[1].mean() * np.exp(-(((x - 0.5) / 0.2) ** 2))).astype(np.float32)
    wrong = np.minimum(wrong, layers[1])
    measured = np.stack([layers[0] + wrong, layers[1] - wrong])
    change = find_light(measured, photo, layers[0]) - find_light(layers, photo, layers[0])
    assert (change * wrong).sum() < 0


def test_a_damaged_network_is_reported(tmp_path, monkeypatch):
    damaged = tmp_path / "film-light.onnx"
    damaged.write_bytes(FILM_LIGHT.path.read_bytes()[:-1])
    monkeypatch.setattr(learned_light, "FILM_LIGHT", replace(FILM_LIGHT, path=damaged))
    learned_light._network.cache_clear()
    layers, photo = layers_and_photo()
    with pytest.raises(ModelError, match="SHA-256"):
        find_light(layers, photo, photo)


def test_the_solver_moves_light_once_between_layers_of_the_size_of_the_network():
    burst = simulate_burst(*linear_pictures((190, 145)), relative_px=16, size=(160, 120))
    frames = [to_linear(frame / 255).astype(np.float32) for frame in burst.frames]
    candidates = motion_candidates(frames, 2, layer_tracks(frames, 2, frames[2] / 2))
    calls = []

    def find(layers, frame, prior):
        calls.append((layers.shape, frame.shape, prior.shape))
        return np.full(frame.shape, 0.05, np.float32)

    levels = (Level(160, 15, None), Level(160, 10, None), Level(166, 1, None))
    plain, moved = (
        solve(frames, 2, frames[2] / 2, candidates, levels=levels, find_light=each)
        for each in (None, find)
    )
    assert calls == [((2, 120, 160, 3), (120, 160, 3), (120, 160, 3))]
    assert moved.measured[0].mean() > plain.measured[0].mean() + 0.01
    assert moved.measured[1].mean() < plain.measured[1].mean() - 0.01
