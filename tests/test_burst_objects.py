"""Objects in front of the wall: what hides the wall is given back to the transmission, and what only adds light is not."""

import cv2
import numpy as np
import pytest

from brewster.burst.joint_model import JointModel, with_fourth_channel
from brewster.burst.objects import with_objects
from brewster.burst.optimiser import Rates, optimise
from brewster.burst.solver import LEVELS

STILL = Rates(homographies=0, splines=0, log_gains=0)


def texture(seed, height=120, width=180):
    noise = np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return (0.4 + 0.25 * (smooth - smooth.mean()) / smooth.std()).clip(0.02, 0.9)


def moved(layer, shift):
    return cv2.warpAffine(layer, np.float32([[1, 0, -20 - shift], [0, 1, -15]]), (120, 90))


def fitted(opacity):
    """The two-layer model of a disc that moves over a wall, with the true motions; and T, the frames, and the mask of the disc."""
    wall, paint = texture(1), texture(2) * (1.2, 0.6, 0.3)
    y, x = np.mgrid[:120, :180]
    disc = (np.hypot(x - 80, y - 60) < 25).astype(np.float32)[..., None]
    shifts = np.array([-8.0, -4.0, 0.0, 4.0, 8.0])
    frames, truth = [], None
    for shift in shifts:
        mask, front = moved(disc, shift)[..., None], moved((paint * disc).astype(np.float32), shift)
        behind = moved(wall, 0) * (1 - opacity * mask)
        truth = behind + opacity * front if shift == 0 else truth
        frames.append((behind + front).clip(0, 1))
    padded = with_fourth_channel(np.stack(frames))
    motions = np.tile(np.eye(3), (1, 2, 5, 1, 1))
    motions[0, 1, :, 0, 2] = shifts * 2 / 120
    start = JointModel.start(padded, motions, np.array([False]), 2, 1.0)
    model = optimise(start, padded, padded[2], 120, rates=STILL, weights=LEVELS[0].weights)
    return model, padded, truth, moved(disc, 0) > 0.5


@pytest.mark.parametrize("opacity", [0, 1])
def test_an_opaque_object_is_transmission_and_added_light_is_reflection(opacity):
    model, frames, truth, disc = fitted(opacity)
    found = with_objects(model, frames, frames[2], rates=STILL, weights=LEVELS[0].weights)
    transmission, reflection = found.reference_layers(90, 120)
    inside = cv2.erode(disc.astype(np.uint8), np.ones((5, 5))) > 0
    if opacity:
        assert reflection[inside].mean() < 0.1 * transmission[inside].mean()
        assert np.abs(transmission - truth)[inside].mean() < 0.03
        assert found.object_share(90, 120) > 0.6
    else:
        assert found is model
        assert found.object_share(90, 120) == 0


def test_a_model_without_a_dominant_second_layer_stays_as_it_is():
    model, frames, *_ = fitted(0)
    model.layers[:, 1] *= 0.1
    assert with_objects(model, frames, frames[2], rates=STILL, weights=LEVELS[0].weights) is model
