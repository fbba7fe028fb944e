"""Photos are downscaled to a shorter side, and their sides are rounded down to multiples as Pillow resizes."""

import numpy as np
import pytest
from PIL import Image

from brewster import Photo
from brewster.evaluate.config import EvaluationConfig
from brewster.evaluate.scoring import resize

MULTIPLES = EvaluationConfig(size_divisor=32)


@pytest.mark.parametrize("size", [(540, 400), (95, 70), (33, 64), (127, 31)])
def test_the_result_is_that_of_pillow(rng, size):
    pixels = rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    width, height = (max(side // 32 * 32, min(side, 32)) for side in size)
    expected = np.asarray(Image.fromarray(pixels).resize((width, height)))
    ours = resize(Photo.from_array(pixels, encoding="srgb"), MULTIPLES).srgb_8bit()
    assert ours.shape == expected.shape
    # Pillow computes with integer weights, so values that lie between two integers can differ.
    assert abs(ours.astype(int) - expected).max() <= 1
    assert (ours != expected).mean() < 0.001


def test_a_photo_with_such_sides_is_not_changed():
    photo = Photo.from_array(np.zeros((64, 96, 3), np.uint8), encoding="srgb")
    assert resize(photo, MULTIPLES) is photo
    assert resize(photo, EvaluationConfig()) is photo


def test_a_photo_is_first_downscaled_and_then_rounded():
    photo = Photo.from_array(np.zeros((500, 700, 3), np.uint8), encoding="srgb")
    assert resize(photo, EvaluationConfig(short_side_px=420, size_divisor=32)).size == (576, 416)


@pytest.mark.parametrize(
    ("size", "small"), [((60, 40), (30, 20)), ((40, 60), (20, 30)), ((50, 18), (50, 18))]
)
def test_a_photo_is_downscaled_to_the_shorter_side_and_never_enlarged(size, small):
    photo = Photo.from_array(np.zeros((*size[::-1], 3), np.uint8), encoding="srgb")
    assert resize(photo, EvaluationConfig(short_side_px=20)).size == small
