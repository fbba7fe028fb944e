"""Objects in front of the wall: what hides the wall belongs to the transmission, and what only adds
light does not.
"""

import cv2
import numpy as np
import pytest

from brewster.film.motion.model.joint_model import JointModel, with_fourth_channel
from brewster.film.motion.model.levels import LEVELS
from brewster.film.motion.model.optimiser import Rates, optimise
from brewster.film.motion.objects import with_objects

STILL = Rates(homographies=0, splines=0, log_gains=0)


def texture(seed, height=120, width=180):
    noise = np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return (0.4 + 0.25 * (smooth - smooth.mean()) / smooth.std()).clip(0.02, 0.9)


def moved(layer, x, y=0.0):
    return cv2.warpAffine(
        np.float32(layer), np.float32([[1, 0, -20 - x], [0, 1, -15 - y]]), (120, 90)
    )


def fitted(opacity, added=(0, 0, 0, 0, 0)):
    """The model of a disc that moves over a wall, with the true motions; T, the frames, the mask of
    the disc.
    """
    wall = texture(1)
    paint = texture(2) * (1.2, 0.6, 0.3)
    y, x = np.mgrid[:120, :180]
    disc = (np.hypot(x - 80, y - 60) < 25).astype(np.float32)[..., None]
    shifts = np.array([-8.0, -4.0, 0.0, 4.0, 8.0])
    frames = []
    truth = None
    for shift, reflection in zip(shifts, added, strict=True):
        mask = moved(disc, shift)[..., None]
        front = moved((paint * disc).astype(np.float32), shift)
        behind = moved(wall, 0) * (1 - opacity * mask)
        truth = behind + opacity * front if shift == 0 else truth
        frames.append((behind + front + reflection).clip(0, 1).astype(np.float32))
    padded = with_fourth_channel(np.stack(frames))
    motions = np.tile(np.eye(3), (1, 2, 5, 1, 1))
    motions[0, 1, :, 0, 2] = shifts * 2 / 120
    start = JointModel.start(padded, motions, np.array([False]), 2, 1.0)
    model = optimise(start, padded, padded[2], 120, rates=STILL, weights=LEVELS[0].weights)
    return model, padded, truth, moved(disc, 0) > 0.5


def objects_of(model, frames, motions=()):
    additive, found = with_objects(
        model, frames, frames[2], motions, density=1.0, rates=STILL, weights=LEVELS[0].weights
    )
    assert additive.layers.shape == model.layers.shape
    assert not np.array_equal(additive.layers, model.layers)  # it had as many steps
    return found


@pytest.mark.parametrize("is_front", [False, True])
def test_an_opaque_object_belongs_to_the_transmission_whichever_layer_it_is_in(is_front):
    model, frames, truth, disc = fitted(1)
    found, without_reflection = objects_of(model.exchanged() if is_front else model, frames)
    transmission, reflection = found.reference_layers(90, 120)
    inside = cv2.erode(disc.astype(np.uint8), np.ones((5, 5))) > 0
    assert reflection[inside].mean() < 0.1 * transmission[inside].mean()
    assert np.abs(transmission - truth)[inside].mean() < 0.03
    assert found.data_losses[0] > 0.7 * without_reflection  # there is none to be found


def test_a_reflection_with_a_third_motion_is_found_in_front_of_an_object():
    paint = texture(3) * (0.1, 0.2, 0.4)
    path = np.array([[8, -8], [-8, -8], [0, 0], [8, 8], [-8, 8.0]])
    model, frames, truth, _ = fitted(1, added=[moved(paint, *offset) for offset in path])
    motion = np.tile(np.eye(3), (5, 1, 1))
    motion[:, :2, 2] = path * 2 / (120, 90)
    found, without_reflection = objects_of(model, frames, [motion])
    transmission, reflection = found.reference_layers(90, 120)
    assert found.data_losses[0] < 0.5 * without_reflection
    inner = np.s_[10:-10, 10:-10]
    assert np.corrcoef(reflection[inner].ravel(), moved(paint, 0)[inner].ravel())[0, 1] > 0.8
    assert np.abs(transmission - truth)[inner].mean() < 0.05


def test_added_light_is_no_object_and_a_model_without_a_dominant_second_layer_has_none():
    model, frames, *_ = fitted(0)
    assert objects_of(model, frames) is None
    model.layers[:, 1] *= 0.1
    assert objects_of(model, frames) is None
