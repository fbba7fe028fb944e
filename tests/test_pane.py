"""Where the glass of a photo ends."""

import cv2
import numpy as np
import pytest

from brewster.film.motion.pane import without_glass
from simulated_bursts import linear_pictures

SIZE = 160, 120
X, Y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))


@pytest.fixture(scope="module")
def layers():
    behind, mirrored = linear_pictures(SIZE)
    return np.stack([0.6 * behind, 0.4 * mirrored]).astype(np.float32)


def with_pane(layers, is_glass, haze=0.008):
    """The layers with glass in a part of the photo, beyond which R is smooth light that the
    measurement left there.
    """
    share = cv2.GaussianBlur(is_glass.astype(np.float32), (0, 0), 0.7)[..., None]
    return np.stack([layers[0], share * layers[1] + (1 - share) * haze])


@pytest.mark.parametrize("is_glass", [
    X < 70,
    X + 0.1 * Y > 60,
    Y > 50,
    (X > 50) & (Y - 0.1 * X < 80),
])  # fmt: skip
def test_what_lies_beyond_the_border_of_the_glass_is_found_on_any_side(layers, is_glass):
    outside = without_glass(with_pane(layers, is_glass))[..., 0]
    assert outside[cv2.erode((~is_glass).astype(np.uint8), np.ones((15, 15))) > 0].mean() > 0.9
    assert outside[is_glass].max() < 0.5


def test_a_pane_that_fills_the_photo_has_no_border(layers):
    assert not without_glass(layers).any()
    black = layers * np.array([1, 0])[:, None, None, None].astype(np.float32)
    assert not without_glass(black).any()


def test_a_mirrored_scene_without_detail_in_a_part_has_no_straight_border(layers):
    """As a house below a sky: its outline is no line."""
    outline = 60 + 14 * np.sin(X / 9)
    assert not without_glass(with_pane(layers, outline < Y, haze=0.3)).any()


@pytest.mark.parametrize("size", [(8, 160), (300, 20), (97, 131)])
def test_small_and_narrow_photos_are_looked_at(size):
    rng = np.random.default_rng(0)
    light = rng.uniform(0.1, 0.4, (2, *size, 3)).astype(np.float32)
    assert without_glass(light).shape == (*size, 1)
