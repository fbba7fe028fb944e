"""White stays white: small changes of clipped pixels are removed, and all other predictions are kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster import Separator
from brewster.inference.clipping import keep_clipped_white
from brewster.inference.predictor import Prediction
from brewster.photo import Photo
from brewster.srgb import to_linear


def predict(photo_level, transmission_level):
    """A prediction for a uniform photo; the levels are sRGB-encoded, in 0..1."""
    photo, transmission = (
        to_linear(np.full((2, 3, 3), level, np.float32)) for level in (photo_level, transmission_level)
    )
    confidence = np.ones((2, 3, 1), np.float32)
    return photo, Prediction(transmission - photo, photo - transmission, confidence)


@pytest.mark.parametrize(
    ("photo_level", "transmission_level", "is_kept"),
    [(1.0, 0.85, True), (0.985, 0.9, True), (1.0, 0.7, False), (0.84, 0.78, False), (0.5, 0.1, False)],
)
def test_only_small_changes_of_clipped_pixels_are_removed(photo_level, transmission_level, is_kept):
    photo, prediction = predict(photo_level, transmission_level)
    kept = keep_clipped_white(photo, prediction)
    for layer in ("change", "reflection"):
        expected = np.zeros_like(photo) if is_kept else getattr(prediction, layer)
        np.testing.assert_allclose(getattr(kept, layer), expected, atol=1e-6)


def test_a_coloured_pixel_with_one_clipped_channel_is_not_white():
    photo, prediction = predict(1.0, 0.95)
    photo[..., 2] = 0.5
    np.testing.assert_array_equal(keep_clipped_white(photo, prediction).change, prediction.change)


@given(st.floats(0, 1), st.floats(0, 1))
def test_a_change_is_never_enlarged_or_inverted(photo_level, transmission_level):
    photo, prediction = predict(photo_level, transmission_level)
    kept = keep_clipped_white(photo, prediction)
    assert (np.abs(kept.change) <= np.abs(prediction.change) + 1e-7).all()
    assert (kept.change * prediction.change >= 0).all()
    np.testing.assert_allclose(kept.change + kept.reflection, 0, atol=1e-6)


def test_a_separator_keeps_white_and_separates_the_rest():
    pixels = np.full((64, 64, 3), 255, np.uint8)
    pixels[32:] = 120
    separation = Separator(lambda tile: (0.8 * tile, 0.2 * tile), name="pane")(
        Photo.from_array(pixels, encoding="srgb")
    )
    assert (separation.transmission.pixels[:24] == 255).all()
    assert (separation.reflection.pixels[:24] == 0).all()
    assert (separation.transmission.pixels[40:] < 112).all()
