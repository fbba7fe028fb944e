"""Harm to bright light: only what is bright in the photo and in the truth counts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster.metrics import lost_clipped, lost_near_white, near_white_cast

SCORES = (lost_clipped, lost_near_white, near_white_cast)


def image(*rows):
    """Rows of colours, each repeated to 16 pixels in 8 rows."""
    return np.repeat(np.repeat(np.array(rows, np.uint8)[:, None], 16, axis=1), 8, axis=0)


def test_a_lamp_that_turns_olive_loses_its_two_clipped_channels():
    photo = image((253, 254, 178), (255, 255, 255))
    assert lost_clipped(image((163, 169, 118), (255, 255, 255)), photo, photo) == 2 / 5


def test_a_removed_reflection_costs_nothing():
    photo, truth = image((255, 255, 255), (255, 255, 255)), image((90, 90, 90), (255, 255, 255))
    assert [score(truth, truth, photo) for score in SCORES] == [0, 0, 0]


def test_white_that_turns_warm_and_darker_has_a_loss_and_a_cast():
    photo = image((230, 230, 230), (90, 90, 90))
    prediction = image((225, 220, 215), (0, 0, 0))
    assert lost_near_white(prediction, photo, photo) == 10
    assert near_white_cast(prediction, photo, photo) == 10


@given(st.integers(0, 255), st.integers(0, 2**32 - 1))
def test_darker_predictions_never_have_a_better_score(dimming, seed):
    random = np.random.default_rng(seed)
    photo, truth = random.integers(190, 256, (2, 40, 40, 3), np.uint8)
    photo[:8, :8], truth[:8, :8] = 255, 255
    prediction = random.integers(0, 256, photo.shape, np.uint8)
    darker = np.maximum(prediction, dimming) - np.uint8(dimming)
    for score in (lost_clipped, lost_near_white):
        assert score(darker, truth, photo) >= score(prediction, truth, photo)
    assert near_white_cast(prediction, truth, photo) >= 0


@pytest.mark.parametrize("score", SCORES)
def test_a_score_without_bright_pixels_is_undefined(score):
    dark = image((90, 90, 90))
    with pytest.raises(ValueError, match="at least 64"):
        score(dark, dark, dark)
    with pytest.raises(ValueError, match="differ in shape"):
        score(dark, dark, dark[1:])
