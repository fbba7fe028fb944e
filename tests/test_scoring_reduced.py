"""Photos are downscaled to a given shorter side."""

import numpy as np
import pytest

from brewster import Photo
from brewster.evaluate.resizing import downscale


@pytest.mark.parametrize(
    ("size", "small"), [((60, 40), (30, 20)), ((40, 60), (20, 30)), ((50, 18), (50, 18))]
)
def test_a_photo_is_downscaled_to_the_shorter_side_and_never_enlarged(size, small):
    width, height = size
    photo = Photo.from_array(np.zeros((height, width, 3), np.uint8), encoding="srgb")
    assert downscale(photo, 20).size == small
    assert downscale(photo, None) is photo
