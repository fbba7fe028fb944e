"""Multi-scale prediction: input scales of each quality, flips, mean and confidence."""

import math

import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.separation import QUALITIES
from brewster.separation.predictor import MultiScalePredictor, confidence_from_spread


def input_pixels(quality, height=1000, width=1000):
    """Returns the pixels of every input of the backend, in order."""
    sizes = []

    def backend(tile):
        sizes.append(tile.shape[0] * tile.shape[1])
        return tile, np.zeros_like(tile)

    photo = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    Separator(backend)(Photo.from_array(photo, encoding="srgb"), quality=quality)
    return sizes


@pytest.mark.parametrize("quality", QUALITIES)
def test_every_listed_input_scale_is_used_with_and_without_flip(quality):
    expected = [pixels for pixels in QUALITIES[quality] for _ in range(2)]
    assert input_pixels(quality) == pytest.approx(expected, rel=0.01)


def test_an_input_is_never_larger_than_the_photo_and_each_size_is_used_once():
    assert input_pixels("standard", 100, 150) == [100 * 150] * 2


@pytest.mark.parametrize("size", [(12_000, 1500), (1500, 12_000), (40_000, 400)])
def test_inputs_of_a_long_thin_photo_are_larger_so_that_the_short_side_is_at_least_160_px(size):
    """The sides are at most three times as long as without this rule."""
    (pixels,) = QUALITIES["draft"]
    ((width, height),) = MultiScalePredictor(lambda tile: (tile, tile)).input_sizes(size, "draft")
    assert width / height == pytest.approx(size[0] / size[1], rel=0.05)
    largest = 9 * pixels
    assert min(width, height) == 160 or width * height == pytest.approx(largest, rel=0.05)


def test_the_prediction_is_the_mean_over_all_inputs():
    """The predicted change is proportional to the height of the input, so its mean is that of the
    mean height.
    """
    photo = np.full((900, 1200, 3), 0.5, np.float32)
    predictor = MultiScalePredictor(lambda tile: (tile, tile))
    heights = [height for _, height in predictor.input_sizes((1200, 900), "standard")]

    def backend(tile):
        return tile - np.float32(1e-4 * tile.shape[0]), np.zeros_like(tile)

    result = Separator(backend)(Photo.from_array(photo, encoding="linear"))
    change = result.transmission.linear() - 0.5
    np.testing.assert_allclose(change, -1e-4 * np.mean(heights), atol=1e-3)


def test_a_single_output_has_no_confidence_and_two_equal_ones_have_all():
    """Of a large network, draft is one run without a flip."""
    photo = Photo.from_array(np.full((60, 80, 3), 0.5, np.float32), encoding="linear")
    predictor = MultiScalePredictor(lambda tile: (0.5 * tile, 0.5 * tile), scales=(1200,))
    confidences = {
        quality: Separator(predictor).fit(photo, quality=quality)[1].confidence_map
        for quality in QUALITIES
    }
    assert (confidences["draft"] == 0).all()
    np.testing.assert_allclose(confidences["standard"], 1, atol=1e-4)


def test_the_confidence_is_1_e_where_the_largest_spread_of_the_channels_is_0_05():
    spread = np.float32([[[0.05, 0, 0], [0, 0.1, 0.05], [0.05, 0.05, 0.05], [0, 0, 0]]])
    expected = [[[math.exp(-1)], [math.exp(-2)], [math.exp(-1)], [1]]]
    np.testing.assert_allclose(confidence_from_spread(spread), expected, rtol=1e-5)
