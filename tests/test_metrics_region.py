"""The reflection region, its threshold and border; and harm to bright light, which is bright in
photo and truth.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster import metrics


def make_pair(side=20):
    return np.full((2, side, side, 3), 100, np.uint8)


def test_equal_images_have_no_reflection():
    photo, truth = make_pair()
    assert not metrics.reflection_region(photo, truth).any()
    assert not metrics.reflection_region(photo, truth, threshold=0).any()


def test_brighter_and_darker_pixels_are_both_marked():
    photo, truth = make_pair()
    photo[:, :10, 1] += np.uint8(40)
    region = metrics.reflection_region(photo, truth)
    assert region.dtype == np.bool_
    assert region[:, :9].all()
    assert not region[:, 13:].any()
    assert (metrics.reflection_region(truth, photo) == region).all()


def test_the_difference_is_the_mean_over_seven_by_seven_pixels_of_the_largest_channel():
    photo, truth = make_pair()
    photo[10, 10] += np.array([49, 7, 0], np.uint8)  # one unit each in the mean of 49 pixels
    marked = metrics.reflection_region(photo, truth, threshold=0.99 / 255)
    assert marked[7:14, 7:14].all()
    assert marked.sum() == 49
    assert not metrics.reflection_region(photo, truth, threshold=1 / 255).any()


def test_edge_pixels_are_repeated_beyond_the_border():
    photo, truth = make_pair()
    photo[0, 0] += np.uint8(49)  # counts 16 times in the window of the corner
    marked = metrics.reflection_region(photo, truth, threshold=15.9 / 255)
    assert np.argwhere(marked).tolist() == [[0, 0]]
    assert not metrics.reflection_region(photo, truth, threshold=16.1 / 255).any()


def test_a_higher_threshold_marks_fewer_pixels(rng):
    photo, truth = rng.integers(0, 256, (2, 30, 30, 3), np.uint8)
    shares = [
        metrics.reflection_region(photo, truth, threshold=t).mean()
        for t in (0, metrics.DEFAULT_THRESHOLD, 0.5, 1)
    ]
    assert shares == sorted(shares, reverse=True)
    assert (shares[0], shares[-1]) == (1, 0)


@pytest.mark.parametrize("difference", [1, 100, 255])
def test_the_threshold_is_a_share_of_the_range_of_eight_bits(difference):
    truth = np.zeros((20, 20, 3), np.uint8)
    photo = truth + np.uint8(difference)
    for share, is_marked in ((0.999, True), (1.0, False)):
        region = metrics.reflection_region(photo, truth, threshold=share * difference / 255)
        assert (region == is_marked).all()


def test_an_image_may_be_smaller_than_the_window():
    assert metrics.reflection_region(
        np.full((1, 2, 3), 255, np.uint8), np.zeros((1, 2, 3), np.uint8)
    ).all()


@pytest.mark.parametrize("threshold", [-0.1, 1.1, float("nan")])
def test_a_threshold_outside_0_to_1_is_refused(threshold):
    with pytest.raises(ValueError, match="threshold"):
        metrics.reflection_region(*make_pair(), threshold=threshold)


SCORES = (metrics.lost_clipped, metrics.lost_near_white, metrics.near_white_cast)


def image(*rows):
    """Rows of colours, each repeated to 16 pixels in 8 rows."""
    return np.repeat(np.repeat(np.array(rows, np.uint8)[:, None], 16, axis=1), 8, axis=0)


def test_a_lamp_that_turns_olive_loses_its_two_clipped_channels():
    photo = image((253, 254, 178), (255, 255, 255))
    assert metrics.lost_clipped(image((163, 169, 118), (255, 255, 255)), photo, photo) == 2 / 5


def test_a_removed_reflection_costs_nothing():
    photo = image((255, 255, 255), (255, 255, 255))
    truth = image((90, 90, 90), (255, 255, 255))
    assert [score(truth, truth, photo) for score in SCORES] == [0, 0, 0]


def test_white_that_turns_warm_and_darker_has_a_loss_and_a_cast():
    photo = image((230, 230, 230), (90, 90, 90))
    prediction = image((225, 220, 215), (0, 0, 0))
    assert metrics.lost_near_white(prediction, photo, photo) == 10
    assert metrics.near_white_cast(prediction, photo, photo) == 10


@given(st.integers(0, 255), st.integers(0, 2**32 - 1))
def test_darker_predictions_never_have_a_better_score(dimming, seed):
    random = np.random.default_rng(seed)
    photo, truth = random.integers(190, 256, (2, 40, 40, 3), np.uint8)
    photo[:8, :8] = 255
    truth[:8, :8] = 255
    prediction = random.integers(0, 256, photo.shape, np.uint8)
    darker = np.maximum(prediction, dimming) - np.uint8(dimming)
    for score in (metrics.lost_clipped, metrics.lost_near_white):
        assert score(darker, truth, photo) >= score(prediction, truth, photo)
    assert metrics.near_white_cast(prediction, truth, photo) >= 0


@pytest.mark.parametrize("score", SCORES)
def test_a_score_without_bright_pixels_is_undefined(score):
    dark = image((90, 90, 90))
    with pytest.raises(ValueError, match="at least 64"):
        score(dark, dark, dark)
    with pytest.raises(ValueError, match="differ in shape"):
        score(dark, dark, dark[1:])
