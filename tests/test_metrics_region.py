"""The reflection region: its definition, its threshold and its border."""

import numpy as np
import pytest

from brewster.metrics import DEFAULT_THRESHOLD, reflection_region


def make_pair(side=20):
    return np.full((2, side, side, 3), 100, np.uint8)


def test_equal_images_have_no_reflection():
    photo, truth = make_pair()
    assert not reflection_region(photo, truth).any()
    assert not reflection_region(photo, truth, threshold=0).any()


def test_brighter_and_darker_pixels_are_both_marked():
    photo, truth = make_pair()
    photo[:, :10, 1] += np.uint8(40)
    region = reflection_region(photo, truth)
    assert region.dtype == np.bool_
    assert region[:, :9].all()
    assert not region[:, 13:].any()
    assert (reflection_region(truth, photo) == region).all()


def test_the_difference_is_the_mean_over_seven_by_seven_pixels_of_the_largest_channel():
    photo, truth = make_pair()
    photo[10, 10] += np.array([49, 7, 0], np.uint8)  # one unit each in the mean of 49 pixels
    marked = reflection_region(photo, truth, threshold=0.99 / 255)
    assert marked[7:14, 7:14].all()
    assert marked.sum() == 49
    assert not reflection_region(photo, truth, threshold=1 / 255).any()


def test_edge_pixels_are_repeated_beyond_the_border():
    photo, truth = make_pair()
    photo[0, 0] += np.uint8(49)  # counts 16 times in the window of the corner
    marked = reflection_region(photo, truth, threshold=15.9 / 255)
    assert np.argwhere(marked).tolist() == [[0, 0]]
    assert not reflection_region(photo, truth, threshold=16.1 / 255).any()


def test_a_higher_threshold_marks_fewer_pixels(rng):
    photo, truth = rng.integers(0, 256, (2, 30, 30, 3), np.uint8)
    shares = [reflection_region(photo, truth, threshold=t).mean() for t in (0, DEFAULT_THRESHOLD, 0.5, 1)]
    assert shares == sorted(shares, reverse=True)
    assert (shares[0], shares[-1]) == (1, 0)


def test_an_image_may_be_smaller_than_the_window():
    assert reflection_region(np.full((1, 2, 3), 255, np.uint8), np.zeros((1, 2, 3), np.uint8)).all()


@pytest.mark.parametrize("threshold", [-0.1, 1.1, float("nan")])
def test_a_threshold_outside_0_to_1_is_refused(threshold):
    with pytest.raises(ValueError, match="threshold"):
        reflection_region(*make_pair(), threshold=threshold)
