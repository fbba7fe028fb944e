"""How a photo is shown to a network: the input scales of each quality, mirrored copies, mean and confidence."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo, Separator
from brewster.inference import QUALITIES
from brewster.inference.predictor import MultiScalePredictor, confidence_from_spread
from brewster.srgb import to_linear

EXPLANATION = Path(__file__).parents[1] / "docs" / "explanation.md"


def shown(quality, height=1000, width=1000):
    """Pixels of every copy that the backend is shown, in order."""
    sizes = []

    def backend(tile):
        sizes.append(tile.shape[0] * tile.shape[1])
        return tile, np.zeros_like(tile)

    photo = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    Separator(backend)(Photo.from_array(photo, encoding="srgb"), quality=quality)
    return sizes


@pytest.mark.parametrize("quality", QUALITIES)
def test_every_input_scale_that_is_listed_is_shown_as_it_is_and_mirrored(quality):
    expected = [pixels for pixels in QUALITIES[quality] for _ in range(2)]
    assert shown(quality) == pytest.approx(expected, rel=0.01)


def test_each_quality_shows_more_than_the_one_below():
    levels = [(len(scales), sum(scales)) for scales in QUALITIES.values()]
    for (few, little), (many, much) in itertools.pairwise(levels):
        assert many >= few
        assert (many, much) > (few, little)


def test_input_scales_rise_and_none_is_listed_twice():
    for scales in QUALITIES.values():
        assert list(scales) == sorted(set(scales))


def test_the_documents_name_the_input_scales_of_every_quality_in_megapixels():
    text = " ".join(EXPLANATION.read_text().split())
    for quality, scales in QUALITIES.items():
        (named,) = re.findall(rf"([^()]*?)(?: megapixels)? \(`{quality}`\)", text)[:1]
        assert [float(number) for number in re.findall(r"0\.\d+", named)] == [s / 1e6 for s in scales]


def test_a_copy_is_never_larger_than_the_photo_and_each_size_is_shown_once():
    assert shown("best", 100, 150) == [100 * 150] * 2


@pytest.mark.parametrize("size", [(12_000, 1500), (1500, 12_000), (40_000, 400)])
def test_a_long_thin_photo_is_shown_larger_so_that_its_short_side_is_160_px_at_least(size):
    """Yet no side of a copy is more than three times as long as that of a photo of ordinary shape."""
    (pixels,) = QUALITIES["draft"]
    ((width, height),) = MultiScalePredictor(lambda tile: (tile, tile)).input_sizes(size, "draft")
    assert width / height == pytest.approx(size[0] / size[1], rel=0.05)
    largest = 9 * pixels
    assert min(width, height) == 160 or width * height == pytest.approx(largest, rel=0.05)


def test_the_answer_is_the_mean_over_all_copies():
    """The transmission's change is proportional to the copy's height: the mean is that of the heights."""
    photo = np.full((900, 1200, 3), 0.5, np.float32)
    heights = [
        height
        for _, height in MultiScalePredictor(lambda tile: (tile, tile)).input_sizes((1200, 900), "best")
    ]

    def backend(tile):
        return tile - np.float32(1e-4 * tile.shape[0]), np.zeros_like(tile)

    result = Separator(backend)(Photo.from_array(photo, encoding="linear"), quality="best")
    change = result.transmission.linear() - 0.5
    np.testing.assert_allclose(change, -1e-4 * np.mean(heights), atol=1e-3)


def test_confidence_falls_to_one_eth_where_the_worst_channel_is_apart_by_a_twentieth():
    apart = np.float32([[[0.05, 0, 0], [0, 0.1, 0.05], [0.05, 0.05, 0.05], [0, 0, 0]]])
    expected = [[[math.exp(-1)], [math.exp(-2)], [math.exp(-1)], [1]]]
    np.testing.assert_allclose(confidence_from_spread(apart), expected, rtol=1e-5)


def test_disagreement_about_one_colour_lowers_confidence_as_much_as_about_all():
    def disagrees(channels):
        def backend(tile):
            answer = tile.copy()
            half = tile.shape[1] // 2
            answer[:, :half, channels] = to_linear(np.float32(0.45))
            return answer, np.zeros_like(tile)

        return backend

    grey = Photo.from_array(to_linear(np.full((64, 64, 3), 0.5, np.float32)), encoding="linear")
    red, every = (
        Separator(disagrees(channels))(grey).confidence.pixels for channels in (slice(0, 1), slice(0, 3))
    )
    assert every.mean() == pytest.approx(255 / math.e, rel=0.1)
    np.testing.assert_allclose(red, every, atol=1)
